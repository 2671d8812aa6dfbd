"""Tables of samples in plain CSV: named columns with units, a time in every row.

The format. Lines that are blank or start with ``#`` are ignored. The first other line is the
header: names with units in brackets, separated by commas, in any order; each column has its own
unit, and columns that nobody asks for are ignored. Time counts from any origin and does not
decrease. An entry that is empty, ``nan`` or infinite is not known.
"""

import math
import re
from collections.abc import Mapping
from decimal import Decimal
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxnav.datasets.base import DataError, read_text
from jaxnav.units import DEG, GRAVITY

Units = Mapping[str, Mapping[str, float]]
"""For each column its units, and their factors to SI."""

ANGLE = {"deg": DEG, "rad": 1.0}
FORCE = {"m/s^2": 1.0, "g": GRAVITY}
LENGTH = {"m": 1.0}
RATE = {"rad/s": 1.0, "deg/s": DEG}
SPEED = {"m/s": 1.0, "km/h": 1 / 3.6}

_DIGITS = {"s": 9, "ms": 6, "us": 3, "ns": 0}  # powers of ten to nanoseconds
_HEADING = re.compile(r"(\w+)\s*\[\s*([^\]\s]*)\s*\]")
_LARGEST_NS = 2**62


class Table(NamedTuple):
    """A table of N rows.

    Attributes:
        time_ns: ``(N,) [ns]``, not decreasing.
        columns: The entries ``(N,)`` of each column that was asked for and is there, in SI units;
            NaN or infinite where not known.
        cut: Whether the last line ends early, as of a logger that was switched off; it is left out.
    """

    time_ns: NDArray[np.int64]
    columns: dict[str, NDArray[np.float64]]
    cut: bool = False


class _Column(NamedTuple):
    name: str
    place: int
    unit: str


def read_table(
    path: Path,
    units: Units,
    accepted: str,
    optional: Units | None = None,
) -> Table:
    """Read the columns of a table.

    Args:
        path: The file.
        units: The columns that must be there besides ``time``.
        accepted: What would have been accepted, for the message.
        optional: Columns that may be there.

    Raises:
        DataError: If the file cannot be read, has no row or no header that names the columns and
            their units, or has a malformed line or a time that goes backwards.
    """
    known = {"time": _DIGITS, **units, **(optional or {})}
    needed = ("time", *units)
    layout: list[_Column] = []
    width, times, rows = 0, [], []
    lines, cut = _whole_lines(read_text(path, accepted))
    for line, text in enumerate(lines, start=1):
        if not text.strip() or text.startswith("#"):
            continue
        fields = [field.strip() for field in text.split(",")]
        try:
            if not layout:
                layout, width = _layout(fields, known, needed), len(fields)
                continue
            times.append(_time(fields, layout[0], width, times))
            rows.append([entry(name, fields[place]) for name, place, _ in layout[1:]])
        except DataError as error:
            raise DataError(f"{path}, line {line}: {error}") from None
    if not rows:
        lacks = "sample" if layout else "header"
        raise DataError(f"{path}: the file has no {lacks}; accepted is {accepted}")
    columns = zip(layout[1:], np.array(rows, dtype=np.float64).T, strict=True)
    return Table(
        np.array(times, dtype=np.int64),
        {column.name: values * known[column.name][column.unit] for column, values in columns},
        cut,
    )


def _whole_lines(text: str) -> tuple[list[str], bool]:
    """Return the lines of a file, without a last one that has no end and fewer columns."""
    lines = text.split("\n")
    last = lines[-1]
    before = [line for line in lines[-3:-1] if line.strip() and not line.startswith("#")]
    cut = bool(last.strip() and before and last.count(",") < before[-1].count(","))
    return (lines[:-1] if cut else lines), cut


def entry(name: str, text: str) -> float:
    """Return the number of a field, NaN for an empty one.

    Raises:
        DataError: If it is neither.
    """
    try:
        return float(text) if text else math.nan
    except ValueError:
        raise DataError(
            f"{name} is {text!r}; accepted is a decimal number, or nothing for a lost one"
        ) from None


def _layout(header: list[str], known: Units, needed: tuple[str, ...]) -> list[_Column]:
    """Return the columns that are read, in the order of the known ones: time is the first."""
    found: dict[str, _Column] = {}
    for place, text in enumerate(header):
        match = _HEADING.fullmatch(text)
        name = match[1] if match else text
        if name not in known:
            continue
        accepted = ", ".join(known[name])
        if name in found:
            raise DataError(f"the column {name} is there twice; accepted is once")
        if not match:
            raise DataError(
                f"the column {name} has no unit; accepted is {name} [unit] with one of {accepted}"
            )
        if match[2] not in known[name]:
            raise DataError(f"the unit of {name} is {match[2]!r}; accepted are {accepted}")
        found[name] = _Column(name, place, match[2])
    missing = [name for name in needed if name not in found]
    if missing:
        examples = ", ".join(f"{name} [{next(iter(known[name]))}]" for name in needed)
        raise DataError(
            f"the header does not name {', '.join(missing)}; accepted are columns such as "
            f"{examples}"
        )
    return [found[name] for name in known if name in found]


def _time(fields: list[str], column: _Column, width: int, times: list[int]) -> int:
    """Return the time of a row that is as wide as the header and not before the last one."""
    if len(fields) != width:
        raise DataError(
            f"the line has {len(fields)} columns; accepted are {width}, as in the header"
        )
    text = fields[column.place]
    time = _nanoseconds(text, column.unit)
    if times and time < times[-1]:
        raise DataError(
            f"the time {text} is before that of the previous row; accepted are times that do not "
            "decrease"
        )
    return time


def _nanoseconds(text: str, unit: str) -> int:
    """Convert a time to whole nanoseconds; a float would lose digits of a count since 1970."""
    try:
        time = Decimal(text).scaleb(_DIGITS[unit])
        if abs(time) < _LARGEST_NS:
            return int(time.to_integral_value())
    except ArithmeticError:
        pass
    raise DataError(f"time is {text!r}; accepted is a decimal number within 146 years of zero")
