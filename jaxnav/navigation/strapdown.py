"""Strapdown mechanisation: attitude, velocity and position from inertial increments."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.navigation.earth import gravity_launch_inertial
from jaxnav.numerics.lie import so3_exp, so3_log
from jaxnav.numerics.linalg import matmul


class NavState(NamedTuple):
    """Navigation state: ``dcm`` C_ib ``(3, 3)``, velocity ``(3,) [m/s]``, position ``(3,) [m]``."""

    dcm: Array
    velocity: Array
    position: Array


class NavSolution(NamedTuple):
    """A mechanised solution at the ends of K periods.

    Attributes:
        state: :class:`NavState` with a leading axis ``K``.
        specific_velocity: ``(K, 3) [m/s]`` velocity gained from the specific force in each period,
            in inertial axes.
    """

    state: NavState
    specific_velocity: Array


def rotation_compensated(dtheta: Array, dvel: Array) -> Array:
    """Return the velocity increment ``(3,) [m/s]`` in the body axes of the start of the interval.

    ``dv + dtheta x dv / 2`` accounts for the rotation of the body within the interval.
    """
    return dvel + 0.5 * jnp.cross(dtheta, dvel)


def accumulate(dtheta: Array, dvel: Array, every: int) -> tuple[Array, Array]:
    """Condense inertial increments into one pair per period of ``every`` intervals.

    The rotation vector is that of the product of the rotations; the velocity increments are turned
    into the body axes of the period's start and summed, so that a filter at a lower rate loses
    neither coning nor sculling.

    Args:
        dtheta: ``(N, 3) [rad]`` rotation vectors of the body over each interval.
        dvel: ``(N, 3) [m/s]`` integrals of the specific force in body axes.
        every: Intervals in a period; ``N`` must be a multiple.

    Returns:
        ``(N / every, 3)`` rotation vectors [rad] and velocity increments [m/s].

    Raises:
        ValueError: If ``N`` is not a multiple of ``every``.
    """
    if dtheta.shape[0] % every:
        raise ValueError(f"{dtheta.shape[0]} increments do not divide into periods of {every}")
    rotations = jax.vmap(so3_exp)(dtheta).reshape(-1, every, 3, 3)
    gained = jax.vmap(rotation_compensated)(dtheta, dvel).reshape(-1, every, 3)
    multiply = jax.vmap(matmul)

    def interval(
        carry: tuple[Array, Array], now: tuple[Array, Array]
    ) -> tuple[tuple[Array, Array], None]:
        turned, total = carry
        rotation, gain = now
        return (multiply(turned, rotation), total + multiply(turned, gain)), None

    start = (rotations[:, 0], gained[:, 0])
    later = (jnp.swapaxes(rotations[:, 1:], 0, 1), jnp.swapaxes(gained[:, 1:], 0, 1))
    (turned, total), _ = jax.lax.scan(interval, start, later)
    return jax.vmap(so3_log)(turned), total


def mechanise_launch_inertial(
    initial: NavState,
    dtheta: Array,
    dvel: Array,
    step: float,
    radius: Array | float,
    every: int = 1,
) -> NavSolution:
    """Integrate inertial increments in the non-rotating launch-inertial frame.

        C+ = C exp([dtheta]x)
        v+ = v + C (dv + dtheta x dv / 2) + g(r + v T/2) T
        r+ = r + (v + v+) T/2

    Args:
        initial: State at t0.
        dtheta: ``(N, 3) [rad]`` rotation vectors of the body over each interval.
        dvel: ``(N, 3) [m/s]`` integrals of the specific force in body axes.
        step: Interval ``T`` [s].
        radius: Distance from the Earth's centre to the launch point [m].
        every: Return the state every so many intervals; ``N`` must be a multiple.

    Returns:
        The solution at the ends of ``N / every`` periods.

    Raises:
        ValueError: If ``N`` is not a multiple of ``every``.

    References:
        Titterton and Weston (2004), ch. 11; Shi, Chen, Wang (2023), Eqs. (34)-(36).
    """
    if dtheta.shape[0] % every:
        raise ValueError(f"{dtheta.shape[0]} increments do not divide into periods of {every}")
    rotations = jax.vmap(so3_exp)(dtheta)
    gained = jax.vmap(rotation_compensated)(dtheta, dvel)

    def one(state: NavState, rotation: Array, gain: Array) -> tuple[NavState, Array]:
        C, v, r = state
        specific = matmul(C, gain)
        mid = r + 0.5 * step * v
        v_next = v + specific + step * gravity_launch_inertial(mid, radius)
        return NavState(matmul(C, rotation), v_next, r + 0.5 * step * (v + v_next)), specific

    def period(state: NavState, chunk: tuple[Array, Array]) -> tuple[NavState, NavSolution]:
        total = jnp.zeros_like(state.velocity)
        for j in range(every):
            state, specific = one(state, chunk[0][j], chunk[1][j])
            total = total + specific
        return state, NavSolution(state, total)

    chunks = (rotations.reshape(-1, every, 3, 3), gained.reshape(-1, every, 3))
    return jax.lax.scan(period, initial, chunks)[1]
