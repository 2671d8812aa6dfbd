"""How the course of the fixes and the vertical gyro turn: alike, and at which offset of the clocks.

Neither needs a filter, so that what they say of each other holds whatever a filter makes of it.
"""

import math
from typing import NamedTuple

import numpy as np

from jaxnav.datasets.drive import DriveLog
from jaxnav.recorded.motion import course_velocity, since_start
from jaxnav.units import DEG

GRID_S = 0.1
SPAN_S = 1.0
"""Turns of the course and of the gyros are compared over so long, on a grid."""
LAGS_S = 30.0
"""Largest offset between the clocks that is looked for."""
LEAST_POINTS = 20
"""Points of two series that are compared at least."""
LEAST_TURN = 3 * DEG
"""Root mean square of the turn rate [rad/s] that a course must show to be compared at all."""
COURSE_SPEED = 3.0
"""Speed [m/s] from which on a velocity gives a course."""
_LEAST_KNOWN = 200
"""Points at which a course must be known to be compared."""


class Turns(NamedTuple):
    """Turn rates to the left [rad/s] on the grid, by the course and by the z gyro; NaN unknown."""

    course: np.ndarray
    gyro: np.ndarray


def turns(log: DriveLog, offset_s: float) -> Turns:
    """Return the turn rates of a drive.

    Args:
        log: The drive.
        offset_s: What is added to the times of the fixes [s].
    """
    time = since_start(log.imu.time_ns, log)
    grid = np.arange(time[0], time[-1], GRID_S)
    rate = np.where(log.imu.valid, log.imu.gyro[:, 2], 0.0)
    angle = np.concatenate([[0.0], np.cumsum(rate[1:] * np.diff(time))])
    turned = np.interp(grid, time, angle)
    velocity = course_velocity(log.fixes)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    fast = speed > COURSE_SPEED
    course = np.full(len(grid), np.nan)
    if fast.sum() > 2:
        fix_time = since_start(log.fixes.time_ns, log) + offset_s
        left = np.unwrap(-np.arctan2(velocity[fast, 0], velocity[fast, 1]))
        course = np.interp(grid, fix_time[fast], left, left=np.nan, right=np.nan)
        # Between fast fixes that are far apart nothing is known.
        after = np.clip(np.searchsorted(fix_time[fast], grid), 1, fast.sum() - 1)
        wide = fix_time[fast][after] - fix_time[fast][after - 1] > 1.5
        course[wide] = np.nan
    span = round(SPAN_S / GRID_S)

    def over_span(angle: np.ndarray) -> np.ndarray:
        return (angle[span:] - angle[:-span]) / SPAN_S

    rates = over_span(course)
    # A turn of the course beyond half a turn a second is a reversal, or noise at walking pace.
    rates[np.abs(rates) > 2.0] = np.nan
    gyro = over_span(turned)
    return Turns(rates, gyro - np.median(gyro))


def matched(
    a: np.ndarray, b: np.ndarray, lag: int = 0, least: int = LEAST_POINTS
) -> tuple[float, float]:
    """Return correlation, and slope of ``b`` over ``a``, with ``a`` taken so many points later.

    Fewer than ``least`` points in common tell nothing: a correlation of 0.
    """
    if lag >= 0:
        a, b = a[lag:], b[: len(b) - lag]
    else:
        a, b = a[:lag], b[-lag:]
    known = np.isfinite(a) & np.isfinite(b)
    if known.sum() < least:
        return 0.0, math.nan
    a, b = a[known] - a[known].mean(), b[known] - b[known].mean()
    both = float(a @ b)
    size = math.sqrt(float(a @ a) * float(b @ b))
    correlation = both / size if size > 0 else 0.0
    return min(1.0, max(-1.0, correlation)), float(b @ b) / both if both else math.nan


class Clocks(NamedTuple):
    """How course and gyro turn together.

    Attributes:
        correlation: At the lag where it is largest, by its size; negative if they turn against each
            other.
        slope: Turn rate of the gyro over that of the course.
        late_s: By how much the fixes are late [s], on the grid.
    """

    correlation: float
    slope: float
    late_s: float


def clocks(log: DriveLog, offset_s: float) -> Clocks | None:
    """Return how course and gyro turn together, or ``None`` where the course hardly turns.

    Args:
        log: The drive.
        offset_s: What is added to the times of the fixes [s].
    """
    course, gyro = turns(log, offset_s)
    known = np.isfinite(course)
    if known.sum() < _LEAST_KNOWN or np.sqrt(np.mean(course[known] ** 2)) < LEAST_TURN:
        return None
    most = min(round(LAGS_S / GRID_S), len(course) // 3)
    lags, enough = np.arange(-most, most + 1), int(known.sum()) // 2
    found = np.array([matched(course, gyro, int(lag), enough)[0] for lag in lags])
    best = int(np.argmax(np.abs(found)))
    slope = matched(course, gyro, int(lags[best]), enough)[1]
    return Clocks(float(found[best]), slope, float(lags[best]) * GRID_S)
