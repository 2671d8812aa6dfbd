"""Figures of a recorded track: where it went, how fast, and which model was believed."""

from pathlib import Path

import numpy as np

from jaxnav.plotting import COLOURS, figure, plot_weights
from jaxnav.studies.base import StudyResult


def draw(result: StudyResult, directory: Path) -> list[Path]:
    """Draw the track, the speed and the weights.

    Args:
        result: The result of one scenario.
        directory: Where the files go.

    Returns:
        The paths of the PNG files.
    """
    paths = [directory / f"{name}.png" for name in ("track", "speed", "weights")]
    _draw_track(result, paths[0])
    _draw_speed(result, paths[1])
    _draw_weights(result, paths[2])
    return paths


def _best(result: StudyResult, among: list[str]) -> str:
    """The method with the highest predictive likelihood."""
    return max(among, key=lambda name: result.methods[name]["log_likelihood"])


def _draw_track(result: StudyResult, path: Path) -> None:
    a = result.arrays
    best = _best(result, list(result.methods))
    estimate = a["estimate"][:, list(a["estimator"]).index(best)]
    with figure(path, (6.5, 6)) as drawing:
        axes = drawing.subplots()
        axes.plot(a["fix"][:, 0], a["fix"][:, 1], ".", ms=2, color="0.6", label="fixes")
        axes.plot(estimate[:, 0], estimate[:, 1], color="tab:blue", lw=0.8, label=best)
        axes.plot(0, 0, "o", color="tab:green", label="start")
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel("east [m]")
        axes.set_ylabel("north [m]")
        axes.legend()
        axes.set_title(f"track, {result.scenario}")


def _draw_speed(result: StudyResult, path: Path) -> None:
    """Speed of the best single filter and of a bank, and the difference from the Doppler speed."""
    a = result.arrays
    methods = list(a["estimator"])
    doppler = np.linalg.norm(a["doppler"], axis=-1)
    single = _best(result, [name for name in methods if name.startswith("kf-")])
    with figure(path, (9, 5)) as drawing:
        above, below = drawing.subplots(2, 1, sharex=True)
        above.plot(a["time"], doppler, color="0.6", lw=2, label="receiver's Doppler")
        for name, colour in ((single, COLOURS["kf"]), ("markov", COLOURS["markov"])):
            speed = np.linalg.norm(a["estimate"][:, methods.index(name), 2:], axis=-1)
            above.plot(a["time"], speed, color=colour, lw=0.8, label=name)
            below.plot(a["time"], speed - doppler, color=colour, lw=0.6, label=name)
        above.set_ylabel("speed [m/s]")
        above.legend(ncols=3)
        below.set_ylabel("difference [m/s]")
        below.set_xlabel("time [s]")
        drawing.suptitle(f"speed, {result.scenario}")


def _draw_weights(result: StudyResult, path: Path) -> None:
    a = result.arrays
    labels = [f"q = {q:g} m²/s³" for q in a["model"]]
    with figure(path, (9, 7)) as drawing:
        rows = drawing.subplots(len(a["bank"]), 1, sharex=True)
        for i, (name, axes) in enumerate(zip(a["bank"], rows, strict=True)):
            plot_weights(axes, a["time"], a["weights"][:, i], labels)
            axes.set_title(str(name), loc="left", fontsize=9)
        for axes in rows[:-1]:
            axes.set_xlabel("")
        rows[0].legend(ncols=4, loc="lower right", bbox_to_anchor=(1, 1), fontsize=8)
        drawing.suptitle(f"weights, {result.scenario}", x=0.02, ha="left")
