"""Figures of `jaxnav filter`."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
from scipy.stats import chi2

from jaxnav.datasets.drive import DriveLog
from jaxnav.navigation.earth import metres_per_radian
from jaxnav.plotting import COLOURS, figure, plot_weights, shades
from jaxnav.recorded.analysis import Report
from jaxnav.recorded.experiments import NoiseScores, Outages
from jaxnav.recorded.scoring import ReferenceErrors, horizontal
from jaxnav.units import DEG

LEGEND_MEMBERS = 12
_OUTAGES = {"inertial": "inertial sensors alone", "constrained": "with the vehicle's constraints"}
_AXES = ("east", "north", "up")


def draw(report: Report, log: DriveLog, directory: Path) -> list[Path]:
    """Draw the figures that a report has the contents of, and return their paths."""
    paths = [
        _track(report, log, directory / "track.png"),
        _errors(report, directory / "errors.png"),
        _nis(report, directory / "nis.png"),
    ]
    if report.members:
        paths.append(_weights(report, directory / "weights.png"))
    if report.outages is not None:
        paths.append(_outages(report.outages, directory / "outages.png"))
    if report.noise is not None:
        paths.append(_noise(report, report.noise, directory / "noise.png"))
    return paths


def _track(report: Report, log: DriveLog, path: Path) -> Path:
    drive, position = report.drive, np.asarray(report.kept.mean.position)
    origin = position[0]
    scale = np.asarray(metres_per_radian(jnp.asarray(origin)))

    def plane(geodetic: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        north, east = ((geodetic - origin) * scale)[:, :2].T
        return east, north

    fixes = plane(log.fixes.geodetic[drive.fix])
    extent = [np.ptp(values) + 1.0 for values in fixes]
    width, height = (7.5 * max(extent[i] / max(extent), 0.35) for i in range(2))
    with figure(path, (width + 0.9, height + 0.7)) as drawing:
        axes = drawing.subplots()
        axes.plot(*fixes, ".", ms=2.5, color="0.6", label="fixes")
        if log.reference is not None:
            axes.plot(*plane(log.reference.geodetic), color="black", lw=1.5, label="reference")
        axes.plot(*plane(position), color=COLOURS["filter"], lw=0.9, label="filter")
        rest = position[drive.stopped]
        if len(rest):
            axes.plot(
                *plane(rest), "s", ms=5, mfc="none", color=COLOURS["stopped"], label="stopped"
            )
        axes.plot(0, 0, "o", ms=5, color="black", label="start")
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel("east [m]")
        axes.set_ylabel("north [m]")
        axes.legend(loc="best")
    return path


def _errors(report: Report, path: Path) -> Path:
    if report.reference is not None:
        return _reference_errors(report.reference, path)
    drive, kept = report.drive, report.kept
    at = drive.fix_step[drive.arrived("position")]
    time = drive.time[at]
    innovation = np.asarray(kept.parts["position"].innovation)[at]
    sigma = np.asarray(kept.parts["position"].sigma)[at]
    with figure(path, (8, 5.5)) as drawing:
        panels = drawing.subplots(3, 1, sharex=True)
        for i, (axes, name) in enumerate(zip(panels, _AXES, strict=True)):
            bound = 3 * sigma[:, i]
            axes.fill_between(time, -bound, bound, color="0.85", lw=0, label="±3 sigma, expected")
            axes.plot(
                time, innovation[:, i], ".", ms=2, color=COLOURS["filter"], label="difference"
            )
            limit = 1.3 * np.percentile(np.maximum(bound, np.abs(innovation[:, i])), 99.5)
            axes.set_ylim(-limit, limit)
            axes.set_ylabel(f"{name} [m]")
            axes.margins(x=0)
        panels[0].set_title("fix less its prediction")
        panels[0].legend(ncols=2, loc="upper right")
        panels[-1].set_xlabel("time [s]")
    return path


def _reference_errors(errors: ReferenceErrors, path: Path) -> Path:
    with figure(path, (8, 5.5)) as drawing:
        top, bottom = drawing.subplots(2, 1, sharex=True)
        top.plot(
            errors.receiver_time,
            horizontal(errors.receiver_offset),
            color="0.6",
            label="receiver",
        )
        top.plot(errors.time, horizontal(errors.offset), color=COLOURS["filter"], label="filter")
        top.set_ylim(bottom=0)
        top.set_ylabel("horizontal error [m]")
        top.legend(ncols=2)
        if np.isfinite(errors.angles).any():
            for i, name in enumerate(("roll", "pitch", "heading")):
                bottom.plot(errors.time, errors.angles[:, i] / DEG, label=name)
            bottom.legend(ncols=3)
        bottom.set_ylabel("attitude error [deg]")
        bottom.set_xlabel("time [s]")
        bottom.margins(x=0)
    return path


def _nis(report: Report, path: Path) -> Path:
    """Draw the NIS of each channel that was used, with what was refused at the top."""
    time = report.drive.time
    every = report.kept.parts
    parts = {name: every[name] for name in report.drive.channels if np.any(every[name].used)}
    with figure(path, (8, 1 + 1.7 * len(parts))) as drawing:
        panels = drawing.subplots(len(parts), 1, sharex=True, squeeze=False)[:, 0]
        for axes, (name, part) in zip(panels, parts.items(), strict=True):
            count = np.asarray(part.used).sum(axis=1)
            at = count > 0
            nis = np.asarray(part.nis)[at] / count[at]
            usual = int(np.median(count[at]))
            bounds = chi2.ppf([0.025, 0.975], usual) / usual
            label = f"95 % of chi-square of {usual}"
            axes.axhspan(*bounds, color="0.85", lw=0, label=label)
            axes.plot(time[at], nis, ".", ms=2, color=COLOURS["filter"], label="an update")
            refused = np.asarray(part.refused).any(axis=1)
            if refused.any():
                top = axes.get_xaxis_transform()
                marks = np.full(refused.sum(), 0.97)
                axes.plot(
                    time[refused], marks, "|", color="tab:red", transform=top, label="refused"
                )
            axes.set_yscale("log")
            low, high = _decades(nis)
            axes.set_ylim(min(low, bounds[0] / 2), max(high, 4 * bounds[1]))
            axes.margins(x=0)
            axes.set_ylabel(f"{name}\nNIS per value")
            axes.legend(ncols=3, loc="upper right")
        panels[-1].set_xlabel("time [s]")
    return path


def _decades(values: np.ndarray) -> tuple[float, float]:
    """Return limits of a logarithmic axis with room above for a legend."""
    known = values[values > 0]
    low, high = np.percentile(known, [0.5, 100]) if known.size else (0.1, 10.0)
    return float(low) / 2, float(high) * 4


def _weights(report: Report, path: Path) -> Path:
    time, weights = report.drive.time, np.asarray(report.kept.weights)
    thin = slice(None, None, max(1, len(time) // 4000))
    with figure(path, (8, 3.2)) as drawing:
        axes = drawing.subplots()
        axes.set_prop_cycle(color=shades(len(report.members)))
        plot_weights(axes, time[thin], weights[thin], report.members)
        if len(report.members) <= LEGEND_MEMBERS:
            drawing.legend(*axes.get_legend_handles_labels(), loc="outside right center")
    return path


def _outages(outages: Outages, path: Path) -> Path:
    limit = 1.05 * max(float(error.max()) for error in outages.error.values())
    with figure(path, (4.2 * len(outages.error) + 0.4, 3.6)) as drawing:
        panels = np.atleast_1d(drawing.subplots(1, len(outages.error), sharey=True))
        for axes, (name, error) in zip(panels, outages.error.items(), strict=True):
            for window in np.unique(outages.window):
                own = outages.window == window
                axes.plot(outages.since[own], error[own], color="0.7", lw=0.8)
            axes.plot([], [], color="0.7", lw=0.8, label="one window")
            grid, median = _median(outages.since, error)
            axes.plot(grid, median, color=COLOURS["filter"], lw=2, label="median")
            end = np.median(outages.at_end[name])
            axes.set_title(f"{_OUTAGES[name]}: {end:.1f} m at the end")
            axes.set_xlabel("time without fixes [s]")
            axes.set_ylim(0, limit)
            axes.set_xlim(left=0)
            axes.legend(loc="upper left")
        panels[0].set_ylabel("horizontal error [m]")
    return path


def _median(since: np.ndarray, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the medians over windows of errors, second by second."""
    bin_of = np.floor(since).astype(int)
    bins = np.unique(bin_of)
    return bins + 0.5, np.array([np.median(error[bin_of == b]) for b in bins])


def _noise(report: Report, noise: NoiseScores, path: Path) -> Path:
    spans = report.document["added_noise"]["spans"]
    names = list(noise.mean_square)
    with figure(path, (8, 3.4)) as drawing:
        panels = drawing.subplots(1, len(spans), sharex=True, sharey=True, squeeze=False)[0]
        for k, (axes, span) in enumerate(zip(panels, spans, strict=True)):
            for i, name in enumerate(("east", "north")):
                values = np.stack([noise.mean_square[method][:, k, i] for method in names])
                axes.plot(np.sqrt(np.mean(values, axis=1)), names, "os"[i], ms=5, label=name)
            axes.set_xscale("log")
            axes.xaxis.get_major_locator().set_params(subs=(1, 2, 5))
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_formatter("")
            axes.set_title(
                f"{span['sigma_m']:g} m added, {span['start_s']:g} s to {span['end_s']:g} s"
            )
            axes.set_xlabel("RMS error [m]")
        panels[0].invert_yaxis()
        panels[-1].legend(loc="center right")
    return path
