"""Refraction at the limb against rays that are traced as curves, and the camera that sees them."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from oracles.matrices import central_difference
from scipy.integrate import solve_ivp

from jaxnav.compiling import compiled
from jaxnav.navigation.atmosphere import (
    REFRACTIVITY,
    TOP,
    RefractionTable,
    apparent_height,
    density,
    refraction_angle,
    table_angle,
    tabulate,
)
from jaxnav.navigation.channels.refraction import Camera, Sight, measure, pick, view
from jaxnav.navigation.earth import MEAN_RADIUS
from jaxnav.navigation.limb import (
    exponential_model,
    fitted_model,
    model_height,
    ray_height,
    seen_refraction,
    separation,
)
from jaxnav.units import ARCSEC, DEG

HEIGHTS = np.array([20.0, 25.0, 30.0, 35.0, 40.0]) * 1e3
traced = compiled(jax.vmap(refraction_angle))
POSITION = jnp.array([1e5, MEAN_RADIUS + 4e5, -2e5])
ALL_ROUND = Camera(jnp.array([0.0, 1.0, 0.0]), np.pi, 6.5)


@cache
def table() -> RefractionTable:
    return tabulate()


def limb_star(height: float | Array, azimuth: float, position: Array = POSITION) -> Array:
    """A direction in which the straight line passes the Earth at a height."""
    up = position / jnp.linalg.norm(position)
    east = jnp.cross(up, jnp.array([0.0, 0.0, 1.0]))
    east = east / jnp.linalg.norm(east)
    level = jnp.cos(azimuth) * east + jnp.sin(azimuth) * jnp.cross(up, east)
    dip = jnp.arccos((MEAN_RADIUS + height) / jnp.linalg.norm(position))
    return jnp.cos(dip) * level - jnp.sin(dip) * up


def test_density_is_that_of_the_standard() -> None:
    """US Standard Atmosphere 1976, Table I; geometric heights."""
    heights = jnp.array([0.0, 11e3, 20e3, 25e3, 30e3, 40e3, 50e3, 70e3])
    published = [1.2250, 0.36480, 0.088910, 0.040084, 0.018410, 0.0039957, 0.0010269, 8.2829e-5]
    np.testing.assert_allclose(density(heights), published, rtol=2e-4)


def test_traced_angles_are_those_of_the_specification() -> None:
    angles = traced(jnp.array(HEIGHTS)) / ARCSEC
    np.testing.assert_allclose(angles, [332.68, 148.02, 67.23, 30.69, 14.06], rtol=5e-4)
    finer = compiled(jax.vmap(lambda h: refraction_angle(h, nodes=48)))(jnp.array(HEIGHTS))
    np.testing.assert_allclose(angles, finer / ARCSEC, rtol=1e-9)


def test_a_ray_traced_as_a_curve_is_bent_as_much_and_seen_where_the_geometry_says() -> None:
    """d/ds (n dr/ds) = grad n from the tangent point to an observer; no Bouguer rule in it."""
    slope = compiled(jax.value_and_grad(lambda h: 1 + REFRACTIVITY * density(h)))

    def derivative(s: float, state: np.ndarray) -> np.ndarray:
        r, t = state[:2], state[2:]
        distance = np.hypot(*r)
        index, rate = slope(distance - MEAN_RADIUS)
        grad = float(rate) * r / distance
        return np.concatenate([t, (grad - t * (t @ grad)) / float(index)])

    for height in (20e3, 30e3, 40e3):
        start = np.array([MEAN_RADIUS + height, 0.0, 0.0, 1.0])
        ends = [1.2e6, 2.5e6]
        # A direction is needed to 1e-9 of a radian, across the jumps of the lapse rate.
        way = solve_ivp(
            derivative,
            (0, ends[-1]),
            start,
            "DOP853",
            ends,
            rtol=1e-11,
            atol=[1e-6] * 2 + [1e-13] * 2,
        )
        half = -np.arctan2(way.y[2, -1], way.y[3, -1])
        angle = float(refraction_angle(height))
        np.testing.assert_allclose(2 * half, angle, rtol=2e-6)
        # The way in mirrors the way out, so the star is where the ray came from.
        star = jnp.array([-np.sin(half), -np.cos(half), 0.0])
        for x, y in way.y[:2].T:
            seen = ray_height(jnp.array([x, y, 0.0]), star, angle)
            np.testing.assert_allclose(seen, apparent_height(height), atol=0.05)


def test_the_small_angle_form_misses_an_offset() -> None:
    """At 148 arcsec, (R_e + h_a)(1 / cos R - 1) is 1.6 m."""
    star, angle = limb_star(25e3, 0.4), 148.0 * ARCSEC
    u = -POSITION @ star
    across = jnp.linalg.norm(jnp.cross(POSITION, star))
    small = across + u * jnp.tan(angle) - MEAN_RADIUS
    np.testing.assert_allclose(small - ray_height(POSITION, star, angle), 1.64, atol=0.05)


def test_the_fitted_model_is_within_20_m_and_the_printed_one_is_not() -> None:
    heights = jnp.linspace(20e3, 40e3, 2001)
    angles, truth = traced(heights), apparent_height(heights)
    fitted = jax.vmap(model_height, in_axes=(None, 0))(fitted_model(20e3, 40e3), angles) - truth
    assert np.max(np.abs(fitted)) < 20
    assert np.sqrt(np.mean(fitted**2)) < 1
    at = jnp.array([20.0, 22.0, 25.0, 28.0, 30.0, 35.0, 40.0]) * 1e3
    printed = jax.vmap(model_height, in_axes=(None, 0))(exponential_model(), traced(at))
    error = printed - apparent_height(at)
    np.testing.assert_allclose(error, [-318, -226, -103, -33, -20, 29, 57], atol=3)
    assert fitted_model(24e3, 26e3).knots.shape == exponential_model().knots.shape


def test_a_fit_where_no_height_belongs_to_an_angle_is_refused() -> None:
    with pytest.raises(ValueError, match=r"must be above 11\.1 km"):
        fitted_model(8e3, 14e3)
    with pytest.raises(ValueError, match=r"low must be below high, got 30000\.0 and"):
        fitted_model(30e3, 20e3)
    for height in (-1.0, TOP + 1):
        with pytest.raises(ValueError, match="must be a tangent height from 0 to 86000 m"):
            refraction_angle(height)


def test_the_model_is_safe_for_any_measured_angle() -> None:
    model = fitted_model(20e3, 25e3)
    angles = jnp.array([-100.0, 0.0, 1e-3, 0.1, 1.0, 200.0, 2000.0]) * ARCSEC
    height, slope = jax.vmap(jax.value_and_grad(model_height, argnums=1), (None, 0))(model, angles)
    assert np.all(np.isfinite(height))
    assert np.all(np.isfinite(slope))
    assert np.all(np.diff(height) < 0), "a ray that is bent more passes lower"
    gradient = jax.grad(lambda a: model_height(model, a))
    step = 1e-4 * ARCSEC
    for angle in (0.05 * ARCSEC, 150 * ARCSEC):
        numeric = (model_height(model, angle + step) - model_height(model, angle - step)) / (
            2 * step
        )
        np.testing.assert_allclose(gradient(angle), numeric, rtol=1e-6)


def test_sensitivities_are_those_of_the_specification() -> None:
    """|dh/dR| = H / R: some 20, 44, 96 m per arc second at 20, 25, 30 km."""
    model = fitted_model(18e3, 42e3)
    at = traced(jnp.array([20.5e3, 25e3, 30e3]))
    slope = jax.vmap(jax.grad(model_height, argnums=1), (None, 0))(model, at) * ARCSEC
    np.testing.assert_allclose(-slope, [21, 44, 96], rtol=0.1)


def test_what_is_seen_from_a_position_closes_the_geometry() -> None:
    heights = jnp.array([18e3, 25e3, 33e3, 60e3])
    for density_scale in (1.0, 1.02):
        angle = density_scale * table_angle(table(), heights)
        impact = MEAN_RADIUS + apparent_height(heights, density_scale)
        distance = jnp.linalg.norm(POSITION)
        up = POSITION / distance
        # A ray of that impact parameter meets the observer at arcsin(b / r) from the vertical.
        nadir = jnp.arcsin(impact / distance)
        side = jnp.cross(up, jnp.array([0.0, 0.0, 1.0]))
        side = side / jnp.linalg.norm(side)
        true = nadir - angle
        stars = -jnp.cos(true)[:, None] * up[None] + jnp.sin(true)[:, None] * side[None]
        found = jax.vmap(lambda s, d=density_scale: seen_refraction(table(), POSITION, s, d))(stars)
        np.testing.assert_allclose(found.tangent_height, heights, atol=1e-3)
        np.testing.assert_allclose(found.angle, angle, rtol=1e-6)


def test_the_table_and_the_scaling_by_density_are_as_good_as_they_say() -> None:
    kink = jnp.array([20.05e3, 32.14e3])
    np.testing.assert_allclose(table_angle(table(), kink), traced(kink), rtol=2e-4)
    at = jnp.array([20.55e3, 25.05e3, 33.333e3])
    np.testing.assert_allclose(table_angle(table(), at), traced(at), rtol=1e-5)
    denser = jax.vmap(lambda h: refraction_angle(h, 1.01))(at)
    np.testing.assert_allclose(1.01 * traced(at), denser, rtol=2e-4)


def test_gradients_are_those_of_differences_and_safe_at_zero() -> None:
    star = limb_star(24e3, 1.0)
    for function, step in (
        (lambda p: ray_height(p, star, 1e-3), 10.0),
        (lambda p: 1e6 * seen_refraction(table(), p, star).angle, 0.5),
    ):
        exact = np.asarray(jax.grad(function)(POSITION))

        def value(p: np.ndarray, function=function) -> np.ndarray:
            return np.asarray(function(jnp.asarray(p)))

        for axis in np.eye(3):
            numeric = central_difference(value, np.asarray(POSITION), axis, step)
            np.testing.assert_allclose(exact @ axis, numeric, rtol=1e-4)
    assert separation(star, star) < 1e-15
    axis = jnp.array([0.0, 1.0, 0.0])
    assert np.all(jax.grad(lambda b: separation(axis, b))(axis) == 0)
    for angle in (1e-9, 1.0, 3.0):
        turned = jnp.array([np.cos(angle), np.sin(angle), 0.0])
        np.testing.assert_allclose(separation(jnp.array([1.0, 0, 0]), turned), angle, rtol=1e-12)


def test_a_camera_tells_what_it_sees() -> None:
    up = POSITION / jnp.linalg.norm(POSITION)
    stars = jnp.stack(
        [
            up,
            -up,
            limb_star(25e3, 0.3),
            limb_star(25e3, 3.0),
            limb_star(200e3, 0.3),
            limb_star(24e3, 2.0),
        ]
    )
    magnitudes = jnp.array([1.0, 1.0, 2.0, 3.0, 4.0, 9.0])
    seen = view(table(), POSITION, stars, magnitudes, ALL_ROUND)
    kinds = [Sight.CLEAR, Sight.OCCULTED, Sight.REFRACTED, Sight.REFRACTED, Sight.CLEAR]
    assert seen.kind.tolist() == [*kinds, Sight.OUT_OF_VIEW]
    raised = jax.vmap(separation)(stars, seen.direction)
    np.testing.assert_allclose(raised, seen.angle, atol=1e-15)
    assert np.all(seen.direction @ up >= stars @ up - 1e-15), "light bends around the Earth"
    # The light of a star at 25 km comes on a lower ray than the straight line, by u R.
    assert np.all(seen.tangent_height[2:4] > 25e3)
    narrow = ALL_ROUND._replace(boresight=stars[2], half_angle=5 * DEG)
    assert view(table(), POSITION, stars, magnitudes, narrow).kind.tolist()[:4] == [0, 0, 2, 0]


def test_stars_are_picked_around_the_limb() -> None:
    azimuths = np.array([0.0, 0.1, 2.0, 3.1, 4.2, 4.3])
    stars = jnp.stack([limb_star(22e3, a) for a in azimuths])
    magnitudes = jnp.array([5.0, 1.0, 5.0, 5.0, 5.0, 5.0])
    seen = view(table(), POSITION, stars, magnitudes, ALL_ROUND)
    low, high = seen.tangent_height.min() - 1, seen.tangent_height.max() + 1
    index, found = pick(seen, POSITION, stars, magnitudes, low, high, 3)
    assert index.tolist()[:2] == [1, 3], "the brightest, then the one opposite"
    assert index.tolist()[2] in (2, 4, 5)
    assert found.all()
    _, found = pick(seen, POSITION, stars, magnitudes, low, high, 8)
    assert found.tolist() == [True] * 6 + [False] * 2
    _, found = pick(seen, POSITION, stars, magnitudes, 50e3, 60e3, 2)
    assert not found.any()


def test_the_noise_is_on_the_angle(key: Array) -> None:
    noise = 3 * ARCSEC
    errors = measure(key, jnp.full(20_000, 1e-3), noise) - 1e-3
    # Five standard errors of a mean and of a standard deviation.
    assert abs(float(jnp.mean(errors))) < 5 * noise / 20_000**0.5
    assert abs(float(jnp.std(errors)) / noise - 1) < 5 / 40_000**0.5
