"""Figures in the layout of the paper's figures 4 to 7, with the oracle and its 3-sigma envelope."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxnav.plotting import COLOURS, figure, largest
from jaxnav.studies.base import StudyResult

GROUPS = {
    "figure-4-position": ("px", "py", "pz"),
    "figure-5-accelerometer-bias": ("bias_x", "bias_y", "bias_z"),
    "figure-6-attitude": ("yaw", "pitch", "roll"),
    "figure-7-gyro-drift": ("drift_x", "drift_y", "drift_z"),
}
WIDTHS = {"conventional": 1.0, "ckf": 2.4, "oracle": 1.6}
"""Line widths where lines lie on one another: the lower ones are wider."""


def draw(result: StudyResult, directory: Path) -> list[Path]:
    """Draw the figures of one scenario.

    Args:
        result: The result of the scenario.
        directory: Where the files go.

    Returns:
        The paths of the PNG files.
    """
    paths = []
    for name, components in GROUPS.items():
        paths.append(directory / f"{name}.png")
        _draw_components(result, paths[-1], components)
    paths.append(directory / "position-rmse.png")
    _draw_position(result, paths[-1])
    if "variation" in result.arrays:
        paths.append(directory / "ablations.png")
        _draw_variations(result, paths[-1])
    return paths


def _draw_components(result: StudyResult, path: Path, components: Sequence[str]) -> None:
    """Mean error over runs, the paper's TRMSE, on the left; RMSE over runs on the right."""
    a = result.arrays
    columns = [list(a["component"]).index(name) for name in components]
    with figure(path, (10, 7.5)) as drawing:
        grid = drawing.subplots(3, 2, sharex=True)
        for row, (column, name) in enumerate(zip(columns, components, strict=True)):
            unit = a["unit"][column]
            for side, (key, what) in enumerate((("mean_error", "mean error"), ("trmse", "RMSE"))):
                axes = grid[row, side]
                _plot_methods(axes, result, a[key][:, :, column])
                axes.set_ylabel(f"{what} of {name} [{unit}]")
                if key == "trmse":
                    axes.set_yscale("log")
        grid[0, 0].legend(ncols=2, fontsize=8)
        for axes in grid[-1]:
            axes.set_xlabel("time of flight [s]")
        drawing.suptitle(f"{result.scenario}: {result.runs} runs")


def _plot_methods(axes, result: StudyResult, values: np.ndarray) -> None:
    """Plot the histories ``(T, methods)`` against time."""
    a = result.arrays
    for i, name in enumerate(a["estimator"]):
        style = "--" if name == "oracle" else "-"
        axes.plot(
            a["time"], values[:, i], style, color=COLOURS[name], label=name, lw=WIDTHS.get(name, 1)
        )
    axes.margins(x=0)


def _draw_position(result: StudyResult, path: Path) -> None:
    """RMSE of the position over runs, and what the filter says of itself in run 0."""
    a = result.arrays
    methods = list(a["estimator"])
    with figure(path, (7.5, 4.5)) as drawing:
        axes = drawing.subplots()
        square = np.sum(a["trmse"][:, :, :3] ** 2, axis=-1)
        _plot_methods(axes, result, np.sqrt(square))
        sigma = a["run_0_sigma"][:, methods.index("oracle"), 6:9]
        axes.plot(
            a["time"], np.sqrt(np.sum(sigma**2, axis=-1)), ":", color="0.4", label="oracle, 1 sigma"
        )
        axes.set_yscale("log")
        axes.set_xlabel("time of flight [s]")
        axes.set_ylabel("RMSE of the position over runs [m]")
        axes.legend(ncols=2)
        axes.set_title(f"{result.scenario}, {result.runs} runs")


def _draw_variations(result: StudyResult, path: Path) -> None:
    """Position RMSE of every variation, beside that of the study itself."""
    a = result.arrays
    own = {
        f"as the study, {name}": result.methods[name]["rmse_position"] for name in a["estimator"]
    }
    labels = [*own, *a["variation"]]
    values = np.array([entry["value"] for entry in own.values()] + list(a["variation_rmse"]))
    errors = np.array([entry["se"] for entry in own.values()] + list(a["variation_se"]))
    shown = np.isfinite(values)
    with figure(path, (8, 0.3 * len(labels) + 1.2)) as drawing:
        axes = drawing.subplots()
        place = np.arange(len(labels))[::-1]
        drawn = np.where(shown, values, largest(values[shown]))
        bars = axes.barh(
            place,
            drawn,
            xerr=np.where(shown, np.nan_to_num(errors), 0),
            color="tab:blue",
            height=0.7,
        )
        axes.bar_label(
            bars,
            [
                f" {v:.4g} m" if good else " not finite"
                for v, good in zip(values, shown, strict=True)
            ],
            fontsize=8,
        )
        axes.set_yticks(place, labels)
        axes.set_xscale("log")
        axes.margins(x=0.15, y=0.02)
        axes.set_xlabel("RMSE of the position over the flight [m]")
        axes.set_title(f"{result.scenario}, {result.runs} runs")
