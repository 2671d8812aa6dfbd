"""Figures in the layout of the paper's figures 3 to 8, and what mis-set noise costs."""

from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.estimation.metrics import chi2_mean_bounds
from jaxnav.plotting import COLOURS, figure, largest, shades
from jaxnav.studies.arekf.config import DRIFTING
from jaxnav.studies.base import StudyResult

FIRST = {"attitude": 8, "velocity": 7, "position": 6}
"""Numbers of the paper's figures of the comparison."""
FIRST_SWEEP = {"attitude": 5, "velocity": 4, "position": 3}
"""Numbers of the paper's figures of the sweep of R."""
WIDTHS = {"ekf": 2.6, "mmae": 2.4, "arekf": 1.8, "oracle": 1.0}
"""Line widths where lines lie on one another: the lower ones are wider."""


OWN_SENSOR = (
    "arw_deg_sqrt_h",
    "vrw_m_s_sqrt_h",
    "gyro_drift_deg_h",
    "accel_bias_mg",
    "gnss_velocity",
)
"""Fields of the configuration that make another sensor than that of the map's first row."""


def draw(result: StudyResult, directory: Path) -> list[Path]:
    """Draw the figures of one scenario.

    Args:
        result: The result of the scenario.
        directory: Where the files go.

    Returns:
        The paths of the PNG files.
    """
    numbers = FIRST_SWEEP if result.scenario == "r-sweep" else FIRST
    paths = []

    def path(name: str) -> Path:
        paths.append(directory / f"{name}.png")
        return paths[-1]

    for kind, number in sorted(numbers.items(), key=lambda item: item[1]):
        _draw_axes(result, path(f"figure-{number}-{kind}"), kind)
    _draw_anees(result, path("anees"))
    if result.scenario in DRIFTING:
        _draw_ratio(result, path("ratio"))
    if "map_ratio" in result.arrays:
        _draw_map(result, path("map"))
    return paths


def _styles(result: StudyResult) -> dict[str, dict[str, Any]]:
    """Return how each method is drawn: known ones in their colours, a sweep in shades."""
    names = list(result.arrays["estimator"])
    if result.scenario == "r-sweep":
        return {name: {"color": c} for name, c in zip(names, shades(len(names)), strict=True)}
    return {
        name: {
            "color": COLOURS[name],
            "lw": WIDTHS.get(name, 1.0),
            "ls": "--" if name == "oracle" else "-",
        }
        for name in names
    }


def _draw_axes(result: StudyResult, path: Path, kind: str) -> None:
    """RMSE over runs on the left; errors of run 0 with three sigmas on the right."""
    a = result.arrays
    j = list(a["kind"]).index(kind)
    reference = "ekf-1" if result.scenario == "r-sweep" else "oracle"
    own = list(a["estimator"]).index(reference)
    with figure(path, (11, 7.5)) as drawing:
        grid = drawing.subplots(3, 2, sharex=True)
        for k, axis in enumerate(a["axis"]):
            left, right = grid[k]
            for i, (name, style) in enumerate(_styles(result).items()):
                left.plot(a["time"], a["trmse"][:, i, j, k], label=name, **style)
                right.plot(a["time"], a["run_0_error"][:, i, j, k], **style)
            envelope = 3 * a["run_0_sigma"][:, own, j, k]
            for sign in (-1, 1):
                label = f"3 sigma of {reference}" if sign > 0 and k == 0 else None
                right.plot(a["time"], sign * envelope, color="0.5", lw=0.8, ls=":", label=label)
            left.set_yscale("log")
            late = a["run_0_error"][len(a["time"]) // 6 :, :, j, k]
            limit = 1.1 * max(largest(late), largest(envelope[len(envelope) // 6 :]))
            right.set_ylim(-limit, limit)
            unit = a["unit"][j]
            left.set_ylabel(f"{axis} [{unit}]")
            for axes in (left, right):
                axes.margins(x=0)
        grid[0, 0].set_title("RMSE over runs")
        grid[0, 1].set_title("error of run 0")
        grid[0, 0].legend(ncols=2, fontsize=8)
        grid[0, 1].legend(fontsize=8, loc="lower left")
        for axes in grid[-1]:
            axes.set_xlabel("time of flight [s]")
        drawing.suptitle(f"{kind} error, {_noise_of(result)}")


def _noise_of(result: StudyResult) -> str:
    drifting = result.scenario in DRIFTING
    drift = f", true noise {result.config['reported']:g} times that given" if drifting else ""
    return f"{result.scenario}{drift}, {result.runs} runs"


def _legend_below(drawing: Any, axes: Any) -> None:
    """Put the legend of some axes under the figure, where it covers no line."""
    handles, labels = axes.get_legend_handles_labels()
    drawing.legend(handles, labels, loc="outside lower center", ncols=5, fontsize=8)


def _draw_anees(result: StudyResult, path: Path) -> None:
    """ANEES of all states over time, with the bounds of a consistent filter."""
    a = result.arrays
    states = next(iter(result.methods.values()))["anees_dof"]
    low, high = chi2_mean_bounds(states, result.runs)
    with figure(path, (7.5, 4.5)) as drawing:
        axes = drawing.subplots()
        axes.axhspan(low, high, color="0.85", label="consistent")
        for i, (name, style) in enumerate(_styles(result).items()):
            axes.plot(a["time"], a["anees"][:, i], label=name, **style)
        axes.set_yscale("log")
        axes.margins(x=0)
        axes.set_xlabel("time of flight [s]")
        axes.set_ylabel(f"ANEES of {states} states")
        _legend_below(drawing, axes)
        axes.set_title(_noise_of(result))


def _draw_ratio(result: StudyResult, path: Path) -> None:
    """Errors of the methods over that of the oracle at each drift factor."""
    a = result.arrays
    names = list(a["estimator"])
    with figure(path, (11, 4)) as drawing:
        panels = drawing.subplots(1, 3, sharex=True)
        for j, (kind, axes) in enumerate(zip(a["kind"], panels, strict=True)):
            level = a["rmse"][:, :, j] / a["rmse"][:, [names.index("oracle")], j]
            for i, (name, style) in enumerate(_styles(result).items()):
                axes.plot(a["factor"], level[:, i], marker="o", ms=3, label=name, **style)
            value, below, above = a["ratio"][:, j].T
            axes.errorbar(
                a["factor"],
                value,
                [value - below, above - value],
                fmt="none",
                color="0.3",
                capsize=3,
                label="EKF over AREKF, 95 %",
            )
            if "map_ratio" in a and not any(result.config[name] for name in OWN_SENSOR):
                expected = a["map_ratio"][0, :, -1, j]
                axes.plot(a["factor"], expected, ":", color="0.3", label="EKF by covariance")
            axes.set_xscale("log")
            axes.set_xticks(a["factor"], [f"{s:g}" for s in a["factor"]])
            axes.minorticks_off()
            axes.set_xlabel("true noise over that given")
            axes.set_title(str(kind))
        panels[0].set_ylabel("RMSE over that of the oracle")
        _legend_below(drawing, panels[0])
        drawing.suptitle(f"{result.scenario}, {result.runs} runs")


def _draw_map(result: StudyResult, path: Path) -> None:
    """Ratio of errors by covariance analysis over sensor, factor and duration."""
    a = result.arrays
    ratio = a["map_ratio"]
    top = max(2.0, float(np.nanmax(ratio)))
    columns = [f"{s:g}" for s in a["factor"]]
    rows = [f"{grade}, {at:g} s" for grade in a["grade"] for at in a["duration"]]
    with figure(path, (13, 0.27 * len(rows) + 1.6)) as drawing:
        panels = drawing.subplots(1, 3, sharey=True)
        for j, (kind, axes) in enumerate(zip(a["kind"], panels, strict=True)):
            table = ratio[..., j].transpose(0, 2, 1).reshape(len(rows), len(columns))
            colours = {"cmap": "viridis", "vmin": 0, "vmax": np.log(top)}
            axes.imshow(np.log(table), aspect="auto", **colours)
            for (r, c), value in np.ndenumerate(table):
                shade = "black" if np.log(value) > 0.6 * np.log(top) else "white"
                axes.text(c, r, f"{value:.2f}", ha="center", va="center", fontsize=7, color=shade)
            axes.set_xticks(range(len(columns)), columns)
            axes.set_yticks(range(len(rows)), rows, fontsize=8)
            axes.set_xlabel("true noise over that given")
            axes.set_title(str(kind))
            axes.grid(visible=False)
        drawing.suptitle("error with the given noise over that with the true one, by covariance")
