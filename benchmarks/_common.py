"""What the benchmarks share: settings, the clock, the check before it, and the output."""

import argparse
import json
import os
import platform
import resource
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

from jaxnav.compiling import cores

TOLERANCE = 1e-8


def setup() -> None:
    """Turn on float64; called before anything touches a device."""
    jax.config.update("jax_enable_x64", True)


def arguments(doc: str | None, argv: Sequence[str] | None) -> argparse.Namespace:
    """Parse the options every benchmark has; the first line of its docstring is its help."""
    parser = argparse.ArgumentParser(description=(doc or "").strip().splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a smaller problem, in seconds")
    parser.add_argument("--json", type=Path, metavar="PATH", help="write what was measured here")
    return parser.parse_args(argv)


class Goal(NamedTuple):
    """A number that was promised; ``measured`` is ``None`` where it could not be taken."""

    text: str
    measured: float | None
    limit: float
    at_least: bool = False

    @property
    def met(self) -> bool | None:
        """Whether the measured number keeps the promise."""
        if self.measured is None:
            return None
        return self.measured >= self.limit if self.at_least else self.measured <= self.limit


def seconds(call: Callable[[], Any]) -> float:
    """Return the wall time of one call, results and all."""
    start = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - start


def best_in_turn(calls: Sequence[Callable[[], Any]], turns: int) -> list[float]:
    """Return the best seconds of each call; they take turns, so a busy moment hits them alike."""
    times = [[seconds(call) for call in calls] for _ in range(turns)]
    return [min(column) for column in zip(*times, strict=True)]


class Moment(NamedTuple):
    """Wall time, CPU time of all processes (``None`` where it is not told) and of this one [s]."""

    wall: float
    everyone: float | None
    own: float


def now() -> Moment:
    """Return the readings that :func:`cores_elsewhere` compares."""
    try:
        user, nice, system = Path("/proc/stat").read_text().split(maxsplit=4)[1:4]
        everyone = (int(user) + int(nice) + int(system)) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError):
        everyone = None
    below = resource.getrusage(resource.RUSAGE_CHILDREN)
    own = time.process_time() + below.ru_utime + below.ru_stime
    return Moment(time.perf_counter(), everyone, own)


def cores_elsewhere(start: Moment) -> list[str]:
    """Return a note if others kept a tenth of a core or more busy since ``start``."""
    end = now()
    if start.everyone is None or end.everyone is None:
        return []
    others = end.everyone - start.everyone - (end.own - start.own)
    cores = others / (end.wall - start.wall)
    if cores < 0.1:
        return []
    return [f"Other processes kept {cores:.1f} cores busy meanwhile: figures on all cores suffer."]


def peak_gib() -> float:
    """Return the largest memory this process has held [GiB]."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30


def require_agreement(
    name: str, value: Any, reference: Any, axis: int = 0, tolerance: float = TOLERANCE
) -> None:
    """Stop the benchmark unless a result is the oracle's: a fast wrong answer has no time.

    Args:
        name: What is compared, for the message.
        value: The result.
        reference: The oracle's.
        axis: Axis of time; the error is relative to each component's largest value along it.
        tolerance: Largest relative error.

    Raises:
        SystemExit: If the results differ.
    """
    value, reference = np.asarray(value), np.asarray(reference)
    scale = np.max(np.abs(reference), axis=axis, keepdims=True)
    error = float(np.max(np.abs(value - reference) / scale))
    if not error <= tolerance:
        raise SystemExit(
            f"{name} differs from the NumPy filter by {error:.1e} relative, "
            f"{tolerance:.0e} is allowed: nothing was timed."
        )


def report(
    args: argparse.Namespace,
    title: str,
    rows: list[dict[str, Any]],
    goals: Sequence[Goal] = (),
    notes: Sequence[str] = (),
) -> dict[str, Any]:
    """Print the table, the goals beside their figures and the notes; write the JSON if asked."""
    console = Console()
    if rows:
        table = Table(title=title)
        for column, value in rows[0].items():
            table.add_column(column, justify="left" if isinstance(value, str) else "right")
        for row in rows:
            table.add_row(*(_cell(value) for value in row.values()))
        console.print(table)
    for goal in goals:
        sign = ">=" if goal.at_least else "<="
        word = {True: "met", False: "NOT met", None: "not measured"}[goal.met]
        console.print(f"{goal.text}: {_cell(goal.measured)}, goal {sign} {goal.limit:g}: {word}")
    for note in notes:
        console.print(note)
    result = {
        "title": title,
        "quick": args.quick,
        "machine": machine(),
        "rows": rows,
        "goals": [{**goal._asdict(), "met": goal.met} for goal in goals],
        "notes": list(notes),
    }
    if args.json is not None:
        args.json.write_text(json.dumps(result, indent=1) + "\n")
    return result


def machine() -> dict[str, Any]:
    """Describe what the figures were taken on."""
    return {
        "cores": cores(),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "processor": platform.machine(),
    }


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
