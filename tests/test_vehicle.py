"""A drive on level ground: its legs, how smooth it is, and its increments mechanised at 1 Hz."""

from functools import cache

import jax
import numpy as np

from jaxnav.compiling import compiled
from jaxnav.navigation.earth import metres_per_radian
from jaxnav.navigation.strapdown.base import NavState
from jaxnav.navigation.strapdown.increments import accumulate
from jaxnav.navigation.strapdown.local_level import level_step
from jaxnav.navigation.trajectory.base import Trajectory
from jaxnav.navigation.trajectory.vehicle import QUARTER, VehicleProfile, drive, town_legs

LEGS = town_legs(9)
DURATION, SPEED, TURN = np.array(LEGS).T
ENDS = np.cumsum(DURATION)
RATE, LENGTH = 100, 600
"""Increments a second, and seconds, the last twenty of them after the last leg."""
STEEPEST, MOST_BENT = 15 / 8, 10 / np.sqrt(3)
"""Largest first and second derivative of a smooth step."""


@cache
def driven() -> Trajectory:
    """Ten minutes through the town."""
    drives = compiled(lambda: drive(VehicleProfile(LEGS), steps=RATE * LENGTH, step=1 / RATE))
    return jax.tree.map(np.asarray, drives())


def speed_and_heading() -> tuple[np.ndarray, np.ndarray]:
    """Speed along the forward axis, and heading of that axis, which is continuous."""
    state = driven().state
    ahead = state.dcm[:, :, 0]
    speed = np.sum(state.velocity * ahead, axis=1)
    return speed, np.unwrap(np.arctan2(ahead[:, 0], ahead[:, 1]))


def test_legs_end_as_they_say() -> None:
    """Speeds and quarter turns at their ends, between those of the ends within each, stops rest."""
    assert LENGTH - 20 < ENDS[-1] < LENGTH
    speed, heading = speed_and_heading()
    ends = np.rint(RATE * ENDS).astype(int)
    np.testing.assert_allclose(speed[ends], SPEED, rtol=0, atol=1e-9)
    np.testing.assert_allclose(heading[ends], np.cumsum(TURN), rtol=0, atol=1e-12)
    assert set(np.rint(TURN / QUARTER)) == {-1, 0, 1}
    np.testing.assert_allclose(TURN % QUARTER, 0, atol=1e-15)
    starts, before = np.concatenate([[0], ends[:-1]]), np.concatenate([[0.0], SPEED[:-1]])
    for start, end, first, last in zip(starts, ends, before, SPEED, strict=True):
        within = speed[start : end + 1]
        assert within.min() >= min(first, last) - 1e-12
        assert within.max() <= max(first, last) + 1e-12
        if first == last == 0:
            rest = driven().state.position[start : end + 1]
            np.testing.assert_allclose(within, 0, atol=1e-30)
            np.testing.assert_array_equal(np.ptp(rest, axis=0), 0)
    assert np.sum((before == 0) & (SPEED == 0)) == 5
    # After the last leg straight on.
    np.testing.assert_allclose(speed[ends[-1] :], SPEED[-1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(heading[ends[-1] :], np.sum(TURN), rtol=0, atol=1e-12)


def test_motion_is_along_the_forward_axis_and_level() -> None:
    state = driven().state
    speed, _ = speed_and_heading()
    np.testing.assert_allclose(speed[:, None] * state.dcm[:, :, 0], state.velocity, atol=1e-13)
    np.testing.assert_array_equal(state.dcm[:, :, 2], [[0, 0, 1]] * len(speed))
    np.testing.assert_array_equal(state.position[:, 2], 400.0)


def test_speed_and_heading_are_smooth() -> None:
    """Their differences are those of the legs' smooth steps, and continuous across the ends."""
    h = 1 / RATE
    changes = np.diff(SPEED, prepend=0), TURN
    for value, change in zip(speed_and_heading(), changes, strict=True):
        rate = np.diff(value) / h
        steepest = np.max(STEEPEST * np.abs(change) / DURATION)
        assert np.abs(rate).max() <= steepest * (1 + 1e-9)
        assert np.abs(rate).max() >= 0.999 * steepest
        bent = np.max(MOST_BENT * np.abs(change) / DURATION**2)
        assert np.abs(np.diff(rate)).max() <= h * bent * (1 + 1e-9) + 1e-11


def test_increments_reproduce_the_drive_at_one_hertz() -> None:
    """Within half a metre in ten minutes, from the trapezoid of a velocity that accelerates."""
    truth = driven()

    @compiled
    def solved(start: NavState, dtheta: jax.Array, dvel: jax.Array) -> NavState:
        def one(state: NavState, now: tuple[jax.Array, jax.Array]) -> tuple[NavState, NavState]:
            state = level_step(state, *now, 1.0)
            return state, state

        return jax.lax.scan(one, start, accumulate(dtheta, dvel, RATE))[1]

    start = jax.tree.map(lambda leaf: leaf[0], truth.state)
    found = jax.tree.map(np.asarray, solved(start, truth.dtheta, truth.dvel))
    true = jax.tree.map(lambda leaf: leaf[RATE::RATE], truth.state)
    off = jax.tree.map(lambda a, b: np.abs(a - b).reshape(LENGTH, -1), found, true)
    metres = off.position * np.asarray(metres_per_radian(start.position))
    assert np.all(metres.max(axis=0) < [0.5, 0.5, 0.03])
    assert off.velocity.max() < 1e-4
    assert off.dcm.max() < 1e-7
