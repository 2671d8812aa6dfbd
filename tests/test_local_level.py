"""Strapdown in the local level frame: rest, oscillation, a boosted arc, order of convergence."""

from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.navigation.earth import WGS84, dcm_ne, ecef_from_geodetic, metres_per_radian
from jaxnav.navigation.strapdown.base import NavState
from jaxnav.navigation.strapdown.increments import (
    compensated,
    coning_and_sculling,
    increments_from_rates,
)
from jaxnav.navigation.strapdown.local_level import mechanise_local_level, pull
from jaxnav.navigation.trajectory.arc import ArcProfile, fly_arc
from jaxnav.navigation.trajectory.base import Trajectory
from jaxnav.navigation.trajectory.level import follow, geodetic_rate
from jaxnav.numerics.lie import so3_exp, so3_local
from jaxnav.units import DEG
from tests.oracles import rotations

ENU_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
EARTH_RATE = 7.292115e-5
METRES = np.array([6.4e6, 6.4e6, 1.0])
"""Upper bounds of metres per radian of latitude and longitude."""
mechanise = compiled(mechanise_local_level, static_argnames="every")
tilts = compiled(jax.vmap(so3_local))


class Errors(NamedTuple):
    """Largest errors over all recorded times."""

    position: float
    velocity: float
    tilt: float


def errors(solution: NavState, true: NavState) -> Errors:
    """Largest errors [m, m/s, rad] of a solution, position and velocity on any axis."""
    off = [np.asarray(a) - np.asarray(b) for a, b in zip(solution, true, strict=True)]
    tilt = np.linalg.norm(tilts(solution.dcm, true.dcm), axis=1)
    return Errors(*(float(np.abs(x).max()) for x in (off[2] * METRES, off[1], tilt)))


def at(tree, index):
    return jax.tree.map(lambda leaf: leaf[index], tree)


def test_rest_stays_at_rest_for_an_hour() -> None:
    """Roll, pitch, heading -5, 10, 110 deg of a body forward, right, down; dt 0.1 s."""
    latitude, longitude, height = 55 * DEG, 37 * DEG, 150.0
    x, y, z = np.eye(3)
    turns = [rotations.exp(a * DEG * axis) for a, axis in ((110, z), (10, y), (-5, x))]
    C = ENU_NED @ turns[0] @ turns[1] @ turns[2]
    e2, s2 = WGS84.eccentricity2, np.sin(latitude) ** 2
    surface = 9.7803253359 * (1 + 0.00193185265241 * s2) / np.sqrt(1 - e2 * s2)
    slope = 1 + WGS84.flattening + 0.00344978650684 - 2 * WGS84.flattening * s2
    a = WGS84.semi_major
    gravity = surface * (1 - 2 * slope * height / a + 3 * (height / a) ** 2)
    rate = C.T @ (EARTH_RATE * np.array([0.0, np.cos(latitude), np.sin(latitude)]))
    force = C.T @ [0.0, 0.0, gravity]
    start = NavState(jnp.array(C), jnp.zeros(3), jnp.array([latitude, longitude, height]))
    steps, dt = 36_000, 0.1
    constant = [jnp.array(np.tile(dt * v, (steps, 1))) for v in (rate, force)]
    solution = mechanise(start, *constant, step=dt, every=600)
    true = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (60, *leaf.shape)), start)
    error = errors(solution, true)
    # 2e-6 m is rounding that the unstable height makes grow by e every seven minutes.
    assert error.position < 1e-4
    assert error.velocity < 1e-7
    assert error.tilt < 1e-9 * DEG


def test_pull_is_what_inertial_coordinates_say() -> None:
    """Specific force from the second derivative of the position in inertial axes."""
    rng = np.random.default_rng(3)
    start = rng.uniform([-1.2, -3, -400], [1.2, 3, 3e4], (20, 3))
    slopes = rng.normal(size=(20, 3)) * [1e-4, 1e-4, 300.0]
    bends = rng.normal(size=(20, 3)) * [1e-6, 1e-6, 10.0]
    w = jnp.array([0.0, 0.0, EARTH_RATE])

    @compiled
    @jax.vmap
    def both(p0: Array, p1: Array, p2: Array) -> tuple[Array, Array]:
        def position(t: Array) -> Array:
            return p0 + p1 * t + p2 * t * t

        def inertial(t: Array) -> Array:
            p = position(t)
            return ecef_from_geodetic(p.at[1].add(EARTH_RATE * t))

        def velocity(t: Array) -> Array:
            rates = jax.jvp(position, (t,), (jnp.ones(()),))[1] * metres_per_radian(position(t))
            return rates[jnp.array([1, 0, 2])]

        zero, one = jnp.zeros(()), jnp.ones(())
        v, a = jax.jvp(velocity, (zero,), (one,))
        felt = a - pull(p0, v)
        r_a = jax.jacfwd(jax.jacfwd(inertial))(zero)
        centrifugal = -jnp.cross(w, jnp.cross(w, ecef_from_geodetic(p0)))
        weight = pull(p0, jnp.zeros(3))
        return felt, dcm_ne(p0[0], p0[1]) @ (r_a + centrifugal) - weight

    felt, expected = both(start, slopes, bends)
    np.testing.assert_allclose(felt, expected, rtol=0, atol=2e-11 * np.abs(felt).max())


STEPS, STEP, EVERY = 360_000, 0.01, 3_000


def swaying(t: Array) -> Array:
    """C_nb that rolls, pitches and yaws by a few degrees in 10 s and 30 s, with coning in it."""
    roll, pitch = 4 * DEG * jnp.sin(2 * jnp.pi * t / 10), 3 * DEG * jnp.cos(2 * jnp.pi * t / 10)
    return so3_exp(jnp.stack([roll, pitch, 0.6 + 5 * DEG * jnp.sin(2 * jnp.pi * t / 30)]))


def weaving(t: Array) -> Array:
    """Velocity east, north, up in sines of 60 s, 90 s and 20 s."""
    w = 2 * jnp.pi * t
    return jnp.stack([20 * jnp.sin(w / 60), 15 * jnp.cos(w / 90), 2 * jnp.sin(w / 20)])


def sensed(t: Array, p: Array) -> tuple[Array, Array]:
    """Angular rate from the derivative of C_ib, and specific force, both in body axes."""

    def inertial(t: Array, p: Array) -> Array:
        return dcm_ne(p[0], p[1] + EARTH_RATE * t).T @ swaying(t)

    v, a = jax.jvp(weaving, (t,), (jnp.ones_like(t),))
    C, moved = jax.jvp(inertial, (t, p), (jnp.ones_like(t), geodetic_rate(p, v)))
    K = C.T @ moved
    return jnp.stack([K[2, 1], K[0, 2], K[1, 0]]), swaying(t).T @ (a - pull(p, v))


class Hour(NamedTuple):
    """An hour at 100 Hz: the truth, true integrals of rate and force, and their samples."""

    truth: Trajectory
    integrals: tuple[Array, Array]
    samples: tuple[Array, Array]


@cache
def hour() -> Hour:
    start = jnp.array([55 * DEG, 37 * DEG, 150.0])
    truth = compiled(lambda start: follow(swaying, weaving, start, steps=STEPS, step=STEP))(start)
    time, p = np.asarray(truth.time), np.asarray(truth.state.position)
    slope = np.asarray(compiled(jax.vmap(geodetic_rate))(p, truth.state.velocity))
    # Hermite's cubic at the middle, right to 1e-12 m here
    middle = 0.5 * (p[:-1] + p[1:]) + STEP / 8 * (slope[:-1] - slope[1:])
    every = np.concatenate([time, time[:-1] + 0.5 * STEP]), np.concatenate([p, middle])
    rate, force = map(np.asarray, compiled(jax.vmap(sensed))(*every))

    def integral(x: np.ndarray) -> Array:
        ends, between = x[: STEPS + 1], x[STEPS + 1 :]
        return jnp.array(STEP * (ends[:-1] + 4 * between + ends[1:]) / 6)

    samples = jnp.array(rate[: STEPS + 1]), jnp.array(force[: STEPS + 1])
    return Hour(truth, (integral(rate), integral(force)), samples)


def test_coned_integrals_are_the_exact_rotation_vectors() -> None:
    truth, (dtheta, dvel), _ = hour()
    turn, _ = compiled(coning_and_sculling)(dtheta, dvel)
    left, without = (np.abs(np.asarray(x - truth.dtheta))[1:].max() for x in (turn, dtheta))
    # What is left is of one order more in the step, a period of 10 s being 1000 steps.
    assert without > 5e-11
    assert left < 5e-13
    np.testing.assert_allclose(dvel, truth.dvel, rtol=0, atol=1e-13)


def test_an_hour_of_oscillation_from_increments_and_from_rates() -> None:
    """Every 30 s of an hour; the published bounds are 0.1 m, 1e-3 m/s and 1e-6 deg.

    The trapezoid of sampled rates leaves ``T^2 / 12`` of the mean of ``w x w'``, just what coning
    restores: rates are as good as integrals without it, and no better.
    """
    truth, integrals, samples = hour()

    start = at(truth.state, 0)
    true = at(truth.state, slice(EVERY, None, EVERY))

    def solved(dtheta: Array, dvel: Array) -> Errors:
        return errors(mechanise(start, dtheta, dvel, STEP, every=EVERY), true)

    cone = compiled(coning_and_sculling)
    rates = compiled(increments_from_rates)(*samples, jnp.full(STEPS, STEP))
    coned, raw, sampled = solved(*cone(*integrals)), solved(*integrals), solved(*cone(*rates))
    exact = solved(truth.dtheta, cone(truth.dtheta, truth.dvel)[1])
    assert coned.position < 3e-3
    assert coned.velocity < 5e-6
    assert coned.tilt < 3e-8 * DEG
    assert exact.tilt < 3e-9 * DEG
    assert exact.position < 3e-3
    assert raw.position > 1e3 * coned.position
    assert raw.velocity > 1e3 * coned.velocity
    assert raw.tilt > 1e4 * coned.tilt
    assert sampled.position < 20
    assert sampled.velocity < 0.02
    assert sampled.tilt < 2e-3 * DEG
    assert 0.5 < sampled.tilt / raw.tilt < 2


def test_invalid_sample_is_held_and_never_used() -> None:
    rng = np.random.default_rng(1)
    gyro, accel = rng.normal(size=(2, 9, 3))
    dt = np.full(8, 0.01)
    valid = np.ones(9, bool)
    valid[[0, 4, 5]] = False
    held = [
        np.concatenate([np.zeros((1, 3)), x[1:4], x[3:4], x[3:4], x[6:]]) for x in (gyro, accel)
    ]
    made = compiled(increments_from_rates)
    expected = [0.005 * (x[:-1] + x[1:]) for x in held]
    outcomes = []
    for lost in (7.0, np.nan, np.inf):
        given = [np.where(valid[:, None], x, lost) for x in (gyro, accel)]
        outcomes.append(made(*given, dt, valid))
        np.testing.assert_allclose(outcomes[-1], expected, rtol=1e-15, atol=1e-18)
        np.testing.assert_array_equal(outcomes[-1], outcomes[0])


def test_time_that_stands_still_or_goes_back_has_no_increment() -> None:
    """Row 21 of the hard inputs."""
    gyro, accel = np.random.default_rng(2).normal(size=(2, 4, 3))
    dtheta, dvel = compiled(increments_from_rates)(gyro, accel, np.array([0.01, 0.0, -0.3]))
    for got, rate in ((dtheta, gyro), (dvel, accel)):
        np.testing.assert_allclose(got[0], 0.005 * (rate[0] + rate[1]), rtol=1e-15)
        np.testing.assert_array_equal(got[1:], 0)


def test_constant_increments_are_compensated_for_the_turn_alone() -> None:
    dtheta, dvel = np.tile([0.01, 0.0, -0.01], (5, 1)), np.tile([0.0, 0.0, 0.1], (5, 1))
    turn, gain = compiled(compensated)(dtheta, dvel)
    np.testing.assert_allclose(turn, dtheta, rtol=1e-15, atol=1e-20)
    expected = np.tile([0.0, -0.5e-3, 0.1], (5, 1))
    np.testing.assert_allclose(gain, expected, rtol=1e-15, atol=1e-18)


ARC = {"steps": 48_000, "step": 1 / 400}


def test_perfect_increments_reproduce_the_arc(optimised_programs: None) -> None:
    truth = fly_arc(ArcProfile(), **ARC)
    dvel = coning_and_sculling(truth.dtheta, truth.dvel)[1]
    solution = mechanise(at(truth.state, 0), truth.dtheta, dvel, ARC["step"], every=400)
    true = at(truth.state, slice(400, None, 400))
    error = errors(solution, true)
    # Trapezoid of the velocity: 2e-5 m in 120 s.
    assert error.position < 1e-4
    assert error.velocity < 1e-8
    assert error.tilt < 1e-11
    C = np.asarray(solution.dcm)
    assert np.abs(C @ C.transpose(0, 2, 1) - np.eye(3)).max() < 1e-12


def test_the_arc_is_as_described() -> None:
    """Mean thrust 45 m/s^2 over 20 s, pitch through more than 90 deg, roll through 360 deg."""
    p = ArcProfile(ballistic=1e12)
    vacuum = fly_arc(p, **ARC)
    time, C = np.asarray(vacuum.time), np.asarray(vacuum.state.dcm)
    np.testing.assert_allclose(np.sum(vacuum.dvel, axis=0), [20 * 45.0, 0, 0], atol=1e-4)
    late = time[1:] > 20.5 + 1e-9
    np.testing.assert_allclose(np.asarray(vacuum.dvel)[late], 0, atol=1e-9)
    pitch = np.arcsin(C[:, 2, 0])
    np.testing.assert_allclose(pitch[[0, -1]], [85 * DEG, -10 * DEG], rtol=1e-12)
    s, c, zero = np.sin(p.azimuth), np.cos(p.azimuth), np.zeros_like(time)
    ahead = [np.cos(pitch) * s, np.cos(pitch) * c, np.sin(pitch)]
    np.testing.assert_allclose(C[:, :, 0], np.stack(ahead, axis=1), rtol=0, atol=1e-12)
    above = np.stack([-np.sin(pitch) * s, -np.sin(pitch) * c, np.cos(pitch)], axis=1)
    right = np.stack([zero + c, zero - s, zero], axis=1)
    side = C[:, :, 1]
    roll = np.unwrap(np.arctan2(np.sum(side * right, 1), np.sum(side * above, 1)))
    np.testing.assert_allclose(roll[[0, -1]], [0, 2 * np.pi], rtol=0, atol=1e-12)


def manoeuvre(t: Array) -> tuple[Array, Array]:
    """C_nb and velocity of a fast vehicle that turns within seconds."""
    w = 2 * jnp.pi * t
    turn = [0.5 * jnp.sin(w / 9), 0.4 * jnp.cos(w / 7), 0.8 * jnp.sin(w / 13)]
    v = [300 + 50 * jnp.sin(w / 8), -200 + 40 * jnp.cos(w / 11), 30 * jnp.sin(w / 7)]
    return so3_exp(jnp.stack(turn)), jnp.stack(v)


def test_order_of_convergence() -> None:
    """Third order per step: the error falls by 8 when the step halves, by 4 without sculling."""
    start = jnp.array([34 * DEG, 108 * DEG, 500.0])

    @compiled
    def solved(step: float) -> tuple[NavState, NavState, NavState]:
        t = follow(
            lambda t: manoeuvre(t)[0], lambda t: manoeuvre(t)[1], start, steps=160, step=step
        )
        sculled = coning_and_sculling(t.dtheta, t.dvel)[1]
        both = [
            mechanise_local_level(at(t.state, 0), t.dtheta, dvel, step, 80)
            for dvel in (sculled, t.dvel)
        ]
        return at(t.state, slice(80, None, 80)), both[0], both[1]

    found = []
    for step, last in ((0.2, 0), (0.1, 1)):
        ends = [at(x, slice(last, last + 1)) for x in solved(step)]
        found.append([errors(end, ends[0]) for end in ends[1:]])
    (whole, whole_plain), (half, half_plain) = np.array(found)
    assert np.all((whole / half > 6) & (whole / half < 12)), whole / half
    np.testing.assert_allclose(whole_plain / half_plain, 4, rtol=0.05)


def test_increments_must_divide_into_periods() -> None:
    start = NavState(jnp.eye(3), jnp.zeros(3), jnp.zeros(3))
    with pytest.raises(ValueError, match="7 increments do not divide into periods of 5"):
        mechanise_local_level(start, jnp.zeros((7, 3)), jnp.zeros((7, 3)), 0.1, 5)
