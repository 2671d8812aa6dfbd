"""Inertial increments: from sampled rates, compensated within an interval, condensed over many."""

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.navigation.strapdown.base import require_periods
from jaxnav.numerics.lie import so3_exp, so3_log
from jaxnav.numerics.linalg import matmul


def rotation_compensated(dtheta: Array, dvel: Array) -> Array:
    """Return the velocity increment ``(3,) [m/s]`` in the body axes of the start of the interval.

    ``dv + dtheta x dv / 2`` accounts for the rotation of the body within the interval.
    """
    return dvel + 0.5 * jnp.cross(dtheta, dvel)


def coning_and_sculling(dtheta: Array, dvel: Array) -> tuple[Array, Array]:
    """Return increments as if each interval had constant rates of its own.

        theta_k + theta_{k-1} x theta_k / 12
        dv_k + (theta_{k-1} x dv_k + dv_{k-1} x theta_k) / 12

    exact to second order for a rate and a specific force that change linearly over two intervals.
    The first interval has none before it and is taken for one of constant rates.

    Args:
        dtheta: ``(N, 3) [rad]`` integrals of the angular rate over each interval.
        dvel: ``(N, 3) [m/s]`` integrals of the specific force in body axes.

    Returns:
        ``(N, 3)`` rotation vectors [rad], and integrals of the specific force [m/s] that turn with
        the body as at a constant rate.

    References:
        Savage (1998), J. Guidance, Control, Dynamics 21(1) and 21(2); Groves (2013), section 5.5.
    """
    theta0, dv0 = (jnp.concatenate([x[:1], x[:-1]]) for x in (dtheta, dvel))
    coning = jnp.cross(theta0, dtheta) / 12
    sculling = (jnp.cross(theta0, dvel) + jnp.cross(dv0, dtheta)) / 12
    return dtheta + coning, dvel + sculling


def compensated(dtheta: Array, dvel: Array) -> tuple[Array, Array]:
    """Return rotation vectors and velocity gains ``(N, 3)`` in the axes of each interval's start.

    :func:`coning_and_sculling`, then :func:`rotation_compensated`: both of second order.
    """
    turn, straight = coning_and_sculling(dtheta, dvel)
    return turn, jax.vmap(rotation_compensated)(dtheta, straight)


def increments_from_rates(
    gyro: Array, accel: Array, dt: Array, valid: Array | None = None
) -> tuple[Array, Array]:
    """Return the integrals of sampled rates over the intervals between samples.

    The trapezoid of the two samples at the ends, whose error is of the size of the coning within an
    interval: :func:`coning_and_sculling` of it gains nothing, and samples have to be dense beside
    the motion. A sample that is not valid is stood for by the
    last valid one before it, and its value is never used; a leading one by zero.

    Args:
        gyro: ``(N + 1, 3) [rad/s]`` angular rate at each time.
        accel: ``(N + 1, 3) [m/s^2]`` specific force at each time.
        dt: ``(N,) [s]`` intervals; one of zero or less has no increment.
        valid: ``(N + 1,)`` whether a sample arrived; the default is all of them.

    Returns:
        ``(N, 3)`` integrals of the angular rate [rad] and of the specific force [m/s].
    """
    if valid is not None:
        gyro, accel = _held(gyro, valid), _held(accel, valid)
    half = 0.5 * jnp.maximum(dt, 0)[:, None]
    return half * (gyro[:-1] + gyro[1:]), half * (accel[:-1] + accel[1:])


def _held(samples: Array, valid: Array) -> Array:
    """Return samples ``(N, 3)`` with the last valid one in place of those that are not."""
    own = jnp.arange(valid.shape[0])
    last = jax.lax.cummax(jnp.where(valid, own, -1))
    known = jnp.where(valid[:, None], samples, 0)
    return jnp.where((last >= 0)[:, None], known[jnp.maximum(last, 0)], 0)


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
    require_periods(dtheta.shape[0], every)
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
