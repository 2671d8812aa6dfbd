"""Mechanisation in the non-rotating launch-inertial frame, about a point-mass Earth."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.navigation.earth import gravity_launch_inertial
from jaxnav.navigation.strapdown.base import NavState, require_periods
from jaxnav.navigation.strapdown.increments import rotation_compensated
from jaxnav.numerics.lie import so3_exp
from jaxnav.numerics.linalg import matmul


class NavSolution(NamedTuple):
    """A mechanised solution at the ends of K periods.

    Attributes:
        state: :class:`NavState` with a leading axis ``K``.
        specific_velocity: ``(K, 3) [m/s]`` velocity gained from the specific force in each period,
            in inertial axes.
    """

    state: NavState
    specific_velocity: Array


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
    require_periods(dtheta.shape[0], every)
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
