"""What a person reads in the terminal: tables, progress, and the state of the installation."""

import json
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import rich.progress
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from jaxnav.results import summary
from jaxnav.studies import STUDIES
from jaxnav.studies.base import Claim, StudyResult

SHOWN = 8
"""Refused fixes that are named on the screen; ``summary.json`` names all."""
NOT_SHOWN = ("anees_dof", "log_likelihood_se")
"""Measures of a method that the table leaves to ``summary.json``."""


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


def print_result(result: StudyResult, directory: Path, figures: list[Path]) -> None:
    """Print the table of methods, the claims with their verdicts, and where the files are."""
    console = Console()
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


def print_document(document: Any) -> None:
    """Print a document as JSON."""
    print(json.dumps(document, indent=2))


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
        table.add_row(method, *errors, *(_number(measures.get(name)) for name in scalars))
    return table


def _shown(measures: dict[str, Any]) -> dict[str, str]:
    """Return the errors of a method by the heading of their column; squared ones by interval."""
    errors = {
        f"RMSE {name} [{measure['unit']}]": _with_error(measure)
        for name, measure in measures.get("rmse", {}).items()
        if "of" not in measure
    }
    axes = measures.get("mse", {})
    for span in next(iter(axes.values()), {}):
        values = [axes[axis][span] for axis in axes]
        heading = f"MSE {', '.join(axes)} [{values[0]['unit']}] {span} s"
        errors[heading] = ", ".join(f"{measure['value']:.2f}" for measure in values)
    return errors


def _with_error(measure: dict[str, Any]) -> str:
    value, se = measure["value"], measure.get("se")
    if se is None or se != se:
        return f"{value:.4f}"
    return f"{value:.4f} ± {se:.4f}"


def _number(value: float | None) -> str:
    if value is None:
        return ""
    return str(value) if isinstance(value, int) else f"{value:.3f}"


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


def print_tuning(document: dict[str, Any], directory: Path, figures: list[Path]) -> None:
    """Print what a tuning found and how it does on the runs held out."""
    console = Console()
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


def _parameter_table(document: dict[str, Any]) -> Table:
    table = Table(title=f"{document['study']}: parameters")
    for heading in ("parameter", "start", "tuned", "sigma", "what it is"):
        table.add_column(heading, overflow="fold")
    for name, entry in document["parameters"].items():
        values = (_values(entry[key]) for key in ("start", "tuned", "sigma"))
        table.add_row(name, *values, escape(entry["text"]))
    return table


def _values(value: Any) -> str:
    if value is None:
        return ""
    entries = np.ravel(value)
    return " ".join(f"{entry:.4g}" for entry in entries)


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
            table.add_row(name, _with_error(value))
            continue
        low, high = against["low"], against["high"]
        table.add_row(name, _with_error(value), f"{against['value']:.4f}", f"{low:.4f}, {high:.4f}")
    return table


def print_filter(document: dict[str, Any], directory: Path, figures: list[Path]) -> None:
    """Print what became of a recorded drive: counts, consistency, and the scores it allows."""
    console = Console()
    counts, run, start = document["counts"], document["filter"], document["alignment"]
    console.print(
        f"{counts['samples']} samples at {1 / counts['sample_s']:.4g} Hz "
        f"({counts['skipped_rows']} rows skipped, {counts['nan_rows']} with an entry that is no "
        f"number, {counts['gaps']} gaps); {counts['fixes_used']} of {counts['fixes']} fixes used "
        f"({counts['fixes_without_solution']} more had no solution); "
        f"aligned {'at rest' if start['kind'] == 'rest' else 'on the move'} until "
        f"{start['end_s']:.4g} s; fixes moved by {document['time_offset']['used_s']:.4g} s",
        soft_wrap=True,
    )
    within = run["nis_within"]
    told = ", ".join(
        f"{finding['name'].removeprefix('NIS, ')} {finding['verdict']}"
        for finding in document["audit"]
        if finding["name"].startswith("NIS, ") and finding["verdict"] != "not seen"
    )
    console.print(
        f"log-likelihood {run['log_likelihood']:.1f}; NIS per channel "
        f"{run['nis_per_channel']:.3g} ({told or 'not judged'}), {within['share']:.1%} of fixes "
        f"within the {within['confidence']:.0%} bound",
        soft_wrap=True,
    )
    turned = ", ".join(f"{angle:.2f}" for angle in start["mounting_deg"])
    console.print(f"mounting {start['mounting']}: {turned} deg", soft_wrap=True)
    for finding in document["audit"]:
        if finding["verdict"] in ("doubt", "fault"):
            colour = "red" if finding["verdict"] == "fault" else "yellow"
            console.print(
                f"[{colour}]{finding['verdict']}: {escape(finding['says'])}", soft_wrap=True
            )
    if document["refused"]:
        shown = ", ".join(
            f"{entry['fix']} ({entry['time_s']:.6g} s)" for entry in document["refused"][:SHOWN]
        )
        more = len(document["refused"]) - SHOWN
        console.print(
            f"[yellow]refused: fix {shown}{f' and {more} more' if more > 0 else ''}",
            soft_wrap=True,
        )
    if document["reference"]:
        console.print(_reference_table(document["reference"]))
    if document["outages"]:
        console.print(_outage_table(document["outages"]))
    if document["added_noise"]:
        console.print(_added_noise_table(document["added_noise"]))
    for note in document["notes"]:
        console.print(f"[yellow]{escape(note)}", soft_wrap=True)
    if document["diverged"]:
        console.print("[red]the filter diverged")
    files = "summary.json, trajectory.csv, trajectory.npz, trajectory.kml, "
    names = files + ", ".join(path.name for path in figures)
    console.print(f"Written to {directory}: {names}", soft_wrap=True)


def _reference_table(scores: dict[str, Any]) -> Table:
    table = Table(title="RMS errors against the reference, after the first 20 s")
    for heading in ("", "horizontal [m]", "up [m]", "roll [deg]", "pitch [deg]", "heading [deg]"):
        table.add_column(escape(heading), justify="right" if heading else "left")
    names = ("horizontal_rms_m", "up_rms_m", "roll_rms_deg", "pitch_rms_deg", "heading_rms_deg")
    table.add_row("filter", *(_number(scores[name]) for name in names))
    table.add_row("receiver", *(_number(scores[f"receiver_{name}"]) for name in names[:2]))
    return table


def _outage_table(scores: dict[str, Any]) -> Table:
    table = Table(title=f"horizontal error after {scores['length_s']:g} s without fixes")
    for heading in ("", "windows", "median [m]", "largest [m]"):
        table.add_column(escape(heading), justify="right" if heading else "left")
    names = {"inertial": "inertial sensors alone", "constrained": "with constraints"}
    for name, entry in scores["horizontal_m"].items():
        count = str(len(entry["all"]))
        table.add_row(names[name], count, f"{entry['median']:.2f}", f"{entry['max']:.2f}")
    return table


def _added_noise_table(scores: dict[str, Any]) -> Table:
    table = Table(show_lines=True, title=f"noise added to the fixes, {scores['runs']} draws")
    table.add_column("method")
    for span in scores["spans"]:
        where = f"{span['sigma_m']:g} m, {span['start_s']:g} s to {span['end_s']:g} s"
        table.add_column(f"MSE east, north \\[m^2]\n{where}", justify="right")
    for name, entries in scores["methods"].items():
        cells = [
            f"{_with_error(entry['mse_east'])}\n{_with_error(entry['mse_north'])}"
            for entry in entries
        ]
        table.add_row(name, *cells)
    return table


def print_catalogue() -> None:
    """Print the studies, filters, weight rules and data formats."""
    from jaxnav.estimation import catalogue

    console = Console()
    table = Table(title="studies")
    table.add_column("study")
    table.add_column("scenario")
    table.add_column("what it is")
    for name, study in STUDIES.items():
        table.add_row(name, "", study.summary)
        for scenario, text in study.load("scenarios").items():
            table.add_row("", scenario, escape(text))
    console.print(table)
    for title, entries in catalogue().items():
        listing = Table(title=title)
        listing.add_column("name")
        listing.add_column("what it is")
        for name, text in entries.items():
            listing.add_row(name, escape(text))
        console.print(listing)
    console.print(
        "data formats: RTKLIB .pos (run gnss-track --log PATH), inertial CSV (allan PATH), drives "
        "as RTK folders, comma2k19 segments and CSV (filter PATH)",
        soft_wrap=True,
    )
