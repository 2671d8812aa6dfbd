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
    median_variance,
)
from jaxnav.navigation.sensors.imu import NoiseModel
from jaxnav.navigation.sensors.noise_fit import (
    NoiseFit,
    coefficient_interval,
    degrees_of_freedom,
    fit_noise,
    model_variance,
)
from jaxnav.noise_report.config import AllanConfig
from jaxnav.noise_report.rest import (
    coarse,
    doubts,
    quantum,
    unlike_neighbours,
    without_spikes,
)
from jaxnav.numerics.masks import runs_of
from jaxnav.results import SCHEMA, provenance
from jaxnav.units import ARCSEC, DEG_PER_HOUR, DEG_PER_SQRT_HOUR, GRAVITY, HOUR

SHORTEST = 72
"""Samples of a record that holds the four cluster sizes the fit needs."""
UNBROKEN = 16
"""Samples without a loss among them that hold those sizes."""
POOR_FIT = 5.0
"""Misfit per degree of freedom above which the four noises do not explain a record."""
CURVE_POINTS = 200
UNLIKE = 5.0
"""Standard deviations by which deviations by the mean and by the median may differ."""

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
        DataError: If the log is refused, or by :func:`prepare`.
    """
    return prepare(load_imu_csv(path), config)


def prepare(log: ImuLog, config: AllanConfig) -> ImuLog:
    """Return the part of a log that is asked for, on a regular grid, if it is one of a rest.

    Args:
        log: A log as it was recorded.
        config: The parameters.

    Raises:
        DataError: If the part is too short, its gaps are not told from jitter, or it is doubtful
            (:func:`~jaxnav.noise_report.rest.doubts`) and doubts are not accepted.
    """
    end_s = math.inf if config.end_s is None else config.end_s
    log = on_grid(window(log, config.start_s, end_s))
    if len(log.valid) < SHORTEST:
        raise DataError(
            f"{log.source}: the record of {len(log.valid)} samples is too short; accepted are at "
            f"least {SHORTEST}, and hours for the slow noises"
        )
    longest = max((stop - start for start, stop in runs_of(log.valid)), default=0)
    if longest < UNBROKEN:
        raise DataError(
            f"{log.source}: no more than {longest} samples follow each other without a loss; "
            f"accepted are at least {UNBROKEN}, which the fit needs"
        )
    found = doubts(log)
    if found and not config.accept_doubts:
        raise DataError(
            f"{log.source}: {found[0]}; accepted is a sensor at rest, a part of the log by "
            "--start-s and --end-s, or any log with --accept-doubts"
        )
    return log


def analyse(log: ImuLog, config: AllanConfig) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return what is known about the noise of the six sensors.

    Args:
        log: A log on a regular grid.
        config: The parameters.

    Returns:
        The contents of ``summary.json``, in the units of data sheets; and arrays in SI units:
        ``axis`` (6,), ``tau`` (M,), ``deviation``, ``low``, ``high`` and, by the median,
        ``median_deviation`` (6, M), and the fitted curve ``fit_deviation`` (6, 200) at ``fit_tau``
        (200,).
    """
    log, spikes = without_spikes(log)
    count = len(log.valid)
    shortest = unlike_neighbours(log)
    sizes = tuple(m for m in cluster_sizes(count, config.per_octave) if m >= shortest)
    rates = jnp.asarray(np.hstack([log.gyro, log.accel]).T)
    valid = None if log.valid.all() else jnp.asarray(log.valid)
    measured, fit, freedom, by_median = _axes(rates, valid, log.step_s, sizes)
    low, high = deviation_interval(measured, freedom, config.confidence)
    tau = np.asarray(measured.tau[0])
    fit_tau = np.geomspace(tau[0], tau[-1], CURVE_POINTS)
    curve = jax.vmap(model_variance, in_axes=(0, None))(fit.noise, jnp.asarray(fit_tau))
    arrays = {
        "axis": np.array(SENSORS),
        "tau": tau,
        "deviation": np.asarray(measured.deviation),
        "median_deviation": np.asarray(by_median.deviation),
        "low": low,
        "high": high,
        "fit_tau": fit_tau,
        "fit_deviation": np.sqrt(np.asarray(curve)),
    }
    notes = [
        *doubts(log),
        *_sampled(log, shortest),
        *_notes(measured, fit),
        *_unlike(log, measured, by_median),
    ]
    return _document(log, config, measured, fit, spikes, notes), arrays


@partial(compiled, static_argnums=3)
def _axes(
    rates: Array, valid: Array | None, step: float, sizes: tuple[int, ...]
) -> tuple[AllanVariance, NoiseFit, Array, AllanVariance]:
    # One axis after the other: a day at 400 Hz is a quarter of a gigabyte an array.
    return jax.lax.map(lambda rate: _one_axis(rate, valid, step, sizes), rates)


def _one_axis(
    rate: Array, valid: Array | None, step: float, sizes: tuple[int, ...]
) -> tuple[AllanVariance, NoiseFit, Array, AllanVariance]:
    count = rate.shape[0]
    measured = allan_variance(rate, step, sizes, valid)
    fit = fit_noise(measured, step, sizes, count)
    freedom = degrees_of_freedom(fit.noise, step, sizes, count, measured.share)
    return measured, fit, freedom, median_variance(rate, step, sizes, valid)


def _document(
    log: ImuLog,
    config: AllanConfig,
    measured: AllanVariance,
    fit: NoiseFit,
    spikes: int,
    notes: list[str],
) -> dict[str, Any]:
    low, high = coefficient_interval(fit, config.confidence)
    known = np.any(np.asarray(measured.variance) > 0, axis=1)
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
            "spikes": spikes,
        },
        "confidence": config.confidence,
        "per_octave": config.per_octave,
        "axes": {
            axis: _coefficients(axis, i, fit.noise, low, high, bool(known[i]))
            for i, axis in enumerate(SENSORS)
        },
        "notes": notes,
        "provenance": provenance(),
    }


def _coefficients(
    axis: str, i: int, noise: NoiseModel, low: NoiseModel, high: NoiseModel, known: bool
) -> dict[str, dict[str, Any]]:
    """Return value, interval and unit of each coefficient of an axis; ``None`` if it is dead."""
    names = _GYRO if axis.startswith("gyro") else _ACCEL
    numbers = {"value": noise, "low": low, "high": high}
    return {
        name: {
            key: float(getattr(model, field)[i]) / unit if known else None
            for key, model in numbers.items()
        }
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
            f"square per degree of freedom up to {misfit.max():.0f}), as with motion, a drift or "
            "a filter in the sensor; do not rely on these coefficients and intervals"
        )
    return notes


def _sampled(log: ImuLog, shortest: int) -> list[str]:
    """Return what the samples are, if they are not the sensor's noise itself."""
    notes = []
    if shortest > 1:
        notes.append(
            "neighbouring samples are alike: the sensor filters or repeats them; clusters of less "
            f"than {shortest} samples, {shortest * log.step_s:.3g} s, are left out"
        )
    steps = coarse(log)
    if steps and shortest == 1:
        notes.append(
            f"{', '.join(steps)}: most samples repeat the one before: the output's steps are "
            "larger than its noise, and the coefficients are those of the output, not the sensor's"
        )
    return notes


def _unlike(log: ImuLog, measured: AllanVariance, by_median: AllanVariance) -> list[str]:
    """Return where the deviations by the mean are not those by the median, a sentence an axis."""
    usual, middle = np.asarray(measured.deviation), np.asarray(by_median.deviation)
    sizes = np.asarray(measured.tau[0]) / log.step_s
    # about as many independent terms as clusters; both scatter, by 0.7 and 1.17 over their root
    scatter = np.sqrt((0.7**2 + 1.17**2) * sizes / np.maximum(np.asarray(measured.terms), 1))
    values = np.hstack([log.gyro, log.accel])[log.valid]
    coarse = np.array([quantum(axis) for axis in values.T])[:, None] / sizes
    judged = (middle > 2 * coarse) & (scatter < 0.3)
    ratio = np.where(judged, usual / np.where(judged, middle, 1), 1.0)
    off = np.abs(np.log(ratio)) / (UNLIKE * scatter + 0.05)
    notes = []
    for i in np.flatnonzero((off > 1).any(axis=1)):
        j = int(off[i].argmax())
        notes.append(
            f"{SENSORS[i]}: the Allan deviation at {measured.tau[i][j]:.3g} s is {ratio[i, j]:.3g} "
            "times that by the median of the changes: spikes, bursts or a noise that is not "
            "normal, of which coefficients and intervals know nothing"
        )
    return notes
