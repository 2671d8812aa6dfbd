"""Inertial measurement unit: white noise, constant drift, constant or coloured bias, noise laws."""

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
    sigma = jnp.sqrt(variance_scale)[:, None]

    def white(key: Array) -> Array:
        return jax.random.normal(key, dtheta.shape, dtheta.dtype)

    # A generator is a second of compiling: in a loop over both sensors there is one.
    gyro, accel = jax.lax.map(white, jax.random.split(key))
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


class NoiseModel(NamedTuple):
    """Coefficients of the noise of a gyro or an accelerometer, each ``()`` or ``(3,)``.

    Densities are two-sided, as in IEEE Std 952; ``u`` is rad for a gyro and m/s for an
    accelerometer, so that a rate is in u/s.

    Attributes:
        quantisation: ``Q`` [u], standard deviation of a white error of the integrated rate.
        random_walk: ``N`` [u/sqrt(s)], angle or velocity random walk: white noise of the rate.
        bias_instability: ``B`` [u/s], flicker noise of the rate with the density
            ``B^2 / (2 pi f)``; the flat part of the Allan deviation is 0.664 B.
        rate_random_walk: ``K`` [u/s/sqrt(s)], random walk of the rate.

    References:
        IEEE Std 952-1997 (R2008), Annex C.
    """

    quantisation: Array | float
    random_walk: Array | float
    bias_instability: Array | float
    rate_random_walk: Array | float


def sensor_noise(key: Array, noise: NoiseModel, step: float, count: int) -> Array:
    """Return the noise of a sensor's rate, averaged over intervals of ``step`` seconds.

    Quantisation is the difference of white errors; white noise has the variance ``N^2 / T``; the
    random walk is averaged over each interval exactly, its Brownian bridge included. Flicker noise
    is white noise of variance ``B^2`` through the filter ``1 / sqrt(1 - 1/z)``,

        h_0 = 1,  h_k = h_{k-1} (k - 1/2) / k

    which starts from rest: the process has no variance of its own, only its differences have. The
    Allan variance is above ``(2 ln 2 / pi) B^2`` by 15 % at two samples and 1 % at eight.

    Args:
        key: Random key.
        noise: The coefficients, all ``()`` or all ``(3,)`` or a mix of both.
        step: Interval ``T`` [s].
        count: Number of intervals.

    Returns:
        ``(count,)`` or ``(count, 3)`` [u/s], independent from axis to axis.

    Raises:
        ValueError: If ``count`` is not positive.

    References:
        Kasdin (1995), Proc. IEEE 83(5), the recursion of the pulse response for 1/f noise. The
        convolution is by FFT, not by the recursive filter.
    """
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}")
    Q, N, B, K = jnp.broadcast_arrays(*map(jnp.asarray, noise))
    phase, white, flicker, walk, bridge = (
        jax.random.normal(part, (rows, *N.shape), N.dtype)
        for part, rows in zip(
            jax.random.split(key, 5), (count + 1, count, count, count, count), strict=True
        )
    )
    moved = jnp.cumsum(walk, axis=0) - walk / 2 + bridge / 12**0.5
    return (
        Q[None] / step * jnp.diff(phase, axis=0)
        + N[None] / step**0.5 * white
        + B[None] * _half_integral(flicker)
        + K[None] * step**0.5 * moved
    )


def _half_integral(white: Array) -> Array:
    """Return white noise ``(N,)`` or ``(N, 3)`` through Kasdin's filter for 1/f noise."""
    count = white.shape[0]
    k = jnp.arange(1, count, dtype=white.dtype)
    pulse = jnp.concatenate([jnp.ones(1, white.dtype), jnp.cumprod((k - 0.5) / k)])
    length = 1 << (2 * count - 1).bit_length()
    response = jnp.fft.rfft(pulse, length).reshape(-1, *(1,) * (white.ndim - 1))
    spectrum = jnp.fft.rfft(white, length, axis=0)
    return jnp.fft.irfft(response * spectrum, length, axis=0)[:count]
