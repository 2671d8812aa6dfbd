"""Recorded drives from one plain CSV.

The format is that of :mod:`jaxnav.datasets.table`. Needed are the columns

    time [s|ms|us|ns], gyro_x, gyro_y, gyro_z [rad/s|deg/s], accel_x, accel_y, accel_z [m/s^2|g],
    lat, lon [deg|rad], height [m]

and taken if they are there

    vel_e, vel_n, vel_u [m/s|km/h], sigma_e, sigma_n, sigma_u [m],
    sigma_vel_e, sigma_vel_n, sigma_vel_u [m/s|km/h]

Axes of the inertial sensors are forward, left, up; an accelerometer at rest shows +g on z. Height
is above the ellipsoid; a sigma is a standard deviation, and where one is not known that of
:class:`jaxnav.datasets.track.Sigmas` is taken. A row holds an inertial sample, a fix (latitude,
longitude and height), or both, and is empty elsewhere; one with neither whole is left out.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jaxnav.datasets.drive import DriveLog, checked
from jaxnav.datasets.inertial import SENSOR_UNITS, assemble
from jaxnav.datasets.table import ANGLE, LENGTH, SPEED, Table, Units, read_table
from jaxnav.datasets.track import GnssTrack, Sigmas, with_solution, without_repeats

PLACE = ("lat", "lon", "height")
VELOCITY = ("vel_e", "vel_n", "vel_u")
SIGMA = ("sigma_e", "sigma_n", "sigma_u")
SIGMA_VELOCITY = ("sigma_vel_e", "sigma_vel_n", "sigma_vel_u")

_NEEDED: Units = {**SENSOR_UNITS, "lat": ANGLE, "lon": ANGLE, "height": LENGTH}
_OPTIONAL: Units = {
    name: LENGTH if name in SIGMA else SPEED for name in (*VELOCITY, *SIGMA, *SIGMA_VELOCITY)
}
_ACCEPTED = "a readable CSV drive with the columns " + ", ".join(("time", *_NEEDED))


def load_drive_csv(
    path: str | Path,
    lever_arm: tuple[float, float, float] = (0.0, 0.0, 0.0),
    sigmas: Sigmas | None = None,
) -> DriveLog:
    """Read a drive in the format of this module.

    Args:
        path: The file.
        lever_arm: From the inertial sensors to the antenna, forward, left, up [m].
        sigmas: Standard deviations where the file has none; ``None`` takes the defaults.

    Returns:
        The drive on the clock of the file.

    Raises:
        DataError: If the file cannot be read, has no header that names the columns and their
            units, has a malformed line or a time that goes backwards, or holds fewer than two
            samples, no fix among them, or implausible numbers.
    """
    table = read_table(Path(path), _NEEDED, _ACCEPTED, _OPTIONAL)
    samples = _stack(table, tuple(SENSOR_UNITS))
    sampled = np.isfinite(samples).all(axis=1)
    fixed = np.asarray(np.isfinite(_stack(table, PLACE)).all(axis=1))
    return checked(
        DriveLog(
            imu=assemble(table.time_ns[sampled], samples[sampled], str(path)),
            fixes=_fixes(table, fixed, sigmas or Sigmas(), str(path)),
            lever_arm=np.array(lever_arm, dtype=np.float64),
            reference=None,
            skipped_rows=int(np.sum(~sampled & ~fixed)) + table.cut,
            source=str(path),
        )
    )


def _fixes(table: Table, fixed: NDArray[np.bool_], sigmas: Sigmas, source: str) -> GnssTrack:
    geodetic = _stack(table, PLACE)[fixed]
    geodetic[:, 1] -= 2 * np.pi * ((geodetic[:, 1] > np.pi) & (geodetic[:, 1] <= 2 * np.pi))
    velocity = _stack(table, VELOCITY)[fixed]
    speeds = bool(table.columns.keys() & set(VELOCITY))
    known = np.isfinite(velocity)
    velocity_sigma = _or(_stack(table, SIGMA_VELOCITY)[fixed], sigmas.velocity)
    track = GnssTrack(
        time_ns=table.time_ns[fixed],
        geodetic=geodetic,
        velocity=np.where(known, velocity, np.nan) if speeds else None,
        position_sigma=_or(_stack(table, SIGMA)[fixed], sigmas.position),
        velocity_sigma=np.where(known, velocity_sigma, np.nan) if speeds else None,
        quality=np.zeros(len(geodetic), np.int64),
        source=source,
        duplicates=0,
    )
    return without_repeats(with_solution(track))


def _stack(table: Table, names: tuple[str, ...]) -> NDArray[np.float64]:
    """Return columns side by side, NaN for those that the file does not have."""
    absent = np.full(len(table.time_ns), np.nan)
    return np.stack([table.columns.get(name, absent) for name in names], axis=1)


def _or(values: NDArray[np.float64], defaults: tuple[float, ...]) -> NDArray[np.float64]:
    return np.where(np.isfinite(values), values, defaults)
