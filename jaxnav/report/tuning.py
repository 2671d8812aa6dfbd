"""What can be tuned, and what a tuning found."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from jaxnav.report.console import print_findings, values_text, with_error


def print_tuning(document: dict[str, Any], directory: Path, figures: list[Path]) -> None:
    """Print what a tuning found and how it does on the runs held out."""
    console = Console()
    print_findings(console, document["audit"])
    console.print(_parameter_table(document))
    fit, loss = document["fit"], document["loss"]
    console.print(
        f"loss {loss['start']:.6g} at the start, {loss['tuned']:.6g} at the optimum; "
        f"{fit['steps']} evaluations, {fit['rejected']} taken back, ended by {fit['stopped']}",
        soft_wrap=True,
    )
    if "hard_tuned" in loss:
        console.print(
            f"with the hard rules {loss['hard_start']:.6g} and {loss['hard_tuned']:.6g}: "
            f"the smooth loss is {loss['smooth_below_hard']:.3%} below the hard one",
            soft_wrap=True,
        )
    checked = document["gradient_check"]
    if checked is not None:
        console.print(
            f"gradient against central differences: {checked['largest_deviation']:.1e} of its "
            "largest entry",
            soft_wrap=True,
        )
    for label, entry in document["held_out"].items():
        console.print(_held_out_table(label, entry, document["measure"]))
    for note in document["notes"]:
        console.print(f"[yellow]{escape(note)}", soft_wrap=True)
    names = ", ".join(["summary.json", "tuning.npz", *(path.name for path in figures)])
    console.print(f"Written to {directory}: {names}", soft_wrap=True)


def print_parameters(parameters: Mapping[str, Any]) -> None:
    """Print what can be tuned: by name, where it starts, its domain and what it is."""
    table = Table(title="parameters that can be tuned: --params NAME --start NAME=VALUE")
    for heading in ("parameter", "start", "domain", "what it is"):
        table.add_column(heading, overflow="fold", no_wrap=heading == "parameter")
    for name, parameter in parameters.items():
        start = values_text(parameter.start)
        table.add_row(name, start, parameter.transform.domain, escape(parameter.text))
    Console().print(table)


def _parameter_table(document: dict[str, Any]) -> Table:
    table = Table(title=f"{document['study']}: parameters")
    for heading in ("parameter", "start", "tuned", "sigma", "what it is"):
        table.add_column(heading, overflow="fold")
    for name, entry in document["parameters"].items():
        values = (values_text(entry[key]) for key in ("start", "tuned", "sigma"))
        table.add_row(name, *values, escape(entry["text"]))
    return table


def _held_out_table(label: str, entry: dict[str, Any], measure: dict[str, Any]) -> Table:
    ratio = measure["kind"] == "mean-square"
    table = Table(
        title=f"{label}, {entry['runs']} {measure['per']} held out: {escape(measure['text'])}"
    )
    table.add_column("method")
    table.add_column(escape(f"[{measure['unit']}]"), justify="right")
    table.add_column("tuned over it" if ratio else "tuned less it", justify="right")
    table.add_column("95 % interval", justify="right")
    for name, value in entry["methods"].items():
        against = entry["tuned_over"].get(name)
        if against is None:
            table.add_row(name, with_error(value))
            continue
        low, high = against["low"], against["high"]
        table.add_row(name, with_error(value), f"{against['value']:.4f}", f"{low:.4f}, {high:.4f}")
    return table
