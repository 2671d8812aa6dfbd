"""Recorded drives with faults: the right answer, or a refusal, or a finding that names the cause.

A finding is a fault of the audit. A drive whose error is beyond five times its stated sigma must
never come without one.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest

from jaxnav.datasets.base import DataError
from jaxnav.recorded.analysis import Report, analyse
from jaxnav.recorded.config import FilterConfig
from jaxnav.recorded.offset import likeliest_offset
from jaxnav.units import DEG
from tests.faulty.car import AROUND, REVERSED, Leg, Sensed, Truth, drive, heading_error, logged

CONFIG = FilterConfig(outages="off", rate_hz=10.0)
also = partial(pytest.param, marks=pytest.mark.slow)
METRE = 1 / 6.4e6
"""A metre north [rad]."""


def turned(matrix: list[list[float]]) -> Callable[[Sensed], Sensed]:
    """Axes of the inertial sensors put elsewhere."""
    M = np.array(matrix, float)
    return lambda s: s._replace(gyro=s.gyro @ M.T, accel=s.accel @ M.T)


def shifted(seconds: float) -> Callable[[Sensed], Sensed]:
    return lambda s: s._replace(fix_time=s.fix_time + seconds)


def scaled(gyro: float = 1.0, sigma: float = 1.0) -> Callable[[Sensed], Sensed]:
    return lambda s: s._replace(gyro=s.gyro * gyro, sigma=s.sigma * sigma)


def stuck(s: Sensed) -> Sensed:
    gyro, accel = s.gyro.copy(), s.accel.copy()
    part = (s.time > 60) & (s.time < 68)
    gyro[part], accel[part] = gyro[part][0], accel[part][0]
    return s._replace(gyro=gyro, accel=accel)


def dead(s: Sensed) -> Sensed:
    return s._replace(gyro=s.gyro * [1.0, 0.0, 1.0])


def frozen(s: Sensed) -> Sensed:
    place, velocity = s.place.copy(), np.array(s.velocity)
    part = (s.fix_time > 60) & (s.fix_time < 90)
    place[part], velocity[part] = place[part][0], velocity[part][0]
    return s._replace(place=place, velocity=velocity)


def swapped(s: Sensed) -> Sensed:
    return s._replace(gyro=s.accel, accel=s.gyro)


FAULTS: dict[str, tuple[Callable[[Sensed], Sensed], str]] = {
    "right, forward, up": (turned([[0, -1, 0], [1, 0, 0], [0, 0, 1]]), "forward axis"),
    "z down": (turned([[1, 0, 0], [0, -1, 0], [0, 0, -1]]), "gravity from the z axis"),
    "x backward": (turned([[-1, 0, 0], [0, -1, 0], [0, 0, 1]]), "forward axis"),
    "z forward": (turned([[0, 0, -1], [0, 1, 0], [1, 0, 0]]), "gravity from the z axis"),
    "a gyro's sign": (
        lambda s: s._replace(gyro=s.gyro * [1.0, 1.0, -1.0]),
        "course against gyro",
    ),
    "rad/s under deg/s": (scaled(gyro=DEG), "scale of the gyro"),
    "a gyro's scale of 1.5": (scaled(gyro=1.5), "scale of the gyro"),
    "fixes a second late": (shifted(1.0), "clocks"),
    "fixes a second early": (shifted(-1.0), "clocks"),
    "fixes 18 s late": (shifted(18.0), "clocks"),
    "gyros and accelerometers swapped": (swapped, "gravity from the z axis"),
    "a sample repeated for 8 s": (stuck, "repeated samples"),
    "a dead gyro": (dead, "dead axes"),
    "a frozen receiver": (frozen, "frozen fixes"),
    "sigmas ten times too large": (scaled(sigma=10.0), "NIS, positions"),
    "sigmas ten times too small": (scaled(sigma=0.1), "NIS, positions"),
}
each_fault = pytest.mark.parametrize("name", FAULTS)


class Outcome(NamedTuple):
    report: Report
    heading: np.ndarray
    sigma: np.ndarray
    away: np.ndarray


def outcome(truth: Truth, sensed: Sensed, config: FilterConfig = CONFIG) -> Outcome:
    """Filter a drive and return its errors: of the heading [rad] and horizontal [m]."""
    report = analyse(logged(sensed), config)
    time, mean = report.drive.time, report.kept.mean
    true = np.stack([np.interp(time, truth.time, p) for p in truth.geodetic.T], axis=1)
    off = (np.asarray(mean.position) - true)[:, :2] / METRE * [1.0, np.cos(true[0, 0])]
    heading = heading_error(truth, time, np.asarray(mean.dcm))
    return Outcome(report, heading, np.asarray(report.kept.sigma), np.hypot(*off.T))


def honest(found: Outcome) -> bool:
    """Whether the errors stay within five times the stated standard deviations."""
    headed = np.all(np.abs(found.heading) < 5 * found.sigma[:, 2])
    return bool(headed and np.all(found.away < 5 * np.hypot(*found.sigma[:, 6:8].T)))


def verdicts(found: Outcome) -> dict[str, str]:
    return {entry["name"]: entry["verdict"] for entry in found.report.document["audit"]}


@pytest.fixture(scope="module")
def clean() -> Outcome:
    return outcome(*drive())


def test_a_clean_drive_is_right_and_nothing_is_found(clean: Outcome) -> None:
    assert honest(clean)
    assert np.max(np.abs(clean.heading)) < 1 * DEG
    assert set(verdicts(clean).values()) == {"pass"}
    assert clean.report.document["faults"] == []
    assert clean.report.document["refused"] == []


@each_fault
def test_a_fault_is_found_and_named(name: str) -> None:
    fault, finding = FAULTS[name]
    truth, sensed = drive()
    found = outcome(truth, fault(sensed))
    told = {entry["name"]: entry for entry in found.report.document["audit"]}
    assert told[finding]["verdict"] == "fault", {k: v["value"] for k, v in told.items()}
    sentence = told[finding]["says"]
    assert sentence in found.report.document["faults"]
    assert "\n" not in sentence


@pytest.mark.parametrize("seconds", [1.0, -1.0, 18.0])
def test_the_clocks_are_told_by_how_much(seconds: float) -> None:
    truth, sensed = drive()
    found = outcome(truth, shifted(seconds)(sensed))
    (late,) = (e["value"] for e in found.report.document["audit"] if e["name"] == "clocks")
    assert abs(late - seconds) < 0.15
    (says,) = (s for s in found.report.document["faults"] if "--time-offset-s" in s)
    assert f"{'late' if seconds > 0 else 'early'} against" in says


@pytest.mark.parametrize("seconds", [1.0, -18.0])
def test_an_offset_is_found_from_far(seconds: float) -> None:
    found = likeliest_offset(logged(shifted(seconds)(drive()[1])), CONFIG)
    assert abs(found.value_s + seconds) < 3 * found.sigma_s < 0.05


def test_an_offset_that_does_not_show_is_refused() -> None:
    straight = drive(((10.0, 0.0, 0.0), (6.0, 9.0, 0.0), (100.0, 9.0, 0.0)))[1]
    with pytest.raises(DataError, match=r"did not settle; .*; accepted is a drive that turns"):
        likeliest_offset(logged(shifted(1.0)(straight)), CONFIG)


@pytest.mark.parametrize("off", [20.0, 100.0, 1.1e3, 1.6e5])
def test_one_fix_that_is_off_changes_nothing(clean: Outcome, off: float) -> None:
    truth, sensed = drive()
    for at in (150, 420):
        place = sensed.place.copy()
        place[at, 0] += off * METRE
        found = outcome(truth, sensed._replace(place=place))
        refused = [entry["fix"] for entry in found.report.document["refused"]]
        assert refused == [at + 1]
        assert honest(found)
        assert np.max(np.abs(found.away - clean.away)) < 1
        assert np.max(np.abs(found.heading - clean.heading)) < 1 * DEG


@pytest.mark.parametrize("heading", [40.0, also(170.0), also(-95.0)])
def test_reversing_before_the_drive_is_not_taken_for_its_direction(heading: float) -> None:
    found = outcome(*drive(REVERSED, seed=int(abs(heading)), heading_deg=heading))
    late = found.report.drive.time > 55
    assert np.max(np.abs(found.heading[late])) < 3 * DEG
    assert np.max(np.abs(found.heading) / found.sigma[:, 2]) < 3
    assert found.report.document["faults"] == []


def straight(seconds: float) -> tuple[Leg, ...]:
    start: tuple[Leg, ...] = ((10.0, 0.0, 0.0), (8.0, 14.0, 0.0), (seconds, 14.0, 0.0))
    return (*start, *AROUND[3:]) if seconds < 100 else start


@pytest.mark.parametrize("seconds", [30.0, also(60.0), also(120.0)])
def test_a_straight_start_leaves_the_mounting_alone(seconds: float) -> None:
    """The error of the heading, which nothing has seen, is not taken for the mounting."""
    truth, sensed = drive(straight(seconds), seed=4)
    found = outcome(truth, sensed)
    assert np.max(np.abs(found.heading) / found.sigma[:, 2]) < 3
    told = found.report.document["alignment"]["mounting_deg"]
    assert abs(told[2]) < 1.0
    velocity = np.asarray(found.report.kept.mean.velocity)
    time = found.report.drive.time
    true = np.stack([np.interp(time, truth.time, v) for v in truth.velocity.T], axis=1)
    at = found.report.drive.fix_step
    receiver = np.asarray(found.report.drive.channels["velocity"].z)[at, :2] - true[at, :2]
    assert np.std(velocity[:, :2] - true[:, :2]) <= np.std(receiver)


@pytest.mark.parametrize("speed", [5.0, also(15.0), also(30.0)])
def test_steady_motion_on_a_smooth_road_is_no_rest(speed: float) -> None:
    legs: tuple[Leg, ...] = ((10.0, 0.0, 0.0), (12.0, speed, 0.0), (90.0, speed, 0.0))
    truth, sensed = drive(legs, seed=2)
    rng = np.random.default_rng(0)
    smooth = sensed.accel.copy()
    quiet = sensed.time > 25
    smooth[quiet] = [0.05, -0.04, 9.865] + 0.01 * rng.normal(size=(quiet.sum(), 3))
    found = outcome(truth, sensed._replace(accel=smooth))
    late = found.report.drive.time > 25
    assert np.mean(found.report.drive.stopped[late]) <= 0.01
    assert found.report.drive.stopped.any() or found.report.drive.time[0] > 10


def test_positions_alone_are_enough() -> None:
    truth, sensed = drive()
    found = outcome(truth, sensed._replace(velocity=None))
    assert honest(found)
    assert np.max(np.abs(found.heading[found.report.drive.time > 60])) < 2 * DEG
    assert verdicts(found)["NIS, velocities"] == "not seen"


@pytest.mark.slow
def test_a_moving_start_with_a_manoeuvre_stays_honest() -> None:
    """The log begins in a bend: what the gyros turn is not taken for their drift."""
    truth, sensed = drive()
    for begin in (26.0, 31.0, 47.0):
        part, fixes = sensed.time >= begin, sensed.fix_time >= begin
        cut = Sensed(
            *(leaf[part] for leaf in sensed[:3]),
            *(np.asarray(leaf)[fixes] for leaf in sensed[3:]),
        )
        found = outcome(truth, cut._replace(time=cut.time - begin, fix_time=cut.fix_time - begin))
        # the truth's own clock goes on from where the log begins
        heading = heading_error(
            truth, found.report.drive.time + begin, np.asarray(found.report.kept.mean.dcm)
        )
        assert np.all(np.abs(heading) < 5 * found.sigma[:, 2]), begin


def test_a_jump_of_the_clock_is_refused() -> None:
    _, sensed = drive()
    time = sensed.time + np.where(sensed.time > 70, 3600.0, 0.0)
    fix_time = sensed.fix_time + np.where(sensed.fix_time > 70, 3600.0, 0.0)
    with pytest.raises(DataError, match=r"no inertial sample from 70 s to 36.*gaps of up to 60 s"):
        analyse(logged(sensed._replace(time=time, fix_time=fix_time)), CONFIG)


def test_coarse_stamps_are_refused() -> None:
    _, sensed = drive()
    with pytest.raises(DataError, match=r"80% of the samples repeat the time of the one before"):
        logged(sensed._replace(time=np.floor(sensed.time * 10) / 10))


def test_noise_that_is_stated_makes_no_fix_implausible() -> None:
    """A slow rover with a receiver of 5 m: the way of ten seconds is mostly noise."""
    legs: tuple[Leg, ...] = ((10.0, 0.0, 0.0), (6.0, 3.5, 0.0), (100.0, 3.5, 5.0))
    _, sensed = drive(legs, seed=5)
    rng = np.random.default_rng(6)
    noise = 5.0 * METRE * rng.normal(size=sensed.place.shape) * [1.0, 1.5, 0.0]
    log = logged(sensed._replace(place=sensed.place + noise, sigma=np.full_like(sensed.sigma, 5.0)))
    assert len(log.fixes.time_ns) == len(sensed.fix_time)


@pytest.mark.slow
def test_a_roll_at_a_moving_start_is_no_drift() -> None:
    """A lean of twelve degrees and back, at up to nine degrees a second."""
    truth, sensed = drive()
    begin = 52.0
    part, fixes = sensed.time >= begin, sensed.fix_time >= begin
    cut = Sensed(
        *(leaf[part] for leaf in sensed[:3]), *(np.asarray(leaf)[fixes] for leaf in sensed[3:])
    )
    time = cut.time - begin
    lean = 12 * DEG * np.sin(2 * np.pi * time / 8) * (time < 4)
    sine, cosine = np.sin(lean), np.cos(lean)
    leant = [v @ np.diag([1.0, 0.0, 0.0]) for v in (cut.gyro, cut.accel)]
    for out, v in zip(leant, (cut.gyro, cut.accel), strict=True):
        out[:, 1] = cosine * v[:, 1] + sine * v[:, 2]
        out[:, 2] = -sine * v[:, 1] + cosine * v[:, 2]
    leant[0][:, 0] += np.gradient(lean, time)
    rolled = cut._replace(time=time, gyro=leant[0], accel=leant[1], fix_time=cut.fix_time - begin)
    found = outcome(truth, rolled)
    heading = heading_error(
        truth, found.report.drive.time + begin, np.asarray(found.report.kept.mean.dcm)
    )
    assert np.all(np.abs(heading) < 5 * found.sigma[:, 2])
    drift = np.asarray(found.report.document["filter"]["gyro_drift_dps"])
    assert np.max(np.abs(drift)) < 0.5


def test_heights_in_feet_and_baselines_for_degrees_are_refused() -> None:
    _, sensed = drive()
    assert sensed.velocity is not None
    hill = 20 * np.sin(sensed.fix_time / 12)
    climb = 20 / 12 * np.cos(sensed.fix_time / 12)
    level = sensed.place * [1.0, 1.0, 0.0]
    up = np.stack([0 * climb, 0 * climb, climb], axis=1)
    hilly = sensed._replace(velocity=sensed.velocity + up)
    for unit, refused in ((1.0, False), (3.28084, True)):
        place = level + np.stack([0 * hill, 0 * hill, unit * (300 + hill)], axis=1)
        if not refused:
            logged(hilly._replace(place=place))
            continue
        with pytest.raises(DataError, match=r"heights change 3\.\d+ times as fast as the vertical"):
            logged(hilly._replace(place=place))
    rng = np.random.default_rng(7)
    baseline = np.array([12 * DEG, -30 * DEG, 2.0])
    parked = baseline + np.deg2rad(0.004) * rng.normal(size=sensed.place.shape) * [1, 1, 0]
    parked = sensed._replace(place=parked, velocity=None, sigma=np.full_like(sensed.sigma, 0.004))
    with pytest.raises(
        DataError, match=r"jump to and fro by 1\.\d+e\+03 m, .* baselines in metres"
    ):
        logged(parked)
