"""What every trajectory shares: its container, a C2 step and Simpson's rule."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxnav.navigation.strapdown.base import NavState


class Trajectory(NamedTuple):
    """True motion at ``N + 1`` equally spaced times, and perfect increments between them.

    Attributes:
        time: ``(N + 1,) [s]``.
        state: :class:`~jaxnav.navigation.strapdown.base.NavState`, leading axis ``N + 1``.
        dtheta: ``(N, 3) [rad]`` rotation vectors of the body over each interval.
        dvel: ``(N, 3) [m/s]`` integrals of the specific force in body axes.
    """

    time: Array
    state: NavState
    dtheta: Array
    dvel: Array


def smooth_step(s: Array) -> Array:
    """Return the C2 step ``s^3 (10 - 15 s + 6 s^2)``, 0 below 0 and 1 above 1."""
    s = jnp.clip(s, 0, 1)
    return s**3 * (10 - 15 * s + 6 * s * s)


def simpson(start: Array, middle: Array, end: Array, step: float) -> Array:
    """Return integrals over intervals of ``step`` seconds from values at three instants of each."""
    return step * (start + 4 * middle + end) / 6
