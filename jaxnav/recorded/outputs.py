"""Files of a run: the trajectory as CSV, as arrays and for map programs."""

import io
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np

from jaxnav.navigation.models.vehicle import FIXES
from jaxnav.recorded.methods import Kept
from jaxnav.recorded.preparation import Drive
from jaxnav.recorded.scoring import attitude_angles
from jaxnav.results import write_arrays, write_text
from jaxnav.units import DEG

KML_POINTS = 5000
"""Points of the line on a map, at most: map programs draw more of them badly."""

_COLUMNS = (
    *("time [s]", "latitude [deg]", "longitude [deg]", "height [m]"),
    *("velocity_east [m/s]", "velocity_north [m/s]", "velocity_up [m/s]"),
    *("roll [deg]", "pitch [deg]", "heading [deg]"),
    *("sigma_east [m]", "sigma_north [m]", "sigma_up [m]"),
    *("sigma_velocity_east [m/s]", "sigma_velocity_north [m/s]", "sigma_velocity_up [m/s]"),
    *("sigma_tilt_east [deg]", "sigma_tilt_north [deg]", "sigma_heading [deg]"),
)
_DECIMALS = (4, 10, 10, 4, *[5] * 3, *[5] * 3, *[4] * 3, *[5] * 3, *[5] * 3)

_KML = """<?xml version="1.0" encoding="UTF-8"?>
<kml xmlns="http://www.opengis.net/kml/2.2">
<Document>
<name>{name}</name>
<Placemark>
<name>{name}</name>
<Style><LineStyle><color>ff0000ff</color><width>3</width></LineStyle></Style>
<LineString>
<tessellate>1</tessellate>
<altitudeMode>clampToGround</altitudeMode>
<coordinates>
{points}
</coordinates>
</LineString>
</Placemark>
</Document>
</kml>
"""


def write_csv(drive: Drive, kept: Kept, path: Path) -> Path:
    """Write the trajectory with its standard deviations as CSV; roll and pitch of C_nb.

    The time counts from the first inertial sample; position and velocity are those of the point
    that the run is of (:func:`~jaxnav.recorded.points.at_point`).
    """
    position, sigma = np.asarray(kept.mean.position), np.asarray(kept.sigma)
    degrees = attitude_angles(np.asarray(kept.mean.dcm)) / DEG
    degrees[:, 2] %= 360
    table = np.hstack(
        [
            drive.time[:, None],
            position[:, :2] / DEG,
            position[:, 2:],
            np.asarray(kept.mean.velocity),
            degrees,
            sigma[:, 6:9],
            sigma[:, 3:6],
            sigma[:, :3] / DEG,
        ]
    )
    text = io.StringIO()
    formats = [f"%.{decimals}f" for decimals in _DECIMALS]
    np.savetxt(text, table, formats, delimiter=",", header=",".join(_COLUMNS), comments="")
    return write_text(text.getvalue(), path)


def write_kml(kept: Kept, name: str, path: Path) -> Path:
    """Write the track as a line for map programs."""
    position = np.asarray(kept.mean.position)
    position = position[:: max(1, -(-len(position) // KML_POINTS))]
    points = "\n".join(
        f"{longitude / DEG:.8f},{latitude / DEG:.8f},{height:.2f}"
        for latitude, longitude, height in position
    )
    return write_text(_KML.format(name=escape(name), points=points), path)


def trajectory_arrays(drive: Drive, kept: Kept, members: list[str]) -> dict[str, Any]:
    """Return the run as arrays in SI units, by name, leading axis T unless said.

    ``time``, ``dcm`` (3, 3), ``velocity``, ``position`` (geodetic), ``gyro_drift``, ``accel_bias``
    (3,), ``sigma`` (15,) in additive errors, ``nis``, ``channels`` (how many were valid),
    ``stopped``, ``innovation`` and ``innovation_sigma`` (6,), ``fix_step`` (F,), of a bank
    ``weights`` (M,) and ``member`` (M,), and what is carried by name with ``carried_sigma`` (k,).
    """
    arrays = {
        "time": drive.time,
        "dcm": np.asarray(kept.mean.dcm),
        "velocity": np.asarray(kept.mean.velocity),
        "position": np.asarray(kept.mean.position),
        "gyro_drift": np.asarray(kept.mean.drift),
        "accel_bias": np.asarray(kept.mean.bias),
        "sigma": np.asarray(kept.sigma),
        "nis": np.asarray(kept.nis),
        "channels": sum(obs.valid.sum(axis=1) for obs in drive.channels.values()),
        "stopped": drive.stopped,
        "innovation": np.hstack([kept.parts[name].innovation for name in FIXES]),
        "innovation_sigma": np.hstack([kept.parts[name].sigma for name in FIXES]),
        "fix_step": drive.fix_step,
    }
    if kept.carried:
        arrays |= {name: np.asarray(values) for name, values in kept.carried.items()}
        arrays["carried_sigma"] = np.asarray(kept.carried_sigma)
    if members:
        arrays |= {"weights": np.asarray(kept.weights), "member": np.array(members)}
    return arrays


def write_trajectory(
    drive: Drive, kept: Kept, members: list[str], name: str, directory: Path
) -> list[Path]:
    """Write ``trajectory.csv``, ``.npz`` and ``.kml`` into a directory; return their paths."""
    return [
        write_csv(drive, kept, directory / "trajectory.csv"),
        write_arrays(trajectory_arrays(drive, kept, members), directory / "trajectory.npz"),
        write_kml(kept, name, directory / "trajectory.kml"),
    ]
