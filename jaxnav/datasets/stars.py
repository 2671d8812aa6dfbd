"""Tables of stars: the one of bright stars that comes along, or the user's own.

A table is a text file of comma-separated columns, named in the first line that is not a comment:

    hip,ra_deg,dec_deg,pmra_mas_yr,pmdec_mas_yr,hp_mag

Number in the Hipparcos catalogue, right ascension and declination (ICRS, epoch J1991.25), proper
motion (that in right ascension times the cosine of the declination), magnitude. Lines that start
with ``#`` are comments.

References:
    van Leeuwen (2007), Validation of the new Hipparcos reduction, A&A 474(2), catalogue I/311 of
    the CDS; ESA (1997), The Hipparcos and Tycho Catalogues, ESA SP-1200, for the stars' numbers.
"""

from pathlib import Path

import numpy as np

from jaxnav.datasets.base import DataError, number, read_text
from jaxnav.navigation.stars import StarCatalogue
from jaxnav.units import ARCSEC, DEG

BUNDLED = Path(__file__).with_name("bright_stars.csv")
"""All stars of Hipparcos to magnitude 6.5, made by :mod:`jaxnav.datasets.make_stars`."""
COLUMNS = ("hip", "ra_deg", "dec_deg", "pmra_mas_yr", "pmdec_mas_yr", "hp_mag")
EPOCH = 1991.25
"""Julian year of the catalogue's positions."""
MAS_PER_YEAR = 1e-3 * ARCSEC

_RANGES = {"hip": (1, 1e9), "ra_deg": (0.0, 360.0), "dec_deg": (-90.0, 90.0)}


def load_stars(path: str | Path | None = None) -> StarCatalogue:
    """Return a table of stars.

    Args:
        path: The file; ``None`` is the one that comes along.

    Raises:
        DataError: If the file cannot be read, has other columns, a malformed or repeated line, or
            no star.
    """
    rows = read_rows(BUNDLED if path is None else Path(path))
    ra, dec, motion_ra, motion_dec, magnitude = np.array(rows)[:, 1:].T
    return StarCatalogue(
        hip=np.array([int(row[0]) for row in rows], dtype=np.int64),
        right_ascension=ra * DEG,
        declination=dec * DEG,
        motion_ra=motion_ra * MAS_PER_YEAR,
        motion_dec=motion_dec * MAS_PER_YEAR,
        magnitude=magnitude,
        epoch=EPOCH,
    )


def read_rows(path: Path, columns: tuple[str, ...] = COLUMNS) -> list[list[float]]:
    """Return the chosen columns of a table, one list of numbers a star.

    Args:
        path: The file.
        columns: Names of the columns in the order of :data:`COLUMNS`, as the file has them.

    Raises:
        DataError: As :func:`load_stars`.
    """
    places: list[int] | None = None
    width, rows = 0, []
    first: dict[float, int] = {}
    accepted = "a table of stars in UTF-8 with the columns " + ", ".join(columns)
    text = read_text(path, accepted, errors="strict")
    for count, line in enumerate(text.split("\n"), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        fields = [field.strip() for field in line.split(",")]
        try:
            if places is None:
                places, width = _places(fields, columns), len(fields)
            else:
                rows.append(_row(fields, places, width))
                _check_once(first, rows[-1][0], count)
        except DataError as error:
            raise DataError(f"{path}, line {count}: {error}") from None
    if not rows:
        raise DataError(f"{path}: the file has no star; accepted is at least one")
    return rows


def _places(header: list[str], columns: tuple[str, ...]) -> list[int]:
    missing = [name for name in columns if name not in header]
    if missing:
        raise DataError(
            f"the header does not name {', '.join(missing)}; accepted are the columns "
            + ", ".join(columns)
        )
    return [header.index(name) for name in columns]


def _row(fields: list[str], places: list[int], width: int) -> list[float]:
    if len(fields) != width:
        raise DataError(f"the line has {len(fields)} columns; accepted are {width}")
    row = [
        number(name, fields[place], *_RANGES.get(name, (-np.inf, np.inf)))
        for name, place in zip(COLUMNS, places, strict=True)
    ]
    if not row[0].is_integer():
        raise DataError(f"hip is {fields[places[0]]}; accepted is a whole number")
    return row


def _check_once(first: dict[float, int], hip: float, line: int) -> None:
    """Note the line on which a star is first found, and refuse a second one."""
    if first.setdefault(hip, line) != line:
        raise DataError(
            f"the star HIP {hip:.0f} is there twice, first on line {first[hip]}; accepted is once"
        )
