"""Recorded drives in whichever format they are."""

from pathlib import Path

from jaxnav.datasets.base import DataError
from jaxnav.datasets.comma2k19 import LOG, load_comma2k19
from jaxnav.datasets.drive import DriveLog
from jaxnav.datasets.drive_csv import load_drive_csv
from jaxnav.datasets.rtk_drive import load_rtk_drive


def load_drive(path: str | Path) -> DriveLog:
    """Read a recorded drive, its format told by what is there.

    Args:
        path: A folder with ``imu*.csv`` and ``*.pos`` (:mod:`jaxnav.datasets.rtk_drive`), one with
            ``processed_log`` (:mod:`jaxnav.datasets.comma2k19`), or a CSV file
            (:mod:`jaxnav.datasets.drive_csv`).

    Raises:
        DataError: If it is none of these, or its loader refuses it.
    """
    path = Path(path)
    if any(path.glob("imu*.csv")) or any(path.glob("*.pos")):
        return load_rtk_drive(path)
    if (path / LOG).is_dir():
        return load_comma2k19(path)
    if path.is_file():
        return load_drive_csv(path)
    raise DataError(
        f"{path}: no recorded drive; accepted are a folder with an inertial log imu*.csv, its "
        f".tag and an RTKLIB solution *.pos, a segment of comma2k19 with its folder {LOG}, and a "
        "CSV file with a header"
    )
