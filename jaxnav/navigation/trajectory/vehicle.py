"""A drive over level ground: straights, right-angled turns and stops, speed and heading smooth."""

from itertools import cycle
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.navigation.earth import WGS84, Earth
from jaxnav.navigation.trajectory.base import Trajectory, smooth_step
from jaxnav.navigation.trajectory.level import follow
from jaxnav.units import DEG

QUARTER = 90.0 * DEG


class Leg(NamedTuple):
    """A part of a drive, over which speed and heading change by C2 steps.

    Attributes:
        duration: [s].
        speed: At the end [m/s].
        turn: Change of heading, clockwise [rad].
    """

    duration: float
    speed: float
    turn: float = 0.0


class VehicleProfile(NamedTuple):
    """A drive from rest at the pace of its legs; after the last the vehicle goes straight on.

    Attributes:
        legs: In order.
        latitude: Of the start [rad].
        longitude: Of the start [rad].
        height: Above the ellipsoid [m].
        heading: At the start, from north by east [rad].
    """

    legs: tuple[Leg, ...]
    latitude: float = 34.0 * DEG
    longitude: float = 108.0 * DEG
    height: float = 400.0
    heading: float = 0.0


def town_legs(blocks: int) -> tuple[Leg, ...]:
    """Return the legs of a drive through a town, 64 s a block in the mean.

    After 20 s at rest each block is a straight at 9 to 20 m/s and a turn by 90 degrees at 5 m/s, to
    either side by turns; in every second block the vehicle stops for 15 s before it turns.

    Args:
        blocks: Number of blocks.
    """
    legs = [Leg(20.0, 0.0)]
    speeds, sides = cycle((14.0, 20.0, 9.0, 17.0)), cycle((1, 1, -1, 1, -1, -1))
    for i in range(blocks):
        speed, side = next(speeds), next(sides)
        legs += [Leg(10.0, speed), Leg(28.0, speed)]
        if i % 2:
            legs += [Leg(8.0, 0.0), Leg(15.0, 0.0), Leg(5.0, 5.0)]
        else:
            legs.append(Leg(7.0, 5.0))
        legs.append(Leg(8.0, 5.0, side * QUARTER))
    return tuple(legs)


def drive(profile: VehicleProfile, *, steps: int, step: float, earth: Earth = WGS84) -> Trajectory:
    """Drive a profile; body axes are forward, left, up, and level.

    Args:
        profile: The drive.
        steps: Number of intervals ``N``.
        step: Their length [s].
        earth: The Earth.

    Returns:
        The trajectory with perfect increments, as
        :func:`~jaxnav.navigation.trajectory.level.follow`.
    """
    legs = np.array(profile.legs, float).T
    return _drive(profile._replace(legs=()), legs, earth, steps=steps, step=step)


@compiled(static_argnames=("steps", "step"))
def _drive(
    profile: VehicleProfile, legs: Array, earth: Earth, *, steps: int, step: float
) -> Trajectory:
    """Drive a profile whose legs are columns ``(3, L)``."""
    duration, speed, turn = legs
    ends = jnp.cumsum(duration)
    before = jnp.concatenate([jnp.zeros(1), speed[:-1]])
    turned = profile.heading + jnp.concatenate([jnp.zeros(1), jnp.cumsum(turn)[:-1]])

    def at(t: Array) -> tuple[Array, Array]:
        """Return speed and heading."""
        i = jnp.minimum(jnp.searchsorted(ends, t, side="right"), ends.shape[0] - 1)
        share = smooth_step(1 + (t - ends[i]) / duration[i])
        return before[i] + (speed[i] - before[i]) * share, turned[i] + turn[i] * share

    def attitude(t: Array) -> Array:
        s, c = jnp.sin(at(t)[1]), jnp.cos(at(t)[1])
        zero, one = jnp.zeros_like(s), jnp.ones_like(s)
        rows = [[s, -c, zero], [c, s, zero], [zero, zero, one]]
        return jnp.stack([jnp.stack(row) for row in rows])

    def velocity(t: Array) -> Array:
        v, heading = at(t)
        return jnp.stack([v * jnp.sin(heading), v * jnp.cos(heading), jnp.zeros_like(v)])

    start = jnp.array([profile.latitude, profile.longitude, profile.height])
    return follow(attitude, velocity, start, steps=steps, step=step, earth=earth)
