"""GNSS receiver: positions and velocities with noise, outliers, outages and a dilution gate."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.navigation.earth import WGS84, Earth, displaced
from jaxnav.numerics.linalg import matmul


class GnssErrors(NamedTuple):
    """Errors of a receiver's fixes, independent from fix to fix.

    Attributes:
        velocity_sigma: ``(3,) [m/s]`` east, north, up.
        position_sigma: ``(3,) [m]`` east, north, up.
        outlier_share: Probability that a fix is an outlier.
        outlier_scale: Factor on both standard deviations in an outlier.
    """

    velocity_sigma: Array
    position_sigma: Array
    outlier_share: Array | float = 0.0
    outlier_scale: Array | float = 1.0


def observe_gnss(
    key: Array, velocity: Array, position: Array, errors: GnssErrors, earth: Earth = WGS84
) -> Array:
    """Return fixes ``(K, 6)``: velocity east, north, up [m/s], then latitude, longitude, height.

    Args:
        key: Random key.
        velocity: ``(K, 3) [m/s]`` of the antenna.
        position: ``(K, 3)`` geodetic, of the antenna.
        errors: The receiver's errors.
        earth: The Earth.
    """
    noise_key, outlier_key = jax.random.split(key)
    count = velocity.shape[0]
    white = jax.random.normal(noise_key, (count, 6), velocity.dtype)
    wild = jax.random.uniform(outlier_key, (count, 1), velocity.dtype) < errors.outlier_share
    white = white * jnp.where(wild, errors.outlier_scale, 1.0).astype(white.dtype)
    offset = white[:, 3:] * errors.position_sigma[None]
    moved = jax.vmap(lambda p, d: displaced(p, d, earth))(position, offset)
    return jnp.concatenate([velocity + white[:, :3] * errors.velocity_sigma[None], moved], axis=1)


def antenna_motion(
    dcm: Array,
    velocity: Array,
    position: Array,
    rate: Array,
    lever_arm: Array,
    earth: Earth = WGS84,
) -> tuple[Array, Array]:
    """Return velocity ``(3,)`` and geodetic position ``(3,)`` of an antenna on the body.

    Args:
        dcm: C_nb ``(3, 3)``.
        velocity: Of the inertial sensors ``(3,) [m/s]``, east, north, up.
        position: Of the inertial sensors, geodetic ``(3,)``.
        rate: Angular rate of the body against the Earth ``(3,) [rad/s]``, body axes.
        lever_arm: From the inertial sensors to the antenna ``(3,) [m]``, body axes.
        earth: The Earth.
    """
    swung = matmul(dcm, jnp.cross(rate, lever_arm))
    return velocity + swung, displaced(position, matmul(dcm, lever_arm), earth)


def outages(time: Array, spans: Sequence[tuple[float, float]]) -> Array:
    """Return which times ``(K,) [s]`` are outside all spans ``[start, end)`` of lost signal."""
    kept = jnp.ones(time.shape, bool)
    for start, end in spans:
        kept = kept & ~((time >= start) & (time < end))
    return kept


def dilution_gate(dilution: Array, limit: float) -> Array:
    """Return which fixes ``(K,)`` have a dilution of precision at most ``limit``, and a finite one.

    References:
        Yang et al. (2025), who take fixes whose position dilution is within a threshold, so that
        the noise of those that are left stays within an order of magnitude.
    """
    return jnp.isfinite(dilution) & (dilution <= limit)
