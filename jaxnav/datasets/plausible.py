"""Do recorded samples and fixes look like what their units say?"""

import numpy as np
from numpy.typing import NDArray

from jaxnav.datasets.base import DataError
from jaxnav.navigation.earth import MEAN_RADIUS
from jaxnav.units import DEG, GRAVITY

_SEVERAL_AXES = 35.0
_ONE_AXIS = 350.0
_TURNING = 0.3
_MISMATCH = 8.0
_HEIGHTS = (-1e3, 1e5)
_STRETCH_S = 10.0
_FAR = 30.0
_HIGH = 3.0
_MANY_STRETCHES = 20
_JUMPS, _BEYOND = 100.0, 1e4
_LOOKS = {"g": 1.0, "m/s^2 where the header says g": GRAVITY**2, "mg": 1000.0}


def check_plausible(gyro: NDArray[np.float64], accel: NDArray[np.float64], step_s: float) -> None:
    """Refuse a log whose numbers betray a wrong unit.

    * The median of the specific force within a fifth of 1, of g^2 or of 1000: the log was in g, in
      m/s^2 or in mg and was read as m/s^2, g or m/s^2. All zeros are no log.
    * In one sample of a hundred, rates above 35 rad/s (2000 deg/s, the range of MEMS gyros) about
      two axes, or above ten times that about one: deg/s read as rad/s. A rocket that spins about
      one axis passes.
    * Over the seconds in which the specific force is within a tenth of g, the gyros turn the
      vertical by more than 0.3 rad/s in the median, and by more than eight times what the
      accelerometers see: deg/s read as rad/s. A recorded drive had 0.3 in the right unit and 16 in
      the wrong one, a rocket under its parachute 3.4, a phone in a car 2.7 and 153.

    Rates too small are not found, nor deg/s read as rad/s at rest with a bias below 0.3 deg/s, nor
    a unit that is wrong in some columns alone. A log whose median force truly is 1 m/s^2 or 10 g,
    as of a flight cut to its coast or its boost, is refused.

    Args:
        gyro: ``(N, 3) [rad/s]``, known samples alone.
        accel: ``(N, 3) [m/s^2]``.
        step_s: Sampling interval [s].

    Raises:
        DataError: With what the log looks like.
    """
    if not len(gyro):
        raise DataError("no sample of the log is complete; accepted is one with rows of numbers")
    _check_force(accel)
    _check_rate(gyro, accel, step_s)


def check_fixes(
    time_ns: NDArray[np.int64],
    geodetic: NDArray[np.float64],
    velocity: NDArray[np.float64] | None,
    sigma: NDArray[np.float64] | None = None,
) -> None:
    """Refuse fixes that are on no place of the Earth, or whose numbers betray a wrong unit.

    * Latitude beyond a quarter turn, longitude beyond half a turn, height below -1 km or above
      100 km.
    * Over stretches of ten seconds with more way than 30 m and ten times the noise,
      ``s . d / max(|s|, |d|)^2`` below a half in the median, ``s`` being the integral of the
      velocity and ``d`` the change of the position: a velocity, a position or the time in another
      unit, or axes in another order.
    * Over the same stretches, where the vertical velocity climbs or sinks by ten times the noise,
      a height that changes by less than half or more than twice of that: feet.
    * Positions that jump to and fro by 100 m and ten thousand times their standard deviation in the
      median: baselines in metres read as degrees.

    Args:
        time_ns: ``(T,) [ns]``.
        geodetic: Latitude, longitude [rad], height [m], ``(T, 3)``.
        velocity: East, north, up ``(T, 3) [m/s]``, NaN where not known; ``None`` if nowhere.
        sigma: Standard deviations of the positions ``(T, 3) [m]``; ``None`` is no noise.

    Raises:
        DataError: With what the fixes look like.
    """
    if not len(time_ns):
        raise DataError("the log has no fix; accepted is at least one")
    ranges = ((-90, 90, "deg"), (-180, 180, "deg"), (*_HEIGHTS, "m"))
    shown = geodetic / [DEG, DEG, 1.0]
    names = ("latitude", "longitude", "height")
    for name, values, (low, high, unit) in zip(names, shown.T, ranges, strict=True):
        outside = ~((values > low - 1e-9) & (values < high + 1e-9))
        if outside.any():
            first = np.argmax(outside)
            raise DataError(
                f"the {name} of fix {first + 1} is {values[first]:.9g} {unit}; accepted is one "
                f"from {low:.6g} to {high:.6g} {unit}"
            )
    _check_scatter(geodetic, sigma)
    if velocity is not None:
        noise = 0.0 if sigma is None else float(np.nanmedian(sigma[:, :2]))
        _check_way(time_ns, geodetic, velocity[:, :2], max(_FAR, 10 * noise))
        above = 0.0 if sigma is None else float(np.nanmedian(sigma[:, 2]))
        _check_climb(time_ns, geodetic[:, 2], velocity[:, 2], max(_HIGH, 10 * above))


def _check_way(
    time_ns: NDArray[np.int64],
    geodetic: NDArray[np.float64],
    velocity: NDArray[np.float64],
    least: float,
) -> None:
    known = np.isfinite(velocity).all(axis=1)
    time, place, velocity = (time_ns[known] - time_ns[0]) / 1e9, geodetic[known], velocity[known]
    way = _travelled(time, velocity)
    begin, end = _stretches(time)
    travelled = way[end] - way[begin]
    turn = np.remainder(place[end] - place[begin] + np.pi, 2 * np.pi) - np.pi
    moved = MEAN_RADIUS * np.stack([turn[:, 1] * np.cos(place[begin, 0]), turn[:, 0]], axis=1)
    lengths = np.stack([np.linalg.norm(travelled, axis=1), np.linalg.norm(moved, axis=1)])
    far = lengths.max(axis=0) > least
    if not far.any():
        return
    if np.median((np.sum(travelled * moved, axis=1) / lengths.max(axis=0) ** 2)[far]) < 0.5:
        told_m, moved_m = np.median(lengths[:, far], axis=1)
        raise DataError(
            f"in ten seconds the positions move by {moved_m:.4g} m and the velocities by "
            f"{told_m:.4g} m, or elsewhere; accepted are fixes that agree, so check units and axes"
        )


def _check_climb(
    time_ns: NDArray[np.int64],
    height: NDArray[np.float64],
    climb: NDArray[np.float64],
    least: float,
) -> None:
    known = np.isfinite(climb)
    time, height = (time_ns[known] - time_ns[0]) / 1e9, height[known]
    way = _travelled(time, climb[known, None])[:, 0]
    begin, end = _stretches(time)
    climbed, moved = way[end] - way[begin], height[end] - height[begin]
    far = np.abs(climbed) > least
    if far.sum() < _MANY_STRETCHES:
        return
    ratio = float(np.median(moved[far] / climbed[far]))
    if not 0.5 < ratio < 2:
        raise DataError(
            f"the heights change {ratio:.3g} times as fast as the vertical velocities say; "
            "accepted are heights in metres, so check their unit (feet would be 3.28)"
        )


def _check_scatter(geodetic: NDArray[np.float64], sigma: NDArray[np.float64] | None) -> None:
    if sigma is None or len(geodetic) < _MANY_STRETCHES:
        return
    level = np.unwrap(geodetic[:, :2], axis=0)
    jump = np.linalg.norm(np.diff(level, 2, axis=0), axis=1)
    scatter = float(np.median(jump)) * MEAN_RADIUS
    stated = float(np.nanmedian(sigma[:, :2]))
    if scatter > max(_JUMPS, _BEYOND * stated):
        raise DataError(
            f"the positions jump to and fro by {scatter:.3g} m, {scatter / stated:.2g} times their "
            "standard deviation; accepted are latitude and longitude in degrees, which baselines "
            "in metres are not"
        )


def _travelled(time: NDArray[np.float64], velocity: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the integral of a velocity ``(T, k)`` over time."""
    mean = (velocity[1:] + velocity[:-1]) / 2
    steps = mean * np.diff(time)[:, None]
    return np.concatenate([np.zeros((1, velocity.shape[1])), np.cumsum(steps, axis=0)])


def _stretches(time: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return where stretches of :data:`_STRETCH_S`, hardly longer ones, begin and end."""
    end = np.searchsorted(time, time + _STRETCH_S)
    begin = np.flatnonzero(end < len(time))
    begin = begin[time[end[begin]] - time[begin] < 2 * _STRETCH_S]
    return begin, end[begin]


def _check_force(accel: NDArray[np.float64]) -> None:
    force = float(np.median(np.linalg.norm(accel, axis=1)))
    if force == 0:
        raise DataError("the specific force is zero; accepted is that of a working accelerometer")
    for unit, level in _LOOKS.items():
        if abs(force / level - 1) < 0.2:
            raise DataError(
                f"the median specific force is {force:.4g} m/s^2, which looks like {unit}; "
                "accepted is specific force in m/s^2 or g, as the header says"
            )


def _check_rate(gyro: NDArray[np.float64], accel: NDArray[np.float64], step_s: float) -> None:
    fast = np.percentile(np.sort(np.abs(gyro), axis=1), 99, axis=0)
    if fast[1] > _SEVERAL_AXES or fast[2] > _ONE_AXIS:
        raise DataError(
            f"one rate in a hundred is above {fast[2]:.4g} rad/s, which looks like deg/s; "
            "accepted are rates in rad/s or deg/s, as the header says"
        )
    turned, seen = _turn_of_vertical(gyro, accel, step_s)
    if turned > max(_TURNING, _MISMATCH * seen):
        raise DataError(
            f"the gyros turn the vertical by {turned:.3g} rad/s and the accelerometers see "
            f"{seen:.3g} rad/s, so the rates look like deg/s; accepted are rates in rad/s or "
            "deg/s, as the header says"
        )


def _turn_of_vertical(
    gyro: NDArray[np.float64], accel: NDArray[np.float64], step_s: float
) -> tuple[float, float]:
    """Return the median turn of the vertical [rad/s] by the gyros and by the accelerometers."""
    size = max(1, round(1 / step_s))
    seconds = len(gyro) // size
    rate = gyro[: seconds * size].reshape(seconds, size, 3).mean(axis=1)
    force = accel[: seconds * size].reshape(seconds, size, 3).mean(axis=1)
    norm = np.linalg.norm(force, axis=1)
    gentle = np.abs(norm / GRAVITY - 1) < 0.1
    both = gentle[1:] & gentle[:-1]
    if not both.any():
        return 0.0, 0.0
    up = force / np.where(norm > 0, norm, 1)[:, None]
    turned = np.cross(rate[1:] + rate[:-1], up[1:] + up[:-1])[both] / 4
    seen = np.diff(up, axis=0)[both] / (size * step_s)
    medians = [float(np.median(np.linalg.norm(turn, axis=1))) for turn in (turned, seen)]
    return medians[0], medians[1]
