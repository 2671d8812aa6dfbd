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
_PAIRED = -0.35
"""Correlation of successive intervals, -1/2 for jitter alone, below which gaps are told from it."""
_STRETCH = 4096
"""Stamps of which the phase on a grid is one."""
_COHERENT = 0.6
"""Least coherence on a grid, that of stamps off by a sixth of its step."""


class Steps(NamedTuple):
    """How many sampling intervals lie between N stamps.

    Attributes:
        between: ``(N - 1,)``, one or more; one where nothing is missing.
        step: Sampling interval, the mean of those that are one: stamps in whole milliseconds have a
            median interval that is wrong by percents.
        certain: Whether gaps could be told from jitter.
    """

    between: NDArray[np.int64]
    step: float
    certain: bool = True


def steps_between(intervals: NDArray[np.int64]) -> Steps:
    """Return how many sampling intervals each interval between stamps is.

    * The sampling interval is the median one, unless nearly all are whole multiples of a shorter
      one: every third sample may be lost.
    * An interval is rounded, up to one and a half to one. So neither rounded stamps nor the drift
      of a clock loses a sample.
    * Stamps that are off by up to a third of that, as rounded ones may be, are counted on the
      regular grid that they are closest to.
    * Where they jitter by more, a long interval is followed or led by a short one, and is a gap
      only by as much as the samples after it are late against those before. With many missing
      besides, gaps are not told from jitter.

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
    regular = _on_grid(intervals, float(np.mean(intervals[intervals < GAP * unit])))
    if regular is not None:
        return regular
    late = np.cumsum(intervals)
    whole = float(np.median(late[_WINDOW:] - late[:-_WINDOW])) / _WINDOW
    # the jitter of a stamp makes one interval longer and the next shorter, a loss makes one longer
    moved = intervals[intervals < _SURE * whole] - whole
    certain = float(moved[1:] @ moved[:-1]) < _PAIRED * float(moved @ moved)
    return Steps(_averaged(intervals, whole), whole, certain)


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


def _on_grid(intervals: NDArray[np.int64], near: float) -> Steps | None:
    """Return the count on the regular grid that stamps are closest to, or ``None`` if to none.

    The interval is refined over ever more stamps, since over many a small error of it adds up; the
    phase is taken anew every :data:`_STRETCH` stamps, so that a clock may drift.

    Args:
        intervals: ``(N - 1,)``.
        near: A sampling interval that is right to a tenth.
    """
    late = np.concatenate([[0.0], np.cumsum(intervals)])
    step, width = near, 0.1
    length = 32
    while True:
        part = late[: min(length, len(late))]
        resolved = 0.1 * step / (part[-1] - part[0])
        trials = step * (1 + np.arange(-width, width + resolved, resolved))
        step = float(trials[np.argmax([_coherence(part, trial) for trial in trials])])
        if length >= min(_STRETCH, len(late)):
            break
        width, length = 2 * resolved, 4 * length
    index, shift = np.empty(len(late)), 0.0
    for begin in range(0, len(late), _STRETCH):
        part = late[begin : begin + _STRETCH] / step
        turn = np.exp(2j * np.pi * part)
        if abs(turn.mean()) < _COHERENT:
            return None
        phase = np.angle(turn.mean()) / (2 * np.pi)
        # the phase of this stretch is that of the one before, but for what the clock drifted
        phase += np.rint(shift - phase)
        shift = phase
        index[begin : begin + _STRETCH] = np.rint(part - phase)
    count = np.diff(index).astype(np.int64)
    if count.min() < 1:
        return None
    return Steps(count, float(late[-1] / count.sum()))


def _coherence(late: NDArray[np.float64], step: float) -> float:
    """Return how well stamps keep to a grid of a step, 1 at best."""
    return abs(np.exp(2j * np.pi * late / step).mean())
