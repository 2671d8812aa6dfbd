"""Figures in the layout of the paper's figures 3 to 6, with the oracle and the 3-sigma envelope."""

from pathlib import Path

from jaxnav.plotting import figure, plot_weights
from jaxnav.studies.attitude_figures import draw_errors, draw_trmse
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
    draw_errors(result, paths[0], SHOWN[result.scenario])
    _draw_weights(result, paths[1])
    draw_trmse(result, paths[2])
    return paths


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
