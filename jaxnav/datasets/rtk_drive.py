"""Drives logged by RTKLIB's stream server: an inertial CSV with its time tag, and a solution.

The folder holds one of each:

* ``imu*.csv``: no header; accel_x, accel_y, accel_z [g], gyro_x, gyro_y, gyro_z [deg/s], and the
  milliseconds since the sensor's power-up. The logger cuts the first and the last line anywhere.
* ``imu*.csv.tag``: when the logger had received which byte of it.
* ``*.pos``: fixes of the antenna, as :mod:`jaxnav.datasets.rtklib` reads them.

References:
    Everett, T. (2025), github.com/rtklibexplorer/GNSS_IMU, the recorded drive and its rig.
"""

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from jaxnav.datasets.base import DataError, number, read_text
from jaxnav.datasets.drive import FLU_FROM_FRD, DriveLog, checked
from jaxnav.datasets.inertial import assemble
from jaxnav.datasets.rtklib import load_rtklib_pos
from jaxnav.datasets.table import entry
from jaxnav.units import DEG, GRAVITY

_NAMES = ("accel_x", "accel_y", "accel_z", "gyro_x", "gyro_y", "gyro_z")
_MAGIC = b"TIMETAG RTKLIB"
_START = struct.Struct("<60xIId")
_CLOCKS = 0.01


class Rig(NamedTuple):
    """How sensors and antenna sit on the vehicle, and how late samples are logged.

    The defaults are the figures that the owner of the recorded drive gives for his car.

    Attributes:
        orientation_deg: Roll, pitch, yaw [deg] ``r, p, y`` of the vehicle's axes forward, right,
            down ``d`` in those of the sensors ``s``: ``C_ds = R_x(r)' R_y(p)' R_z(y)'`` with the
            matrices that turn a vector. Its transpose would put the vertical of the stopped car
            14 deg off, this one 1 deg.
        lever_arm: From the sensors to the antenna, forward, left, up [m].
        delay_s: Added to the logged times [s].
    """

    orientation_deg: tuple[float, float, float] = (180.0, -6.79, 185.35)
    lever_arm: tuple[float, float, float] = (0.0, 0.05, 0.0)
    delay_s: float = -0.125


class _Samples(NamedTuple):
    clock_ms: NDArray[np.float64]  # (N,) since power-up
    values: NDArray[np.float64]  # (N, 6) rates [rad/s], forces [m/s^2] in the axes of the sensors
    ends: NDArray[np.int64]  # (N,) bytes of the file up to the end of each line
    lines: int  # of the file
    size: int  # of the file


class _Tag(NamedTuple):
    start_ns: int  # [ns] GPS time since 1970
    ticks_ms: NDArray[np.float64]  # (K,) since then
    positions: NDArray[np.float64]  # (K,) bytes received


def load_rtk_drive(directory: str | Path, rig: Rig | None = None) -> DriveLog:
    """Read a drive in the format of this module.

    The sensor's clock is a straight line through the ticks at which the samples were received,
    by least squares; 98 in 100 of the recorded ones lie within 8 ms of it. The owner's script
    stretches the clock from tick zero to the last tick instead. But the first sample came at tick
    131, and so the offset at which the accelerometers match the Doppler velocity drifts with that
    clock, from -0.03 s in the first 90 s to -0.14 s in the last. Here it is -0.16 s throughout, of
    which the delay is -0.125 s.

    Args:
        directory: The folder.
        rig: The mounting; ``None`` is that of the recorded drive.

    Returns:
        The drive in GPS time since 1970. There is no reference: fixes that a filter does not get
        are one.

    Raises:
        DataError: If a file is missing, twice there, malformed or implausible, or they do not go
            together.
    """
    folder = Path(directory)
    rig = Rig() if rig is None else rig
    path = _only(folder, "imu*.csv")
    samples = _read_samples(path)
    tag = _read_tag(_only(folder, "imu*.csv.tag"))
    since_ms = _clock(path, samples, tag) + 1e3 * rig.delay_s
    time_ns = tag.start_ns + np.rint(since_ms * 1e6).astype(np.int64)
    turned = samples.values.reshape(-1, 2, 3) @ _mounting(rig).T
    return checked(
        DriveLog(
            imu=assemble(time_ns, turned.reshape(-1, 6), str(path)),
            fixes=load_rtklib_pos(_only(folder, "*.pos")),
            lever_arm=np.array(rig.lever_arm),
            reference=None,
            skipped_rows=samples.lines - len(samples.values),
            source=str(folder),
        )
    )


def _only(folder: Path, pattern: str) -> Path:
    found = sorted(folder.glob(pattern))
    if len(found) != 1:
        names = ", ".join(path.name for path in found) or "none"
        raise DataError(
            f"{folder}: of the files {pattern} there is {names}; accepted is exactly one"
        )
    return found[0]


def _mounting(rig: Rig) -> NDArray[np.float64]:
    """Return the matrix ``(3, 3)`` from the axes of the sensors to forward, left, up."""
    roll, pitch, yaw = rig.orientation_deg
    turned = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True)
    return FLU_FROM_FRD @ turned.as_matrix().T


def _read_samples(path: Path) -> _Samples:
    text = read_text(path, "a readable inertial log without a header")
    lines = text.removesuffix("\n").split("\n")
    rows = []
    for count, line in enumerate(lines[1:-1], start=2):
        try:
            rows.append(_row(line.split(",")))
        except DataError as error:
            raise DataError(f"{path}, line {count}: {error}") from None
    if len(rows) < 2 or rows[-1][-1] <= rows[0][-1]:
        raise DataError(
            f"{path}: the log has {len(rows)} whole samples or their time stands still; accepted "
            "are at least two between a first and a last line"
        )
    table = np.array(rows)
    accel, gyro = table[:, :3] * GRAVITY, table[:, 3:6] * DEG
    ends = np.cumsum([len(line) + 1 for line in lines])
    return _Samples(table[:, 6], np.hstack([gyro, accel]), ends[1:-1], len(lines), len(text))


def _row(fields: list[str]) -> list[float]:
    if len(fields) != len(_NAMES) + 1:
        raise DataError(f"the line has {len(fields)} columns; accepted are {len(_NAMES) + 1}")
    values = [entry(name, text.strip()) for name, text in zip(_NAMES, fields, strict=False)]
    return [*values, number("the time in ms", fields[-1])]


def _read_tag(path: Path) -> _Tag:
    try:
        data = path.read_bytes()
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise DataError(f"{path}: {reason}; accepted is a time tag of RTKLIB") from None
    pairs = np.frombuffer(data[_START.size :][: (len(data) - _START.size) // 8 * 8], "<u4")
    if not data.startswith(_MAGIC) or len(pairs) < 4:
        raise DataError(
            f"{path}: not a time tag with two entries; accepted is one that begins with "
            f"{_MAGIC.decode()}"
        )
    _, whole, part = _START.unpack_from(data)
    ticks, positions = pairs.reshape(-1, 2).T.astype(np.float64)
    return _Tag(whole * 10**9 + round(part * 1e9), ticks, positions)


def _clock(path: Path, samples: _Samples, tag: _Tag) -> NDArray[np.float64]:
    """Return the time of each sample ``(N,) [ms]`` since the tag's start."""
    # Whoever checked the files out may have stripped a carriage return from each line.
    stripped = round((tag.positions[-1] - samples.size) / samples.lines)
    ends = samples.ends + stripped * np.arange(2, samples.lines)
    received = ends <= tag.positions[-1]
    if stripped not in (0, 1) or np.any(np.diff(tag.positions) < 0) or np.sum(received) < 2:
        raise DataError(
            f"{path}: the file has {samples.size} bytes and its time tag ends at byte "
            f"{tag.positions[-1]:.0f}; accepted are a log and a tag of the same recording"
        )
    arrival = tag.ticks_ms[np.searchsorted(tag.positions, ends[received])]
    clock = samples.clock_ms - samples.clock_ms[0]
    slope, start = np.polyfit(clock[received], arrival, 1)
    if abs(slope - 1) > _CLOCKS:
        raise DataError(
            f"{path}: by its time tag the sensor's clock runs {1 / slope:.4g} times too fast; "
            f"accepted are clocks within {_CLOCKS:.0%}"
        )
    return start + slope * clock
