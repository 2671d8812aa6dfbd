"""RTKLIB's solution files.

Times are integer nanoseconds of GPS time since 1970-01-01 00:00:00 on the GPS calendar (no leap
seconds), the count that RTKLIB's own time tags use. Malformed input raises `DataError`.
"""

import math
import re
from datetime import datetime, timedelta
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxnav.datasets.base import DataError, number, read_text
from jaxnav.datasets.track import GnssTrack, with_solution, without_repeats

_EPOCH = datetime(1970, 1, 1)
_GPS_EPOCH = datetime(1980, 1, 6)
_END = datetime(2262, 1, 1)  # nanoseconds since 1970 leave int64 later in that year

_CALENDAR = re.compile(r"(\d{4})/(\d\d?)/(\d\d?) (\d\d?):(\d\d?):(\d\d?)(?:\.(\d*))?", re.ASCII)
_WEEK_TOW = re.compile(r"(\d{1,5}) (\d{1,6})(?:\.(\d*))?", re.ASCII)

_REQUIRED = ("latitude(deg)", "longitude(deg)", "height(m)", "Q", "sdn(m)", "sde(m)", "sdu(m)")
_PLAIN = (*_REQUIRED[:4], "ns", *_REQUIRED[4:], "sdne(m)", "sdeu(m)", "sdun(m)", "age(s)", "ratio")
_VELOCITY = ("vn", "ve", "vu")
_VELOCITY_SIGMA = ("sdvn", "sdve", "sdvu")
_BY_COUNT = {15: _PLAIN, 24: (*_PLAIN, *_VELOCITY, *_VELOCITY_SIGMA, "sdvne", "sdveu", "sdvun")}
_RANGES = {"latitude(deg)": (-90, 90), "longitude(deg)": (-180, 360), "Q": (0, 9)} | dict.fromkeys(
    (*_REQUIRED[4:], *_VELOCITY_SIGMA), (0, math.inf)
)


class _Epoch(NamedTuple):
    stamp: str
    time_ns: int
    values: dict[str, float]


def load_rtklib_pos(path: str | Path) -> GnssTrack:
    """Reads an RTKLIB solution file (`.pos`) in the latitude/longitude/height output format.

    Time is `YYYY/MM/DD HH:MM:SS.sss` or GPS week and seconds of week, in GPST. Columns are
    separated by blanks or commas and found by their names in the header line or, without one, by
    their number: 15, or 24 with velocity. An epoch that repeats the time of the one before is
    dropped and counted. Height is kept as written: ellipsoidal, unless RTKLIB's option `geodetic`
    was chosen.

    Args:
        path: The file.

    Returns:
        The track; `velocity` and `velocity_sigma` are None where the file has no such columns.

    Raises:
        DataError: If the file cannot be read, is in another output format, or has a malformed
            line, a value out of range, or a time that goes backwards.
    """
    epochs = _read_epochs(Path(path))
    longitude = _columns(epochs, "longitude(deg)")
    longitude = np.where(longitude > 180.0, longitude - 360.0, longitude)
    angles = np.deg2rad(np.hstack([_columns(epochs, "latitude(deg)"), longitude]))
    track = GnssTrack(
        time_ns=np.array([epoch.time_ns for epoch in epochs], dtype=np.int64),
        geodetic=np.hstack([angles, _columns(epochs, "height(m)")]),
        velocity=_optional(epochs, "ve", "vn", "vu"),
        position_sigma=_columns(epochs, "sde(m)", "sdn(m)", "sdu(m)"),
        velocity_sigma=_optional(epochs, "sdve", "sdvn", "sdvu"),
        quality=_columns(epochs, "Q")[:, 0].astype(np.int64),
        source=str(path),
        duplicates=0,
    )
    track = with_solution(track, track.quality != 0)
    if not len(track.time_ns):
        raise DataError(f"{path}: no fix has a solution (Q is 0 in all); accepted is at least one")
    return without_repeats(track)


def _columns(epochs: list[_Epoch], *names: str) -> NDArray[np.float64]:
    return np.array([[epoch.values[name] for name in names] for epoch in epochs])


def _optional(epochs: list[_Epoch], *names: str) -> NDArray[np.float64] | None:
    return _columns(epochs, *names) if epochs[0].values.keys() >= set(names) else None


def _read_epochs(path: Path) -> list[_Epoch]:
    """Parses the solution lines; times do not decrease, columns are the same in all lines."""
    names, epochs = (), []
    text = read_text(path, "a readable RTKLIB .pos file")
    for count, line in enumerate(text.split("\n"), start=1):
        fields = line.removeprefix("%").replace(",", " ").split()
        try:
            if line.startswith("%"):
                header = _header_names(fields)
                names = names or header
            elif fields:
                names = names or _BY_COUNT.get(len(fields), ())
                epochs.append(_parse_epoch(names, fields))
                _check_order(epochs[-2:])
        except DataError as error:
            raise DataError(f"{path}, line {count}: {error}") from None
    if not epochs:
        raise DataError(f"{path}: the file has no solution line; accepted is at least one")
    return epochs


def _header_names(fields: list[str]) -> tuple[str, ...]:
    """Returns the names of the columns after the time, none if it is another comment line."""
    if not fields or fields[0] not in ("GPST", "UTC", "JST"):
        return ()
    if fields[0] != "GPST":
        raise DataError(f"the times are in {fields[0]}; accepted are times in GPST")
    for missing in (name for name in _REQUIRED if name not in fields):
        raise DataError(
            f"the columns {' '.join(fields[1:9])} do not include {missing}; accepted is RTKLIB's "
            "output format latitude, longitude, height in decimal degrees"
        )
    return tuple(name.removesuffix("(m/s)") for name in fields[1:])


def _parse_epoch(names: tuple[str, ...], fields: list[str]) -> _Epoch:
    if len(fields) != len(names) + 2:
        accepted = len(names) + 2 if names else "15, or 24 with velocity, without a header"
        raise DataError(f"the line has {len(fields)} columns; accepted are {accepted}")
    stamp = " ".join(fields[:2])
    values = {name: _number(name, text) for name, text in zip(names, fields[2:], strict=True)}
    return _Epoch(stamp, _parse_time(stamp), values)


def _number(name: str, text: str) -> float:
    value = number(name, text, *_RANGES.get(name, (-math.inf, math.inf)))
    if name == "Q" and not value.is_integer():
        raise DataError(f"{name} is {text}; accepted is a whole number")
    return value


def _parse_time(stamp: str) -> int:
    """Converts a time stamp to integer nanoseconds, rounded half up after nine decimals."""
    try:
        if match := _CALENDAR.fullmatch(stamp):
            year, month, day, hour, minute, second = map(int, match.groups()[:6])
            time = datetime(year, month, day, hour, minute, second)
        elif (match := _WEEK_TOW.fullmatch(stamp)) and int(match[2]) < 604_800:
            time = _GPS_EPOCH + timedelta(weeks=int(match[1]), seconds=int(match[2]))
        else:
            raise ValueError
        if not _GPS_EPOCH <= time < _END:
            raise ValueError
    except ValueError:
        raise DataError(
            f"the time is {stamp!r}; accepted is GPST from 1980 to 2261 as YYYY/MM/DD HH:MM:SS.sss "
            "or as GPS week and seconds of week"
        ) from None
    since = time - _EPOCH
    decimals = (match.groups()[-1] or "")[:10].ljust(10, "0")
    return (since.days * 86_400 + since.seconds) * 10**9 + (int(decimals) + 5) // 10


def _check_order(last: list[_Epoch]) -> None:
    if last[-1].time_ns < last[0].time_ns:
        raise DataError(
            f"the time {last[-1].stamp} is before {last[0].stamp} of the previous epoch; accepted "
            "are times that do not decrease"
        )
