"""Is a filtered drive to be believed? What the log says of itself, and the innovations of the run.

Each finding judges one number against bounds on both sides. The log's own are taken from the
samples and the fixes as they are, without a filter: the course of the fixes turns as the gyros
say, at the same time; gravity points up; speed grows when the accelerometer says forward. A sensor
with wrong axes, sign, unit or clock shows there, whatever a filter makes of it.
"""

import math

import numpy as np

from jaxnav.datasets.drive import DriveLog
from jaxnav.estimation.types import Flag
from jaxnav.findings import Finding, judged, memory_of, size_of
from jaxnav.navigation.models.vehicle import CONSTRAINTS
from jaxnav.numerics.masks import runs_of
from jaxnav.recorded.methods import Kept
from jaxnav.recorded.motion import course_velocity, since_start
from jaxnav.recorded.preparation import Drive
from jaxnav.recorded.turning import COURSE_SPEED, SPAN_S, clocks, matched
from jaxnav.units import DEG

LEAST_TRACK = 20
"""Fixes on end, and seconds, that show how speed grows."""


def audit(log: DriveLog, drive: Drive, kept: Kept) -> list[Finding]:
    """Return what was found, the log's own findings first.

    Args:
        log: The drive.
        drive: The prepared drive.
        kept: The run.
    """
    return [
        *_samples(log),
        *_receiver(log, drive),
        *_turning(log, drive),
        *_driving(log, drive),
        *_innovations(drive, kept),
        *_estimates(drive, kept),
    ]


def _longest_run(same: np.ndarray) -> tuple[int, int]:
    """Return the length of the longest run of True and where it begins."""
    runs = runs_of(same)
    if not len(runs):
        return 0, 0
    lengths = runs[:, 1] - runs[:, 0]
    best = int(np.argmax(lengths))
    return int(lengths[best]), int(runs[best, 0])


def _samples(log: DriveLog) -> list[Finding]:
    """Judge the inertial samples: repeats, dead axes, gravity."""
    values = np.hstack([log.imu.gyro, log.imu.accel])
    same = np.all(values[1:] == values[:-1], axis=1) & log.imu.valid[1:] & log.imu.valid[:-1]
    length, begin = _longest_run(same)
    since = float(since_start(log.imu.time_ns[begin], log))
    lasted = length * log.imu.step_s
    repeated = judged(
        "repeated samples",
        lasted,
        (0.0, 0.1),
        (0.0, 0.5),
        "s",
        f"an inertial sample is repeated for {lasted:.3g} s from {since:.6g} s on: the sensor or "
        "its logger stood still; cut that part out or leave its rows empty",
    )
    spread = values[log.imu.valid].std(axis=0)
    names = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")
    dead = [name for name, sigma in zip(names, spread, strict=True) if sigma == 0]
    alive = judged(
        "dead axes",
        float(len(dead)),
        (0.0, 0.0),
        (0.0, 0.0),
        "",
        f"{', '.join(dead)} never changes: a dead axis or an empty column",
    )
    mean = log.imu.accel[log.imu.valid].mean(axis=0)
    tilt = math.degrees(math.acos(np.clip(mean[2] / max(float(np.linalg.norm(mean)), 1e-9), -1, 1)))
    axis = "xyz"[int(np.argmax(np.abs(mean)))]
    sign = "-" if mean[int(np.argmax(np.abs(mean)))] < 0 else "+"
    upright = judged(
        "gravity from the z axis",
        tilt,
        (0.0, 20.0),
        (0.0, 45.0),
        "deg",
        f"the accelerometers show gravity mostly on {sign}{axis}, {tilt:.0f} deg from z: the axes "
        "are not forward, left, up; turn the columns, or give the orientation of the sensors",
    )
    return [repeated, alive, upright]


def _receiver(log: DriveLog, drive: Drive) -> list[Finding]:
    """Judge the fixes by themselves: a receiver that goes on saying the same."""
    place, time = log.fixes.geodetic, since_start(log.fixes.time_ns, log)
    same = np.all(place[1:] == place[:-1], axis=1)
    at = np.clip(np.searchsorted(drive.time, time[1:]), 0, len(drive.time) - 1)
    length, begin = _longest_run(same & ~drive.stopped[at])
    lasted = float(time[begin + length] - time[begin]) if length else 0.0
    return [
        judged(
            "frozen fixes",
            lasted,
            (0.0, 2.0),
            (0.0, 4.0),
            "s",
            f"the receiver gives the same place for {lasted:.3g} s from {time[begin]:.6g} s on "
            "while the vehicle is not at rest: it has frozen; cut these fixes out",
        )
    ]


def _turning(log: DriveLog, drive: Drive) -> list[Finding]:
    """Judge the vertical gyro and the clocks by the course of the fixes."""
    names = ("course against gyro", "scale of the gyro", "clocks")
    found = clocks(log, drive.offset_s)
    if found is None:
        return [Finding(name, "not seen", math.nan, (0.0, 0.0), "") for name in names]
    strength, late = found.correlation, found.late_s
    agree = judged(
        names[0],
        strength,
        (0.8, 1.0),
        (0.6, 1.0),
        "",
        f"the course of the fixes and the z gyro turn against each other (correlation "
        f"{strength:.2f}): the gyro's sign is reversed, or z points down"
        if strength < -0.6
        else f"the z gyro does not turn as the course of the fixes does (correlation "
        f"{strength:.2f} at best): check axes, units and clocks of the inertial sensors",
    )
    if abs(strength) < 0.6:
        return [agree, *(Finding(name, "not seen", math.nan, (0.0, 0.0), "") for name in names[1:])]
    ratio = abs(found.slope)
    scale = judged(
        names[1],
        ratio,
        (0.9, 1.1),
        (0.8, 1.25),
        "",
        f"the z gyro turns {ratio:.3g} times as fast as the course of the fixes: "
        + ("its unit is not that of the header" if not 0.2 < ratio < 5 else "its scale is wrong"),
    )
    apart = judged(
        names[2],
        late,
        (-0.35, 0.35),
        (-0.6, 0.6),
        "s",
        f"the fixes are {abs(late):.1f} s {'late' if late > 0 else 'early'} against the inertial "
        f"samples; try --tune-offset, or --time-offset-s {drive.offset_s - late:.2f}",
    )
    return [agree, scale, apart]


def _driving(log: DriveLog, drive: Drive) -> list[Finding]:
    """Judge the level accelerometers by speed and turn: forward and left, or elsewhere."""
    time = since_start(log.imu.time_ns, log)
    velocity = course_velocity(log.fixes)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    fix_time = since_start(log.fixes.time_ns, log) + drive.offset_s
    inside = np.isfinite(speed) & (fix_time > time[0]) & (fix_time < time[-1])
    grid = np.arange(time[0], time[-1], SPAN_S)
    if inside.sum() < LEAST_TRACK or len(grid) < LEAST_TRACK:
        return [Finding("forward axis", "not seen", math.nan, (0.0, 0.0), "")]
    seen = np.interp(grid, fix_time[inside], speed[inside])
    moving = (seen[1:] > 1.0) & (seen[:-1] > 1.0)
    surge = np.diff(seen) / SPAN_S
    gains = []
    for axis in range(2):
        force = np.where(log.imu.valid, log.imu.accel[:, axis], 0.0)
        total = np.concatenate([[0.0], np.cumsum(force[:-1] * np.diff(time))])
        gains.append(np.diff(np.interp(grid, time, total)) / SPAN_S)
    if moving.sum() < LEAST_TRACK or surge[moving].std() < 0.2:
        return [Finding("forward axis", "not seen", math.nan, (0.0, 0.0), "")]
    along, across = (matched(surge[moving], gain[moving])[0] for gain in gains)
    changes = (
        "points backward"
        if along < -0.3 and abs(along) > abs(across)
        else "is not forward: y moves with it"
        if abs(across) > abs(along)
        else "does not show it"
    )
    return [
        judged(
            "forward axis",
            along,
            (0.3, 1.0),
            (0.0, 1.0),
            "",
            f"when the speed grows the x accelerometer {changes} (correlation {along:.2f}, y "
            f"{across:.2f}): check the axes; they must be forward, left, up",
        )
    ]


_GROUPS = {"velocities": ("velocity",), "positions": ("position",), "constraints": CONSTRAINTS}
"""What is judged together, by the channels of a vehicle."""


def _constraints(value: float) -> Finding:
    """Judge the NIS of the constraints: what they say is rougher than noise, and may be small."""
    says = f"the constraints have a NIS of {value:.3g} per channel" + (
        ": the vehicle slips or the mounting is wrong; try --constraints off"
        if value > 1
        else "; --steered-sigma may be smaller"
    )
    return judged("NIS, constraints", value, (0.01, 4.0), (0.0, 10.0), "", says)


def _innovations(drive: Drive, kept: Kept) -> list[Finding]:
    """Judge the run's innovations: their size, their memory, what was refused."""
    findings = []
    for group, names in _GROUPS.items():
        parts = [kept.parts[name] for name in names if name in kept.parts]
        total = sum(int(np.sum(part.used)) for part in parts)
        nis = sum(float(np.sum(part.nis)) for part in parts)
        value = nis / total if total > 30 else math.nan
        if group == "constraints":
            findings.append(_constraints(value))
            continue
        findings.append(size_of(group, value))
    at = drive.fix_step
    for group, axes in (("velocities", slice(0, 3)), ("positions", slice(0, 2))):
        part = kept.parts[_GROUPS[group][0]]
        white = (np.asarray(part.innovation) / np.asarray(part.sigma))[at]
        findings.append(memory_of(group, white[np.any(part.used[at], axis=1)][:, axes]))
    flags = np.asarray(kept.flags)[at]
    share = float(np.mean((flags & (Flag.REFUSED | Flag.REOPENED)) > 0)) if len(at) else math.nan
    findings.append(
        judged(
            "refused fixes",
            share,
            (0.0, 0.01),
            (0.0, 0.1),
            "",
            f"{share:.1%} of the fixes contradict the filter and were refused: receiver or filter "
            "is wrong for long",
        )
    )
    return findings


def _estimates(drive: Drive, kept: Kept) -> list[Finding]:
    """Judge what was estimated: the biases of the sensors, the direction of motion."""
    bias = float(np.max(np.abs(np.asarray(kept.mean.bias)[-1])))
    drift = float(np.max(np.abs(np.asarray(kept.mean.drift)[-1]))) / DEG
    v = np.einsum("nji,nj->ni", np.asarray(kept.mean.dcm), np.asarray(kept.mean.velocity))
    fast = np.hypot(v[:, 0], v[:, 1]) > COURSE_SPEED
    sideways = math.nan
    if fast.sum() > 50:
        sideways = float(np.mean(np.abs(v[fast, 1]) > np.abs(v[fast, 0])))
    backward = float(np.mean(v[fast, 0] < 0)) if fast.sum() > 50 else math.nan
    return [
        judged(
            "accelerometer bias",
            bias,
            (0.0, 0.6),
            (0.0, 1.5),
            "m/s^2",
            f"an accelerometer bias of {bias:.3g} m/s^2 was estimated: more than a sensor has; "
            "check axes, units and clocks",
        ),
        judged(
            "gyro drift",
            drift,
            (0.0, 1.5),
            (0.0, 4.0),
            "deg/s",
            f"a gyro drift of {drift:.3g} deg/s was estimated: more than a sensor has; check axes, "
            "units and clocks",
        ),
        judged(
            "motion sideways",
            sideways,
            (0.0, 0.05),
            (0.0, 0.3),
            "",
            f"for {sideways:.0%} of the time the vehicle moves more sideways than forward: heading "
            "or axes are wrong",
        ),
        judged(
            "motion backward",
            backward,
            (0.0, 0.3),
            (0.0, 0.5),
            "",
            f"for {backward:.0%} of the time the vehicle drives backward: the heading at the start "
            "is wrong by half a turn, or x points backward",
        ),
    ]
