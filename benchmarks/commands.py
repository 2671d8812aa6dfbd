"""How long does a user wait for a command, beside another version of this library?

The README's first command with an empty cache and with what that left behind, and two studies with
four runs and an empty cache. ``--before`` names the ``jaxnav`` of another environment; both take
turns, each command is a process of its own, and the median of the turns counts. Without it the
seconds are those of this version alone, and no goal is judged.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

if not __package__:
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import _common as common

FIRST = ("run", "immae", "--scenario", "all")
FEW = {
    "arekf, four runs": ("run", "arekf", "--scenario", "outliers", "--runs", "4"),
    "mmae-ukf, four runs": ("run", "mmae-ukf", "--scenario", "large-misalignment", "--runs", "4"),
}
GOALS = {"first, empty cache": 0.65, "first, warm cache": 0.65} | dict.fromkeys(FEW, 0.4)
"""Largest ratio of the time to that of the version before (commit fc417c8)."""
TURNS = 3


def seconds(program: str, options: Sequence[str], home: Path) -> float:
    """Return how long a command takes with the cache of a home folder.

    Raises:
        SystemExit: If the command fails; nothing is then timed.
    """
    environment = {**os.environ, "XDG_CACHE_HOME": str(home), "MPLBACKEND": "agg"}
    out = home / "out"
    start = time.perf_counter()
    done = subprocess.run(
        [program, *options, "--out", str(out)], capture_output=True, text=True, env=environment
    )
    taken = time.perf_counter() - start
    if done.returncode != 0:
        raise SystemExit(f"{program} {' '.join(options)} failed: {done.stderr.strip()}")
    return taken


def turn(program: str, few: bool) -> dict[str, float]:
    """Return the seconds of each command, once."""
    with tempfile.TemporaryDirectory() as home:
        taken = {
            name: seconds(program, FIRST, Path(home))
            for name in ("first, empty cache", "first, warm cache")
        }
    if few:
        for name, options in FEW.items():
            with tempfile.TemporaryDirectory() as home:
                taken[name] = seconds(program, options, Path(home))
    return taken


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Run the benchmark and return what it measured."""
    own = argparse.ArgumentParser(add_help=False)
    own.add_argument("--before", metavar="JAXNAV")
    given, rest = own.parse_known_args(argv)
    args = common.arguments(__doc__, rest)
    here = str(Path(sys.executable).with_name("jaxnav"))
    programs = {"this": here} | ({"before": given.before} if given.before else {})
    start = common.now()
    turns = 1 if args.quick else TURNS
    taken: dict[str, list[dict[str, float]]] = {name: [] for name in programs}
    for k in range(turns):
        for name, program in programs.items():
            # once is enough for what takes minutes
            taken[name].append(turn(program, few=k == 0))
    rows, goals = [], []
    for command in taken["this"][0]:
        found = {
            name: median(one[command] for one in own if command in one)
            for name, own in taken.items()
        }
        row = {"command": command} | {f"{name}, s": value for name, value in found.items()}
        if "before" in found:
            ratio = found["this"] / found["before"]
            row["ratio"] = ratio
            goals.append(common.Goal(f"{command}: this / before", ratio, GOALS[command]))
        rows.append(row)
    notes = common.cores_elsewhere(start)
    title = f"Seconds of a command, median of {turns} turns"
    return common.report(args, title, rows, goals=goals, notes=notes)


if __name__ == "__main__":
    main()
