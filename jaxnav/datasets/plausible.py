"""Does a recorded inertial log look like what its units say?"""

import numpy as np
from numpy.typing import NDArray

from jaxnav.datasets.base import DataError
from jaxnav.units import GRAVITY

_SEVERAL_AXES = 35.0
_ONE_AXIS = 350.0
_TURNING = 0.3
_MISMATCH = 8.0
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
