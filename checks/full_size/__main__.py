"""Do the studies at full size reach the figures they are held to?

Usage: python -m checks.full_size [STUDY ...]

STUDY is one or more of arekf, immae, mmae-ukf, rkcns and sage-husa; all of them unless given. Each
is a module of tests beside this one; the outcome of every test, what it took and the figures that
it measured go to ``results.json``, where other studies' stay. The exit code is 1 if a test fails.
On two cores immae takes a minute and sage-husa three.
"""

import argparse
import json
import platform
import sys
from pathlib import Path
from typing import Any

import jax
import pytest

FOLDER = Path(__file__).parent
RECORD = FOLDER / "results.json"
STUDIES = {
    path.stem.removeprefix("test_").replace("_", "-"): path
    for path in sorted(FOLDER.glob("test_*.py"))
}


class Outcomes:
    """Gathers what the tests of each study came to."""

    def __init__(self) -> None:
        """Start with none."""
        self.by_study: dict[str, dict[str, Any]] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Keep a test's outcome; a fixture that fails is the failure of its test."""
        path, _, test = report.nodeid.partition("::")
        study = Path(path).stem.removeprefix("test_").replace("_", "-")
        own = self.by_study.setdefault(study, {}).setdefault(
            test.removeprefix("test_").replace("_", " "), {"outcome": "passed", "seconds": 0.0}
        )
        own["seconds"] = round(own["seconds"] + report.duration, 1)
        if report.outcome != "passed":
            own["outcome"] = report.outcome
        if report.when == "call":
            own["figures"] = dict(report.user_properties)


def main() -> int:
    """Run the tests of the studies asked for and write their outcomes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("study", nargs="*", choices=[*STUDIES, []], help="all unless given")
    studies = parser.parse_args().study or list(STUDIES)
    outcomes = Outcomes()
    paths = [str(STUDIES[study]) for study in studies]
    # one process: what is heavy here spreads over the cores by itself
    code = pytest.main([*paths, "-p", "tests.conftest", "-n", "0", "-q"], plugins=[outcomes])
    record = json.loads(RECORD.read_text()) if RECORD.exists() else {}
    machine = {"jax": jax.__version__, "python": platform.python_version()}
    for study, tests in outcomes.by_study.items():
        record[study] = {"machine": machine, "tests": tests}
    RECORD.write_text(json.dumps(dict(sorted(record.items())), indent=1) + "\n")
    return int(code != 0)


if __name__ == "__main__":
    sys.exit(main())
