"""Inertial measurement unit: white noise per sample, constant drift, constant or coloured bias."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array


class ImuErrors(NamedTuple):
    """Errors of an IMU, measured minus true.

    Attributes:
        gyro_noise: Standard deviation of one sample ``(3,) [rad/s]``.
        accel_noise: Standard deviation of one sample ``(3,) [m/s^2]``.
        gyro_drift: Constant drift ``(3,) [rad/s]``.
        accel_bias: Bias [m/s^2], constant ``(3,)`` or of each interval ``(N, 3)``.
    """

    gyro_noise: Array
    accel_noise: Array
    gyro_drift: Array
    accel_bias: Array


def corrupt(
    key: Array, errors: ImuErrors, dtheta: Array, dvel: Array, step: float, variance_scale: Array
) -> tuple[Array, Array]:
    """Return the increments an imperfect IMU reports.

    The white noise is independent from sample to sample, so an interval of ``step`` seconds gets a
    rotation of standard deviation ``gyro_noise * step``.

    Args:
        key: Random key.
        errors: The IMU's errors.
        dtheta: ``(N, 3) [rad]`` true increments.
        dvel: ``(N, 3) [m/s]`` true increments.
        step: Interval [s].
        variance_scale: ``(N,)`` factor on the noise variances at each sample.

    Returns:
        The measured increments, ``(N, 3)`` each.
    """
    gyro_key, accel_key = jax.random.split(key)
    sigma = jnp.sqrt(variance_scale)[:, None]
    gyro = jax.random.normal(gyro_key, dtheta.shape, dtheta.dtype)
    accel = jax.random.normal(accel_key, dvel.shape, dvel.dtype)
    bias = jnp.broadcast_to(errors.accel_bias, dvel.shape)
    return (
        dtheta + step * (errors.gyro_drift[None] + sigma * gyro * errors.gyro_noise[None]),
        dvel + step * (bias + sigma * accel * errors.accel_noise[None]),
    )


def markov_error(
    key: Array,
    sigma: Array | float,
    correlation_time: Array | float,
    start: Array,
    step: float,
    count: int,
) -> Array:
    """Return a first-order Gauss-Markov error on three independent axes, sampled exactly.

        x+ = exp(-T / tau) x + sigma sqrt(1 - exp(-2 T / tau)) w,  w ~ N(0, I)

    Args:
        key: Random key.
        sigma: Stationary standard deviation ``()`` or ``(3,)``, in the unit of ``start``.
        correlation_time: ``tau`` [s].
        start: Value at t0 ``(3,)``; the process is stationary if it is drawn from N(0, sigma^2).
        step: Interval ``T`` [s].
        count: Number of intervals ``N``.

    Returns:
        ``(N, 3)`` values at the starts of the intervals; the first is ``start``. As the
        ``accel_bias`` of :func:`corrupt` each is held over its interval.

    Raises:
        ValueError: If ``count`` is not positive.

    References:
        Zhao, Chen, He, Ge (2018), IEEE/CAA JAS 5(6), Sec. IV, which names the process of the
        accelerometer's error and gives neither number; Gelb (1974), Applied Optimal Estimation.
    """
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}")
    ratio = step / correlation_time
    decay, drive = jnp.exp(-ratio), sigma * jnp.sqrt(-jnp.expm1(-2 * ratio))
    white = jax.random.normal(key, (count - 1, 3), start.dtype)

    # A scan costs little more than its draws; an associative scan twice as much on a CPU.
    def advance(x: Array, w: Array) -> tuple[Array, Array]:
        x = decay * x + drive * w
        return x, x

    return jnp.concatenate([start[None], jax.lax.scan(advance, start, white)[1]])
