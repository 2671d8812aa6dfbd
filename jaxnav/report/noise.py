"""The noise coefficients of a sensor at rest."""

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table


def print_allan(document: dict[str, Any], directory: Path) -> None:
    """Print the noise coefficients of gyros and accelerometers with their intervals."""
    console = Console()
    counts, step = document["counts"], document["step_s"]
    console.print(
        f"{document['samples']} samples, {document['samples'] * step:.6g} s at {1 / step:.6g} Hz; "
        f"{counts['duplicates']} duplicates dropped, {counts['nan_rows']} rows with an entry that "
        f"is no number, {counts['gaps']} gaps of {counts['missing']} samples"
        + (f", {counts['spikes']} spikes left out" if counts["spikes"] else ""),
        soft_wrap=True,
    )
    for sensor, title in (("gyro", "gyros"), ("accel", "accelerometers")):
        axes = {name: row for name, row in document["axes"].items() if name.startswith(sensor)}
        console.print(_noise_table(title, axes, document["confidence"]))
    for note in document["notes"]:
        console.print(f"[yellow]{escape(note)}", soft_wrap=True)
    console.print(f"Written to {directory}: summary.json, allan.npz, allan.png", soft_wrap=True)


def _noise_table(
    title: str, axes: dict[str, dict[str, dict[str, Any]]], confidence: float
) -> Table:
    table = Table(show_lines=True, title=f"{title}, with {100 * confidence:.4g} % intervals")
    table.add_column("axis")
    for name, entry in next(iter(axes.values())).items():
        table.add_column(escape(f"{name.replace('_', ' ')}\n[{entry['unit']}]"), justify="right")
    for axis, entries in axes.items():
        table.add_row(axis[-1], *(_coefficient(entry) for entry in entries.values()))
    return table


def _coefficient(entry: dict[str, Any]) -> str:
    """Return a coefficient over its interval, or its bound where it may be zero."""
    if entry["value"] is None:
        return "not known"
    if entry["low"] > 0:
        return f"{entry['value']:.4g}\n{entry['low']:.3g} to {entry['high']:.3g}"
    return f"below {entry['high']:.3g}" if entry["high"] < float("inf") else "not known"
