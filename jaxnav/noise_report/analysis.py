"""From a log at rest to noise coefficients with intervals of confidence, axis by axis."""

import math
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.datasets.base import DataError
from jaxnav.datasets.inertial import SENSORS, ImuLog, load_imu_csv, on_grid, window
from jaxnav.navigation.sensors.allan import (
    AllanVariance,
    allan_variance,
    cluster_sizes,
    deviation_interval,
)
from jaxnav.navigation.sensors.imu import NoiseModel
from jaxnav.navigation.sensors.noise_fit import (
    NoiseFit,
    coefficient_interval,
    degrees_of_freedom,
    fit_noise,
    model_variance,
)
from jaxnav.noise_report.config import AllanConfig, check
from jaxnav.results import SCHEMA, provenance
from jaxnav.units import ARCSEC, DEG_PER_HOUR, DEG_PER_SQRT_HOUR, GRAVITY, HOUR

SHORTEST = 72
"""Samples of a record that holds the four cluster sizes the fit needs."""
POOR_FIT = 5.0
"""Misfit per degree of freedom above which the four noises do not explain a record."""
CURVE_POINTS = 200

_ROOT_HOUR = HOUR**0.5
_GYRO = {
    "angle_random_walk": ("random_walk", DEG_PER_SQRT_HOUR, "deg/sqrt(h)"),
    "bias_instability": ("bias_instability", DEG_PER_HOUR, "deg/h"),
    "rate_random_walk": ("rate_random_walk", DEG_PER_HOUR / _ROOT_HOUR, "deg/h/sqrt(h)"),
    "quantisation": ("quantisation", ARCSEC, "arcsec"),
}
_ACCEL = {
    "velocity_random_walk": ("random_walk", 1 / _ROOT_HOUR, "m/s/sqrt(h)"),
    "bias_instability": ("bias_instability", 1e-6 * GRAVITY, "ug"),
    "acceleration_random_walk": ("rate_random_walk", 1 / _ROOT_HOUR, "m/s^2/sqrt(h)"),
    "quantisation": ("quantisation", 1.0, "m/s"),
}


def load(path: Path, config: AllanConfig) -> ImuLog:
    """Return the part of a log that is asked for, on a regular grid.

    Args:
        path: Log in the format of :mod:`jaxnav.datasets.inertial`.
        config: The parameters.

    Raises:
        ConfigError: If a parameter is out of its range.
        DataError: If the log is refused, or the part too short.
    """
    check(config)
    end_s = math.inf if config.end_s is None else config.end_s
    log = on_grid(window(load_imu_csv(path), config.start_s, end_s))
    if len(log.valid) < SHORTEST:
        raise DataError(
            f"{path}: the record of {len(log.valid)} samples is too short; accepted are at least "
            f"{SHORTEST}, and hours for the slow noises"
        )
    return log


def analyse(log: ImuLog, config: AllanConfig) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return what is known about the noise of the six sensors.

    Args:
        log: A log on a regular grid.
        config: The parameters.

    Returns:
        The contents of ``summary.json``, in the units of data sheets; and arrays in SI units:
        ``axis`` (6,), ``tau`` (M,), ``deviation``, ``low``, ``high`` (6, M), and the fitted curve
        ``fit_deviation`` (6, 200) at ``fit_tau`` (200,).
    """
    count = len(log.valid)
    sizes = cluster_sizes(count, config.per_octave)
    one = partial(_one_axis, step=log.step_s, sizes=sizes)
    rates = jnp.asarray(np.hstack([log.gyro, log.accel]).T)
    valid = None if log.valid.all() else jnp.asarray(log.valid)
    # One axis after the other: a day at 400 Hz is a quarter of a gigabyte an array.
    each = compiled(lambda rates, valid: jax.lax.map(partial(one, valid=valid), rates))
    measured, fit, freedom = each(rates, valid)
    low, high = deviation_interval(measured, freedom, config.confidence)
    tau = np.asarray(measured.tau[0])
    fit_tau = np.geomspace(tau[0], tau[-1], CURVE_POINTS)
    curve = jax.vmap(model_variance, in_axes=(0, None))(fit.noise, jnp.asarray(fit_tau))
    arrays = {
        "axis": np.array(SENSORS),
        "tau": tau,
        "deviation": np.asarray(measured.deviation),
        "low": low,
        "high": high,
        "fit_tau": fit_tau,
        "fit_deviation": np.sqrt(np.asarray(curve)),
    }
    return _document(log, config, measured, fit), arrays


def _one_axis(
    rate: Array, valid: Array | None, step: float, sizes: tuple[int, ...]
) -> tuple[AllanVariance, NoiseFit, Array]:
    count = rate.shape[0]
    measured = allan_variance(rate, step, sizes, valid)
    fit = fit_noise(measured, step, sizes, count)
    return measured, fit, degrees_of_freedom(fit.noise, step, sizes, count, measured.share)


def _document(
    log: ImuLog, config: AllanConfig, measured: AllanVariance, fit: NoiseFit
) -> dict[str, Any]:
    low, high = coefficient_interval(fit, config.confidence)
    return {
        "schema": SCHEMA,
        "command": "allan",
        "log": log.source,
        "window": {"start_s": config.start_s, "end_s": config.end_s},
        "samples": len(log.valid),
        "step_s": log.step_s,
        "counts": {
            "duplicates": log.duplicates,
            "nan_rows": log.nan_rows,
            "gaps": log.gaps,
            "missing": log.missing,
        },
        "confidence": config.confidence,
        "per_octave": config.per_octave,
        "axes": {
            axis: _coefficients(axis, i, fit.noise, low, high) for i, axis in enumerate(SENSORS)
        },
        "notes": _notes(measured, fit),
        "provenance": provenance(),
    }


def _coefficients(
    axis: str, i: int, noise: NoiseModel, low: NoiseModel, high: NoiseModel
) -> dict[str, dict[str, Any]]:
    """Return value, interval and unit of each coefficient of an axis."""
    names = _GYRO if axis.startswith("gyro") else _ACCEL
    numbers = {"value": noise, "low": low, "high": high}
    return {
        name: {key: float(getattr(model, field)[i]) / unit for key, model in numbers.items()}
        | {"unit": text}
        for name, (field, unit, text) in names.items()
    }


def _notes(measured: AllanVariance, fit: NoiseFit) -> list[str]:
    """Return what a reader of the coefficients must know, one sentence each."""
    axes, notes = np.array(SENSORS), []
    still = ~np.any(np.asarray(measured.variance) > 0, axis=1)
    if still.any():
        notes.append(f"{', '.join(axes[still])}: constant, or without an unbroken stretch")
    misfit = np.asarray(fit.misfit) / np.maximum(np.asarray(fit.misfit_freedom), 1)
    poor = misfit > POOR_FIT
    if poor.any():
        notes.append(
            f"{', '.join(axes[poor])}: the four noises do not explain the Allan deviations (chi-"
            f"square per degree of freedom up to {misfit.max():.0f}); coefficients and intervals "
            "hold for a sensor at rest"
        )
    return notes
