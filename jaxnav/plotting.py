"""Figures: one style, headless, and saved at 150 dpi."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

DPI = 150
STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "lines.linewidth": 1.0,
}
COLOURS = {
    "kf": "tab:red",
    "mmae": "tab:orange",
    "immae": "tab:blue",
    "floor": "tab:green",
    "markov": "tab:purple",
    "ekf": "tab:red",
    "ukf": "tab:pink",
    "mmae-ekf": "tab:orange",
    "mmae-ukf": "tab:olive",
    "immae-ukf": "tab:blue",
    "imm-ukf": "tab:purple",
    "conventional": "tab:red",
    "ckf": "tab:pink",
    "iterated-ckf": "tab:blue",
    "modified-iterated-ckf": "tab:green",
    "angle-ckf": "tab:orange",
    "liekf": "tab:olive",
    "se23-ekf": "tab:cyan",
    "versoria-ekf": "tab:purple",
    "iae": "tab:brown",
    "arekf": "tab:blue",
    "sage-husa": "tab:green",
    "exponential-decay": "tab:purple",
    "proposed": "tab:blue",
    "proposed-bayes": "tab:olive",
    "proposed-bayes-floor": "tab:cyan",
    "unnormalised-floor": "tab:brown",
    "oracle-r": "0.5",
    "oracle": "black",
    "filter": "tab:blue",
    "stopped": "tab:red",
}
"""Colour of each method, the same in all figures; the last two are of a recorded drive."""


@contextmanager
def figure(path: Path, size: tuple[float, float], **layout: Any) -> Iterator[Figure]:
    """Give a figure in the project's style and save it to ``path`` at the end."""
    with mpl.rc_context(STYLE):
        made = Figure(figsize=size, layout="constrained", **layout)
        yield made
        made.savefig(path, dpi=DPI)


def shades(count: int) -> list[Any]:
    """Return colours from dark to light for so many steps of one quantity."""
    return [mpl.colormaps["viridis"](x) for x in np.linspace(0, 0.9, count)]


def largest(values: np.ndarray) -> float:
    """Return the largest finite magnitude, one if there is none: a limit for an axis."""
    finite = np.abs(values[np.isfinite(values)])
    return float(finite.max()) if finite.size and finite.max() > 0 else 1.0


def plot_weights(axes: Any, time: Any, weights: Any, labels: Sequence[str]) -> None:
    """Plot the weights ``(T, M)`` of a bank's models over time [s]."""
    for j, label in enumerate(labels):
        axes.plot(time, weights[:, j], label=label)
    axes.margins(x=0)
    axes.set_ylim(-0.02, 1.02)
    axes.set_ylabel("weight")
    axes.set_xlabel("time [s]")
