"""How many samples lie between time stamps, whatever jitter, rounding and loss do to them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

GAP = 1.5
"""Intervals above so many sampling intervals are gaps, unless jitter explains them."""
_NEAR = 0.2
"""Distance from a whole number of sampling intervals within which an interval counts as whole."""
_MOST = 0.95
_WINDOW = 32
"""Samples on either side of a long interval over which jitter is averaged."""
_SURE = 3.0
"""Sampling intervals above which jitter does not explain an interval."""
_FEW = 0.02
"""Share of intervals that are long without as many short ones, up to which gaps can be told from
jitter."""


class Steps(NamedTuple):
    """How many sampling intervals lie between N stamps.

    Attributes:
        count: ``(N - 1,)``, one or more; one where nothing is missing.
        step: Sampling interval, the mean of those that are one: stamps in whole milliseconds have a
            median interval that is wrong by percents.
        told: Whether gaps could be told from jitter.
    """

    count: NDArray[np.int64]
    step: float
    told: bool = True


def steps_between(intervals: NDArray[np.int64]) -> Steps:
    """Return how many sampling intervals each interval between stamps is.

    * The sampling interval is the median one, unless nearly all are whole multiples of a shorter
      one: every third sample may be lost.
    * An interval is rounded, up to one and a half to one. So neither rounded stamps nor the drift
      of a clock loses a sample.
    * Where stamps jitter by much, a long interval is followed or led by a short one. There a long
      interval is a gap only by as much as the samples after it are late against those before.

    Args:
        intervals: ``(N - 1,)``, positive, in any unit.
    """
    unit = float(np.median(intervals))
    shorter = _shortest(intervals)
    if np.mean(_off(intervals / shorter) < _NEAR) > _MOST:
        unit = shorter
    count = np.maximum(1, np.ceil(intervals / unit - (GAP - 1))).astype(np.int64)
    whole = float(np.mean(intervals[count == 1]))
    if len(intervals) < 4 * _WINDOW or np.mean(_off(intervals / whole) < _NEAR) > _MOST:
        return Steps(count, whole)
    late = np.cumsum(intervals)
    whole = float(np.median(late[_WINDOW:] - late[:-_WINDOW])) / _WINDOW
    count = _averaged(intervals, whole)
    unmatched = np.mean(intervals > GAP * whole) - np.mean(intervals < (2 - GAP) * whole)
    return Steps(count, whole, told=bool(unmatched <= _FEW))


def _shortest(intervals: NDArray[np.int64]) -> float:
    """Return the mean of the intervals about the tenth percentile."""
    low = np.percentile(intervals, 10)
    return float(np.mean(intervals[np.abs(intervals - low) <= _NEAR * low]))


def _off(ratio: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance from the nearest whole number, from one on."""
    return np.abs(ratio - np.maximum(1, np.rint(ratio)))


def _averaged(intervals: NDArray[np.int64], step: float) -> NDArray[np.int64]:
    """Return the count from how much later than before the samples after each interval are.

    The two samples next to it are left out: where they jitter apart, the interval is long. Long
    intervals within a window of each other see the same gap, which is that of the one that sees
    the most of it.
    """
    plain = np.where(intervals > _SURE * step, np.rint(intervals / step), 1).astype(np.int64)
    late = np.concatenate([[0.0], np.cumsum(intervals - plain * step)])
    total = np.concatenate([[0.0], np.cumsum(late)])
    last = np.flatnonzero((intervals > GAP * step) & (plain == 1))
    before = np.maximum(last - _WINDOW, 0)
    begin = np.minimum(last + 2, len(late))
    after = np.minimum(begin + _WINDOW, len(late))
    ahead = (total[last] - total[before]) / np.maximum(last - before, 1)
    behind = (total[after] - total[begin]) / np.maximum(after - begin, 1)
    jump = np.where((last > before) & (after > begin), (behind - ahead) / step, 0.0)
    last, jump = last[jump > 0.5], jump[jump > 0.5]
    group = np.cumsum(np.diff(last, prepend=0) > _WINDOW)
    for own in np.unique(group):
        best = np.argmax(np.where(group == own, jump, 0.0))
        plain[last[best]] += int(np.rint(jump[best]))
    return plain
