"""Figures that the studies of attitude share: errors of one run, and the RMSE over runs."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jaxnav.plotting import COLOURS, figure, largest
from jaxnav.studies.base import StudyResult


def draw_errors(result: StudyResult, path: Path, shown: Mapping[str, float]) -> None:
    """Draw the errors of the three angles in run 0, and the envelope of the oracle's.

    Args:
        result: The result of the scenario.
        path: The file.
        shown: Methods with their line widths, from the back to the front.
    """
    a = result.arrays
    methods = list(a["estimator"])
    oracle = methods.index("oracle")
    # The star tracker's noise is isotropic: the largest component bounds every angle's deviation.
    envelope = 3 * a["run_0_sigma"][:, oracle].max(axis=-1)
    with figure(path, (7.5, 7.5)) as drawing:
        for row, axes in enumerate(drawing.subplots(3, 1, sharex=True)):
            for name, width in shown.items():
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


def draw_trmse(result: StudyResult, path: Path) -> None:
    """Draw the RMSE over runs at each second, mean of the three angles, for every method."""
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
        axes.legend(ncols=4, loc="upper center")
        axes.set_title(f"{result.scenario}, {result.runs} runs")
