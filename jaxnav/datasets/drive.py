"""A recorded drive: inertial samples and satellite fixes on one clock, and what is known beside."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxnav.datasets.base import DataError
from jaxnav.datasets.inertial import ImuLog
from jaxnav.datasets.plausible import check_fixes
from jaxnav.datasets.track import GnssTrack

FLU_FROM_FRD = np.diag([1.0, -1.0, -1.0])
"""From axes forward, right, down to forward, left, up."""


class Reference(NamedTuple):
    """A trajectory from elsewhere that is better than what is scored against it.

    Attributes:
        time_ns: ``(R,) [ns]`` on the clock of the inertial samples.
        geodetic: ``(R, 3)`` latitude, longitude [rad] and ellipsoidal height [m].
        velocity: ``(R, 3) [m/s]`` east, north, up.
        dcm: C_nb ``(R, 3, 3)`` of the vehicle's axes, up to constant mounting angles; ``None``
            where the attitude is not known.
    """

    time_ns: NDArray[np.int64]
    geodetic: NDArray[np.float64]
    velocity: NDArray[np.float64]
    dcm: NDArray[np.float64] | None


class DriveLog(NamedTuple):
    """A recorded drive.

    Attributes:
        imu: Inertial samples in the vehicle's axes: x forward, y left, z up, as nominally mounted.
        fixes: Fixes of the antenna, times on the clock of the inertial samples.
        lever_arm: ``(3,) [m]`` from the inertial sensors to the antenna, vehicle's axes.
        reference: What to score against, if there is any.
        skipped_rows: Rows of the files that held no complete entry and were left out.
        source: Path of the log.
    """

    imu: ImuLog
    fixes: GnssTrack
    lever_arm: NDArray[np.float64]
    reference: Reference | None
    skipped_rows: int
    source: str


def checked(log: DriveLog) -> DriveLog:
    """Return a drive whose fixes are plausible and fall in the time of its inertial samples.

    Args:
        log: The drive; its inertial samples were checked when they were assembled.

    Raises:
        DataError: If there is no fix, one is implausible (:func:`check_fixes`) or has a standard
            deviation that is not positive, or none falls in the time of the samples.
    """
    fixes = log.fixes
    try:
        check_fixes(fixes.time_ns, fixes.geodetic, fixes.velocity, fixes.position_sigma)
        _check_sigmas("position", fixes.position_sigma)
        if fixes.velocity_sigma is not None:
            _check_sigmas("velocity", fixes.velocity_sigma)
        _check_overlap(log.imu.time_ns, fixes.time_ns)
    except DataError as error:
        raise DataError(f"{log.source}: {error}") from None
    return log


def _check_sigmas(name: str, sigma: NDArray[np.float64]) -> None:
    wrong = np.any((sigma <= 0) | np.isinf(sigma), axis=1)
    if wrong.any():
        first = int(np.argmax(wrong))
        raise DataError(
            f"the standard deviations of the {name} of fix {first + 1} are "
            f"{', '.join(f'{value:.4g}' for value in sigma[first])}; accepted are positive ones"
        )


def _check_overlap(samples_ns: NDArray[np.int64], fixes_ns: NDArray[np.int64]) -> None:
    first, last = samples_ns[0], samples_ns[-1]
    if not np.any((fixes_ns >= first) & (fixes_ns <= last)):
        begin, end = (fixes_ns[[0, -1]] - first) / 1e9
        raise DataError(
            f"the fixes last from {begin:.6g} s to {end:.6g} s after the first inertial sample and "
            f"the samples {(last - first) / 1e9:.6g} s; accepted are fixes among the samples, on "
            "the same clock"
        )
