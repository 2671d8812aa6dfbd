"""Mechanisation in the local level frame (east, north, up) of a turning ellipsoid."""

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.navigation.earth import (
    WGS84,
    Earth,
    displaced,
    earth_rate,
    normal_gravity,
    transport_rate,
)
from jaxnav.navigation.strapdown.base import NavState, require_periods
from jaxnav.numerics.lie import so3_exp, so3_left_jacobian
from jaxnav.numerics.linalg import matmul


def pull(position: Array, velocity: Array, earth: Earth = WGS84) -> Array:
    """Return what accelerates a vehicle in free fall ``(3,) [m/s^2]``, east, north, up.

    ``g - (2 w_ie + w_en) x v``: gravity less the accelerations of Coriolis and of transport.

    Args:
        position: Latitude, longitude [rad], height [m].
        velocity: Against the Earth ``(3,) [m/s]``, east, north, up.
        earth: The Earth.
    """
    turning = 2 * earth_rate(position[0], earth) + transport_rate(position, velocity, earth)
    weight = normal_gravity(position[0], position[2], earth)
    return -jnp.cross(turning, velocity) - weight * jnp.array([0.0, 0.0, 1.0], velocity.dtype)


def level_step(
    state: NavState, dtheta: Array, gain: Array, dt: Array | float, earth: Earth = WGS84
) -> NavState:
    """Advance a navigation state by one interval.

        C+ = exp(-[z]x) C exp([dtheta]x),   z = (w_ie + w_en) T
        v+ = v + (I - [z]x / 2 + [z]x^2 / 6 - [z]x [C dtheta]x / 12) C gain
               + (g - (2 w_ie + w_en) x v) T
        p+ = p + (v + v+) T / 2 as latitude, longitude and height

    with Earth rate, transport rate, gravity and Coriolis acceleration at the middle of the
    interval, predicted by half a step, so that the error is of third order in ``T``; what comes
    before ``C gain`` makes a vehicle at rest stay at rest.

    Args:
        state: C_nb, velocity and geodetic position.
        dtheta: ``(3,) [rad]`` rotation vector of the body against inertial space.
        gain: ``(3,) [m/s]`` integral of the specific force in the body axes of the interval's
            start, as from :func:`~jaxnav.navigation.strapdown.increments.compensated` or
            :func:`~jaxnav.navigation.strapdown.increments.accumulate`.
        dt: Interval ``T`` [s].
        earth: The Earth.

    References:
        Groves (2013), section 5.4; Yang et al. (2025), Eqs. (1)-(6), whose images are not
        available: the attitude update they list twice is read as attitude and position.
    """
    C, v, p = state
    felt = matmul(C, gain)
    middle_p = displaced(p, 0.5 * dt * v, earth)

    def turned(velocity: Array) -> Array:
        frame = earth_rate(middle_p[0], earth) + transport_rate(middle_p, velocity, earth)
        return dt * frame

    early = felt - 0.5 * jnp.cross(turned(v), felt)
    middle_v = v + 0.5 * (early + dt * pull(middle_p, v, earth))
    turn = turned(middle_v)
    mean = 0.5 * felt - jnp.cross(turn / 6 - matmul(C, dtheta) / 12, felt)
    v_next = v + felt - jnp.cross(turn, mean) + dt * pull(middle_p, middle_v, earth)
    moved = displaced(middle_p, 0.5 * dt * (v + v_next), earth) - middle_p
    return NavState(matmul(so3_exp(-turn), matmul(C, so3_exp(dtheta))), v_next, p + moved)


def mechanise_local_level(
    initial: NavState,
    dtheta: Array,
    dvel: Array,
    step: float,
    every: int = 1,
    earth: Earth = WGS84,
) -> NavState:
    """Integrate inertial increments over intervals of equal length by :func:`level_step`.

    Within an interval the specific force turns with the body by the exact mean of its rotation: at
    0.1 s the usual half of a cross product would let the unstable height of a vehicle at rest go by
    a centimetre in an hour.

    Args:
        initial: State at t0.
        dtheta: ``(N, 3) [rad]`` rotation vectors of the body over each interval; integrals of the
            angular rate come through
            :func:`~jaxnav.navigation.strapdown.increments.coning_and_sculling` first.
        dvel: ``(N, 3) [m/s]`` integrals of the specific force in body axes, likewise.
        step: Interval [s].
        every: Return the state every so many intervals; ``N`` must be a multiple.
        earth: The Earth.

    Returns:
        The states at the ends of ``N / every`` periods. Without aiding the height diverges, by a
        factor e in about seven minutes.

    Raises:
        ValueError: If ``N`` is not a multiple of ``every``, or the position is of 32 bits.
    """
    require_periods(dtheta.shape[0], every)
    gain = jax.vmap(matmul)(jax.vmap(so3_left_jacobian)(dtheta), dvel)

    def one(state: NavState, now: tuple[Array, Array]) -> tuple[NavState, None]:
        return level_step(state, *now, step, earth), None

    def period(state: NavState, chunk: tuple[Array, Array]) -> tuple[NavState, NavState]:
        state, _ = jax.lax.scan(one, state, chunk)
        return state, state

    chunks = jax.tree.map(lambda leaf: leaf.reshape(-1, every, 3), (dtheta, gain))
    return jax.lax.scan(period, initial, chunks)[1]
