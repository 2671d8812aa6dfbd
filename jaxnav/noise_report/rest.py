"""Is a log that of a sensor at rest, in the units of its header? And samples that are spikes."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from jaxnav.datasets.inertial import SENSORS, ImuLog
from jaxnav.units import DEG, GRAVITY

LEVEL = 0.2
"""Share of gravity by which the specific force at rest may be off."""
FASTEST = 10 * DEG
"""Mean rate of a sensor at rest, its bias and the Earth's rate [rad/s]."""
NOISIEST = 0.2 * DEG
"""Random walk of a gyro [rad/s/sqrt(Hz)], a multiple of the worst on the market."""
SWING = np.array(3 * [3 * DEG] + 3 * [0.5])
"""Spread beyond the noise of a rate [rad/s] or force [m/s^2] that is motion and not drift."""
SPIKE = 12.0
"""Standard deviations from the median of its neighbours above which a sample is a spike."""
FEW_SPIKES = 1e-3
"""Share of samples that may be spikes; more are a property of the sensor."""
ALIKE = -0.35
"""Correlation of successive changes from which on samples are not those of white noise."""
LEAST_MEANS = 1000
"""Averages that tell that correlation."""
STILL = 0.3
"""Share of samples equal to the one before, above which the output's steps exceed its noise."""
_NEIGHBOURS = 11
_ALONE = 3
_NORMAL = 0.6745
"""Median of the absolute value of a standard normal variable."""


def doubts(log: ImuLog) -> list[str]:
    """Return what speaks against a sensor at rest in the units of the header, a sentence each.

    * The specific force is not that of gravity: columns swapped, a wrong unit, gravity taken off.
    * The gyros turn by more than a bias, or are noisier than any: deg/s under a header of rad/s.
    * A rate or a force moves by more than its noise and its drift.

    Rates in rad/s under a header of deg/s look like a better sensor and are not found.

    Args:
        log: A log on a regular grid.
    """
    valid = log.valid
    if not valid.any():
        return []
    values = np.hstack([log.gyro, log.accel])[valid]
    middle = np.median(values, axis=0)
    force = float(np.linalg.norm(middle[3:]))
    rate = float(np.linalg.norm(middle[:3])) / DEG
    noise = np.array([_white(axis) for axis in values.T])
    walk = noise[:3] * np.sqrt(log.step_s)
    found = []
    if abs(force / GRAVITY - 1) > LEVEL:
        found.append(
            f"the specific force is {force:.3g} m/s^2 in the middle and that of rest is 9.8: "
            "gyro and accelerometer columns may be swapped, the unit another, gravity taken off"
        )
    if rate > FASTEST / DEG:
        found.append(
            f"the gyros turn by {rate:.3g} deg/s in the middle, more than the bias of a sensor at "
            "rest: the unit may be another than the header says"
        )
    if walk.max() > NOISIEST:
        worst = walk.max() / DEG
        found.append(
            f"{SENSORS[int(walk.argmax())]} has a random walk of {worst:.3g} deg/s/sqrt(Hz), more "
            "than any gyro: the unit may be another than the header says"
        )
    low, high = np.percentile(values, (2.5, 97.5), axis=0)
    # what is left of the width when that of the noise, four standard deviations, is taken off
    swing = np.sqrt(np.maximum((high - low) ** 2 - (3.92 * noise) ** 2, 0))
    moved = swing > SWING
    for name, width in zip(np.array(SENSORS)[moved], swing[moved], strict=True):
        gyro = name.startswith("gyro")
        shown = f"{width / DEG:.3g} deg/s" if gyro else f"{width:.3g} m/s^2"
        found.append(f"{name} moves by {shown} beyond its noise: the sensor is not at rest")
    return found


def without_spikes(log: ImuLog) -> tuple[ImuLog, int]:
    """Return the log with spikes as lost samples, and their number.

    A spike is more than :data:`SPIKE` standard deviations off the median of the eleven samples
    about it. Where more than :data:`FEW_SPIKES` of the samples are, none is taken out, nor where
    they crowd: that is a bump, which a reader should see.

    Args:
        log: A log on a regular grid.
    """
    values = np.hstack([log.gyro, log.accel])[log.valid]
    spike = np.zeros(len(values), bool)
    for axis in values.T:
        off = np.abs(axis - median_filter(axis, _NEIGHBOURS, mode="nearest"))
        # of a coarse sensor more than half may be zero, and all but a few
        scale = max(np.median(off) / _NORMAL, np.percentile(off, 99) / 2.576, quantum(axis))
        spike |= off > SPIKE * scale
    crowd = np.convolve(spike, np.ones(2 * _NEIGHBOURS - 1), "same")
    spike &= crowd <= _ALONE
    count = int(np.sum(spike))
    if count == 0 or count > FEW_SPIKES * len(values):
        return log, 0
    valid = log.valid.copy()
    valid[np.flatnonzero(valid)[spike]] = False
    keep = valid[:, None]
    return log._replace(
        valid=valid, gyro=np.where(keep, log.gyro, 0.0), accel=np.where(keep, log.accel, 0.0)
    ), count


def unlike_neighbours(log: ImuLog) -> int:
    """Return the shortest cluster that a filter in the sensor, or a held sample, hardly touches.

    The changes of white noise have a correlation of -1/2 from one to the next, those of a sensor
    that filters or holds its samples a larger one. Averages of a few samples have it again, and
    clusters of eight times as many lose a few percent to the filter. One where samples are as they
    should be, and where the record is too short for that.

    Args:
        log: A log on a regular grid.
    """
    values = np.where(log.valid[:, None], np.hstack([log.gyro, log.accel]), np.nan)
    if max(map(_alike, values.T)) < ALIKE:
        return 1
    for size in (2, 4, 8, 16, 32, 64):
        whole = len(values) // size
        means = values[: whole * size].reshape(whole, size, 6).mean(axis=1)
        if whole < LEAST_MEANS:
            return 1
        if max(map(_alike, means.T)) < ALIKE:
            return 8 * size
    return 1


def _alike(axis: NDArray[np.float64]) -> float:
    """Return the correlation of a change with the one before, -1/2 for white noise."""
    change = np.diff(axis)
    pair = np.isfinite(change[1:]) & np.isfinite(change[:-1])
    one, other = change[:-1][pair], change[1:][pair]
    power = float(one @ one)
    return float(one @ other) / power if power > 0 else -0.5


def coarse(log: ImuLog) -> list[str]:
    """Return the axes whose output mostly stays what it was, a dead one not among them."""
    values = np.hstack([log.gyro, log.accel])[log.valid]
    still = np.mean(np.diff(values, axis=0) == 0, axis=0)
    return [name for name, share in zip(SENSORS, still, strict=True) if STILL < share < 1]


def quantum(axis: NDArray[np.float64]) -> float:
    """Return the smallest change of a sensor's output, zero if it never changes.

    Args:
        axis: ``(N,)``.
    """
    change = np.abs(np.diff(axis))
    return float(np.min(change, where=change > 0, initial=np.inf)) if change.any() else 0.0


def _white(axis: NDArray[np.float64]) -> float:
    """Return the standard deviation of what changes from sample to sample."""
    change = np.abs(np.diff(axis, 2))
    if not len(change):
        return 0.0
    return float(max(np.median(change) / _NORMAL, np.percentile(change, 95) / 1.96) / np.sqrt(6))
