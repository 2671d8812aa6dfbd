"""Are the rows of the studies what they were? Six runs of each scenario against those on record.

Usage: python checks/study_rows.py [STUDY ...] [--record DIR]

Every study on record is run with few runs and seed 0; what it keeps of each run is compared with
``study_rows.json`` beside this script: 1e-9 relative to the largest entry of the array along the
runs. What differs by more is printed, with the run, and the exit code is 1. ``--record DIR`` takes
the rows from results that ``jaxnav run --out`` has left in DIR/STUDY, one folder a scenario, and
puts them in the file in place of those of the same studies. Takes a quarter of an hour on two
cores.
"""

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

RECORD = Path(__file__).with_suffix(".json")
RUNS = 6
TOLERANCE = 1e-9
KEPT = {
    "immae": ("mean_square", "nees"),
    "mmae-ukf": ("mean_square", "nees", "settled"),
    "rkcns": ("mean_square",),
    "sage-husa": ("mean_square", "nees"),
    "arekf": ("mean_square", "convergence", "identified"),
}
"""Arrays of a study's result with an axis of runs, which comes first."""
OFF = {
    "mmae-ukf": {"cost": False},
    "rkcns": {"cost": False, "ablations": False},
    "arekf": {"cost": False, "analysis": False},
}
"""Parts of a study that have no rows."""


def rows_of(study: str, arrays: Any) -> dict[str, list]:
    """Return the arrays that are kept, of the first runs, as lists."""
    return {name: np.asarray(arrays[name])[:RUNS].tolist() for name in KEPT[study]}


def computed(study: str, runs: int = RUNS, scenario: str = "all") -> dict[str, dict[str, list]]:
    """Run a study and return its rows by scenario."""
    from jaxnav.cli import configure_jax
    from jaxnav.studies import STUDIES

    configure_jax()
    config = STUDIES[study].load("config")(runs=runs, scenario=scenario, **OFF.get(study, {}))
    results = STUDIES[study].load("entry")(replace(config, seed=0))
    return {result.scenario: rows_of(study, result.arrays) for result in results}


def recorded(folder: Path) -> dict[str, dict[str, dict[str, list]]]:
    """Return the rows that ``jaxnav run`` has left in a folder, by study and scenario."""
    found: dict[str, dict[str, dict[str, list]]] = {}
    for study in KEPT:
        for path in sorted((folder / study).glob("*/arrays.npz")):
            with np.load(path) as arrays:
                found.setdefault(study, {})[path.parent.name] = rows_of(study, arrays)
    return found


def differences(study: str, found: dict[str, Any], expected: dict[str, Any]) -> list[str]:
    """Return a sentence for each array whose rows are not those expected."""
    said = []
    for scenario, arrays in found.items():
        for name, rows in arrays.items():
            new = np.asarray(rows, float)
            old = np.asarray(expected[scenario][name], float)[: len(new)]
            scale = np.max(np.abs(old), axis=0, keepdims=True)
            apart = np.abs(new - old) / np.where(scale > 0, scale, 1)
            if not np.array_equal(np.isfinite(new), np.isfinite(old)):
                said.append(f"{study}, {scenario}, {name}: other runs are finite")
            elif np.nanmax(apart) > TOLERANCE:
                where = np.unravel_index(np.nanargmax(apart), apart.shape)
                place = ", ".join(map(str, where))
                said.append(
                    f"{study}, {scenario}, {name}: {np.nanmax(apart):.1e} relative at ({place}), "
                    f"{old[where]:.17g} before and {new[where]:.17g} now"
                )
    return said


def main() -> int:
    """Compare the studies that were asked for, or all."""
    parser = argparse.ArgumentParser(description="Compare the studies' rows with those on record.")
    parser.add_argument("studies", nargs="*", metavar="STUDY", help=f"of {', '.join(KEPT)}")
    parser.add_argument("--record", type=Path, metavar="DIR", help="write the record from results")
    args = parser.parse_args()
    unknown = [name for name in args.studies if name not in KEPT]
    if unknown:
        parser.error(f"there is no study {unknown[0]!r}; it must be one of {', '.join(KEPT)}")
    if args.record is not None:
        before = json.loads(RECORD.read_text()) if RECORD.exists() else {}
        RECORD.write_text(json.dumps(before | recorded(args.record)) + "\n")
        return 0
    expected = json.loads(RECORD.read_text())
    missing = [name for name in args.studies if name not in expected]
    if missing:
        parser.error(f"no rows of {missing[0]} are on record; make them with --record DIR")
    said = []
    for study in args.studies or expected:
        found = differences(study, computed(study), expected[study])
        print(f"{study}: {'differs' if found else 'as before'}", flush=True)
        said += found
    print("\n".join(said))
    return 1 if said else 0


if __name__ == "__main__":
    sys.exit(main())
