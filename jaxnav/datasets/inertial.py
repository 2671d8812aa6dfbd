"""Recorded inertial logs from plain CSV: what is read, what is refused, and a regular time grid.

The format. Lines that are blank or start with ``#`` are ignored. The first other line is the
header: names with units in brackets, separated by commas, in any order. Needed are

    time [s|ms|us|ns], gyro_x, gyro_y, gyro_z [rad/s|deg/s], accel_x, accel_y, accel_z [m/s^2|g]

with g = 9.80665 m/s^2; each column has its own unit, and further columns are ignored. A gyro
measures the rate of the body against inertial space, an accelerometer specific force: +1 g upwards
at rest. Time counts from any origin and does not decrease. An entry that is empty, ``nan`` or
infinite makes its row a lost sample.
"""

import math
import re
from decimal import Decimal
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxnav.datasets.base import DataError, read_text
from jaxnav.datasets.plausible import check_plausible
from jaxnav.units import DEG, GRAVITY

SENSORS = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")
COLUMNS = ("time", *SENSORS)
GAP = 1.5
"""Intervals above so many median intervals are gaps."""
SPARSEST = 100
"""Samples of a regular grid for each sample of the log, at most."""

_DIGITS = {"s": 9, "ms": 6, "us": 3, "ns": 0}  # powers of ten to nanoseconds
_RATE = {"rad/s": 1.0, "deg/s": DEG}
_FORCE = {"m/s^2": 1.0, "g": GRAVITY}
_UNITS = {"time": _DIGITS} | dict.fromkeys(SENSORS[:3], _RATE) | dict.fromkeys(SENSORS[3:], _FORCE)
_HEADING = re.compile(r"(\w+)\s*\[\s*([^\]\s]*)\s*\]")
_ACCEPTED = "a readable CSV log with the columns " + ", ".join(COLUMNS)
_LARGEST_NS = 2**62


class ImuLog(NamedTuple):
    """An inertial log of N samples, strictly increasing in time.

    Attributes:
        time_ns: ``(N,) [ns]`` from the log's own origin.
        gyro: Angular rate ``(N, 3) [rad/s]``; zero where not valid.
        accel: Specific force ``(N, 3) [m/s^2]``; zero where not valid.
        valid: Whether all six entries of a sample are known, ``(N,)``.
        step_s: Sampling interval [s], the mean of the intervals that are no gaps: time stamps in
            whole milliseconds have a median interval that is wrong by percents.
        duplicates: Rows dropped because they repeat the time before.
        nan_rows: Rows with an entry that is empty, not a number or infinite.
        gaps: Intervals above one and a half median intervals.
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


class _Layout(NamedTuple):
    places: list[int]
    units: list[str]
    width: int


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
    time_ns, values = _read_rows(Path(path))
    fresh = np.diff(time_ns, prepend=time_ns[0] - 1) > 0
    duplicates = int(np.sum(~fresh))
    time_ns, values = time_ns[fresh], values[fresh]
    if len(time_ns) < 2:
        raise DataError(f"{path}: the log has {len(time_ns)} samples; accepted are at least two")
    valid = np.asarray(np.isfinite(values).all(axis=1))
    values = np.where(valid[:, None], values, 0.0)
    log = _assemble(time_ns, values, valid, duplicates, str(path))
    try:
        check_plausible(log.gyro[valid], log.accel[valid], log.step_s)
    except DataError as error:
        raise DataError(f"{path}: {error}") from None
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
            f"{log.source}: the window from {start_s} s to {end_s} s holds {len(inside)} samples; "
            f"accepted is one with two or more, and the log lasts {since[-1]:.6g} s"
        )
    values = np.hstack([log.gyro, log.accel])[inside]
    return _assemble(log.time_ns[inside], values, log.valid[inside], log.duplicates, log.source)


def on_grid(log: ImuLog) -> ImuLog:
    """Return the log on a regular grid, missing samples as samples that are not valid.

    Each interval is rounded to a whole number of steps, one at least, so that neither the jitter
    of time stamps nor the drift of a clock loses a sample.

    Args:
        log: The log.

    Returns:
        The log with ``N + missing`` samples; the counts stay.

    Raises:
        DataError: If the gaps hold more than a hundred times the samples of the log.
    """
    intervals = np.diff(log.time_ns)
    steps = _steps(intervals)
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


def _assemble(
    time_ns: NDArray[np.int64],
    values: NDArray[np.float64],
    valid: NDArray[np.bool_],
    duplicates: int,
    source: str,
) -> ImuLog:
    intervals = np.diff(time_ns)
    steps = _steps(intervals)
    return ImuLog(
        time_ns=time_ns,
        gyro=values[:, :3],
        accel=values[:, 3:],
        valid=valid,
        step_s=float(np.mean(intervals[steps == 1])) / 1e9,
        duplicates=duplicates,
        nan_rows=int(np.sum(~valid)),
        gaps=int(np.sum(steps > 1)),
        missing=int(np.sum(steps - 1)),
        source=source,
    )


def _steps(intervals: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return how many steps each interval is; up to one and a half it is one."""
    ratio = intervals / np.median(intervals)
    return np.maximum(1, np.ceil(ratio - (GAP - 1))).astype(np.int64)


def _read_rows(path: Path) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return times [ns], not decreasing, and rates and forces ``(N, 6)`` in SI units."""
    layout, times, rows = None, [], []
    for line, text in enumerate(read_text(path, _ACCEPTED).split("\n"), start=1):
        if not text.strip() or text.startswith("#"):
            continue
        fields = [field.strip() for field in text.split(",")]
        try:
            if layout is None:
                layout = _layout(fields)
                continue
            if len(fields) != layout.width:
                raise DataError(
                    f"the line has {len(fields)} columns; accepted are {layout.width}, as in the "
                    "header"
                )
            times.append(_nanoseconds(fields[layout.places[0]], layout.units[0]))
            if len(times) > 1 and times[-1] < times[-2]:
                raise DataError(
                    f"the time {fields[layout.places[0]]} is before that of the previous row; "
                    "accepted are times that do not decrease"
                )
            places = zip(SENSORS, layout.places[1:], strict=True)
            rows.append([_entry(name, fields[place]) for name, place in places])
        except DataError as error:
            raise DataError(f"{path}, line {line}: {error}") from None
    if layout is None or not rows:
        lacks = "header" if layout is None else "sample"
        raise DataError(f"{path}: the file has no {lacks}; accepted is {_ACCEPTED}")
    units = zip(SENSORS, layout.units[1:], strict=True)
    factors = [_UNITS[name][unit] for name, unit in units]
    return np.array(times, dtype=np.int64), np.array(rows, dtype=np.float64) * factors


def _layout(header: list[str]) -> _Layout:
    """Return the place and the unit of each column that is read."""
    found: dict[str, tuple[int, str]] = {}
    for place, text in enumerate(header):
        match = _HEADING.fullmatch(text)
        name = match[1] if match else text
        if name not in COLUMNS:
            continue
        accepted = ", ".join(_UNITS[name])
        if name in found:
            raise DataError(f"the column {name} is there twice; accepted is once")
        if not match:
            raise DataError(
                f"the column {name} has no unit; accepted is {name} [unit] with one of {accepted}"
            )
        if match[2] not in _UNITS[name]:
            raise DataError(f"the unit of {name} is {match[2]!r}; accepted are {accepted}")
        found[name] = (place, match[2])
    missing = [name for name in COLUMNS if name not in found]
    if missing:
        raise DataError(
            f"the header does not name {', '.join(missing)}; accepted are columns such as "
            "time [s], gyro_x [rad/s], accel_x [m/s^2]"
        )
    places, units = zip(*(found[name] for name in COLUMNS), strict=True)
    return _Layout(list(places), list(units), len(header))


def _nanoseconds(text: str, unit: str) -> int:
    """Convert a time to whole nanoseconds; a float would lose digits of a count since 1970."""
    try:
        time = Decimal(text).scaleb(_DIGITS[unit])
        if abs(time) < _LARGEST_NS:
            return int(time.to_integral_value())
    except ArithmeticError:
        pass
    raise DataError(f"time is {text!r}; accepted is a decimal number within 146 years of zero")


def _entry(name: str, text: str) -> float:
    try:
        return float(text) if text else math.nan
    except ValueError:
        raise DataError(
            f"{name} is {text!r}; accepted is a decimal number, or nothing for a lost one"
        ) from None
