"""The figure of `jaxnav allan`: deviations with their intervals, and the fitted noise."""

from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.plotting import figure
from jaxnav.units import DEG_PER_HOUR, GRAVITY

_PANELS = (("gyro", DEG_PER_HOUR, "deg/h"), ("accel", 1e-6 * GRAVITY, "µg"))
_COLOURS = {"x": "tab:blue", "y": "tab:orange", "z": "tab:green"}


def draw(arrays: dict[str, Any], confidence: float, path: Path) -> Path:
    """Draw the Allan deviations of gyros and accelerometers over the cluster time.

    Args:
        arrays: As from :func:`~jaxnav.noise_report.analysis.analyse`.
        confidence: Probability of the intervals.
        path: The PNG file.

    Returns:
        The path.
    """
    with figure(path, (9, 4.2)) as drawing:
        panels = drawing.subplots(1, 2, sharex=True)
        for axes, (sensor, unit, text) in zip(panels, _PANELS, strict=True):
            _draw_panel(axes, arrays, sensor, unit)
            axes.set(xscale="log", yscale="log")
            axes.yaxis.get_major_locator().set_params(subs=(1, 2, 5))
            axes.yaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_minor_formatter("")
            axes.set_xlabel("cluster time [s]")
            axes.set_ylabel(f"Allan deviation [{text}]")
            axes.set_title({"gyro": "gyros", "accel": "accelerometers"}[sensor])
        panels[0].plot([], [], color="0.3", lw=1, label="fitted noise")
        panels[0].fill_between([], [], color="0.3", alpha=0.25, lw=0, label=_percent(confidence))
        panels[0].legend()
    return path


def _percent(confidence: float) -> str:
    return f"{100 * confidence:.4g} % interval"


def _draw_panel(axes: Any, arrays: dict[str, Any], sensor: str, unit: float) -> None:
    tau, fit_tau = arrays["tau"], arrays["fit_tau"]
    for i, name in enumerate(arrays["axis"]):
        if not str(name).startswith(sensor):
            continue
        colour = _COLOURS[str(name)[-1]]
        deviation = arrays["deviation"][i] / unit
        known = np.isfinite(arrays["high"][i]) & (deviation > 0)
        if not known.any():
            continue
        low, high = arrays["low"][i][known] / unit, arrays["high"][i][known] / unit
        axes.fill_between(tau[known], low, high, color=colour, alpha=0.25, lw=0)
        axes.plot(tau[known], deviation[known], "o", ms=3, color=colour, label=str(name)[-1])
        axes.plot(fit_tau, arrays["fit_deviation"][i] / unit, color=colour)
