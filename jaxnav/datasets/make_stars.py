"""Make the table of bright stars from a copy of the Hipparcos catalogue in its new reduction.

    python -m jaxnav.datasets.make_stars SOURCE [--magnitude 6.5] [--out FILE]

``SOURCE`` is a comma-separated file with the columns that :data:`SOURCE_COLUMNS` names, as the
package ruststartracker distributes it.
"""

import argparse
import os
import sys
from pathlib import Path

from jaxnav.datasets.base import DataError
from jaxnav.datasets.stars import BUNDLED, COLUMNS, read_rows

SOURCE_COLUMNS = ("source_id", "ra", "dec", "pmra", "pmdec", "phot_g_mean_mag")
FORMATS = ("{:.0f}", "{:.7f}", "{:.7f}", "{:.2f}", "{:.2f}", "{:.2f}")
HEADING = """\
# Stars of the Hipparcos catalogue in its new reduction (van Leeuwen 2007, A&A 474(2), CDS I/311)
# to magnitude Hp {:g}, ICRS, epoch J1991.25. Proper motion in right ascension is times
# cos(declination).
"""


def table(source: Path, magnitude: float) -> str:
    """Return the text of the table, in the order of the catalogue's numbers.

    Args:
        source: Copy of the catalogue.
        magnitude: Faintest magnitude to keep.

    Raises:
        DataError: If the source is missing or malformed, or has no star so bright.
    """
    kept = sorted(row for row in read_rows(source, SOURCE_COLUMNS) if row[-1] <= magnitude)
    if not kept:
        raise DataError(
            f"{source}: no star is as bright as magnitude {magnitude:g}; accepted is a fainter one"
        )
    lines = [
        ",".join(form.format(value) for form, value in zip(FORMATS, row, strict=True))
        for row in kept
    ]
    return HEADING.format(magnitude) + "\n".join([",".join(COLUMNS), *lines]) + "\n"


def main(arguments: list[str] | None = None) -> int:
    """Write the table; return 0, or 2 with one sentence on standard error for bad input."""
    parser = argparse.ArgumentParser(
        prog="python -m jaxnav.datasets.make_stars", description="Make the table of bright stars."
    )
    parser.add_argument("source", type=Path, help="copy of the Hipparcos catalogue")
    parser.add_argument("--magnitude", type=float, default=6.5, help="faintest to keep")
    parser.add_argument("--out", type=Path, default=BUNDLED, help="file to write")
    given = parser.parse_args(arguments)
    try:
        _write(given.out, table(given.source, given.magnitude))
    except DataError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def _write(out: Path, text: str) -> None:
    """Write a file whole or not at all; raise DataError if it cannot be written."""
    partial = out.parent / f".{out.name}.{os.getpid()}.tmp"
    try:
        try:
            partial.write_text(text, encoding="utf-8", newline="\n")
            partial.replace(out)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise DataError(f"{out}: {reason}; accepted is a file that can be written") from error


if __name__ == "__main__":
    sys.exit(main())
