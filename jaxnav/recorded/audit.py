"""Is a filtered drive to be believed? What the log says of itself, and the innovations of the run.

Each finding judges one number against bounds on both sides. The log's own are taken from the
samples and the fixes as they are, without a filter: the course of the fixes turns as the gyros
say, at the same time; gravity points up; speed grows when the accelerometer says forward. A sensor
with wrong axes, sign, unit or clock shows there, whatever a filter makes of it.
"""

import math
from typing import NamedTuple

import numpy as np

from jaxnav.datasets.drive import DriveLog
from jaxnav.estimation.types import Flag
from jaxnav.numerics.masks import runs_of
from jaxnav.recorded.findings import Finding, judged
from jaxnav.recorded.methods import Kept
from jaxnav.recorded.motion import course_velocity, since_start
from jaxnav.recorded.preparation import Drive
from jaxnav.units import DEG

GRID_S = 0.1
SPAN_S = 1.0
"""Turns of the course and of the gyros are compared over so long, on a grid."""
LAGS_S = 30.0
"""Largest offset between the clocks that is looked for."""
LEAST_POINTS = 20
"""Points of two series that are compared at least."""
LEAST_TURN = 3 * DEG
"""Root mean square of the turn rate [rad/s] that a course must show to be compared at all."""
COURSE_SPEED = 3.0
"""Speed [m/s] from which on a velocity gives a course."""


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


class _Turns(NamedTuple):
    """Turn rates to the left [rad/s] on the grid, by the course and by the z gyro; NaN unknown."""

    course: np.ndarray
    gyro: np.ndarray


def _turns(log: DriveLog, drive: Drive) -> _Turns:
    time = since_start(log.imu.time_ns, log)
    grid = np.arange(time[0], time[-1], GRID_S)
    rate = np.where(log.imu.valid, log.imu.gyro[:, 2], 0.0)
    angle = np.concatenate([[0.0], np.cumsum(rate[1:] * np.diff(time))])
    turned = np.interp(grid, time, angle)
    velocity = course_velocity(log.fixes)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    fast = speed > COURSE_SPEED
    course = np.full(len(grid), np.nan)
    if fast.sum() > 2:
        fix_time = since_start(log.fixes.time_ns, log) + drive.offset_s
        left = np.unwrap(-np.arctan2(velocity[fast, 0], velocity[fast, 1]))
        course = np.interp(grid, fix_time[fast], left, left=np.nan, right=np.nan)
        # Between fast fixes that are far apart nothing is known.
        after = np.clip(np.searchsorted(fix_time[fast], grid), 1, fast.sum() - 1)
        wide = fix_time[fast][after] - fix_time[fast][after - 1] > 1.5
        course[wide] = np.nan
    span = round(SPAN_S / GRID_S)

    def over_span(angle: np.ndarray) -> np.ndarray:
        return (angle[span:] - angle[:-span]) / SPAN_S

    rates = over_span(course)
    # A turn of the course beyond half a turn a second is a reversal, or noise at walking pace.
    rates[np.abs(rates) > 2.0] = np.nan
    gyro = over_span(turned)
    return _Turns(rates, gyro - np.median(gyro))


def _matched(
    a: np.ndarray, b: np.ndarray, lag: int = 0, least: int = LEAST_POINTS
) -> tuple[float, float]:
    """Return correlation, and slope of ``b`` over ``a``, with ``a`` taken so many points later.

    Fewer than ``least`` points in common tell nothing: a correlation of 0.
    """
    if lag >= 0:
        a, b = a[lag:], b[: len(b) - lag]
    else:
        a, b = a[:lag], b[-lag:]
    known = np.isfinite(a) & np.isfinite(b)
    if known.sum() < least:
        return 0.0, math.nan
    a, b = a[known] - a[known].mean(), b[known] - b[known].mean()
    both = float(a @ b)
    size = math.sqrt(float(a @ a) * float(b @ b))
    correlation = both / size if size > 0 else 0.0
    return min(1.0, max(-1.0, correlation)), float(b @ b) / both if both else math.nan


def _turning(log: DriveLog, drive: Drive) -> list[Finding]:
    """Judge the vertical gyro and the clocks by the course of the fixes."""
    course, gyro = _turns(log, drive)
    known = np.isfinite(course)
    names = ("course against gyro", "scale of the gyro", "clocks")
    if known.sum() < 200 or np.sqrt(np.mean(course[known] ** 2)) < LEAST_TURN:
        return [Finding(name, "not seen", math.nan, (0.0, 0.0), "") for name in names]
    most = min(round(LAGS_S / GRID_S), len(course) // 3)
    lags, enough = np.arange(-most, most + 1), int(known.sum()) // 2
    found = np.array([_matched(course, gyro, int(lag), enough)[0] for lag in lags])
    best = int(np.argmax(np.abs(found)))
    strength, late = float(found[best]), float(lags[best]) * GRID_S
    here, slope = _matched(course, gyro, int(lags[best]), enough)
    agree = judged(
        names[0],
        strength,
        (0.8, 1.0),
        (0.6, 1.0),
        "",
        f"the course of the fixes and the z gyro turn against each other (correlation "
        f"{strength:.2f}): the gyro's sign is reversed, or z points down"
        if strength < -0.6
        else f"the z gyro does not turn as the course of the fixes does (correlation {here:.2f} at "
        "best): check axes, units and clocks of the inertial sensors",
    )
    if abs(strength) < 0.6:
        return [agree, *(Finding(name, "not seen", math.nan, (0.0, 0.0), "") for name in names[1:])]
    ratio = abs(slope)
    scale = judged(
        names[1],
        ratio,
        (0.9, 1.1),
        (0.8, 1.25),
        "",
        f"the z gyro turns {ratio:.3g} times as fast as the course of the fixes: "
        + ("its unit is not that of the header" if not 0.2 < ratio < 5 else "its scale is wrong"),
    )
    clocks = judged(
        names[2],
        late,
        (-0.35, 0.35),
        (-0.6, 0.6),
        "s",
        f"the fixes are {abs(late):.1f} s {'late' if late > 0 else 'early'} against the inertial "
        f"samples; try --time-offset-s {drive.offset_s - late:.2f}, or --tune-offset from there",
    )
    return [agree, scale, clocks]


def _driving(log: DriveLog, drive: Drive) -> list[Finding]:
    """Judge the level accelerometers by speed and turn: forward and left, or elsewhere."""
    time = since_start(log.imu.time_ns, log)
    velocity = course_velocity(log.fixes)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    fix_time = since_start(log.fixes.time_ns, log) + drive.offset_s
    inside = np.isfinite(speed) & (fix_time > time[0]) & (fix_time < time[-1])
    grid = np.arange(time[0], time[-1], SPAN_S)
    if inside.sum() < LEAST_POINTS or len(grid) < LEAST_POINTS:
        return [Finding("forward axis", "not seen", math.nan, (0.0, 0.0), "")]
    seen = np.interp(grid, fix_time[inside], speed[inside])
    moving = (seen[1:] > 1.0) & (seen[:-1] > 1.0)
    surge = np.diff(seen) / SPAN_S
    gains = []
    for axis in range(2):
        force = np.where(log.imu.valid, log.imu.accel[:, axis], 0.0)
        total = np.concatenate([[0.0], np.cumsum(force[:-1] * np.diff(time))])
        gains.append(np.diff(np.interp(grid, time, total)) / SPAN_S)
    if moving.sum() < LEAST_POINTS or surge[moving].std() < 0.2:
        return [Finding("forward axis", "not seen", math.nan, (0.0, 0.0), "")]
    along, across = (_matched(surge[moving], gain[moving])[0] for gain in gains)
    told = (
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
            f"when the speed grows the x accelerometer {told} (correlation {along:.2f}, y "
            f"{across:.2f}): check the axes; they must be forward, left, up",
        )
    ]


_GROUPS = ("velocities", "positions", "constraints")


def _innovations(drive: Drive, kept: Kept) -> list[Finding]:
    """Judge the run's innovations: their size, their memory, what was refused."""
    findings = []
    nis, channels = np.asarray(kept.group_nis), np.asarray(kept.channels)
    for i, group in enumerate(_GROUPS):
        total = int(channels[:, i].sum())
        value = float(nis[:, i].sum()) / total if total > 30 else math.nan
        says = (
            f"the {group} are {value**0.5:.3g} times as far from their prediction as their "
            f"standard deviations say (NIS {value:.3g} per channel)"
        )
        if group == "constraints":
            says += (
                ": the vehicle slips or the mounting is wrong; try --constraints off"
                if value > 1
                else "; --steered-sigma may be smaller"
            )
            findings.append(judged(f"NIS, {group}", value, (0.01, 4.0), (0.0, 10.0), "", says))
            continue
        says += (
            ": noise is larger than stated, or a sensor is wrong; the standard deviations of the "
            "result are too small"
            if value > 1
            else ": the noise is stated too large; the standard deviations of the result are too "
            "large, and outliers pass"
        )
        findings.append(judged(f"NIS, {group}", value, (0.2, 3.0), (0.05, 10.0), "", says))
    at = drive.fix_step
    used = channels[at, 1] > 0
    white = (np.asarray(kept.innovation) / np.asarray(kept.innovation_sigma))[at][used][:, 3:5]
    memory = math.nan
    if len(white) > 50:
        both = np.sum(white[1:] * white[:-1])
        memory = float(both / np.sum(white * white))
    findings.append(
        judged(
            "memory of positions",
            memory,
            (-0.5, 0.8),
            (-0.8, 0.95),
            "",
            f"what the positions are off lasts from fix to fix (correlation {memory:.2f}): the "
            "filter follows them too slowly, or their errors last, and its standard deviations "
            "are too small",
        )
    )
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
