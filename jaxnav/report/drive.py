"""A recorded drive: what was done to it, what is wrong with it, and its scores."""

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from jaxnav.report.console import number, print_findings, with_error

SHOWN = 8
"""Refused fixes that are named on the screen; ``summary.json`` names all."""


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
    judged = ", ".join(
        f"{finding['name'].removeprefix('NIS, ')} {finding['verdict']}"
        for finding in document["audit"]
        if finding["name"].startswith("NIS, ") and finding["verdict"] != "not seen"
    )
    console.print(
        f"log-likelihood {run['log_likelihood']:.1f}; NIS per channel "
        f"{run['nis_per_channel']:.3g} ({judged or 'not judged'}), {within['share']:.1%} of fixes "
        f"within the {within['confidence']:.0%} bound",
        soft_wrap=True,
    )
    turned = ", ".join(f"{angle:.2f}" for angle in start["mounting_deg"])
    console.print(f"mounting {start['mounting']}: {turned} deg", soft_wrap=True)
    for name, found in document["carried"].items():
        values = ", ".join(
            f"{value:.3g} +- {sigma:.2g}"
            for value, sigma in zip(found["value"], found["sigma"], strict=True)
        )
        console.print(f"{name} found: {values} {found['unit']}", soft_wrap=True)
    print_findings(console, document["audit"])
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
    table.add_row("filter", *(number(scores[name]) for name in names))
    table.add_row("receiver", *(number(scores[f"receiver_{name}"]) for name in names[:2]))
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
            f"{with_error(entry['mse_east'])}\n{with_error(entry['mse_north'])}"
            for entry in entries
        ]
        table.add_row(name, *cells)
    return table
