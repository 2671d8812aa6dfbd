"""Recorded inertial logs from plain CSV: what is read, what is refused, and a regular time grid.

The format is that of :mod:`jaxnav.datasets.table` with the columns

    time [s|ms|us|ns], gyro_x, gyro_y, gyro_z [rad/s|deg/s], accel_x, accel_y, accel_z [m/s^2|g]

with g = 9.80665 m/s^2. A gyro measures the rate of the body against inertial space, an
accelerometer specific force: +1 g upwards at rest. An entry that is not known makes its row a lost
sample.
"""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxnav.datasets.base import DataError
from jaxnav.datasets.plausible import check_plausible
from jaxnav.datasets.stamps import steps_between
from jaxnav.datasets.table import FORCE, RATE, Units, read_table

SENSORS = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")
COLUMNS = ("time", *SENSORS)
SENSOR_UNITS: Units = {name: RATE if name.startswith("gyro") else FORCE for name in SENSORS}
REPEATED = 0.05
"""Share of samples that may repeat a time: a logger that wrote some of them twice."""
MANY = 100
"""Samples above which a share of them means something."""
SPARSEST = 100
"""Samples of a regular grid for each sample of the log, at most."""

_ACCEPTED = "a readable CSV log with the columns " + ", ".join(COLUMNS)


class ImuLog(NamedTuple):
    """An inertial log of N samples, strictly increasing in time.

    Attributes:
        time_ns: ``(N,) [ns]`` from the log's own origin.
        gyro: Angular rate ``(N, 3) [rad/s]``; zero where not valid.
        accel: Specific force ``(N, 3) [m/s^2]``; zero where not valid.
        valid: Whether all six entries of a sample are known, ``(N,)``.
        step_s: Sampling interval [s] (:func:`~jaxnav.datasets.stamps.steps_between`).
        duplicates: Rows dropped because they repeat the time before.
        nan_rows: Rows with an entry that is empty, not a number, infinite or cut off.
        gaps: Intervals in which samples are missing.
        missing: Samples that those intervals lack.
        source: Path of the file.
    """

    time_ns: NDArray[np.int64]
    gyro: NDArray[np.float64]
    accel: NDArray[np.float64]
    valid: NDArray[np.bool_]
    step_s: float
    duplicates: int
    nan_rows: int
    gaps: int
    missing: int
    source: str


def load_imu_csv(path: str | Path) -> ImuLog:
    """Read an inertial log in the CSV format of this module.

    Args:
        path: The file.

    Returns:
        The log, its samples at the times of the file.

    Raises:
        DataError: If the file cannot be read, has no header that names the columns and their
            units, has a malformed line or a time that goes backwards, holds fewer than two
            samples, or is implausible (:func:`check_plausible`).
    """
    table = read_table(Path(path), SENSOR_UNITS, _ACCEPTED)
    values = np.stack([table.columns[name] for name in SENSORS], axis=1)
    log = assemble(table.time_ns, values, str(path))
    return log._replace(nan_rows=log.nan_rows + table.cut)


def assemble(time_ns: NDArray[np.int64], values: NDArray[np.float64], source: str) -> ImuLog:
    """Return the log of rows as they were read: repeated times dropped, what is lost counted.

    Args:
        time_ns: ``(N,) [ns]``, not decreasing.
        values: Rate [rad/s] and specific force [m/s^2], ``(N, 6)``; NaN or infinite where lost.
        source: Path of the file.

    Raises:
        DataError: If a time goes backwards, many repeat the one before, fewer than two samples are
            left, or they are implausible (:func:`check_plausible`).
    """
    steps = np.diff(time_ns, prepend=time_ns[:1] - 1)
    if np.any(steps < 0):
        raise DataError(
            f"{source}: the time of sample {np.argmax(steps < 0) + 1} is before that of the "
            "previous one; accepted are times that do not decrease"
        )
    repeats = float(np.mean(steps == 0)) if len(steps) else 0.0
    if repeats > REPEATED and len(steps) > MANY:
        raise DataError(
            f"{source}: {repeats:.0%} of the samples repeat the time of the one before: their "
            "stamps are too coarse for the rate; accepted are stamps that tell samples apart"
        )
    time_ns, values = time_ns[steps > 0], values[steps > 0]
    if len(time_ns) < 2:
        raise DataError(f"{source}: the log has {len(time_ns)} samples; accepted are at least two")
    valid = np.asarray(np.isfinite(values).all(axis=1))
    values = np.where(valid[:, None], values, 0.0)
    log = _counted(time_ns, values, valid, int(np.sum(steps == 0)), source)
    try:
        check_plausible(log.gyro[valid], log.accel[valid], log.step_s)
    except DataError as error:
        raise DataError(f"{source}: {error}") from None
    return log


def window(log: ImuLog, start_s: float = 0.0, end_s: float = math.inf) -> ImuLog:
    """Return the samples between two times since the first sample, both included.

    Gaps and lost samples are counted anew; ``duplicates`` stays that of the file.

    Args:
        log: The log.
        start_s: Begin [s].
        end_s: End [s].

    Raises:
        DataError: If fewer than two samples are left.
    """
    since = (log.time_ns - log.time_ns[0]) / 1e9
    inside = np.flatnonzero((since >= start_s) & (since <= end_s))
    if len(inside) < 2:
        raise DataError(
            f"{log.source}: the window from {start_s} s to "
            f"{'the end' if end_s == math.inf else f'{end_s} s'} holds {len(inside)} samples; "
            f"accepted is one with two or more, and the log lasts {since[-1]:.6g} s"
        )
    values = np.hstack([log.gyro, log.accel])[inside]
    return _counted(log.time_ns[inside], values, log.valid[inside], log.duplicates, log.source)


def on_grid(log: ImuLog) -> ImuLog:
    """Return the log on a regular grid, missing samples as samples that are not valid.

    Each interval is rounded to a whole number of steps, one at least, so that neither the jitter
    of time stamps nor the drift of a clock loses a sample.

    Args:
        log: The log.

    Returns:
        The log with ``N + missing`` samples; the counts stay.

    Raises:
        DataError: If the gaps hold more than a hundred times the samples of the log, or are not
            told from jitter.
    """
    intervals = np.diff(log.time_ns)
    steps, _, certain = steps_between(intervals)
    if not certain:
        raise DataError(
            f"{log.source}: many samples are missing and the stamps of the others scatter by a "
            "large part of the sampling interval, so gaps are not told from jitter; accepted are "
            "even stamps or complete samples"
        )
    count = 1 + int(steps.sum())
    if count > SPARSEST * len(log.time_ns):
        raise DataError(
            f"{log.source}: gaps of up to {intervals.max() / 1e9:.6g} s make {count} samples of "
            f"{len(log.time_ns)}; accepted are at most {SPARSEST} for one, so choose a window"
        )
    index = np.concatenate([[0], np.cumsum(steps)])
    gyro, accel, valid = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count, bool)
    gyro[index], accel[index], valid[index] = log.gyro, log.accel, log.valid
    since = np.rint(np.arange(count) * (log.step_s * 1e9)).astype(np.int64)
    return log._replace(time_ns=log.time_ns[0] + since, gyro=gyro, accel=accel, valid=valid)


def _counted(
    time_ns: NDArray[np.int64],
    values: NDArray[np.float64],
    valid: NDArray[np.bool_],
    duplicates: int,
    source: str,
) -> ImuLog:
    steps, step, _ = steps_between(np.diff(time_ns))
    return ImuLog(
        time_ns=time_ns,
        gyro=values[:, :3],
        accel=values[:, 3:],
        valid=valid,
        step_s=step / 1e9,
        duplicates=duplicates,
        nan_rows=int(np.sum(~valid)),
        gaps=int(np.sum(steps > 1)),
        missing=int(np.sum(steps - 1)),
        source=source,
    )
