"""The figures of ``jaxnav tune``: the descent, the profiles of the loss, before and after."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.estimation.tune.fit import Fit
from jaxnav.estimation.tune.inspect import Profile
from jaxnav.plotting import COLOURS, figure
from jaxnav.tuning.analysis import Report

COLUMNS = 4


def draw(report: Report, directory: Path) -> list[Path]:
    """Draw ``descent.png``, ``held_out.png`` and, if there are profiles, ``profiles.png``."""
    drawn = [
        _descent(report.fit, directory / "descent.png"),
        _held_out(report.document, directory / "held_out.png"),
    ]
    if report.profile is not None:
        drawn.append(_profiles(report.profile, directory / "profiles.png"))
    return drawn


def _descent(found: Fit, path: Path) -> Path:
    with figure(path, (6, 3.2)) as drawing:
        axes = drawing.subplots()
        axes.plot(found.history, color="0.6", label="training batch")
        if len(found.validation):
            steps, loss = found.validation.T
            axes.plot(steps, loss, "o-", ms=3, color="tab:blue", label="validation")
            best = np.argmin(loss)
            axes.plot(steps[best], loss[best], "o", color="tab:red", label="chosen")
        rejected = np.flatnonzero(np.isnan(found.history))
        for step in rejected:
            axes.axvline(float(step), color="tab:orange", lw=0.5)
        if rejected.size:
            axes.plot([], [], color="tab:orange", lw=0.5, label="taken back")
        axes.set(xlabel="gradient step", ylabel="loss")
        axes.legend()
    return path


def _held_out(document: dict[str, Any], path: Path) -> Path:
    """Draw every method's measure on each held-out set, with its standard error."""
    sets = document["held_out"]
    count = max(len(entry["methods"]) for entry in sets.values())
    with figure(path, (9, 1.3 + 0.28 * count)) as drawing:
        panels = drawing.subplots(1, len(sets), squeeze=False, sharey=True)[0]
        for axes, (label, entry) in zip(panels, sets.items(), strict=True):
            names = list(entry["methods"])
            value = [entry["methods"][name]["value"] for name in names]
            error = [1.96 * entry["methods"][name]["se"] for name in names]
            for row, name in enumerate(names):
                colour = "tab:red" if name == "tuned" else COLOURS.get(name, "0.4")
                axes.errorbar(value[row], row, xerr=error[row], fmt="o", ms=4, color=colour)
            axes.set_yticks(range(len(names)), names)
            axes.invert_yaxis()
            measure = document["measure"]
            axes.set_title(f"{label}, {entry['runs']} {measure['per']}")
            axes.set_xlabel(f"[{measure['unit']}], 95 % intervals")
        drawing.suptitle(document["measure"]["text"], fontsize="medium")
    return path


def _profiles(profiled: Profile, path: Path) -> Path:
    """Draw the loss along each parameter above its value at the optimum."""
    count = len(profiled.labels)
    rows = math.ceil(count / COLUMNS)
    with figure(path, (2.4 * min(count, COLUMNS), 1.9 * rows)) as drawing:
        panels = drawing.subplots(rows, min(count, COLUMNS), squeeze=False).flat
        for axes, label, value, loss in zip(
            panels, profiled.labels, profiled.value, profiled.loss, strict=False
        ):
            middle = loss.size // 2
            axes.plot(value, loss - loss[middle], "o-", ms=3)
            axes.plot(value[middle], 0, "o", color="tab:red")
            if np.all(value > 0) and value.max() > 3 * value.min():
                axes.set_xscale("log")
                axes.xaxis.set_major_formatter("{x:.3g}")
                axes.xaxis.set_minor_formatter("")
                axes.set_xticks(value[:: max(1, middle)])
            axes.set_title(label)
        for axes in list(drawing.axes)[count:]:
            axes.set_visible(False)
        drawing.supylabel("loss above the optimum's")
    return path
