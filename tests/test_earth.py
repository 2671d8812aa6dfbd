"""The Earth: ellipsoid, local level frame, gravitation and its gradient."""

import jax
import jax.numpy as jnp
import numpy as np
from oracles import sins

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

ecef = jax.jit(jax.vmap(earth.ecef_from_geodetic))
enu = jax.jit(jax.vmap(earth.enu_from_geodetic))
gravity = jax.jit(jax.vmap(earth.gravity_launch_inertial, (0, None)))


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
    C = np.asarray(jax.jit(jax.vmap(earth.dcm_ne))(*PLACES[:, :2].T))
    np.testing.assert_allclose(C[:, 2], normal, rtol=0, atol=1e-15)
    np.testing.assert_allclose(
        C @ C.transpose(0, 2, 1), np.eye(3)[None] + 0 * C, rtol=0, atol=1e-15
    )
    np.testing.assert_allclose(np.linalg.det(C), 1, rtol=1e-15)


def test_meridian_radius_at_the_equator_and_the_pole():
    np.testing.assert_allclose(earth.meridian_radius(0.0), B**2 / A, rtol=1e-15)
    np.testing.assert_allclose(earth.meridian_radius(np.pi / 2), A**2 / B, rtol=1e-15)


def test_small_offsets_are_east_north_up():
    @jax.jit
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
    @jax.jit
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
