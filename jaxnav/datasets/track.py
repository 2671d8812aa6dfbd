"""Recorded fixes of a satellite receiver as a plain container, whichever file they come from."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxnav.datasets.base import DataError


class GnssTrack(NamedTuple):
    """A log of T fixes, strictly increasing in time.

    Attributes:
        time_ns: ``(T,) [ns]``; GPS time since 1970-01-01 without leap seconds, or the log's own
            clock, as its loader says.
        geodetic: ``(T, 3)`` latitude, longitude in [-pi, pi] [rad] and height [m]; loaders of
            drives give ellipsoidal height.
        velocity: ``(T, 3) [m/s]`` east, north, up; NaN where an entry is not known, ``None`` where
            the log has no velocity at all.
        position_sigma: Standard deviation ``(T, 3) [m]`` east, north, up.
        velocity_sigma: ``(T, 3) [m/s]`` east, north, up; NaN or ``None`` as the velocity.
        quality: ``(T,)`` in RTKLIB's numbers: 1 carrier phase with fixed ambiguities, 2 with float
            ones, 3 with corrections of a satellite (SBAS), 4 differential code, 5 code alone,
            6 precise point positioning; 0 where the log does not say.
        source: Path of the file.
        duplicates: Fixes of the file dropped because they repeat the time before.
        unsolved: Fixes of the file dropped because the receiver had no solution.
    """

    time_ns: NDArray[np.int64]
    geodetic: NDArray[np.float64]
    velocity: NDArray[np.float64] | None
    position_sigma: NDArray[np.float64]
    velocity_sigma: NDArray[np.float64] | None
    quality: NDArray[np.int64]
    source: str
    duplicates: int
    unsolved: int = 0


class Sigmas(NamedTuple):
    """Standard deviations, east, north, up, of fixes whose log gives none.

    The defaults are for a receiver that uses the code alone. That of the recorded segment of
    comma2k19 was off by 1.5 m horizontally, 1.1 m up, and 0.12 m/s an axis; since such errors last
    for minutes, and a filter takes them as new in each fix, all are put two to five times higher.

    Attributes:
        position: [m].
        velocity: [m/s].
    """

    position: tuple[float, float, float] = (3.0, 3.0, 5.0)
    velocity: tuple[float, float, float] = (0.3, 0.3, 0.3)


def without_repeats(track: GnssTrack) -> GnssTrack:
    """Return the log without the fixes that repeat the time before, counted.

    Args:
        track: The log as read.

    Raises:
        DataError: If a time goes backwards.
    """
    steps = np.diff(track.time_ns)
    if np.any(steps < 0):
        raise DataError(
            f"{track.source}: the time of fix {np.argmax(steps < 0) + 2} is before that of the "
            "previous one; accepted are times that do not decrease"
        )
    fresh = np.flatnonzero(np.concatenate([[1], steps])[: len(track.time_ns)])
    dropped = len(track.time_ns) - len(fresh)
    return _take(track, fresh)._replace(duplicates=track.duplicates + dropped)


def with_solution(track: GnssTrack, solved: NDArray[np.bool_] | None = None) -> GnssTrack:
    """Return the log without the fixes of a receiver that had no solution, counted.

    A latitude and a longitude of exactly zero are such a fix whatever the log says of it.

    Args:
        track: The log as read.
        solved: ``(T,)`` which fixes the log calls one; ``None`` if it does not say.
    """
    null = np.all(track.geodetic[:, :2] == 0, axis=1)
    kept = ~null if solved is None else solved & ~null
    dropped = int(np.sum(~kept))
    return _take(track, np.flatnonzero(kept))._replace(unsolved=track.unsolved + dropped)


def thin(track: GnssTrack, period_s: float) -> GnssTrack:
    """Keeps the epochs nearest a regular grid that starts at the first epoch.

    A grid point with no epoch within one median interval, as in a gap, keeps none.

    Args:
        track: The log.
        period_s: Grid period [s], at least the median interval of the log.

    Returns:
        The thinned log; `duplicates` stays that of the file.

    Raises:
        DataError: If the period is not positive and finite, or is shorter than the median interval.
    """
    _check_positive("thinning period [s]", period_s)
    median = _median_interval_ns(track)
    period = round(min(period_s, 1e9) * 1e9)  # capped at 31 years, so that it stays in int64
    if period < median:
        raise DataError(
            f"{track.source}: the thinning period {period_s} s is shorter than the median "
            f"interval; accepted is at least {median / 1e9} s"
        )
    if len(track.time_ns) < 2:
        return track
    since = track.time_ns - track.time_ns[0]
    point = (since + period // 2) // period
    offset = np.abs(since - point * period)
    order = np.lexsort((offset, point))
    nearest = order[np.unique(point[order], return_index=True)[1]]
    # A grid point past the end of the log would keep the last epoch off the grid.
    on_grid = (offset <= median) & (point * period <= since[-1] + median / 2)
    return _take(track, nearest[on_grid[nearest]])


def gaps(track: GnssTrack, factor: float = 1.5) -> NDArray[np.intp]:
    """Finds the epochs that follow an interval longer than `factor` median intervals.

    Args:
        track: The log.
        factor: Multiple of the median interval, positive.

    Returns:
        The indices k, (G,), where the interval from epoch k - 1 to k is that long.

    Raises:
        DataError: If the factor is not positive and finite.
    """
    _check_positive("gap factor", factor)
    return np.flatnonzero(np.diff(track.time_ns) > factor * _median_interval_ns(track)) + 1


def intervals_s(track: GnssTrack) -> NDArray[np.float64]:
    """Returns the time since the previous epoch, (T,) [s]; 0 for the first."""
    # The difference is taken in integers: a float64 count since 1970 resolves only 0.2 us.
    return np.diff(track.time_ns, prepend=track.time_ns[:1]) / 1e9


def _median_interval_ns(track: GnssTrack) -> float:
    return float(np.median(np.diff(track.time_ns))) if len(track.time_ns) > 1 else 0.0


def _check_positive(name: str, value: float) -> None:
    if not 0.0 < value < math.inf:
        raise DataError(f"the {name} is {value}; accepted is a positive finite number")


def _take(track: GnssTrack, index: NDArray[np.intp]) -> GnssTrack:
    arrays = {k: v[index] for k, v in track._asdict().items() if isinstance(v, np.ndarray)}
    return track._replace(**arrays)
