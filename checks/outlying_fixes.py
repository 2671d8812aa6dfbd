"""Does one fix that is off spoil a recorded drive? At twenty places, by 20 m to 160 km.

Usage: python checks/outlying_fixes.py FOLDER [FILTER ...]

FOLDER is that of the drive with RTK. One fix after the other is moved north by 20 m, 100 m, 1.1 km
and 160 km, and the drive filtered by ``ekf``; every other filter of ``jaxnav filter`` gets four of
the places. The trajectory must stay within a metre and a degree of the clean one and the gate must
name the fix, which it does not do in the clean drive. Writes ``outlying_fixes.json`` beside this
script, where the filters that were not asked for stay; the exit code is 1 if one fails. Takes
half an hour on two cores.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

RECORD = Path(__file__).with_suffix(".json")
OFF_M = (20.0, 100.0, 1.1e3, 1.6e5)
PLACES = 20
FEW = ((3, 20.0), (8, 100.0), (13, 1.1e3), (18, 1.6e5))
"""Places and distances of the other filters."""
METRE = 1 / 6.37e6


def moved(log: Any, fix: int, metres: float) -> Any:
    """Return a drive with one fix moved north."""
    geodetic = log.fixes.geodetic.copy()
    geodetic[fix, 0] += metres * METRE
    return log._replace(fixes=log.fixes._replace(geodetic=geodetic))


def places(drive: Any, count: int = PLACES) -> np.ndarray:
    """Return the places in the log of so many fixes that are used, evenly over a drive."""
    inner = np.linspace(0.02, 0.98, count) * (len(drive.fix) - 1)
    return drive.fix[np.rint(inner).astype(int)]


def compared(clean: Any, report: Any, fix: int) -> dict[str, Any]:
    """Return how far a trajectory is from the clean one, and whether the fix was named.

    ``others`` is the number of other fixes that one of the runs refused and the other did not.
    """
    a, b = clean.kept.mean, report.kept.mean
    off = (np.asarray(b.position) - np.asarray(a.position))[:, :2] / METRE
    dcm = np.einsum("nij,nkj->nik", np.asarray(b.dcm), np.asarray(a.dcm))
    angle = np.arccos(np.clip((np.trace(dcm, axis1=1, axis2=2) - 1) / 2, -1, 1))
    return {
        "metres": float(np.max(np.hypot(*off.T))),
        "degrees": float(np.rad2deg(np.max(angle))),
        "named": fix + 1 in refused(report) - refused(clean),
        "others": len((refused(report) ^ refused(clean)) - {fix + 1}),
    }


def refused(report: Any) -> set[int]:
    """Return the numbers in the log of the fixes that the gate refused."""
    return {entry["fix"] for entry in report.document["refused"]}


def good(found: dict[str, Any]) -> bool:
    """Return whether a case keeps its bars."""
    return found["metres"] < 1 and found["degrees"] < 1 and found["named"]


def names_of_all() -> list[str]:
    """Return every filter that a drive can go through, and every wrapper around ``ekf``."""
    from jaxnav.estimation.register import FILTER, WRAPPER, by_kind
    from jaxnav.recorded.config import ALIASES

    # A drive is not linear, and every run has its gate.
    filters = [name for name in by_kind()[FILTER] if name not in ("kf", "square_root_kf")]
    wrapped = [f"{name}(ekf)" for name in by_kind()[WRAPPER] if name != "gated"]
    return [*filters, *ALIASES, *(name for name in wrapped if name not in ALIASES.values())]


def main() -> int:
    """Filter the drive with each fix moved and write how far off it went."""
    from jaxnav.cli import configure_jax
    from jaxnav.datasets.formats import load_drive
    from jaxnav.recorded.analysis import analyse
    from jaxnav.recorded.config import FilterConfig

    folder, names = next(iter(sys.argv[1:]), ""), sys.argv[2:]
    if not folder:
        print("usage: python checks/outlying_fixes.py FOLDER [FILTER ...]")
        return 2
    configure_jax()
    log = load_drive(Path(folder))
    result: dict[str, Any] = json.loads(RECORD.read_text()) if RECORD.exists() else {}
    for name in names or names_of_all():
        config = FilterConfig(filter=name, outages="off", rate_hz=25.0)
        clean = analyse(log, config)
        at = places(clean.drive)
        every = [(i, off) for i in range(PLACES) for off in OFF_M]
        cases = []
        for i, off in every if name == "ekf" else FEW:
            fix = int(at[i])
            found = compared(clean, analyse(moved(log, fix, off), config), fix)
            cases.append({"fix": fix + 1, "off_m": off, **found})
        result[name] = {
            "refused in the clean drive": len(clean.document["refused"]),
            "cases": len(cases),
            "within the bars": sum(good(case) for case in cases),
            "worst": max(cases, key=lambda case: case["metres"]),
            "beyond": [case for case in cases if not good(case)],
        }
        print(name, json.dumps(result[name]), flush=True)
        RECORD.write_text(json.dumps(result, indent=2) + "\n")
    return int(any(entry["beyond"] for entry in result.values()))


if __name__ == "__main__":
    sys.exit(main())
