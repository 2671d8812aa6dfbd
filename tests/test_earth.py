"""The Earth: ellipsoid, local level frame, gravitation and its gradient."""

import jax
import jax.numpy as jnp
import numpy as np
from oracles import sins

from jaxnav.compiling import compiled
from jaxnav.navigation import earth
from jaxnav.units import DEG

RADIUS = 6.371e6
A = earth.WGS84.semi_major
B = A * (1 - earth.WGS84.flattening)
# Latitude, longitude [deg] and height [m]: ordinary points, both poles, the antimeridian.
PLACES = np.array(
    [
        [42.0, -82.0, 200.0],
        [39.98, 116.34, -400.0],
        [0.0, 0.0, 0.0],
        [90.0, 12.0, 0.0],
        [-90.0, -170.0, 1e6],
        [-33.0, 180.0, 0.0],
        [12.0, -180.0, 1e6],
    ]
) * [DEG, DEG, 1.0]

ecef = compiled(jax.vmap(earth.ecef_from_geodetic))
enu = compiled(jax.vmap(earth.enu_from_geodetic))
gravity = compiled(jax.vmap(earth.gravity_launch_inertial, (0, None)))


def positions():
    """Return positions in the launch-inertial frame from the ground to 1000 km."""
    rng = np.random.default_rng(1)
    return rng.uniform([-5e5, -4e2, -5e5], [5e5, 1e6, 5e5], (50, 3))


def test_earth_fixed_position_of_a_published_point():
    expected = [660675.2518247, -4700948.683162, 4245737.662222]
    np.testing.assert_allclose(ecef(PLACES)[0], expected, rtol=0, atol=1e-6)


def test_height_is_along_the_normal_of_the_ellipsoid():
    ground = PLACES * [1.0, 1.0, 0.0]
    p, foot = np.asarray(ecef(PLACES)), np.asarray(ecef(ground))
    np.testing.assert_allclose(np.sum((foot / [A, A, B]) ** 2, axis=1), 1, rtol=1e-14)
    normal = foot / np.array([A, A, B]) ** 2
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    np.testing.assert_allclose(p - foot, PLACES[:, 2:] * normal, rtol=0, atol=3e-9)
    C = np.asarray(compiled(jax.vmap(earth.dcm_ne))(*PLACES[:, :2].T))
    np.testing.assert_allclose(C[:, 2], normal, rtol=0, atol=1e-15)
    np.testing.assert_allclose(
        C @ C.transpose(0, 2, 1), np.eye(3)[None] + 0 * C, rtol=0, atol=1e-15
    )
    np.testing.assert_allclose(np.linalg.det(C), 1, rtol=1e-15)


def test_meridian_radius_at_the_equator_and_the_pole():
    np.testing.assert_allclose(earth.meridian_radius(0.0), B**2 / A, rtol=1e-15)
    np.testing.assert_allclose(earth.meridian_radius(np.pi / 2), A**2 / B, rtol=1e-15)


def test_small_offsets_are_east_north_up():
    @compiled
    @jax.vmap
    def derivative(origin):
        return jax.jacfwd(earth.enu_from_geodetic)(origin, origin)

    latitude, height = PLACES[:, 0], PLACES[:, 2]
    normal = A / np.sqrt(1 - earth.WGS84.eccentricity2 * np.sin(latitude) ** 2)
    expected = np.zeros((len(PLACES), 3, 3))
    expected[:, 0, 1] = (normal + height) * np.cos(latitude)
    expected[:, 1, 0] = earth.meridian_radius(jnp.asarray(latitude)) + height
    expected[:, 2, 2] = 1
    np.testing.assert_allclose(derivative(PLACES), expected, rtol=1e-14, atol=2e-9)
    above = PLACES + np.array([0.0, 0.0, 150.0])
    np.testing.assert_allclose(
        enu(above, PLACES), [[0.0, 0.0, 150.0]] * len(PLACES), rtol=0, atol=3e-9
    )


def test_longitude_has_no_seam():
    west, east = np.array([[0.2, -np.pi, 10.0]]), np.array([[0.2, np.pi, 10.0]])
    np.testing.assert_allclose(enu(west, east), 0, rtol=0, atol=3e-9)


def test_gravitation_points_to_the_centre_with_the_inverse_square():
    g = gravity(positions(), RADIUS)
    np.testing.assert_allclose(g, [sins.gravity(r, RADIUS) for r in positions()], rtol=1e-14)
    at_launch = gravity(np.zeros((1, 3)), RADIUS)[0]
    np.testing.assert_allclose(at_launch, [0, -sins.GM / RADIUS**2, 0], rtol=1e-15)


def test_gravity_gradient_is_the_derivative_and_has_no_trace():
    @compiled
    @jax.vmap
    def gradients(r):
        automatic = jax.jacfwd(earth.gravity_launch_inertial)(r, RADIUS)
        return earth.gravity_gradient_launch_inertial(r, RADIUS), automatic

    F, automatic = map(np.asarray, gradients(np.append(positions(), np.zeros((1, 3)), axis=0)))
    scale = np.abs(F).max()
    np.testing.assert_allclose(F, automatic, rtol=0, atol=1e-14 * scale)
    np.testing.assert_allclose(F, F.transpose(0, 2, 1), rtol=0, atol=1e-15 * scale)
    np.testing.assert_allclose(np.trace(F, axis1=1, axis2=2), 0, rtol=0, atol=1e-14 * scale)
    at_launch = sins.GM / RADIUS**3 * np.diag([-1.0, 2.0, -1.0])
    np.testing.assert_allclose(F[-1], at_launch, rtol=1e-14)


def test_normal_gravity_of_the_ellipsoid_and_above_it():
    g = compiled(jax.vmap(earth.normal_gravity))
    at_sea = g(np.array([0.0, 0.5, -0.5]) * np.pi, np.zeros(3))
    np.testing.assert_allclose(at_sea, [9.7803253359, 9.8321849378, 9.8321849378], rtol=1e-11)
    latitude = np.array([0.0, 45.0, 90.0]) * DEG
    slope = np.asarray(g(latitude, np.full(3, 50.0)) - g(latitude, np.full(3, -50.0))) / 100
    # From the equator to the pole, with the free-air gradient of geodesy in the middle.
    np.testing.assert_allclose(slope, [-3.0877e-6, -3.0855e-6, -3.0834e-6], rtol=0, atol=2e-10)
    # At 100 km over the equator what the oblate field says, but for the third order: 4 h^3 / a^3.
    r = A + 1e5
    exact = earth.GM / r**2 * (1 + 1.5 * 1.08263e-3 * (A / r) ** 2) - earth.WGS84.rate**2 * r
    np.testing.assert_allclose(g(np.zeros(1), np.full(1, 1e5)), exact, rtol=3e-5)


def test_frame_rates_are_those_of_its_turning_axes():
    places, velocity = PLACES[[0, 1, 5, 6]], np.array([250.0, -120.0, 30.0])

    @compiled
    @jax.vmap
    def rates(p):
        metres = earth.metres_per_radian(p)
        ecef_slope = jax.jacfwd(earth.ecef_from_geodetic)(p)
        moved = velocity[np.array([1, 0, 2])] / metres

        def axes(t):
            return earth.dcm_ne(p[0] + t * moved[0], p[1] + t * moved[1])

        C, slope = jax.jvp(axes, (0.0,), (1.0,))
        turned = earth.transport_rate(p, jnp.asarray(velocity)), earth.earth_rate(p[0])
        return metres, jnp.linalg.norm(ecef_slope, axis=0), *turned, C, slope

    metres, stretch, transport, rate, C, slope = map(np.asarray, rates(places))
    np.testing.assert_allclose(metres, stretch, rtol=1e-14)
    # The axes are rows: dC/dt = -[w]x C with the rate w in the axes themselves.
    W = -slope @ C.transpose(0, 2, 1)
    automatic = np.stack([W[:, 2, 1], W[:, 0, 2], W[:, 1, 0]], axis=1)
    np.testing.assert_allclose(transport, automatic, rtol=1e-12, atol=1e-19)
    north = C @ [0.0, 0.0, earth.WGS84.rate]
    np.testing.assert_allclose(rate, north, rtol=1e-15, atol=1e-20)


def test_offsets_and_displacements_undo_each_other_across_the_antimeridian():
    """Longitudes to either side of it are near: row 23 of the hard inputs."""
    places = PLACES[[0, 1, 2, 5, 6]]
    offset = np.random.default_rng(2).uniform(-5e3, 5e3, (5, 3))
    offset[3:, 0] = [4e3, -4e3]
    moved = compiled(jax.vmap(earth.displaced))(places, offset)
    back = compiled(jax.vmap(earth.offset_between))
    np.testing.assert_allclose(back(places, moved), offset, rtol=0, atol=3e-9)
    wrapped = np.array(moved)
    wrapped[3:, 1] -= np.sign(wrapped[3:, 1]) * 2 * np.pi
    assert np.all(np.abs(wrapped[3:, 1]) < np.pi)
    np.testing.assert_allclose(back(places, wrapped), offset, rtol=0, atol=6e-9)
    # Exact but for the curvature: d^2 / (2 R), with the tangent of the latitude across.
    near = compiled(jax.vmap(earth.displaced))(places, 0.1 * offset)
    np.testing.assert_allclose(enu(near, places), 0.1 * offset, rtol=0, atol=0.1)


def test_flat_earth_neither_turns_nor_curves():
    position, velocity = jnp.array([1e-12, 1e-12, 500.0]), jnp.array([300.0, -200.0, 50.0])
    flat = earth.FLAT
    np.testing.assert_array_equal(earth.earth_rate(position[0], flat), 0)
    assert np.abs(earth.transport_rate(position, velocity, flat)).max() < 1e-14
    np.testing.assert_allclose(
        earth.normal_gravity(position[0], position[2], flat), flat.gravity, rtol=1e-14
    )
    np.testing.assert_allclose(
        earth.metres_per_radian(position, flat), [flat.semi_major, flat.semi_major, 1], rtol=1e-14
    )
