"""What every command prints: progress, documents, and numbers in cells."""

import json
from types import TracebackType
from typing import Any

import numpy as np
import rich.progress
from rich.console import Console
from rich.markup import escape


class Progress:
    """Progress of the scenarios with the time left, on standard error."""

    def __init__(self, *, quiet: bool = False, unit: str = "runs") -> None:
        """Make the display; ``quiet`` shows nothing, and ``unit`` is what is counted."""
        self._tasks: dict[str, rich.progress.TaskID] = {}
        self._display = rich.progress.Progress(
            rich.progress.TextColumn("{task.description}"),
            rich.progress.BarColumn(),
            rich.progress.MofNCompleteColumn(),
            rich.progress.TextColumn(f"{unit}, left"),
            rich.progress.TimeRemainingColumn(),
            console=Console(stderr=True),
            transient=True,
            disable=quiet,
        )

    def __enter__(self) -> "Progress":
        """Return itself; the display starts with the first progress."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop the display."""
        if self._tasks:
            self._display.stop()

    def __call__(self, label: str, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` runs are done."""
        if not self._tasks:
            self._display.start()
        if label not in self._tasks:
            self._tasks[label] = self._display.add_task(label, total=total)
        self._display.update(self._tasks[label], completed=done)


def print_document(document: Any) -> None:
    """Print a document as JSON."""
    print(json.dumps(document, indent=2))


def with_error(measure: dict[str, Any]) -> str:
    """Return a measure with its standard error, where that is known."""
    value, se = measure["value"], measure.get("se")
    if se is None or se != se:
        return f"{value:.4f}"
    return f"{value:.4f} ± {se:.4f}"


def number(value: float | None) -> str:
    """Return a number for a cell, or nothing."""
    if value is None:
        return ""
    return str(value) if isinstance(value, int) else f"{value:.3f}"


def values_text(value: Any) -> str:
    """Return the entries of an array for a cell, or nothing."""
    if value is None:
        return ""
    entries = np.ravel(value)
    return " ".join(f"{entry:.4g}" for entry in entries)


def print_findings(console: Console, audit: list[dict[str, Any]]) -> None:
    """Print what is in doubt and what is a fault, a sentence each."""
    for finding in audit:
        if finding["verdict"] in ("doubt", "fault"):
            colour = "red" if finding["verdict"] == "fault" else "yellow"
            console.print(
                f"[{colour}]{finding['verdict']}: {escape(finding['says'])}", soft_wrap=True
            )
