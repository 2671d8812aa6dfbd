"""``jaxnav tune``: its document, its outputs, and what it says to bad input."""

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.cli import BAD_INPUT, OK, main
from jaxnav.config import ConfigError
from jaxnav.estimation.tune.transforms import POSITIVE
from jaxnav.studies.tuned import Measure, Parameter, Problem
from jaxnav.tuning.analysis import tune as run_tuning
from jaxnav.tuning.config import TuneConfig, parse_bounds, parse_start

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
LOG = DATA / "rtk_drive" / "gnss_1934_sf.pos"
recorded = pytest.mark.skipif(not LOG.is_file(), reason="no recorded drive in ../shared/data")


def tune(*arguments: object) -> int:
    """Tune the recorded track."""
    return main(["tune", "gnss-track", "--study.log", str(LOG), *map(str, arguments)])


@recorded
def test_a_track_is_tuned_and_judged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The bank fitted on the first half predicts the second better than every hand-set rule."""
    assert (
        tune(
            "--out",
            tmp_path,
            "--optimiser",
            "adam",
            "--steps",
            25,
            "--check-gradient",
            "--profile-points",
            3,
        )
        == OK
    )
    said = capsys.readouterr().out
    assert "25 evaluations, 0 taken back" in said
    document = json.loads((tmp_path / "summary.json").read_text())
    assert document["command"] == "tune"
    assert document["parameters"]["switching"]["start"] == 0.02
    assert document["gradient_check"]["largest_deviation"] < 1e-6
    assert document["loss"]["tuned"] < document["loss"]["start"]
    verdict = document["held_out"]["second half of the track"]
    assert {"hand-set", "floor", "immae", "kf-1"} < set(verdict["tuned_over"])
    for rival in verdict["tuned_over"].values():
        assert rival["low"] > 0
    arrays = np.load(tmp_path / "tuning.npz")
    assert arrays["history"].shape == (26,)
    assert arrays["profile_loss"].shape == (6, 3)
    for name in ("descent.png", "profiles.png", "held_out.png"):
        assert (tmp_path / name).stat().st_size > 10_000


def test_what_can_be_tuned_is_listed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["tune", "immae", "--list", "--study.duration-s", "6"]) == OK
    said = capsys.readouterr().out
    for word in ("reset_threshold", "0.9", "between 0 and 1", "weight that allows"):
        assert word in said
    assert not list(tmp_path.iterdir())


@recorded
def test_what_is_not_tuned_stays(tmp_path: Path) -> None:
    options = ("--params", "switching", "--start", "q=0.02,0.1,1,9")
    few = ("--steps", 15, "--profile-points", 0, "--bounds", "switching=0.001:0.3")
    assert tune("--out", tmp_path, *options, *few, "--json") == OK
    found = json.loads((tmp_path / "summary.json").read_text())["parameters"]
    assert found["q"]["tuned"] == [0.02, 0.1, 1.0, 9.0]
    assert found["position_sigma"]["tuned"] == 0.02
    assert 0.001 < found["switching"]["tuned"] < 0.3
    assert found["switching"]["tuned"] != 0.02


@recorded
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--params", "theta"), "no parameter 'theta'; it must be one of q, position_sigma, switc"),
        (("--start", "speed=1"), "no parameter 'speed'; it must be one of q, position_sigma"),
        (("--bounds", "switching=0.1:2"), "bounds of switching is 0.1:2; it must be between 0 and"),
        (("--bounds", "q=0.1:1"), r"start of q is [0.01, 0.1, 1.0, 10.0]; it must be between 0.1"),
        (("--bounds", "switching=0.5"), "'switching=0.5'; it must be given as NAME=LOW:HIGH"),
        (("--bounds", "switching=0.5:0.1"), "it must be finite, LOW below HIGH"),
        (("--start", "switching=1.5"), "start of switching is 1.5; it must be between 0 and 1"),
        (("--start", "q=1,2"), "start of q is 1.0,2.0; it must be 4 numbers"),
        (("--start", "q=1,2,x,4"), "'x' in 'q=1,2,x,4' is no number"),
        (("--start", "switching"), "start is 'switching'; it must be given as NAME=VALUE"),
        (("--steps", "0"), "steps is 0; it must be at least 1"),
        (("--profile-points", "4"), "--profile-points is 4; it must be 0, or odd and at least 3"),
        (("--held-out-runs", "1"), "--held-out-runs is 1; it must be at least 2"),
    ],
)
def test_bad_input_is_one_sentence(
    arguments: tuple[str, ...],
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert tune("--out", tmp_path / "out", *arguments) == BAD_INPUT
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not list(tmp_path.rglob("summary.json"))


@recorded
def test_a_drive_is_tuned_from_its_configuration_file(tmp_path: Path) -> None:
    """The noise of the receiver alone; what the file says is where it starts."""
    file = tmp_path / "bank.toml"
    file.write_text("gyro_noise_dps = 0.2\nr_factors = [3.0]\nnoise_rate_hz = 5.0\n")
    options = ("--study.config", str(file), "--params", "r_factors", "--steps", "8")
    rest = ("--profile-points", "0", "--out", str(tmp_path), "--json")
    assert main(["tune", str(LOG.parent), *options, *rest]) == OK
    document = json.loads((tmp_path / "summary.json").read_text())
    found = document["parameters"]
    assert found["gyro_noise_dps"]["tuned"] == 0.2
    assert found["r_factors"]["start"] == [3.0]
    assert 0.1 < found["r_factors"]["tuned"][0] < 2.0
    assert 0 < found["r_factors"]["sigma"][0] < 0.2
    assert document["loss"]["tuned"] < document["loss"]["start"]
    (verdict,) = document["held_out"].values()
    assert verdict["methods"]["tuned"]["value"] > verdict["methods"]["hand-set"]["value"]


def test_what_is_neither_study_nor_log(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tune", "no-such-thing"]) == BAD_INPUT
    said = capsys.readouterr().err
    assert "no study or log 'no-such-thing'; it must be one of immae" in said
    assert said.endswith("or a recorded drive\n")
    assert main(["tune"]) == BAD_INPUT
    assert main(["tune", "gnss-track"]) == BAD_INPUT
    assert "log is not given" in capsys.readouterr().err
    assert main(["tune", "immae", "--help"]) == OK
    assert "--study.reset-period-s" in capsys.readouterr().out


def test_a_loss_that_starts_non_finite_is_named() -> None:
    """A filter that fails is ruled out and leaves its bank finite, so the loss is made here."""
    problem = Problem(
        parameters={"a": Parameter(1.0, POSITIVE, "a number")},
        draw=lambda key, runs: jnp.zeros(()),
        loss=lambda values, data: values["a"] * jnp.nan,
        hard=None,
        held_out={},
        measure=Measure("mean", "nothing", "1"),
    )
    for optimiser in ("adam", "lbfgs"):
        with pytest.raises(ConfigError, match="the loss nan or its gradient is not finite at"):
            run_tuning("none", {}, problem, TuneConfig(optimiser=optimiser))


def test_runs_held_out_that_diverge_are_counted() -> None:
    """And bounds hold: the loss falls towards zero, the parameter stays above a half."""
    problem = Problem(
        parameters={"a": Parameter(1.0, POSITIVE, "a number")},
        draw=lambda key, runs: jnp.zeros(()),
        loss=lambda values, data: values["a"] ** 2 + data,
        hard=None,
        held_out={
            "three runs": lambda values, key, runs: {
                "tuned": np.array([1.0, 2.0, 3.0]),
                "hand-set": np.array([1.0, np.nan, 3.0]),
            }
        },
        measure=Measure("mean-square", "nothing", "1"),
        fresh=True,
    )
    report = run_tuning("none", {}, problem, TuneConfig(bounds=("a=0.5:2",), steps=40))
    assert report.document["diverged"] == 1
    assert any("diverged in 1 of" in note for note in report.document["notes"])
    assert 0.5 < report.fit.params["a"] < 0.6
    assert report.fit.validation[0, 0] == 0


def test_starts_and_bounds_are_read() -> None:
    assert parse_start(("a=1,2.5", "b=-3e-4")) == {"a": (1.0, 2.5), "b": (-3e-4,)}
    assert parse_bounds(("a=-1:2",)) == {"a": (-1.0, 2.0)}
    with pytest.raises(ConfigError, match="a is inf; it must be finite"):
        parse_start(("a=inf",))
    with pytest.raises(ConfigError, match=r"rate is 0\.0; it must be positive"):
        TuneConfig(rate=0)
