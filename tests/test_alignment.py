"""Alignment at rest, and the receiver: attitudes, biases, fixes and their masks."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.navigation.alignment import (
    align_with_heading,
    course_heading,
    gyro_compass,
    static_biases,
)
from jaxnav.navigation.channels.gnss import (
    GnssErrors,
    antenna_motion,
    dilution_gate,
    observe_gnss,
    outages,
)
from jaxnav.navigation.earth import FLAT, WGS84, offset_between
from jaxnav.navigation.models.sins_gnss import SinsGnssInput, SinsGnssParams, sins_gnss
from jaxnav.navigation.states import SinsLevel
from jaxnav.units import DEG, DEG_PER_HOUR
from tests.oracles import rotations

GRAVITY, EARTH_RATE = 9.8, 7.292115e-5
LATITUDES = np.linspace(-80, 80, 40) * DEG


def attitudes(count: int = 40) -> np.ndarray:
    """C_nb ``(count, 3, 3)`` at any attitude."""
    return np.array([rotations.exp(v) for v in np.random.default_rng(1).normal(size=(count, 3))])


def still(C: np.ndarray, latitude: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Specific force and angular rate in body axes at rest."""
    none = np.zeros_like(latitude)
    rate = EARTH_RATE * np.stack([none, np.cos(latitude), np.sin(latitude)], axis=1)
    back = C.transpose(0, 2, 1)
    return back @ [0.0, 0.0, GRAVITY], (back @ rate[..., None])[..., 0]


def heading_of(C: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Direction of a body axis over ground, from north by east."""
    ahead = C @ axis
    return np.arctan2(ahead[:, 0], ahead[:, 1])


def vector(R: np.ndarray) -> np.ndarray:
    """Small rotations ``(N, 3)`` of matrices near one."""
    return 0.5 * np.stack(
        [R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1
    )


def test_levelling_with_a_heading_is_exact_for_any_body_axes() -> None:
    C = attitudes()
    force, _ = still(C, LATITUDES)
    for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0)):
        heading = heading_of(C, np.array(axis))
        found = compiled(jax.vmap(lambda f, h, axis=axis: align_with_heading(f, h, axis)))
        np.testing.assert_allclose(found(force, heading), C, rtol=0, atol=2e-14)
        np.testing.assert_allclose(found(7 * force, heading), C, rtol=0, atol=2e-14)


def test_bias_tilts_by_its_ratio_to_gravity() -> None:
    C = attitudes()
    force, _ = still(C, LATITUDES)
    bias = 1e-5 * GRAVITY * np.random.default_rng(2).normal(size=(40, 3))
    heading = heading_of(C, np.eye(3)[0])
    found = np.asarray(compiled(jax.vmap(align_with_heading))(force + bias, heading))
    tilt = vector(found @ C.transpose(0, 2, 1))
    level = (C @ bias[..., None])[..., 0] / GRAVITY
    # What is felt as up is turned into up: about east by north, about north by minus east.
    np.testing.assert_allclose(tilt[:, 0], level[:, 1], rtol=0, atol=1e-9)
    np.testing.assert_allclose(tilt[:, 1], -level[:, 0], rtol=0, atol=1e-9)


def test_gyro_compass_is_exact_and_turned_by_a_drift() -> None:
    C = attitudes()
    force, rate = still(C, LATITUDES)
    compass = compiled(jax.vmap(gyro_compass))
    np.testing.assert_allclose(compass(force, rate), C, rtol=0, atol=2e-14)
    drift = 1e-3 * DEG_PER_HOUR
    east = C.transpose(0, 2, 1) @ [drift, 0.0, 0.0]
    turned = vector(np.asarray(compass(force, rate + east)) @ C.transpose(0, 2, 1))
    expected = drift / (EARTH_RATE * np.cos(LATITUDES))
    np.testing.assert_allclose(np.abs(turned[:, 2]), expected, rtol=1e-6)
    np.testing.assert_allclose(turned[:, :2], 0, rtol=0, atol=1e-14)
    across = C.transpose(0, 2, 1) @ [0.0, drift, drift]
    np.testing.assert_allclose(compass(force, rate + across), C, rtol=0, atol=2e-14)
    middle = 0.2 * DEG_PER_HOUR / (EARTH_RATE * np.cos(40 * DEG))
    np.testing.assert_allclose(middle, DEG, rtol=0.01)


def test_course_is_a_heading_for_those_who_move() -> None:
    speed = np.array(
        [[0.0, 5, 1], [5, 0, 0], [-3, -3, 9], [0.3, 0.4, 30], [0, 0, 0], [0.6, 0.8, 0]]
    )
    heading, usable = compiled(jax.vmap(course_heading))(speed)
    np.testing.assert_allclose(np.asarray(heading)[:3] / DEG, [0, 90, -135], rtol=1e-15)
    np.testing.assert_array_equal(usable, [True, True, True, False, False, True])
    slope = compiled(jax.vmap(jax.grad(lambda v: course_heading(v)[0])))(speed)
    assert np.all(np.isfinite(slope))


def test_static_biases_are_what_rest_does_not_explain() -> None:
    C = attitudes()
    force, rate = still(C, LATITUDES)
    drift, bias = np.random.default_rng(3).normal(size=(2, 40, 3)) * [[[1e-5]], [[1e-2]]]
    found = compiled(jax.vmap(static_biases, (0, 0, 0, 0, None)))(
        C, force + bias, rate + drift, LATITUDES, GRAVITY
    )
    np.testing.assert_allclose(found[0], drift, rtol=0, atol=1e-19)
    np.testing.assert_allclose(found[1], bias, rtol=0, atol=2e-14)


def test_fixes_have_the_noise_they_are_said_to_have() -> None:
    """Standard deviations and the share of outliers within five of their own standard errors."""
    count, share, scale = 100_000, 0.05, 20.0
    velocity = np.tile([100.0, -20.0, 3.0], (count, 1))
    position = np.tile([60 * DEG, np.pi, 500.0], (count, 1))
    sigmas = jnp.array([0.1, 0.2, 0.3]), jnp.array([3.0, 4.0, 8.0])

    @compiled
    def whitened(key: Array, share: Array) -> Array:
        errors = GnssErrors(*sigmas, share, scale)
        z = observe_gnss(key, jnp.array(velocity), jnp.array(position), errors)
        away = jax.vmap(offset_between)(jnp.array(position), z[:, 3:])
        return jnp.concatenate([z[:, :3] - velocity, away], axis=1) / jnp.concatenate(sigmas)[None]

    clean = np.asarray(whitened(jax.random.key(1), jnp.array(0.0)))
    spread = 5 / np.sqrt(2 * count)
    np.testing.assert_allclose(clean.std(axis=0), 1, rtol=spread)
    np.testing.assert_allclose(clean.mean(axis=0), 0, atol=5 / np.sqrt(count))
    np.testing.assert_allclose(np.corrcoef(clean.T), np.eye(6), atol=5 / np.sqrt(count))
    wild = np.asarray(whitened(jax.random.key(1), jnp.array(share)))
    outlier = np.any(wild != clean, axis=1)
    assert abs(outlier.mean() - share) < 5 * np.sqrt(share * (1 - share) / count)
    np.testing.assert_array_equal(wild[~outlier], clean[~outlier])
    np.testing.assert_allclose(wild[outlier], scale * clean[outlier], rtol=1e-4, atol=1e-6)


def test_outages_and_dilution_are_masks() -> None:
    time = jnp.arange(8.0)
    kept = outages(time, [(2.0, 4.0), (6.0, 6.5)])
    np.testing.assert_array_equal(kept, [1, 1, 0, 0, 1, 1, 0, 1])
    np.testing.assert_array_equal(outages(time, []), np.ones(8, bool))
    dilution = jnp.array([1.0, 3.0, 3.1, np.nan, np.inf, -np.inf])
    np.testing.assert_array_equal(dilution_gate(dilution, 3.0), [1, 1, 0, 0, 0, 0])


def test_antenna_moves_as_the_model_observes() -> None:
    """The model has the rate against inertial space, the receiver that against the Earth."""
    C = attitudes()
    rng = np.random.default_rng(5)
    rate, velocity, arm = rng.normal(size=(3, 40, 3)) * [[[1.0]], [[100.0]], [[2.0]]]
    position = np.stack([LATITUDES, rng.uniform(-3, 3, 40), rng.uniform(0, 1e4, 40)], axis=1)
    for earth in (WGS84, FLAT):
        model = sins_gnss(earth=earth)
        of_earth = earth.rate / EARTH_RATE * still(C, LATITUDES)[1]

        def both(C, v, p, w, w_earth, arm, model=model, earth=earth):
            none = jnp.zeros(3)
            params = SinsGnssParams(none, none, none, none, none, none, arm)
            u = SinsGnssInput(none, none, w + w_earth, jnp.array(0.1))
            seen = model.observe(params, SinsLevel(C, v, p, none, none), u)
            return seen, jnp.concatenate(antenna_motion(C, v, p, w, arm, earth))

        seen, moved = compiled(jax.vmap(both))(C, velocity, position, rate, of_earth, arm)
        np.testing.assert_allclose(moved, seen, rtol=1e-14, atol=1e-12)
        swung = np.asarray(seen)[:, :3] - velocity - (C @ np.cross(rate, arm)[..., None])[..., 0]
        np.testing.assert_allclose(swung, 0, rtol=0, atol=1e-12)
