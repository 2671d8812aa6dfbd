"""Figures in the layout of the paper's figures 4 to 7, and what explains them."""

from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.plotting import COLOURS, figure, largest, shades
from jaxnav.studies.base import StudyResult
from jaxnav.studies.sage_husa.claims import right_weight
from jaxnav.studies.sage_husa.config import SageHusaConfig

SHOWN = (
    "ukf",
    "mmae",
    "exponential-decay",
    "sage-husa",
    "proposed",
    "proposed-bayes-floor",
    "oracle",
)
"""Methods of the figures of errors, from the back to the front."""
WEIGHED = ("proposed", "exponential-decay", "proposed-bayes-floor", "unnormalised-floor")


def draw(result: StudyResult, directory: Path) -> list[Path]:
    """Draw the figures of one scenario.

    Args:
        result: The result of the scenario.
        directory: Where the files go.

    Returns:
        The paths of the PNG files.
    """
    config = SageHusaConfig(**result.config)
    names = ["figure-4-right-weight", "figure-5-east", "figure-6-north", "figure-7-radar"]
    paths = [directory / f"{name}.png" for name in (*names, "weights", "noise")]
    _draw_right_weight(result, config, paths[0])
    _draw_axis(result, config, paths[1], 0)
    _draw_axis(result, config, paths[2], 1)
    _draw_radar(result, paths[3])
    _draw_weights(result, config, paths[4])
    _draw_noise(result, config, paths[5])
    return paths


def _shade_noise(axes: Any, config: SageHusaConfig) -> None:
    """Mark the times of added noise."""
    spans = (config.first_noise_s, config.second_noise_s)
    for span, sigma in zip(spans, (config.first_noise, config.second_noise), strict=True):
        axes.axvspan(*span, color="0.93", zorder=0)
        middle = 0.5 * sum(span)
        where = {"transform": axes.get_xaxis_transform(), "ha": "center", "va": "top"}
        axes.text(middle, 0.99, f"+{sigma:g} m", fontsize=8, color="0.4", **where)
    axes.margins(x=0)


def _title(result: StudyResult) -> str:
    return f"{result.scenario}, {result.runs} runs"


def _draw_right_weight(result: StudyResult, config: SageHusaConfig, path: Path) -> None:
    """Weight of the members whose Q is nearest to the true one, under each rule."""
    a = result.arrays
    banks = list(a["bank"])
    with figure(path, (8, 4)) as drawing:
        axes = drawing.subplots()
        _shade_noise(axes, config)
        for name in ("proposed-bayes", *WEIGHED):
            share = right_weight(config, a["mean_weights"][:, banks.index(name)])
            axes.plot(a["time"], share, color=COLOURS[name], label=name)
        axes.set(xlabel="time [s]", ylabel="mean weight", ylim=(-0.02, 1.1))
        axes.set_title(f"weight of the members with the Q nearest the truth: {_title(result)}")
        drawing.legend(loc="outside lower center", ncols=5, fontsize=8)


def _draw_axis(result: StudyResult, config: SageHusaConfig, path: Path, axis: int) -> None:
    """RMSE over runs above, errors of run 0 with three sigmas of the oracle below."""
    a = result.arrays
    names = list(a["estimator"])
    with figure(path, (10, 6.5)) as drawing:
        above, below = drawing.subplots(2, 1, sharex=True)
        for axes in (above, below):
            _shade_noise(axes, config)
        for name in SHOWN:
            i, style = names.index(name), {"color": COLOURS[name], "lw": 0.8}
            above.plot(a["time"], _smooth(a["trmse"][:, i, axis]), label=name, **style)
            below.plot(a["time"], a["run_0_error"][:, i, axis], **style)
        envelope = 3 * a["run_0_sigma"][:, names.index("oracle"), axis]
        for sign in (-1, 1):
            below.plot(a["time"], sign * envelope, color="0.5", lw=0.8, ls=":")
        settled = len(a["time"]) // 20
        limit = 1.1 * max(largest(a["run_0_error"][settled:, :, axis]), largest(envelope[settled:]))
        below.set_ylim(-limit, limit)
        above.set_ylim(0, None)
        above.set_ylabel("RMSE [m], mean of 21 fixes")
        below.set_ylabel("error of run 0 [m]")
        below.set_xlabel("time [s]")
        drawing.suptitle(f"position error {a['axis'][axis]}: {_title(result)}; dotted, 3 sigma")
        drawing.legend(loc="outside lower center", ncols=4, fontsize=8)


def _smooth(rms: np.ndarray, width: int = 21) -> np.ndarray:
    """Return the root of a running mean of squares."""
    ones = np.ones(width)
    count = np.convolve(np.ones_like(rms), ones, mode="same")
    return np.sqrt(np.convolve(rms**2, ones, mode="same") / count)


def _draw_radar(result: StudyResult, path: Path) -> None:
    """MSE of the methods as a radar chart, each spoke over its largest; beside, the paper's."""
    spokes = [(axis, span) for axis, row in result.methods["ukf"]["mse"].items() for span in row]
    printed = result.published["methods"]
    ours = {
        name: np.array([result.methods[name]["mse"][axis][span]["value"] for axis, span in spokes])
        for name in SHOWN
    }
    theirs = {
        name: np.array([printed[name][axis][span] for axis, span in spokes]) for name in printed
    }
    angle = np.linspace(0, 2 * np.pi, len(spokes), endpoint=False)
    with figure(path, (10.5, 5.2)) as drawing:
        panels = drawing.subplots(1, 2, subplot_kw={"projection": "polar"})
        for axes, values, title in zip(
            panels, (ours, theirs), (_title(result), "Song et al., Table 4"), strict=True
        ):
            top = np.max(list(values.values()), axis=0)
            for name in (name for name in SHOWN if name in values):
                closed = np.append(values[name] / top, values[name][0] / top[0])
                label = name if values is ours else None
                axes.plot(np.append(angle, 0), closed, color=COLOURS[name], label=label)
            labels = [
                f"{axis}\n{span} s\n{most:.2f}"
                for (axis, span), most in zip(spokes, top, strict=True)
            ]
            axes.set_xticks(angle, labels, fontsize=8)
            axes.tick_params(pad=18)
            axes.set_ylim(0, 1.02)
            axes.set_yticks([0.25, 0.5, 0.75, 1.0], [])
            axes.set_title(title, pad=20)
        drawing.suptitle("MSE of position over the largest of each spoke [m²]")
        drawing.legend(loc="outside lower center", ncols=4, fontsize=8)


def _draw_weights(result: StudyResult, config: SageHusaConfig, path: Path) -> None:
    """Mean weights by factor on Q and by forgetting factor under each rule."""
    a = result.arrays
    banks = list(a["bank"])
    groups = (("member_q_scale", "Q x {:g}"), ("member_forgetting", "b = {:g}"))
    with figure(path, (11, 9)) as drawing:
        grid = drawing.subplots(len(WEIGHED), 2, sharex=True, sharey=True)
        for row, name in zip(grid, WEIGHED, strict=True):
            weights = a["mean_weights"][:, banks.index(name)]
            for axes, (key, label) in zip(row, groups, strict=True):
                _shade_noise(axes, config)
                values = sorted(set(a[key]))
                for value, colour in zip(values, shades(len(values)), strict=True):
                    share = weights[:, a[key] == value].sum(axis=1)
                    axes.plot(a["time"], share, color=colour, label=label.format(value))
                axes.set_ylim(-0.02, 1.15)
            row[0].set_ylabel(f"{name}\nmean weight")
        for axes in grid[0]:
            axes.legend(loc="center right", fontsize=8)
        for axes in grid[-1]:
            axes.set_xlabel("time [s]")
        drawing.suptitle(f"weights by factor on Q and by forgetting factor: {_title(result)}")


def _draw_noise(result: StudyResult, config: SageHusaConfig, path: Path) -> None:
    """The standard deviation of the fixes that the Sage-Husa filters estimate, beside the truth."""
    a = result.arrays
    true = np.hypot(config.gnss_position, a["added"])
    members = [j for j, q in enumerate(a["member_q_scale"]) if q == 1]
    with figure(path, (9, 4.2)) as drawing:
        axes = drawing.subplots()
        _shade_noise(axes, config)
        axes.plot(a["time"], true, color="black", lw=1.4, label="true")
        for j, colour in zip(members, shades(len(members)), strict=True):
            own, mean = (
                config.gnss_position * np.sqrt(a[key][:, j, 0])
                for key in ("run_0_variance", "mean_variance")
            )
            label = f"b = {a['member_forgetting'][j]:g}"
            axes.plot(a["time"], own, color=colour, lw=0.5, alpha=0.6)
            axes.plot(a["time"], mean, color=colour, label=label)
        axes.set(xlabel="time [s]", ylabel="noise of a fix east [m]", ylim=(0, None))
        axes.set_title(f"noise estimated by the Sage-Husa filters, run 0 thin: {_title(result)}")
        axes.legend(fontsize=8)
