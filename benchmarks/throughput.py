"""How long does one filter step of one model take, in a bank of five, and how long elsewhere?

Microseconds per filter step and model: 15 states, 3 measurements, float64, a bank of five models
over 16 and 128 Monte Carlo runs. The runs either share one covariance recursion, because their
inputs are the same, or each has its own. jaxnav's figure contains what makes the members a bank
(weights, mixture, statistics of each run); the peers run the members alone. All contestants take
turns on the clock, so that a busy moment of the machine is nobody's alone; the best turn counts.
"""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

if not __package__:
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np

from benchmarks import _common as common
from benchmarks._ours import Statistics, structured, unstructured
from benchmarks._peers import CONTESTANTS, Contestant, Missing
from benchmarks._problem import THETA, Dense, dense, make_problem, oracle
from jaxnav.compiling import cores
from jaxnav.units import ARCSEC

RUNS = (16, 128)
CHECKED = 2
"""Number of runs that are compared with the oracle before the clock starts."""
CASES = {"shared": False, "own": True}
GOALS_US = {"shared": 0.12, "own": 0.38}
GOAL_RATIOS = {"shared": 3.5, "own": 9.0}
LARGE_TILE = 64
"""Runs a tile of the second way: a shared covariance leaves room in the cache for more runs."""
DENSE_LANE_STEPS = 200_000
"""Filter steps of the dense path in one timed call, so that its matrices fit the memory."""


class Entry(NamedTuple):
    """A checked call that waits for its turn on the clock.

    Attributes:
        name: Of the filter.
        spread: How the work is spread over the machine.
        call: What is timed.
        lane_steps: Filter steps in it, over all runs and models.
        first: Seconds of the first call, which compiles.
    """

    name: str
    spread: str
    call: Callable[[], Any]
    lane_steps: int
    first: float


def shortened(matrices: Dense, runs: int, lane_steps: int) -> Dense:
    """Return the first runs of a problem, as far as the number of filter steps goes."""
    steps = lane_steps // (runs * len(THETA))
    F, G = (m[:runs, :steps] if matrices.own else m[:steps] for m in (matrices.F, matrices.G))
    return matrices._replace(F=F, G=G, z=matrices.z[:runs, :steps])


def lane_steps(matrices: Dense) -> int:
    """Return the number of filter steps over all runs and models."""
    runs, steps = matrices.z.shape[:2]
    return runs * steps * len(THETA)


def study_entry(
    name: str, spread: str, call: Callable[[], Statistics], matrices: Dense, unit: float = 1.0
) -> Entry:
    """Compare a Monte Carlo study of the bank with the oracle's mixture."""
    first = common.seconds(call)
    rows = call()
    for index in range(CHECKED):
        truth = oracle(matrices, index).mixture * unit
        expected = (truth.mean(axis=0), (truth**2).mean(axis=0), truth[-1])
        for label, value, reference in zip(rows._fields, rows, expected, strict=True):
            common.require_agreement(f"{name}, {label} of run {index}", value[index], reference)
    return Entry(name, spread, call, lane_steps(matrices), first)


def contestant_entries(contestant: Contestant, matrices: Dense) -> list[Entry]:
    """Compare each way a contestant has through the problem with the oracle's members."""
    runs = min(len(matrices.z), contestant.runs)
    part = shortened(matrices, runs, contestant.lane_steps)
    truths = [oracle(part, index) for index in range(min(CHECKED, runs))]
    entries = []
    for spread, call in contestant.prepare(part).items():
        first = common.seconds(call)
        attitude, total = call()
        for index, truth in enumerate(truths):
            name = f"{contestant.name}, run {index}"
            wanted = np.moveaxis(truth.attitude, 1, 0)
            common.require_agreement(name, attitude[index], wanted, axis=1)
            common.require_agreement(name, total[index], truth.log_likelihood.sum(axis=0))
        entries.append(Entry(contestant.name, spread, call, lane_steps(part), first))
    return entries


def line_up(steps: int, runs: int, own: bool) -> tuple[list[Entry], list[str]]:
    """Return all contestants, checked, and a note for each that is missing."""
    problem = make_problem(steps, runs)
    matrices = dense(problem, own)
    part = shortened(matrices, runs, DENSE_LANE_STEPS)
    entries = [
        study_entry("jaxnav", "threads", structured(problem, own), matrices, ARCSEC),
        study_entry("jaxnav, dense F", "threads", unstructured(part), part),
    ]
    if runs >= cores() * LARGE_TILE:
        wide = structured(problem, own, LARGE_TILE)
        entries.append(study_entry("jaxnav", f"tiles of {LARGE_TILE}", wide, matrices, ARCSEC))
    notes = []
    for contestant in CONTESTANTS:
        try:
            entries += contestant_entries(contestant, matrices)
        except Missing as reason:
            notes.append(f"{contestant.name} is left out: {reason}.")
    return entries, notes


def measure(steps: int, runs: int, case: str, turns: int) -> tuple[list[dict], list[str]]:
    """Return the rows of the table for one case, the fastest way of each contestant, and notes."""
    entries, notes = line_up(steps, runs, CASES[case])
    start = common.now()
    best = common.best_in_turn([entry.call for entry in entries], turns)
    notes += [f"Covariance {case}, {runs} runs: {note}" for note in common.cores_elsewhere(start)]
    fastest: dict[str, dict[str, Any]] = {}
    for entry, seconds in zip(entries, best, strict=True):
        us = 1e6 * seconds / entry.lane_steps
        if entry.name not in fastest or us < fastest[entry.name]["us"]:
            fastest[entry.name] = {
                "covariance": case,
                "runs": runs,
                "filter": entry.name,
                "us": us,
                "spread": entry.spread,
                "first call, s": entry.first,
            }
    return list(fastest.values()), notes


def goals(rows: list[dict[str, Any]]) -> list[common.Goal]:
    """Hold the figures at the larger number of runs against what was promised."""
    peers = {contestant.name for contestant in CONTESTANTS if contestant.jax}
    found = []
    for case, limit in GOALS_US.items():
        at_end = [row for row in rows if (row["covariance"], row["runs"]) == (case, RUNS[-1])]
        us = {row["filter"]: row["us"] for row in at_end}
        fastest = min((us[name] for name in peers & us.keys()), default=None)
        ratio = None if fastest is None else fastest / us["jaxnav"]
        found.append(common.Goal(f"us, covariance {case}", us["jaxnav"], limit))
        text = f"fastest JAX peer / jaxnav, covariance {case}"
        found.append(common.Goal(text, ratio, GOAL_RATIOS[case], at_least=True))
    return found


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Run the benchmark and return what it measured."""
    args = common.arguments(__doc__, argv)
    common.setup()
    steps, turns = (500, 3) if args.quick else (2000, 6)
    rows: list[dict[str, Any]] = []
    notes: list[str] = []
    for case in CASES:
        for runs in RUNS:
            found, missing = measure(steps, runs, case, turns)
            rows += found
            notes += [note for note in missing if note not in notes]
    title = "Microseconds per filter step and model (15 states, 3 measurements, 5 models)"
    return common.report(args, title, rows, goals(rows), notes)


if __name__ == "__main__":
    main()
