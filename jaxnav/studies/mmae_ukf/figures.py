"""Figures in the layout of the paper's figures 3 to 6, and what explains them."""

from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.numerics.sequences import hammersley
from jaxnav.plotting import COLOURS, figure
from jaxnav.studies.attitude_figures import draw_errors, draw_trmse
from jaxnav.studies.base import StudyResult
from jaxnav.studies.mmae_ukf.claims import DISCREPANCY_POINTS

SHOWN = {"ekf": 0.6, "ukf": 0.6, "mmae-ekf": 0.6, "mmae-ukf": 0.6, "oracle": 1.0, "imm-ukf": 0.6}
"""Methods of the errors' figure with their line widths, from the back to the front."""
WEIGHED = ("mmae-ukf", "immae-ukf", "imm-ukf")


def draw(result: StudyResult, directory: Path) -> list[Path]:
    """Draw the figures of one scenario.

    Args:
        result: The result of the scenario.
        directory: Where the files go.

    Returns:
        The paths of the PNG files.
    """
    names = ["figure-3-discrepancy", "figures-4-to-6-errors", "weights", "trmse"]
    paths = [directory / f"{name}.png" for name in names]
    _draw_discrepancy(result, paths[0])
    draw_errors(result, paths[1], SHOWN)
    _draw_weights(result, paths[2])
    draw_trmse(result, paths[3])
    if "settling" in result.arrays:
        paths.append(directory / "settling.png")
        _draw_settling(result, paths[-1])
    return paths


def _draw_discrepancy(result: StudyResult, path: Path) -> None:
    """Uniform random numbers beside Hammersley points, 250 of each."""
    a = result.arrays
    rng = np.random.default_rng(result.seed)
    sets = {
        f"uniform, L2-star discrepancy {a['uniform_discrepancy'][0]:.4f}": rng.uniform(
            size=(DISCREPANCY_POINTS, 2)
        ),
        f"Hammersley, {a['hammersley_discrepancy'][0]:.4f}": hammersley(DISCREPANCY_POINTS, 2),
    }
    with figure(path, (8, 4.2)) as drawing:
        for axes, (title, points) in zip(drawing.subplots(1, 2), sets.items(), strict=True):
            axes.plot(points[:, 0], points[:, 1], ".", ms=4, color=COLOURS["immae-ukf"])
            axes.set(title=title, xlim=(0, 1), ylim=(0, 1), aspect="equal")
        drawing.suptitle(f"{DISCREPANCY_POINTS} points in the unit square")


def _draw_weights(result: StudyResult, path: Path) -> None:
    """Mean weights over time and the models' factor on wgt, with the true factor."""
    a = result.arrays
    banks, factors = list(a["bank"]), a["model_factors"][:, 0]
    order = np.argsort(factors)
    with figure(path, (8, 7)) as drawing:
        grid: Any = drawing.subplots(len(WEIGHED), 1, sharex=True)
        image = None
        for axes, name in zip(grid, WEIGHED, strict=True):
            weights = a["mean_weights"][:, banks.index(name), order]
            image = axes.pcolormesh(
                a["time"], factors[order], weights.T, shading="nearest", cmap="Blues", vmin=0
            )
            image.set_clim(0, max(float(weights[len(weights) // 20 :].max()), 1e-3))
            axes.plot(a["time"], a["true_factor"], color="tab:red", lw=1.2, label="true factor")
            axes.set(yscale="log", ylabel="factor on wgt0", title=name)
            axes.set_yticks([0.25, 0.5, 1, 2, 4], ["1/4", "1/2", "1", "2", "4"])
            axes.minorticks_off()
            axes.grid(visible=False)
            drawing.colorbar(image, ax=axes, label="mean weight")
        grid[0].legend(loc="lower right")
        grid[-1].set_xlabel("time [s]")
        drawing.suptitle(f"{result.scenario}: weights of the models, mean of {result.runs} runs")


def _draw_settling(result: StudyResult, path: Path) -> None:
    """When the single filters settle, by the size of the initial error and the observation."""
    a = result.arrays
    with figure(path, (8, 3.8)) as drawing:
        for i, axes in enumerate(drawing.subplots(1, len(a["form"]), sharey=True)):
            for j, name in enumerate(a["filter"]):
                low, middle, high = np.quantile(a["settling"][i, :, j], (0.05, 0.5, 0.95), axis=-1)
                axes.plot(a["angle"], middle, "o-", ms=4, color=COLOURS[name], label=name)
                axes.fill_between(a["angle"], low, high, color=COLOURS[name], alpha=0.2, lw=0)
            axes.set(title=f"star tracker as {a['form'][i]}", xlabel="initial error [deg]")
            axes.set_ylim(bottom=0)
        drawing.axes[0].set_ylabel("time to settle [s], median and 5-95 %")
        drawing.axes[0].legend()
        drawing.suptitle(f"{result.runs} runs of each filter and angle")
