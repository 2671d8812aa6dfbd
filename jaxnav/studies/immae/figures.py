"""Figures in the layout of the paper's figures 3 to 6, with the oracle and the 3-sigma envelope."""

from pathlib import Path

import numpy as np

from jaxnav.plotting import COLOURS, figure, largest, plot_weights
from jaxnav.studies.base import StudyResult

SHOWN = {
    "matched-noise": {"kf": 0.6, "oracle": 1.2, "immae": 0.6},
    "noise-step": {"kf": 0.6, "mmae": 0.6, "oracle": 1.2, "immae": 0.6},
}
"""Methods of the errors' figure with their line widths, from the back to the front."""
NUMBERS = {"matched-noise": (3, 4), "noise-step": (5, 6)}


def draw(result: StudyResult, directory: Path) -> list[Path]:
    """Draw the figures of one scenario.

    Args:
        result: The result of the scenario.
        directory: Where the files go.

    Returns:
        The paths of the PNG files.
    """
    errors, weights = NUMBERS[result.scenario]
    paths = [
        directory / f"figure-{errors}-errors.png",
        directory / f"figure-{weights}-weights.png",
        directory / "trmse.png",
    ]
    _draw_errors(result, paths[0])
    _draw_weights(result, paths[1])
    _draw_trmse(result, paths[2])
    return paths


def _draw_errors(result: StudyResult, path: Path) -> None:
    """One run: the errors of the three angles, and the envelope of the oracle's."""
    a = result.arrays
    methods = list(a["estimator"])
    oracle = methods.index("oracle")
    # The star tracker's noise is isotropic: the largest component bounds every angle's deviation.
    envelope = 3 * a["run_0_sigma"][:, oracle].max(axis=-1)
    with figure(path, (7.5, 7.5)) as drawing:
        for row, axes in enumerate(drawing.subplots(3, 1, sharex=True)):
            for name, width in SHOWN[result.scenario].items():
                error = a["run_0_error"][:, methods.index(name), row]
                axes.plot(a["time"], error, color=COLOURS[name], label=name, lw=width)
            axes.margins(x=0)
            for sign in (-1, 1):
                label = "oracle 3 sigma" if sign > 0 else None
                axes.plot(a["time"], sign * envelope, color="0.4", ls="--", lw=0.8, label=label)
            limit = 1.15 * largest(a["run_0_error"][len(a["time"]) // 20 :, :, row])
            axes.set_ylim(-limit, limit)
            axes.set_ylabel(f"{a['axis'][row]} error [arcsec]")
        drawing.axes[0].legend(ncols=5, loc="upper center")
        drawing.axes[-1].set_xlabel("time [s]")
        drawing.suptitle(f"{result.scenario}: errors of run 0")


def _draw_weights(result: StudyResult, path: Path) -> None:
    """Weights of MMAE and IMMAE: one run, and the mean over runs."""
    a = result.arrays
    banks = list(a["bank"])
    labels = [f"model {i + 1}: {theta:g} Q0" for i, theta in enumerate(a["model"])]
    with figure(path, (9, 6)) as drawing:
        grid = drawing.subplots(2, 2, sharex=True, sharey=True)
        for column, name in enumerate(("mmae", "immae")):
            bank = banks.index(name)
            plot_weights(grid[0, column], a["time"], a["run_0_weights"][:, bank], labels)
            plot_weights(grid[1, column], a["time"], a["mean_weights"][:, bank], labels)
            grid[0, column].set_title(f"{name.upper()}, run 0")
            grid[1, column].set_title(f"{name.upper()}, mean of {result.runs} runs")
        grid[0, 0].legend(loc="center right", fontsize=8)
        drawing.suptitle(f"{result.scenario}: weights of the models")


def _draw_trmse(result: StudyResult, path: Path) -> None:
    """The RMSE over runs at each second, mean of the three angles, for every method."""
    a = result.arrays
    square = np.mean(a["trmse"] ** 2, axis=-1)
    steps = min(max(1, round(1 / float(a["time"][0]))), len(square))
    whole = len(square) // steps * steps
    seconds = np.sqrt(square[:whole].reshape(-1, steps, square.shape[1]).mean(axis=1))
    with figure(path, (7.5, 4)) as drawing:
        axes = drawing.subplots()
        for i, name in enumerate(a["estimator"]):
            axes.plot(
                a["time"][steps - 1 : whole : steps], seconds[:, i], color=COLOURS[name], label=name
            )
        axes.margins(x=0)
        axes.set_ylim(0, 1.3 * largest(seconds[len(seconds) // 20 :]))
        axes.set_xlabel("time [s]")
        axes.set_ylabel("attitude RMSE over runs [arcsec]")
        axes.legend(ncols=6, loc="upper center")
        axes.set_title(f"{result.scenario}, {result.runs} runs")
