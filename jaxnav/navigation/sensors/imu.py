"""Inertial measurement unit: white noise per sample, constant drift and bias."""

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
        accel_bias: Constant bias ``(3,) [m/s^2]``.
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
    return (
        dtheta + step * (errors.gyro_drift[None] + sigma * gyro * errors.gyro_noise[None]),
        dvel + step * (errors.accel_bias[None] + sigma * accel * errors.accel_noise[None]),
    )
