"""`jaxnav allan`: what it prints and writes, and its answers to bad input."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav import cli
from jaxnav.cli import BAD_INPUT, OK, main
from jaxnav.navigation.sensors.imu import NoiseModel, sensor_noise
from jaxnav.units import DEG_PER_HOUR, DEG_PER_SQRT_HOUR

STEP, COUNT = 0.01, 20000
TRUTH = {
    "gyro": {"angle_random_walk": 0.3, "rate_random_walk": 900.0},
    "accel": {"velocity_random_walk": 0.06, "acceleration_random_walk": 0.3},
}
UNITS = {
    "gyro": ["deg/sqrt(h)", "deg/h", "deg/h/sqrt(h)", "arcsec"],
    "accel": ["m/s/sqrt(h)", "ug", "m/s^2/sqrt(h)", "m/s"],
}
HEADER = "time [s],gyro_x [rad/s],gyro_y [rad/s],gyro_z [rad/s]," + (
    "accel_x [m/s^2],accel_y [m/s^2],accel_z [m/s^2]"
)


@pytest.fixture(autouse=True)
def _leave_jax_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """The suite has set JAX up; a process may do so only once."""
    monkeypatch.setattr(cli, "configure_jax", lambda **options: None)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """200 s at rest with a gap, a repeated row and a lost one."""
    path = tmp_path_factory.mktemp("log") / "rest.csv"
    gyro, accel = (
        sensor_noise(jax.random.key(seed), NoiseModel(0.0, jnp.full(3, N), 0.0, K), STEP, COUNT)
        for seed, N, K in (
            (1, 0.3 * DEG_PER_SQRT_HOUR, 900 * DEG_PER_HOUR / 60),
            (2, 0.06 / 60, 0.3 / 60),
        )
    )
    table = np.column_stack([np.arange(COUNT) * STEP, gyro, accel + jnp.array([[0.1, 0.0, 9.8]])])
    table[40, 5] = np.nan
    table = np.delete(np.insert(table, 50, table[50], axis=0), slice(5000, 5100), axis=0)
    np.savetxt(path, table, delimiter=",", header=HEADER, comments="", fmt="%.12g")
    return path


def test_coefficients_are_printed_and_written(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["allan", str(log), "--out", str(tmp_path)]) == OK
    said = capsys.readouterr().out
    for word in ("gyros", "accelerometers", "deg/h", "1 duplicates", "1 gaps of 100 samples"):
        assert word in said
    document = json.loads((tmp_path / "summary.json").read_text())
    assert (document["schema"], document["command"]) == (1, "allan")
    counts = {"duplicates": 1, "nan_rows": 1, "gaps": 1, "missing": 100, "spikes": 0}
    assert document["counts"] == counts
    assert document["samples"] == COUNT
    assert document["provenance"]["x64"] is True
    assert document["notes"] == []
    assert list(document["axes"]) == [f"{s}_{axis}" for s in ("gyro", "accel") for axis in "xyz"]
    for axis, entries in document["axes"].items():
        sensor = axis.split("_")[0]
        assert [entry["unit"] for entry in entries.values()] == UNITS[sensor]
        for entry in entries.values():
            assert 0 <= entry["low"] <= entry["value"] <= entry["high"]
        for name, value in TRUTH[sensor].items():
            # Of 12 intervals of 95 % one or two may miss; none may miss by its own width.
            entry = entries[name]
            width = entry["high"] - entry["low"]
            assert entry["low"] - width < value < entry["high"] + width
    with np.load(tmp_path / "allan.npz") as arrays:
        assert arrays["axis"].tolist() == list(document["axes"])
        assert arrays["deviation"].shape == (6, len(arrays["tau"]))
        assert np.all(arrays["low"] < arrays["deviation"])
        assert np.all(arrays["deviation"] < arrays["high"])
        np.testing.assert_allclose(arrays["tau"][0], STEP)
        near = arrays["fit_deviation"][:, 0] / arrays["deviation"][:, 0]
        np.testing.assert_allclose(near, 1, rtol=0.02)
    assert (tmp_path / "allan.png").stat().st_size > 10_000


def test_json_window_and_confidence(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--json", "--start-s", "60", "--end-s", "90", "--confidence", "0.5")
    options += ("--per-octave", "2")
    assert main(["allan", str(log), *options, "--out", str(tmp_path)]) == OK
    document = json.loads(capsys.readouterr().out)
    assert document == json.loads((tmp_path / "summary.json").read_text())
    assert document["window"] == {"start_s": 60, "end_s": 90}
    assert document["samples"] == 3001
    assert document["counts"]["gaps"] == 0
    assert (document["confidence"], document["per_octave"]) == (0.5, 2)
    with np.load(tmp_path / "allan.npz") as arrays:
        np.testing.assert_allclose(arrays["tau"][:6], STEP * np.array([1, 2, 3, 4, 6, 8]))


def test_a_sensor_that_moves_or_is_stuck_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    count = 4000
    time = np.arange(count) * STEP
    table = np.random.default_rng(1).normal(size=(count, 6)) * 1e-3 + [0, 0, 0, 0, 0, 9.8]
    table[:, 1] += np.sin(2 * np.pi * 3 * time)
    table[:, 3] = 0.0
    path = tmp_path / "moving.csv"
    everything = np.column_stack([time, table])
    np.savetxt(path, everything, delimiter=",", header=HEADER, comments="", fmt="%.12g")
    assert main(["allan", str(path), "--out", str(tmp_path / "out")]) == BAD_INPUT
    said = capsys.readouterr().err
    assert "gyro_y moves by 114 deg/s beyond its noise" in said
    assert "--accept-doubts" in said
    assert not (tmp_path / "out").exists()
    arguments = ["allan", str(path), "--accept-doubts", "--out", str(tmp_path / "out")]
    assert main(arguments) == OK
    said = capsys.readouterr().out
    assert "gyro_y: the four noises do not explain" in said
    assert "accel_x: constant" in said
    notes = json.loads((tmp_path / "out" / "summary.json").read_text())["notes"]
    assert len(notes) == 4


BAD = {
    "no log": (("--json",), ("the log is not given", "'--json'")),
    "missing log": (("/nowhere/at.csv",), ("/nowhere/at.csv", "no such file")),
    "unknown flag": (("LOG", "--start", "3"), ("--start", "--help")),
    "not a number": (("LOG", "--per-octave", "many"), ("--per-octave", "'many'", "a whole number")),
    "no density": (("LOG", "--per-octave", "0"), ("--per-octave is 0", "from 1 to 8")),
    "certainty": (("LOG", "--confidence", "1"), ("confidence is 1.0", "between 0 and 1")),
    "before the start": (("LOG", "--start-s", "-1"), ("--start-s is -1.0", "zero or more")),
    "end before start": (("LOG", "--start-s", "5", "--end-s", "4"), ("--end-s is 4.0", "start_s")),
    "window outside": (("LOG", "--start-s", "1000"), ("holds 0 samples", "two or more")),
    "too short": (("LOG", "--end-s", "0.5"), ("51 samples is too short", "at least 72")),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_gets_one_sentence(
    name: str,
    log: Path,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments, words = BAD[name]
    given = [str(log) if argument == "LOG" else argument for argument in arguments]
    assert main(["allan", *given]) == BAD_INPUT
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("jaxnav: ")
    assert said.err.count("\n") == 1
    for word in words:
        assert word in said.err
    assert not list(tmp_path.iterdir())


def test_directory_that_cannot_be_written(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    taken = tmp_path / "file"
    taken.write_text("kept")
    assert main(["allan", str(log), "--out", str(taken / "below")]) == BAD_INPUT
    assert str(taken) in capsys.readouterr().err
    assert taken.read_text() == "kept"


def test_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["allan", "--help"]) == OK
    said = capsys.readouterr().out
    for word in ("usage: jaxnav allan LOG", "--start-s", "--confidence", "--out"):
        assert word in said
    assert main(["allan"]) == BAD_INPUT
    assert "usage: jaxnav allan LOG" in capsys.readouterr().out
