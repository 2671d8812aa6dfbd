"""Are the noise coefficients of a spoilt log within their own intervals? A hundred seeds a fault.

Usage: python -m checks.allan_faults

Each log is ten minutes of a sensor at rest at 100 Hz with a fault of ``tests/faulty/rest.py``. It
must be refused; or the interval of 95 % of each random walk must hold the truth for nine of ten
seeds, unless the numbers are those of the output alone; and what must be noted, is. Writes
``allan_faults.json`` beside this script; the exit code is 1 if a fault fails. Takes a quarter of an
hour on two cores.
"""

import json
import sys
from pathlib import Path

import numpy as np

RECORD = Path(__file__).with_suffix(".json")
SEEDS = 100
COUNT = 60_000
LEAST = 0.9
"""Share of the intervals, of all axes, that must hold the truth."""


def main() -> int:
    """Analyse every fault with every seed and write what came of it."""
    from jaxnav.cli import configure_jax
    from jaxnav.datasets.base import DataError
    from jaxnav.noise_report.analysis import analyse, prepare
    from jaxnav.noise_report.config import AllanConfig
    from tests.faulty.rest import FAULTS, clean, log_of
    from tests.faulty.test_rest_faults import walks

    configure_jax()
    outcomes, failed = {}, []
    for name, fault in FAULTS.items():
        refused, noted, ratios = 0, 0, []
        for seed in range(SEEDS):
            rng = np.random.default_rng(seed)
            try:
                log = prepare(log_of(*fault.spoil(rng, *clean(rng, COUNT))), AllanConfig())
            except DataError as error:
                refused += fault.refused is not None and fault.refused in str(error)
                continue
            document = analyse(log, AllanConfig())[0]
            noted += any(fault.noted in note for note in document["notes"]) if fault.noted else 0
            ratios.append(walks(document))
        entry: dict[str, object] = {"seeds": SEEDS, "refused": refused}
        good = refused == SEEDS
        if ratios:
            value, low, high = np.moveaxis(np.array(ratios), 2, 0)
            known = np.isfinite(value)
            inside = (low <= 1) & (high >= 1)
            entry["inside"] = round(float(inside[known].mean()), 4)
            entry["scatter"] = round(float(np.std(value[known])), 4)
            entry["mean"] = round(float(np.mean(value[known])), 4)
            entry["noted"] = noted
            right = inside[known].mean() >= LEAST or not fault.sensor
            told = fault.noted is None or noted == SEEDS
            good = right and told and len(ratios) == SEEDS and fault.refused is None
        outcomes[name] = entry | {"good": bool(good)}
        failed += [] if good else [name]
        print(name, outcomes[name], flush=True)
    RECORD.write_text(json.dumps(outcomes, indent=1) + "\n")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
