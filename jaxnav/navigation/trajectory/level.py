"""Motion in the local level frame of a turning ellipsoid, and what its sensors feel."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.navigation.earth import WGS84, Earth, dcm_ne, metres_per_radian
from jaxnav.navigation.strapdown.base import NavState
from jaxnav.navigation.strapdown.local_level import pull
from jaxnav.navigation.trajectory.base import Trajectory, simpson
from jaxnav.numerics.lie import so3_log
from jaxnav.numerics.linalg import matmul
from jaxnav.numerics.ode import rk4

Motion = tuple[Array, Array]
"""Velocity east, north, up ``(3,) [m/s]`` and geodetic position ``(3,)``."""


def geodetic_rate(position: Array, velocity: Array, earth: Earth = WGS84) -> Array:
    """Return the rates of latitude, longitude [rad/s] and height [m/s]."""
    return velocity[jnp.array([1, 0, 2])] / metres_per_radian(position, earth)


def follow(
    attitude: Callable[[Array], Array],
    velocity: Callable[[Array], Array],
    start: Array,
    *,
    steps: int,
    step: float,
    earth: Earth = WGS84,
) -> Trajectory:
    """Follow given histories of attitude and velocity, and derive the perfect increments.

    Args:
        attitude: C_nb ``(3, 3)`` at a time [s].
        velocity: Against the Earth ``(3,) [m/s]`` at a time [s], east, north, up; differentiable.
        start: Geodetic position ``(3,)`` at t = 0.
        steps: Number of intervals ``N``.
        step: Their length [s].
        earth: The Earth.

    Returns:
        The trajectory; positions by RK4, rotation vectors exact, velocity increments by Simpson's
        rule.
    """
    time = _half_steps(steps, step)

    def advance(p: Array, t: Array) -> tuple[Array, Array]:
        p = rk4(lambda t, p: geodetic_rate(p, velocity(t), earth), t, p, 0.5 * step)
        return p, p

    moved = jax.lax.scan(advance, start, time[:-1])[1]
    position = jnp.concatenate([start[None], moved])

    def force(t: Array, p: Array) -> Array:
        v, acceleration = jax.jvp(velocity, (t,), (jnp.ones_like(t),))
        return matmul(attitude(t).T, acceleration - pull(p, v, earth))

    felt = jax.vmap(force)(time, position)
    motion = (jax.vmap(velocity)(time), position)
    return _sensed(attitude, time, motion, felt, step, earth)


def fall(
    attitude: Callable[[Array], Array],
    force: Callable[[Array, Motion], Array],
    start: Motion,
    *,
    steps: int,
    step: float,
    earth: Earth = WGS84,
) -> Trajectory:
    """Move under a given specific force at a given attitude, and derive the perfect increments.

    Args:
        attitude: C_nb ``(3, 3)`` at a time [s].
        force: ``(t, (velocity, position))`` to the specific force ``(3,) [m/s^2]`` in body axes.
        start: Velocity and geodetic position at t = 0.
        steps: Number of intervals ``N``.
        step: Their length [s].
        earth: The Earth.

    Returns:
        The trajectory; motion by RK4, the rest as :func:`follow`.
    """
    time = _half_steps(steps, step)

    def derivative(t: Array, at: Motion) -> Motion:
        v, p = at
        felt = matmul(attitude(t), force(t, at))
        return felt + pull(p, v, earth), geodetic_rate(p, v, earth)

    def advance(at: Motion, t: Array) -> tuple[Motion, Motion]:
        at = rk4(derivative, t, at, 0.5 * step)
        return at, at

    moved = jax.lax.scan(advance, start, time[:-1])[1]
    motion = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, moved)
    felt = jax.vmap(force)(time, motion)
    return _sensed(attitude, time, motion, felt, step, earth)


def _half_steps(steps: int, step: float) -> Array:
    """Return times at half steps, so that Simpson's rule has the middle of each interval."""
    return 0.5 * step * jnp.arange(2 * steps + 1, dtype=jnp.result_type(float))


def _sensed(
    attitude: Callable[[Array], Array],
    time: Array,
    motion: Motion,
    felt: Array,
    step: float,
    earth: Earth,
) -> Trajectory:
    """Assemble a trajectory from histories at half steps."""
    dvel = simpson(felt[:-1:2], felt[1::2], felt[2::2], step)
    time, velocity, position = time[::2], motion[0][::2], motion[1][::2]
    dcm = jax.vmap(attitude)(time)

    def inertial(t: Array, p: Array, C: Array) -> Array:
        """Return C_ib with the longitude as seen from inertial space."""
        return matmul(dcm_ne(p[0], p[1] + earth.rate * t).T, C)

    turned = jax.vmap(inertial)(time, position, dcm)
    dtheta = jax.vmap(lambda a, b: so3_log(matmul(a.T, b)))(turned[:-1], turned[1:])
    return Trajectory(time, NavState(dcm, velocity, position), dtheta, dvel)
