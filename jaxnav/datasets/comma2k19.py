"""Segments of comma2k19: a car with the sensors of a phone, fixes of a u-blox, and a reference.

The folder of a segment holds NumPy arrays, with or without the ending ``.npy``; those read are

* ``processed_log/IMU/accelerometer`` and ``.../gyro_uncalibrated``: ``t`` and ``value`` (n, 3) in
  m/s^2 and rad/s, axes forward, right, down;
* ``processed_log/GNSS/live_gnss_ublox``: ``t`` and ``value`` (n, 6), latitude, longitude [deg],
  speed [m/s], UTC [ms], height above the ellipsoid [m], bearing [deg];
* ``global_pose``, if it is there: ``frame_times``, ``frame_positions`` and ``frame_velocities``
  (n, 3) in Earth-fixed axes, ``frame_orientations`` (n, 4), the quaternion, scalar first, that
  turns the camera's axes forward, right, down to Earth-fixed ones.

All times are seconds since the phone was started, when it received an entry. In the recorded
segment the fixes lag behind the reference, the position by 0.06 s and the speed by 0.14 s.

References:
    Schafer, Santana, Haden, Biasini (2018), A Commute in Data: The comma2k19 Dataset,
    arXiv:1812.05752.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from jaxnav.datasets.base import DataError
from jaxnav.datasets.drive import FLU_FROM_FRD, DriveLog, Reference, checked
from jaxnav.datasets.inertial import ImuLog, assemble
from jaxnav.datasets.track import GnssTrack, Sigmas, without_repeats
from jaxnav.navigation.earth import WGS84
from jaxnav.units import DEG

LOG = "processed_log"
POSE = "global_pose"
_CODE = 5  # RTKLIB's number of a fix by code alone


def load_comma2k19(directory: str | Path, sigmas: Sigmas | None = None) -> DriveLog:
    """Read a segment in the format of this module.

    The gyro is interpolated to the stamps of the accelerometer where they differ. The receiver
    gives speed and bearing: the upward velocity is NaN. Where its antenna sits is not documented:
    the lever arm is zero.

    Args:
        directory: The folder of the segment.
        sigmas: Standard deviations of the fixes, which the log lacks; ``None`` takes the defaults.

    Returns:
        The drive on the phone's clock, with the reference if the folder holds one.

    Raises:
        DataError: If an array is missing, has another shape, or is implausible.
    """
    folder = Path(directory)
    fixes, skipped = _fixes(folder / LOG / "GNSS" / "live_gnss_ublox", sigmas or Sigmas())
    return checked(
        DriveLog(
            imu=_imu(folder / LOG / "IMU"),
            fixes=fixes,
            lever_arm=np.zeros(3),
            reference=_reference(folder / POSE) if (folder / POSE).is_dir() else None,
            skipped_rows=skipped,
            source=str(folder),
        )
    )


def _imu(folder: Path) -> ImuLog:
    time, accel = _series(folder / "accelerometer", 3)
    gyro_time, gyro = _series(folder / "gyro_uncalibrated", 3)
    if not np.array_equal(time, gyro_time):
        columns = [np.interp(time, gyro_time, column, np.nan, np.nan) for column in gyro.T]
        gyro = np.stack(columns, axis=1)
    turned = np.hstack([gyro @ FLU_FROM_FRD.T, accel @ FLU_FROM_FRD.T])
    return assemble(_nanoseconds(time), turned, str(folder))


def _fixes(folder: Path, sigmas: Sigmas) -> tuple[GnssTrack, int]:
    """Return the fixes and how many rows were left out as one of their numbers is not known."""
    time, values = _series(folder, 6)
    known = np.isfinite(values).all(axis=1)
    latitude, longitude, speed, _, height, bearing = values[known].T
    course = bearing * DEG
    unknown = np.full_like(speed, np.nan)
    velocity = np.stack([speed * np.sin(course), speed * np.cos(course), unknown], axis=1)
    track = GnssTrack(
        time_ns=_nanoseconds(time[known]),
        geodetic=np.stack([latitude * DEG, longitude * DEG, height], axis=1),
        velocity=velocity,
        position_sigma=np.broadcast_to(sigmas.position, velocity.shape),
        velocity_sigma=np.where(np.isnan(velocity), np.nan, sigmas.velocity),
        quality=np.full(len(speed), _CODE),
        source=str(folder),
        duplicates=0,
    )
    return without_repeats(track), int(np.sum(~known))


def _reference(folder: Path) -> Reference:
    time = _array(folder / "frame_times", ())
    count = len(time)
    position = _array(folder / "frame_positions", (3,), count)
    quaternion = _array(folder / "frame_orientations", (4,), count)
    geodetic = _geodetic_from_ecef(position)
    C_ne = _dcm_ne(geodetic[:, 0], geodetic[:, 1])
    C_ec = Rotation.from_quat(quaternion[:, [1, 2, 3, 0]]).as_matrix()
    return Reference(
        time_ns=_nanoseconds(time),
        geodetic=geodetic,
        velocity=np.squeeze(
            C_ne @ _array(folder / "frame_velocities", (3,), count)[:, :, None], axis=2
        ),
        dcm=C_ne @ C_ec @ FLU_FROM_FRD,
    )


def _geodetic_from_ecef(position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return latitude, longitude [rad] and height [m], ``(R, 3)``, of Earth-fixed positions.

    In NumPy, since JAX would round to half a metre wherever its caller has not enabled float64.
    The iteration gains a factor of 150 on each round.
    """
    e2, a = WGS84.eccentricity2, WGS84.semi_major
    x, y, z = position.T
    distance = np.hypot(x, y)
    latitude = np.arctan2(z, distance * (1 - e2))
    for _ in range(6):
        normal = a / np.sqrt(1 - e2 * np.sin(latitude) ** 2)
        latitude = np.arctan2(z + e2 * normal * np.sin(latitude), distance)
    surface = a * np.sqrt(1 - e2 * np.sin(latitude) ** 2)
    height = distance * np.cos(latitude) + z * np.sin(latitude) - surface
    return np.stack([latitude, np.arctan2(y, x), height], axis=1)


def _dcm_ne(latitude: NDArray[np.float64], longitude: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``C_ne`` ``(R, 3, 3)``, from Earth-fixed axes to east, north, up."""
    turned = Rotation.from_euler("ZY", np.stack([longitude, -latitude], axis=1)).as_matrix()
    return np.swapaxes(turned, 1, 2)[:, [1, 2, 0]]


def _series(folder: Path, width: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    time = _array(folder / "t", ())
    return time, _array(folder / "value", (width,), len(time))


def _array(path: Path, shape: tuple[int, ...], count: int | None = None) -> NDArray[np.float64]:
    """Return an array ``(count, *shape)``; times, which alone have no shape, are finite."""
    found = next((p for p in (path, path.with_name(f"{path.name}.npy")) if p.is_file()), None)
    if found is None:
        raise DataError(f"{path}: no such file; accepted is an array there or in {path.name}.npy")
    try:
        values = np.load(found, allow_pickle=False).astype(np.float64)
    except (OSError, ValueError, EOFError) as error:
        raise DataError(f"{found}: {str(error).lower()}; accepted is a NumPy array") from None
    accepted = (len(values) if count is None and values.ndim else count, *shape)
    if values.shape != accepted:
        raise DataError(f"{found}: the array is {values.shape}; accepted is {accepted}")
    if not shape and not (len(values) and np.isfinite(values).all()):
        raise DataError(f"{found}: times are missing or not finite; accepted are numbers")
    return values


def _nanoseconds(time: NDArray[np.float64]) -> NDArray[np.int64]:
    return np.rint(time * 1e9).astype(np.int64)
