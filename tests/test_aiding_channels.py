"""Channels of further sensors against independent calculations, and what they do for a drive."""

import re
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.estimation.carried import Carried
from jaxnav.estimation.models import Channel
from jaxnav.estimation.sampling import measured
from jaxnav.navigation.atmosphere import density, pressure, pressure_height, temperature
from jaxnav.navigation.channels.barometer import Barometer, barometer, stretch
from jaxnav.navigation.channels.baseline import Baseline, baseline
from jaxnav.navigation.channels.ground import Altimeter, height_above
from jaxnav.navigation.channels.magnetometer import Magnetometer, magnetic_field, magnetometer
from jaxnav.navigation.channels.ranges import Beacons, ranges
from jaxnav.navigation.channels.rest import zero_rate
from jaxnav.navigation.channels.steered import Axle
from jaxnav.navigation.channels.wheel import wheel_speed
from jaxnav.navigation.states import SinsLevel
from jaxnav.numerics.lie import so3_exp
from jaxnav.units import DEG

US76 = {
    0: (288.150, 101325.0),
    1000: (281.651, 89876.0),
    5000: (255.676, 54048.0),
    11000: (216.774, 22700.0),
    20000: (216.650, 5529.3),
    30000: (226.509, 1197.0),
    50000: (270.650, 79.779),
    80000: (198.639, 1.0524),
}
"""Geometric height [m]: temperature [K], pressure [Pa]; US Standard Atmosphere 1976, Table I."""


def test_the_standard_atmosphere_is_the_published_one() -> None:
    heights = jnp.array(list(US76), float)
    published = np.array(list(US76.values()))
    np.testing.assert_allclose(temperature(heights), published[:, 0], rtol=0, atol=6e-4)
    np.testing.assert_allclose(pressure(heights), published[:, 1], rtol=1e-4)
    np.testing.assert_allclose(
        pressure(heights), density(heights) * 287.0529 * published[:, 0], rtol=1e-5
    )


def test_pressure_height_is_the_inverse_of_pressure() -> None:
    heights = jnp.linspace(-400, 84000, 400)
    np.testing.assert_allclose(pressure_height(pressure(heights)), heights, rtol=1e-12, atol=1e-8)
    assert np.isnan(pressure_height(jnp.array([0.0, -3.0]))).all()
    slope = jax.vmap(jax.grad(pressure_height))(jnp.array([101325.0, 5000.0]))
    np.testing.assert_allclose(slope[0], -1 / (9.80665 * 1.2250), rtol=1e-4)


RNG = np.random.default_rng(3)
STATE = SinsLevel(
    so3_exp(jnp.array([0.1, -0.2, 0.9])),
    jnp.array([7.0, 12.0, -0.5]),
    jnp.array([0.85, 0.15, 312.0]),
    jnp.array([1e-3, -2e-3, 5e-4]),
    jnp.array([0.02, 0.03, -0.01]),
)
C, V, P = (np.asarray(part) for part in STATE[:3])
A, E2 = 6378137.0, 0.00669437999014
EARTH = np.array([0, np.cos(P[0]), np.sin(P[0])]) * 7.292115e-5
RATE = np.array([0.02, -0.01, 0.3])
AXLE = Axle(
    jnp.array([-1.0, 0.3, -0.4]), jnp.array([0.01, 0.02, -0.03]), jnp.asarray(RATE), jnp.ones(2)
)
BEACONS = np.array([[0.8502, 0.1503, 350.0], [0.8495, 0.1498, 420.0], [0.85, 0.1505, 10.0]])
LEVER = np.array([0.5, -0.2, 1.0])


def ecef(place: np.ndarray) -> np.ndarray:
    b, lon, h = place
    N = A / np.sqrt(1 - E2 * np.sin(b) ** 2)
    return np.array(
        [
            (N + h) * np.cos(b) * np.cos(lon),
            (N + h) * np.cos(b) * np.sin(lon),
            (N * (1 - E2) + h) * np.sin(b),
        ]
    )


def east_north_up(place: np.ndarray) -> np.ndarray:
    b, lon = place[:2]
    return np.array(
        [
            [-np.sin(lon), np.cos(lon), 0],
            [-np.sin(b) * np.cos(lon), -np.sin(b) * np.sin(lon), np.cos(b)],
            [np.cos(b) * np.cos(lon), np.cos(b) * np.sin(lon), np.sin(b)],
        ]
    )


def heading_and_pitch(vector: np.ndarray) -> np.ndarray:
    d = C @ vector
    return np.array([np.arctan2(d[0], d[1]), np.arcsin(d[2] / np.linalg.norm(d))])


def axle_forward() -> np.ndarray:
    turning = RATE - np.asarray(STATE.drift) - C.T @ EARTH
    return np.asarray(so3_exp(AXLE.mounting))[:1] @ (C.T @ V + np.cross(turning, AXLE.arm))


VECTOR = np.array([0.2, 1.4, -0.1])
ANTENNA = ecef(P) + east_north_up(P).T @ (C @ LEVER)
FIELD = np.array([1000.0, 21000.0, -43000.0])
CASES: dict[str, tuple[Channel, Any, dict[str, Any], np.ndarray, np.ndarray, float]] = {
    "barometer": (
        barometer(),
        Barometer(jnp.array(0.5), jnp.array(300.0), jnp.array(0.96)),
        {"barometer_bias": 3.5},
        np.array([300 + 0.96 * 12]),
        np.array([3.5]),
        1e-12,
    ),
    "wheel speed": (
        wheel_speed(lambda p, x, u: AXLE, lambda p: p),
        jnp.array(0.1),
        {"wheel_scale": 0.02},
        axle_forward(),
        0.02 * axle_forward(),
        1e-9,
    ),
    "zero rate": (
        zero_rate(lambda p, u: p),
        jnp.array(1e-3),
        {},
        np.asarray(STATE.drift) + C.T @ EARTH,
        np.zeros(3),
        1e-12,
    ),
    "baseline": (
        baseline(),
        Baseline(jnp.asarray(VECTOR), jnp.array([0.01, 0.02])),
        {},
        heading_and_pitch(VECTOR),
        np.zeros(2),
        1e-12,
    ),
    "ground": (
        height_above(lambda b, lon: 250 + 1e4 * (b - 0.85) + 2e4 * (lon - 0.15)),
        Altimeter(jnp.array(2.0)),
        {},
        np.array([62.0]),
        np.zeros(1),
        1e-12,
    ),
    "magnetometer": (
        magnetometer(),
        Magnetometer(jnp.asarray(FIELD), jnp.array(50.0)),
        {"hard_iron": [100.0, -200.0, 50.0]},
        C.T @ FIELD,
        np.array([100.0, -200.0, 50.0]),
        1e-12,
    ),
    # the antenna is displaced to first order on the ellipsoid
    "ranges": (
        ranges(3),
        Beacons(jnp.asarray(BEACONS), jnp.array([0.1, 0.2, 0.3]), jnp.asarray(LEVER)),
        {"range_offset": 25.0},
        np.linalg.norm([ecef(b) - ANTENNA for b in BEACONS], axis=1),
        np.full(3, 25.0),
        1e-8,
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_a_channel_is_what_an_independent_calculation_gives(name: str) -> None:
    """With and without the state that it sees when it is carried, and with the noise it states."""
    channel, params, carried, expected, more, tolerance = CASES[name]
    np.testing.assert_allclose(channel.observe(params, STATE, None), expected, rtol=tolerance)
    states = {key: jnp.reshape(jnp.array(value), (-1,)) for key, value in carried.items()}
    z = channel.observe(params, Carried(STATE, states), None)
    np.testing.assert_allclose(z, expected + more, rtol=tolerance)
    assert z.shape == (channel.size,) == channel.noise(params, STATE, None).shape
    many = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (4000, *leaf.shape)), STATE)
    samples = np.asarray(measured(jax.random.key(0), channel, params, many, None)) - expected
    variance = np.asarray(channel.noise(params, STATE, None))
    # four standard errors of a variance of 4000 samples are 9 %
    np.testing.assert_allclose(samples.var(axis=0), variance, rtol=0.09)
    assert np.all(np.abs(samples.mean(axis=0)) < 4 * np.sqrt(variance / 4000))
    gradient = jax.jacrev(lambda v: channel.observe(params, STATE._replace(velocity=v), None))
    assert np.isfinite(gradient(STATE.velocity)).all()


def test_headings_differ_by_the_shorter_way() -> None:
    z, other = jnp.array([3.1, 0.1]), jnp.array([-3.1, 0.0])
    np.testing.assert_allclose(baseline().residual(z, other), [6.2 - 2 * np.pi, 0.1], rtol=1e-12)


def test_ranges_from_a_beacon_itself_have_a_finite_derivative() -> None:
    params = Beacons(STATE.position[None], jnp.ones(1), jnp.zeros(3))

    def seen(position: jax.Array) -> jax.Array:
        return ranges(1).observe(params, STATE._replace(position=position), None)

    assert np.isfinite(jax.jacrev(seen)(STATE.position)).all()


def test_warmer_air_stretches_less() -> None:
    np.testing.assert_allclose(stretch(15.0, 0.0), 1, rtol=1e-12)
    np.testing.assert_allclose(stretch(35.0, 0.0), 288.15 / 308.15, rtol=1e-12)


WMM2020 = {
    (80, 0): (6570.4, -146.3, 54606.0),
    (0, 120): (39624.3, 109.9, -10932.5),
    (-80, 240): (5940.6, 15772.1, -52480.8),
}
"""Latitude, longitude [deg]: north, east, down [nT] on the ellipsoid at 2020.0; Chulliat et al.
(2020), The US/UK World Magnetic Model for 2020-2025, test values."""


def test_the_field_of_the_earth_is_the_published_one() -> None:
    for (latitude, longitude), (north, east, down) in WMM2020.items():
        place = np.array([latitude * DEG, longitude * DEG, 0.0])
        np.testing.assert_allclose(magnetic_field(place, 2020.0), [east, north, -down], atol=0.06)


HARD = Carried(STATE, {"hard_iron": jnp.zeros(1)})
MISUSE: dict[str, tuple[Callable[[], object], str]] = {
    "a carried state of another size": (
        lambda: magnetometer().observe(CASES["magnetometer"][1], HARD, None),
        "the carried state 'hard_iron' is (1,); it must be (3,)",
    ),
    "one beacon as a vector": (
        lambda: ranges(1).observe(Beacons(STATE.position, jnp.ones(1), jnp.zeros(3)), STATE, None),
        "the beacons' positions are (3,); they must be (1, 3)",
    ),
    "a year without a model": (lambda: magnetic_field(P, 1990.0), "1990"),
}


@pytest.mark.parametrize("name", MISUSE)
def test_misuse_is_refused(name: str) -> None:
    call, sentence = MISUSE[name]
    with pytest.raises(ValueError, match=re.escape(sentence)):
        call()
