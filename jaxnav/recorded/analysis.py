"""`jaxnav filter` as a whole: from a drive to its document, and all that figures are drawn from."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2

from jaxnav.config import plain
from jaxnav.datasets.drive import DriveLog
from jaxnav.estimation.run import run
from jaxnav.estimation.types import Flag
from jaxnav.findings import document_of, faults
from jaxnav.navigation.models.vehicle import CONSTRAINTS, FIXES
from jaxnav.recorded.audit import audit
from jaxnav.recorded.carry import summary
from jaxnav.recorded.config import FilterConfig, check, members
from jaxnav.recorded.experiments import (
    NoiseScores,
    Outages,
    add_noise,
    hide_and_score,
    single_model,
)
from jaxnav.recorded.methods import Kept, Method, filter_params, member_names, method
from jaxnav.recorded.motion import since_start
from jaxnav.recorded.offset import Offset, likeliest_offset
from jaxnav.recorded.points import at_point
from jaxnav.recorded.preparation import Drive, prepare
from jaxnav.recorded.scoring import (
    ReferenceErrors,
    against_reference,
    diverged,
    fix_errors,
    horizontal,
    mounting,
    rms,
)
from jaxnav.results import SCHEMA, provenance
from jaxnav.units import DEG

NIS_CONFIDENCE = 0.95
FIXED = 1
"""RTKLIB's number of a fix with fixed ambiguities."""

Progress = Callable[[str, int, int], None]


class Report(NamedTuple):
    """All that is known of a filtered drive.

    Attributes:
        document: Contents of ``summary.json``.
        drive: The prepared drive.
        kept: The run.
        trajectory: The same with velocity and position of the point that was asked for.
        members: Names of the members of a bank.
        reference: Errors against the reference, if there is one.
        outages: Errors without fixes, if they were hidden.
        noise: Errors under added noise, if it was added.
    """

    document: dict[str, Any]
    drive: Drive
    kept: Kept
    trajectory: Kept
    members: list[str]
    reference: ReferenceErrors | None
    outages: Outages | None
    noise: NoiseScores | None


def analyse(log: DriveLog, config: FilterConfig, progress: Progress | None = None) -> Report:
    """Filter a drive, and score it in all ways that it allows and the configuration asks for.

    Args:
        log: The drive.
        config: The configuration.
        progress: Called with what is being done, parts done and parts.

    Raises:
        ConfigError: If a parameter is out of its range.
        DataError: If the drive cannot be filtered, or what is asked for is not in it.
    """
    check(config)
    notes: list[str] = []
    tell = progress or (lambda label, done, total: None)
    offset = None
    if config.tune_offset:
        offset = likeliest_offset(log, config)
        config = replace(config, time_offset_s=offset.value_s)
        tell("time offset", 1, 1)
    drive = prepare(log, config, config.rate_hz)
    chosen = method(config, drive.initial.mean.position)
    params, turned = _with_mounting(log, config, drive, chosen)
    seen = drive.seen_by(chosen.model)
    kept = run(chosen.filter, params, drive.inputs, seen, record=chosen.record).record
    tell("filter", 1, 1)
    reference = None
    if log.reference is not None:
        reference = against_reference(log, drive, kept, config.time_offset_s)
    outages, lost = None, False
    if _wants_outages(log, config):
        outages, runs = hide_and_score(chosen, params, drive, config)
        lost = any(diverged(each, drive) for each in runs.values())
        tell("outages", 1, 1)
    noise = None
    if config.added_noise:
        noise = add_noise(log, config)
        tell("added noise", 1, 1)
    if lost:
        notes.append("a run with fixes hidden diverged")
    findings = audit(log, drive, kept)
    off = fix_errors(chosen.model, single_model(params), drive, kept.state)
    names = member_names(config) if members(config) > 1 else []
    document = {
        "schema": SCHEMA,
        "command": "filter",
        "log": log.source,
        "config": {**plain(config), "config": config.config and str(config.config)},
        "counts": _counts(log, drive),
        "alignment": _alignment(drive, config, turned),
        "time_offset": _offset(config, offset),
        "members": names,
        "filter": _filter_scores(drive, kept, off),
        "channels": _channel_scores(drive, kept),
        "carried": summary(
            config.carry,
            {name: np.asarray(values)[-1] for name, values in kept.carried.items()},
            np.asarray(kept.carried_sigma)[-1],
        ),
        "audit": document_of(findings),
        "faults": faults(findings),
        "refused": _refused(log, drive, kept),
        "diverged": diverged(kept, drive) or lost,
        "reference": reference and _reference_scores(reference),
        "outages": outages and _outage_scores(outages, config),
        "added_noise": noise and _noise_scores(noise, config),
        "notes": notes + _notes(log, drive, config),
        "provenance": provenance(),
    }
    trajectory = at_point(kept, log, drive, config)
    return Report(document, drive, kept, trajectory, names, reference, outages, noise)


def _wants_outages(log: DriveLog, config: FilterConfig) -> bool:
    mostly_fixed = 2 * np.sum(log.fixes.quality == FIXED) > len(log.fixes.quality)
    return config.outages == "on" or (config.outages == "auto" and bool(mostly_fixed))


def _with_mounting(
    log: DriveLog, config: FilterConfig, drive: Drive, chosen: Method
) -> tuple[Any, np.ndarray]:
    """Return the parameters of the run and the rotation vector to the vehicle's axes."""
    turned = np.zeros(3)
    if config.mounting_deg is not None:
        turned = np.array(config.mounting_deg) * DEG
    elif config.constraints:
        params = filter_params(config, drive, log.lever_arm, chosen.form)
        fixes = drive._replace(channels={name: drive.channels[name] for name in FIXES})
        obs = fixes.seen_by(chosen.model)
        free = run(chosen.filter, params, drive.inputs, obs, record=chosen.record).record
        turned = mounting(free, drive)
    return filter_params(config, drive, log.lever_arm, chosen.form, turned), turned


def _counts(log: DriveLog, drive: Drive) -> dict[str, Any]:
    constraints = [drive.channels[name].valid for name in CONSTRAINTS if name in drive.channels]
    return {
        "samples": len(log.imu.time_ns),
        "sample_s": log.imu.step_s,
        "nan_rows": log.imu.nan_rows,
        "duplicates": log.imu.duplicates,
        "gaps": log.imu.gaps,
        "missing": log.imu.missing,
        "skipped_rows": log.skipped_rows,
        "fixes": len(log.fixes.time_ns),
        "fix_duplicates": log.fixes.duplicates,
        "fixes_without_solution": log.fixes.unsolved,
        "fixes_used": len(drive.fix),
        "fixes_unused": drive.unused,
        "fixes_not_fixed": int(np.sum(log.fixes.quality != FIXED)),
        "periods": len(drive.time),
        "period_s": float(np.median(np.asarray(drive.inputs.inertial.dt))),
        "longest_period_s": float(np.max(np.asarray(drive.inputs.inertial.dt))),
        "stopped_periods": int(np.sum(drive.stopped)),
        "constraint_updates": int(sum(np.sum(held.any(axis=1)) for held in constraints)),
    }


def _refused(log: DriveLog, drive: Drive, kept: Kept) -> list[dict[str, Any]]:
    """Return the fixes that the gate refused: their number in the log, from 1, and their time."""
    flags = np.asarray(kept.flags)[drive.fix_step]
    refused = np.flatnonzero(flags & Flag.REFUSED)
    since = since_start(log.fixes.time_ns, log)
    return [{"fix": int(drive.fix[i]) + 1, "time_s": float(since[drive.fix[i]])} for i in refused]


def _alignment(drive: Drive, config: FilterConfig, turned: np.ndarray) -> dict[str, Any]:
    return {
        "kind": "rest" if drive.at_rest else "moving",
        "end_s": float(drive.time[0]),
        "gyro_drift_dps": np.asarray(drive.initial.mean.drift) / DEG,
        "mounting_deg": turned / DEG,
        "mounting": "estimated" if config.mounting_deg is None else "given",
    }


def _offset(config: FilterConfig, offset: Offset | None) -> dict[str, Any]:
    used = {"used_s": config.time_offset_s}
    return used if offset is None else used | {"sigma_s": offset.sigma_s}


def _filter_scores(drive: Drive, kept: Kept, off: dict[str, np.ndarray]) -> dict[str, Any]:
    at = drive.fix_step
    freedom = sum(seen.valid[at].sum(axis=1) for seen in drive.channels.values())
    nis = np.asarray(kept.nis)[at]
    within = nis < chi2.ppf(NIS_CONFIDENCE, freedom)
    innovation = {
        name: np.where(drive.channels[name].valid[at], kept.parts[name].innovation[at], np.nan)
        for name in FIXES
    }
    return {
        "log_likelihood": float(np.sum(np.asarray(kept.log_likelihood))),
        "nis_per_channel": float(np.sum(nis) / np.sum(freedom)),
        "nis_within": {"confidence": NIS_CONFIDENCE, "share": float(np.mean(within))},
        "innovation_rms": _east_north_up(innovation),
        "residual_rms": _east_north_up(off),
        "gyro_drift_dps": np.asarray(kept.mean.drift)[-1] / DEG,
        "accel_bias": np.asarray(kept.mean.bias)[-1],
    }


def _channel_scores(drive: Drive, kept: Kept) -> dict[str, Any]:
    """Return by channel how often it arrived and was refused, and its NIS per value used."""
    found = {}
    for name, part in kept.parts.items():
        used, refused = np.asarray(part.used), np.asarray(part.refused)
        count = int(used.sum())
        nis = float(np.asarray(part.nis)[used.any(axis=1)].sum()) / count if count else None
        # What the drive has nothing of was never used either.
        arrived = drive.channels[name].valid if name in drive.channels else used
        found[name] = {
            "updates": int(used.any(axis=1).sum()),
            "arrived": int(arrived.any(axis=1).sum()),
            "refused": int(refused.any(axis=1).sum()),
            "nis_per_value": nis,
        }
    return found


def _east_north_up(values: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return the RMS of each of the receiver's channels, ``(F, 3)``."""
    return {
        name: {
            **{axis: rms(values[name][:, i]) for i, axis in enumerate(("east", "north", "up"))},
            "unit": unit,
        }
        for name, unit in (("velocity", "m/s"), ("position", "m"))
    }


def _reference_scores(errors: ReferenceErrors) -> dict[str, Any]:
    roll, pitch, heading = (rms(errors.angles[:, i]) / DEG for i in range(3))
    return {
        "horizontal_rms_m": rms(horizontal(errors.offset)),
        "receiver_horizontal_rms_m": rms(horizontal(errors.receiver_offset)),
        "up_rms_m": rms(errors.offset[:, 2]),
        "receiver_up_rms_m": rms(errors.receiver_offset[:, 2]),
        "roll_rms_deg": roll,
        "pitch_rms_deg": pitch,
        "heading_rms_deg": heading,
        "constant_angles_deg": errors.constant / DEG,
    }


def _outage_scores(outages: Outages, config: FilterConfig) -> dict[str, Any]:
    return {
        "length_s": config.outage_s,
        "start_s": outages.start,
        "horizontal_m": {
            name: {"median": float(np.median(error)), "max": float(np.max(error)), "all": error}
            for name, error in outages.at_end.items()
        },
    }


def _noise_scores(noise: NoiseScores, config: FilterConfig) -> dict[str, Any]:
    spans = zip(config.noise_start_s, config.noise_end_s, config.noise_sigma_m, strict=True)
    root = max(1, config.noise_runs) ** 0.5
    methods = {}
    for name, square in noise.mean_square.items():
        spread = square.std(axis=0, ddof=1) / root if len(square) > 1 else square[0] * np.nan
        methods[name] = [
            {
                "mse_east": {"value": mean[0], "se": se[0], "unit": "m^2"},
                "mse_north": {"value": mean[1], "se": se[1], "unit": "m^2"},
            }
            for mean, se in zip(square.mean(axis=0), spread, strict=True)
        ]
    return {
        "runs": config.noise_runs,
        "rate_hz": config.noise_rate_hz,
        "spans": [
            {"start_s": start, "end_s": end, "sigma_m": sigma, "fixes": count}
            for (start, end, sigma), count in zip(spans, noise.fixes, strict=True)
        ],
        "methods": methods,
    }


def _notes(log: DriveLog, drive: Drive, config: FilterConfig) -> list[str]:
    """Return what a reader must know, one sentence each."""
    notes = []
    if not drive.at_rest:
        notes.append("the vehicle was never at rest before it moved: levelled on the move")
    if drive.bridged_s > 5 * log.imu.step_s:
        notes.append(f"inertial samples are missing for up to {drive.bridged_s:.3g} s")
    if config.constraints and config.mounting_deg is None:
        notes.append("the mounting angles are from a run without the constraints")
    return notes
