"""Does a study compile anything again for other runs and another seed?

Usage: python -m checks.compiled_again

``arekf --scenario outliers`` and ``mmae-ukf --scenario large-misalignment`` run with four runs, and
then with 150 runs and another seed. Writes ``compiled_again.json`` beside this script: programs
compiled and seconds of either; the exit code is 1 if any was compiled the second time.
"""

import json
import sys
import time
from dataclasses import replace
from pathlib import Path

RECORD = Path(__file__).with_suffix(".json")
CASES = {"arekf": "outliers", "mmae-ukf": "large-misalignment"}
FEW, MANY = 4, 150


def main() -> int:
    """Run both studies twice and write what was compiled."""
    from jaxnav.cli import configure_jax
    from jaxnav.studies import STUDIES
    from tests.programs import compilations

    configure_jax(cache=False)
    found = {}
    for name, scenario in CASES.items():
        study = STUDIES[name]
        config = study.load("config")(scenario=scenario, runs=FEW, cost=False)
        run = study.load("entry")
        taken = []
        for asked in (config, replace(config, runs=MANY, seed=1)):
            begin = time.perf_counter()
            with compilations() as programs:
                run(asked)
            taken.append((len(programs), round(time.perf_counter() - begin, 1)))
        (first, cold), (again, warm) = taken
        found[name] = {
            "scenario": scenario,
            "programs": first,
            "again": again,
            f"seconds, {FEW} runs": cold,
            f"seconds, {MANY} runs": warm,
        }
        print(name, found[name], flush=True)
        RECORD.write_text(json.dumps(found, indent=1) + "\n")
    return int(any(entry["again"] for entry in found.values()))


if __name__ == "__main__":
    sys.exit(main())
