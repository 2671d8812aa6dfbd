"""`jaxnav filter`: a simulated drive from preparation to files, and the recorded ones."""

import csv
import json
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from checks import outlying_fixes
from jaxnav.cli import main
from jaxnav.compiling import compiled
from jaxnav.config import ConfigError
from jaxnav.datasets.base import DataError
from jaxnav.datasets.drive import DriveLog, Reference
from jaxnav.datasets.formats import load_drive
from jaxnav.datasets.inertial import assemble
from jaxnav.datasets.track import GnssTrack
from jaxnav.estimation.filters.linearise import jacobians
from jaxnav.navigation.earth import displaced
from jaxnav.navigation.models.sins_gnss import SinsGnssInput, SinsGnssParams
from jaxnav.navigation.models.vehicle import VehicleInput, VehicleParams, vehicle
from jaxnav.navigation.states import LevelError, SinsLevel
from jaxnav.navigation.trajectory.vehicle import Leg, VehicleProfile, drive
from jaxnav.numerics.lie import so3_exp
from jaxnav.options import parse_filter
from jaxnav.recorded.analysis import Report, analyse
from jaxnav.recorded.config import FilterConfig, check
from jaxnav.recorded.figures import draw
from jaxnav.recorded.methods import member_names, rule_params
from jaxnav.recorded.motion import still_samples
from jaxnav.recorded.outputs import write_trajectory
from jaxnav.recorded.preparation import prepare
from jaxnav.recorded.scoring import attitude_angles, diverged, horizontal
from jaxnav.recorded.tuning import likeliest_offset
from jaxnav.units import DEG

RATE = 50
INJECTED = 0.083
"""The receiver's clock is late by so much in the simulated drive [s]."""
LEGS = (
    *(Leg(8.0, 0.0), Leg(6.0, 12.0), Leg(14.0, 12.0), Leg(5.0, 5.0), Leg(6.0, 5.0, 90 * DEG)),
    *(Leg(6.0, 15.0), Leg(16.0, 15.0), Leg(6.0, 6.0), Leg(6.0, 6.0, -90 * DEG), Leg(6.0, 14.0)),
    *(Leg(14.0, 9.0), Leg(5.0, 0.0), Leg(10.0, 0.0), Leg(6.0, 8.0), Leg(12.0, 11.0)),
)
SECONDS = 124

NOTHING, ONES = jnp.zeros(3), jnp.ones(3)
SENSORS = SinsGnssParams(ONES, ONES, ONES, ONES, ONES, ONES, NOTHING)
PARAMS = VehicleParams(
    inner=SENSORS,
    time_offset=jnp.array(0.0),
    mounting=NOTHING,
    axle=NOTHING,
    steered_noise=ONES[:2],
    rest_noise=jnp.array(0.05),
    rest_speed=jnp.array(1.0),
)


@cache
def simulated() -> tuple[DriveLog, SinsLevel]:
    """A drive with stops and bends, drifts, noise and a late receiver; and its true motion."""
    count = RATE * SECONDS
    true = drive(VehicleProfile(LEGS), steps=count, step=1 / RATE)
    rng = np.random.default_rng(3)
    gyro, accel = (
        RATE * np.concatenate([x[:1], 0.5 * (x[:-1] + x[1:]), x[-1:]])
        for x in (np.asarray(true.dtheta), np.asarray(true.dvel))
    )
    gyro += np.array([0.2, -0.3, 0.4]) * DEG + 0.02 * DEG * rng.normal(size=gyro.shape)
    accel += np.array([0.05, -0.04, 0.06]) + 0.02 * rng.normal(size=accel.shape)
    time_ns = np.rint(np.asarray(true.time) * 1e9).astype(np.int64)
    at = np.arange(0, count, RATE // 5)
    position, velocity = (np.asarray(x)[at] for x in (true.state.position, true.state.velocity))
    off = jnp.array(0.02 * rng.normal(size=position.shape))
    fixes = GnssTrack(
        time_ns=time_ns[at] + round(INJECTED * 1e9),
        geodetic=np.asarray(jax.vmap(displaced)(jnp.array(position), off)),
        velocity=velocity + 0.05 * rng.normal(size=velocity.shape),
        position_sigma=np.full(position.shape, 0.02),
        velocity_sigma=None,
        quality=np.ones(len(at), np.int64),
        source="simulated",
        duplicates=0,
    )
    geodetic, moving, dcm = (np.asarray(true.state[i]) for i in (2, 1, 0))
    reference = Reference(time_ns, geodetic, moving, dcm)
    imu = assemble(time_ns, np.hstack([gyro, accel]), "simulated")
    log = DriveLog(imu, fixes, np.zeros(3), reference, 0, "simulated <&> drive")
    state = SinsLevel(*true.state, jnp.zeros((count + 1, 3)), jnp.zeros((count + 1, 3)))
    return log, state


QUIET = FilterConfig(
    gyro_noise_dps=0.01,
    accel_noise_ug=500.0,
    position_sigma_m=0.02,
    velocity_sigma=0.05,
    time_offset_s=-INJECTED,
)
BANK = replace(QUIET, r_factors=(1.0, 100.0), rate_hz=10.0, outages="on", outage_every_s=30.0)


@pytest.fixture(scope="module")
def report() -> Report:
    """The simulated drive through a bank of two, with outages."""
    return analyse(simulated()[0], BANK)


@pytest.mark.parametrize("form", ["additive", "left-invariant", "right-invariant"])
def test_jacobian_of_all_channels_agrees_with_the_automatic_one(form: LevelError) -> None:
    rng = np.random.default_rng(1)
    origin = jnp.array([0.7, -1.8, 1600.0])
    x = SinsLevel(
        so3_exp(jnp.array([0.3, -0.2, 1.1])),
        jnp.array([9.0, -4.0, 0.5]),
        origin + jnp.array([1e-5, -2e-5, 3.0]),
        jnp.array(rng.normal(size=3) * 1e-2),
        jnp.array(rng.normal(size=3) * 0.2),
    )
    turn, force = jnp.array([0.1, -0.2, 0.6]), jnp.array([2.0, 1.0, 9.8])
    u = VehicleInput(
        SinsGnssInput(0.02 * turn, 0.02 * force, turn, jnp.array(0.02)),
        jnp.array(0.02),
        jnp.array(2.0),
    )
    params = PARAMS._replace(
        inner=SENSORS._replace(lever_arm=jnp.array([0.3, 0.1, 0.6])),
        time_offset=jnp.array(-0.05),
        mounting=jnp.array([0.02, 0.05, -0.03]),
        axle=jnp.array([-1.2, 0.1, -1.0]),
    )
    model = vehicle(form, origin)
    own, automatic = compiled(
        lambda x: [
            jacobians(m, params, x, u, 15)[1] for m in (model, model._replace(jacobians=None))
        ]
    )(x)
    # What is left out is Earth rate beside the turning of a car, and how metres per radian change.
    np.testing.assert_allclose(own, automatic, atol=2e-4)
    assert np.linalg.matrix_rank(own) >= 9


def test_observation_is_that_of_the_time_of_the_fix() -> None:
    """Along a bend, an observation with a lag is that of the later state to second order."""
    _, true = simulated()
    k, later = 35 * RATE, 2
    x, ahead = (jax.tree.map(lambda leaf, i=i: leaf[i], true) for i in (k, k + later))
    acceleration = RATE * (true.velocity[k + 1] - true.velocity[k])
    felt = x.dcm.T @ (acceleration + jnp.array([0.0, 0.0, 9.797]))
    still = jnp.zeros(3)
    u = VehicleInput(
        SinsGnssInput(still, 0.02 * felt, still, jnp.array(0.02)),
        jnp.array(later / RATE - 0.01),
        jnp.array(1.0),
    )
    params = PARAMS._replace(time_offset=jnp.array(0.01))
    model = vehicle(constrained=False)
    off = model.residual(
        jnp.concatenate([ahead.velocity, ahead.position]), model.observe(params, x, u)
    )
    assert float(jnp.linalg.norm(acceleration)) > 1
    assert np.abs(off[:3]).max() < 0.02
    assert np.abs(off[3:]).max() < 0.003


def test_stops_are_found_and_no_change_of_motion() -> None:
    log, true = simulated()
    speed = np.linalg.norm(np.asarray(true.velocity), axis=1)
    still = still_samples(log.imu, FilterConfig())
    acceleration = np.gradient(np.asarray(true.velocity), 1 / RATE, axis=0)
    changes = np.linalg.norm(acceleration, axis=1) > 1.0
    assert changes.mean() > 0.2
    assert not still[changes].any()
    assert np.mean(still[(speed == 0) & (np.arange(len(speed)) > 3 * RATE)]) > 0.6
    assert still[speed > 10].any(), "a smooth road feels like a stop, and the model has to know"


def test_a_stop_is_not_believed_at_speed() -> None:
    _, true = simulated()
    x = jax.tree.map(lambda leaf: leaf[0], true)
    u = jax.tree.map(lambda leaf: leaf[0], prepare(simulated()[0], QUIET, 10.0).inputs)
    model = vehicle()
    rest = model.channel("rest")
    sigma = [
        np.sqrt(model.observation_noise(PARAMS, x._replace(velocity=jnp.array([v, 0, 0])), u))[rest]
        for v in (0.0, 1.0, 12.0, 1e4)
    ]
    np.testing.assert_allclose(sigma[0], 0.05)
    np.testing.assert_allclose(sigma[1], 0.05 * np.exp(0.5))
    assert sigma[2].min() > 1e6
    assert np.isfinite(sigma[3]).all()


def test_each_fix_is_observed_in_the_nearest_period() -> None:
    log, _ = simulated()
    ready = prepare(log, QUIET, 7.0)
    fix_time = (log.fixes.time_ns[ready.fix] - log.imu.time_ns[0]) / 1e9 - INJECTED
    lag = np.asarray(ready.inputs.lag)[ready.fix_step]
    np.testing.assert_allclose(ready.time[ready.fix_step] + lag, fix_time, atol=1e-9)
    assert np.abs(lag).max() <= 0.5 / 7 + 1e-9
    assert len(set(ready.fix_step)) == len(ready.fix_step)
    fixed = [ready.channels[name].valid.any(axis=1) for name in ("velocity", "position")]
    assert (fixed[0] | fixed[1]).sum() == len(ready.fix)
    assert not ready.channels["rest"].valid[~ready.stopped].any()
    assert ready.at_rest


def test_a_drive_that_never_moves_is_refused() -> None:
    log, _ = simulated()
    velocity = log.fixes.velocity
    assert velocity is not None
    slow = log._replace(fixes=log.fixes._replace(velocity=0.01 * velocity))
    with pytest.raises(DataError, match=r"at most 0\.15.* m/s fast; accepted is a drive"):
        prepare(slow, QUIET)


def test_the_likeliest_offset_is_the_injected_one() -> None:
    found = likeliest_offset(simulated()[0], replace(QUIET, time_offset_s=0.02))
    assert abs(found.value_s + INJECTED) < 0.003
    assert 0 < found.sigma_s < 0.003


def test_bank_of_a_simulated_drive_finds_the_truth(report: Report) -> None:
    assert not report.document["diverged"]
    scores = report.document["reference"]
    assert scores["horizontal_rms_m"] < 0.05
    assert scores["roll_rms_deg"] < 0.3
    assert scores["pitch_rms_deg"] < 0.3
    assert scores["heading_rms_deg"] < 1.0
    assert 0.5 < report.document["filter"]["nis_per_channel"] < 1.5
    assert np.abs(report.document["alignment"]["mounting_deg"]).max() < 0.5
    weights = np.asarray(report.kept.weights)
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-12)
    assert weights[-1, 0] > 0.9, "the receiver is as good as it says"


def test_constraints_carry_the_filter_over_outages(report: Report) -> None:
    assert report.outages is not None
    free, held = (report.outages.at_end[name] for name in ("inertial", "constrained"))
    assert len(free) == len(held) >= 1
    assert np.median(held) < np.median(free)
    assert np.isfinite(report.outages.error["inertial"]).all()


def test_diverged_needs_ten_seconds_of_far_fixes(report: Report) -> None:
    drive_, kept = report.drive, report.kept
    assert not diverged(kept, drive_)
    lost = kept.mean._replace(velocity=kept.mean.velocity.at[-1, 0].set(jnp.nan))
    assert diverged(kept._replace(mean=lost), drive_)
    for fixes, verdict in ((20, False), (60, True)):
        part = kept.parts["position"]
        far = part.innovation.at[jnp.asarray(drive_.fix_step[50 : 50 + fixes]), 0].set(150.0)
        parts = {**kept.parts, "position": part._replace(innovation=far)}
        assert diverged(kept._replace(parts=parts), drive_) is verdict


def test_files_parse_back(report: Report, tmp_path: Path) -> None:
    log, _ = simulated()
    paths = write_trajectory(report.drive, report.kept, report.members, log.source, tmp_path)
    with paths[0].open(newline="") as file:
        rows = list(csv.DictReader(file))
    arrays = np.load(paths[1])
    assert len(rows) == len(arrays["time"]) == len(report.drive.time)
    k = len(rows) // 2
    assert abs(float(rows[k]["latitude [deg]"]) * DEG - arrays["position"][k, 0]) < 1e-11
    assert abs(float(rows[k]["velocity_north [m/s]"]) - arrays["velocity"][k, 1]) < 1e-5
    heading = attitude_angles(arrays["dcm"][k : k + 1])[0, 2] / DEG % 360
    assert abs(float(rows[k]["heading [deg]"]) - heading) < 1e-4
    assert arrays["member"].tolist() == report.members == ["R x1", "R x100"]
    tree = ElementTree.parse(paths[2])
    space = "{http://www.opengis.net/kml/2.2}"
    assert tree.findtext(f".//{space}name") == "simulated <&> drive"
    points = (tree.findtext(f".//{space}coordinates") or "").split()
    longitude, latitude, _ = (float(part) for part in points[0].split(","))
    first = arrays["position"][0] / DEG
    assert abs(latitude - first[0]) < 1e-7
    assert abs(longitude - first[1]) < 1e-7


def test_figures_are_drawn(report: Report, tmp_path: Path) -> None:
    paths = draw(report, simulated()[0], tmp_path)
    names = {path.name for path in paths}
    assert names == {"track.png", "errors.png", "nis.png", "weights.png", "outages.png"}
    assert all(path.stat().st_size > 10_000 for path in paths)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (
            "filtre = 'ekf'",
            "there is no 'filtre', did you mean 'filter'; it must be one of",
        ),
        ("config = 'x'", "there is no 'config'"),
        ("filter = 3", "filter is 3; it must be a text"),
        ("carry = 'mounting'", "carry is 'mounting'; it must be a list of texts"),
        ("r_factors = 2.0", "r_factors is 2.0; it must be a list of numbers"),
        ("axle_m = [1.0, 2.0]", r"axle_m is \[1.0, 2.0\]; it must be three numbers"),
        ("seed = 1.5", "seed is 1.5; it must be a whole number"),
        ("constraints = 1", "constraints is 1; it must be true or false"),
        ("gyro_noise_dps = true", "gyro_noise_dps is True; it must be a number"),
        ("seed = ", "is not TOML"),
    ],
)
def test_toml_refusals(write: Callable[..., Path], line: str, message: str) -> None:
    path = write(line, name="bank.toml")
    with pytest.raises(ConfigError, match=message) as caught:
        parse_filter(["--config", str(path)])
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_flags_go_before_the_file(write: Callable[..., Path]) -> None:
    path = write(
        "filter = 'sage-husa-ekf'",
        "forgetting = [0.9, 0.99]",
        "q_factors = [1, 10]",
        "mounting_deg = [0, 1, 2]",
        "rate_hz = 20",
        name="bank.toml",
    )
    parsed = parse_filter(["--config", str(path), "--rate-hz", "25", "--q-factors", "2"])
    assert parsed is not None
    assert parsed.config == replace(
        FilterConfig(),
        config=path,
        filter="sage-husa-ekf",
        forgetting=(0.9, 0.99),
        q_factors=(2.0,),
        mounting_deg=(0.0, 1.0, 2.0),
        rate_hz=25.0,
    )
    check(parsed.config)
    assert member_names(parsed.config) == ["b 0.9", "b 0.99"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"forgetting": (0.9, 0.99)}, "one factor for ekf"),
        ({"r_factors": ()}, "r_factors is"),
        ({"weight_floor": 0.6, "r_factors": (1.0, 2.0)}, "below the equal weight of the 2 members"),
        ({"outage_every_s": 10.0}, "above outage_s"),
        ({"noise_end_s": (100.0, 420.0)}, "noise_end_s is"),
        ({"noise_sigma_m": (1.0,)}, "noise_start_s is"),
        ({"time_offset_s": float("nan")}, "time_offset_s is nan; it must be finite"),
        ({"rule": "vote"}, "rule is vote; it must be one of floor, bayes"),
    ],
)
def test_parameters_out_of_range_are_refused(changes: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        check(replace(FilterConfig(), **changes))


def test_rules_that_forget_do_so_in_time_not_in_steps() -> None:
    slow, fast = (
        [rule_params(replace(FilterConfig(), rule=rule), period) for rule in ("forget", "markov")]
        for period in (0.1, 0.01)
    )
    assert abs(float(slow[0][0]) - float(fast[0][0]) ** 10) < 1e-12
    assert abs((1 - float(slow[1][0])) - (1 - float(fast[1][0])) ** 10) < 1e-12


def test_command_line_refuses_what_is_no_drive(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["filter", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "no recorded drive; accepted are" in capsys.readouterr().err
    assert main(["filter"]) == 2
    assert main(["filter", "--help"]) == 0
    assert "--outage-every-s" in capsys.readouterr().out
    assert main(["filter", str(tmp_path), "--config", str(tmp_path / "no.toml")]) == 2
    assert "no such file" in capsys.readouterr().err


DATA = Path(__file__).parents[2] / "shared" / "data"


def recorded(name: str) -> DriveLog:
    """A recorded drive, or the reason why it is not there."""
    path = DATA / name
    if not path.is_dir():
        pytest.skip(f"{path} is not there; {name} is recorded data that is not part of the project")
    return load_drive(path)


@pytest.mark.slow
def test_rtk_drive_at_full_rate_through_outages(tmp_path: Path) -> None:
    log = recorded("rtk_drive")
    code = main(["filter", str(DATA / "rtk_drive"), "--out", str(tmp_path), "--json"])
    document = json.loads((tmp_path / "summary.json").read_text())
    assert code == 0
    assert document["schema"] == 1
    assert document["diverged"] is False
    assert document["counts"]["samples"] == len(log.imu.time_ns) == 54858
    errors = document["outages"]["horizontal_m"]
    assert document["outages"]["length_s"] == 15
    assert len(errors["inertial"]["all"]) >= 10
    assert errors["inertial"]["median"] < 12
    assert errors["constrained"]["median"] < 5


@pytest.mark.slow
def test_adaptive_banks_beat_the_fixed_filter_under_added_noise() -> None:
    config = replace(FilterConfig(), outages="off", rate_hz=10.0, added_noise=True)
    scores = analyse(recorded("rtk_drive"), config).document["added_noise"]
    for span in range(2):
        for bank in ("mmae", "bank-floor", "bank-penalty"):
            for axis in ("mse_east", "mse_north"):
                fixed, own = (scores["methods"][name][span][axis] for name in ("ekf", bank))
                margin = 3 * (fixed["se"] ** 2 + own["se"] ** 2) ** 0.5
                assert own["value"] + margin < fixed["value"], (span, bank, axis)


@pytest.mark.slow
def test_comma2k19_against_its_reference() -> None:
    scores = analyse(recorded("comma2k19"), FilterConfig()).document["reference"]
    assert scores["roll_rms_deg"] < 1.5
    assert scores["pitch_rms_deg"] < 1.5
    assert scores["horizontal_rms_m"] <= scores["receiver_horizontal_rms_m"]


@pytest.mark.slow
def test_rtk_drive_tells_its_time_offset() -> None:
    """The likelihood at twice the rate is highest near what the search finds."""
    log = recorded("rtk_drive")
    found = likeliest_offset(log, FilterConfig())

    def likelihood(offset: float) -> float:
        config = FilterConfig(time_offset_s=offset, outages="off", constraints=False, rate_hz=20.0)
        return analyse(log, config).document["filter"]["log_likelihood"]

    here = likelihood(found.value_s)
    assert likelihood(found.value_s - 0.1) < here
    assert likelihood(found.value_s + 0.1) < here


def test_horizontal_is_the_distance_in_the_plane() -> None:
    np.testing.assert_array_equal(horizontal(np.array([[3.0, 4.0, 9.0]])), [5.0])


@pytest.mark.slow
def test_one_fix_that_is_off_leaves_the_recorded_drive_alone() -> None:
    """A sample of ``checks/outlying_fixes.py``: four of its eighty cases for the ekf."""
    log = recorded("rtk_drive")
    config = FilterConfig(outages="off", rate_hz=25.0)
    clean = analyse(log, config)
    assert clean.document["refused"] == []
    for i, off in outlying_fixes.FEW:
        fix = int(outlying_fixes.places(clean.drive)[i])
        report = analyse(outlying_fixes.moved(log, fix, off), config)
        found = outlying_fixes.compared(clean, report, fix)
        assert outlying_fixes.good(found), (fix, off, found)
