"""The result of a study: its methods, its claims and their verdicts."""

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from jaxnav.findings import document_of
from jaxnav.report.console import number, print_document, print_findings, with_error
from jaxnav.results import summary
from jaxnav.studies.base import Claim, StudyResult

NOT_SHOWN = ("anees_dof", "log_likelihood_se")
"""Measures of a method that the table leaves to ``summary.json``."""


def print_result(result: StudyResult, directory: Path, figures: list[Path]) -> None:
    """Print the table of methods, the claims with their verdicts, and where the files are."""
    console = Console()
    print_findings(console, document_of(result.audit))
    console.print(_method_table(result))
    if result.claims:
        console.print(_claim_table(result.claims))
    for note in result.notes:
        console.print(escape(note))
    if result.diverged:
        console.print(f"[red]{result.diverged} of {result.runs} runs diverged")
    names = ", ".join(path.name for path in figures)
    console.print(f"Written to {directory}: summary.json, arrays.npz, {names}\n", soft_wrap=True)


def print_json(results: list[StudyResult]) -> None:
    """Print the summaries as JSON: an object for one scenario, a list for several."""
    documents = [summary(result) for result in results]
    print_document(documents[0] if len(documents) == 1 else documents)


def _method_table(result: StudyResult) -> Table:
    """One row a method; a column for each measure that any has, components of another left out."""
    table = Table(
        title=f"{result.study}, {result.scenario}: {result.runs} runs, seed {result.seed}"
    )
    table.add_column("method")
    columns: dict[str, None] = {}
    for measures in result.methods.values():
        columns |= dict.fromkeys(_shown(measures))
    scalars = list(
        dict.fromkeys(
            name
            for measures in result.methods.values()
            for name, value in measures.items()
            if isinstance(value, int | float) and name not in NOT_SHOWN
        )
    )
    for name in columns:
        table.add_column(escape(name), justify="right")
    for name in scalars:
        table.add_column(name.replace("_", " "), justify="right")
    for method, measures in result.methods.items():
        shown = _shown(measures)
        errors = [shown.get(name, "") for name in columns]
        table.add_row(method, *errors, *(number(measures.get(name)) for name in scalars))
    return table


def _shown(measures: dict[str, Any]) -> dict[str, str]:
    """Return the errors of a method by the heading of their column; squared ones by interval."""
    errors = {
        f"RMSE {name} [{measure['unit']}]": with_error(measure)
        for name, measure in measures.get("rmse", {}).items()
        if "of" not in measure
    }
    axes = measures.get("mse", {})
    for span in next(iter(axes.values()), {}):
        values = [axes[axis][span] for axis in axes]
        heading = f"MSE {', '.join(axes)} [{values[0]['unit']}] {span} s"
        errors[heading] = ", ".join(f"{measure['value']:.2f}" for measure in values)
    return errors


def _claim_table(claims: list[Claim]) -> Table:
    table = Table(title="claims")
    for heading in ("claim", "published", "measured", "95 % interval", "verdict"):
        justify = "left" if heading in ("claim", "verdict") else "right"
        table.add_column(heading, justify=justify)
    colours = {"reproduced": "green", "not reproduced": "red"}
    for claim in claims:
        known = claim.ci95 is not None and claim.ci95[0] == claim.ci95[0]
        interval = f"{claim.ci95[0]:.4g} to {claim.ci95[1]:.4g}" if claim.ci95 and known else ""
        colour = colours.get(claim.verdict, "yellow")
        table.add_row(
            escape(claim.text),
            "" if claim.published is None else f"{claim.published:.4g}",
            "" if claim.measured is None else f"{claim.measured:.4g}",
            interval,
            f"[{colour}]{claim.verdict}",
        )
    return table
