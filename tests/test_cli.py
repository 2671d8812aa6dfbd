"""The command line: what it prints and writes, and its answers to bad input."""

import json
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from jaxnav import cli
from jaxnav.cli import BAD_INPUT, DIVERGED, INTERRUPTED, OK, main
from jaxnav.studies import STUDIES

TINY = ("--chain", "linear", "--runs", "2", "--duration-s", "6")


@pytest.fixture(autouse=True)
def _leave_jax_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """The suite has set JAX up; a process may do so only once."""
    monkeypatch.setattr(cli, "configure_jax", lambda **options: None)


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Run a command that must be refused and return its one sentence."""
    assert main(arguments) == BAD_INPUT
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("jaxnav: ")
    assert said.err.count("\n") == 1
    return said.err


BAD = {
    "unknown command": (("fly",), ("'fly'", "list, run, tune, filter, allan, doctor")),
    "unknown study": (
        ("run", "imae"),
        ("'imae'", "immae, mmae-ukf, rkcns, arekf, sage-husa, gnss-track"),
    ),
    "unknown scenario": (
        ("run", "immae", "--scenario", "calm"),
        ("calm", "matched-noise", "noise-step", "all"),
    ),
    "unknown flag": (("run", "immae", "--rums", "3"), ("--rums", "--help")),
    "not a number": (("run", "immae", "--runs", "many"), ("--runs", "'many'", "a whole number")),
    "zero runs": (("run", "immae", "--runs", "0"), ("--runs is 0", "from 1 to")),
    "negative noise": (
        ("run", "immae", "--gyro-noise-deg-h", "-1"),
        ("--gyro-noise-deg-h is -1.0", "zero or more"),
    ),
    "star noise of zero": (
        ("run", "immae", "--star-noise-arcsec", "0"),
        ("--star-noise-arcsec is 0.0", "positive"),
    ),
    "theta with a negative entry": (
        ("run", "immae", "--theta", "1", "-10"),
        ("theta is (1.0, -10.0)", "positive"),
    ),
    "threshold above one": (
        ("run", "immae", "--reset-threshold", "1.5"),
        ("--reset-threshold is 1.5", "(0, 1]"),
    ),
    "threshold of zero": (
        ("run", "immae", "--reset-threshold", "0"),
        ("--reset-threshold is 0.0", "(0, 1]"),
    ),
    "drift that is no number": (
        ("run", "immae", "--gyro-drift-deg-h", "nan"),
        ("--gyro-drift-deg-h is nan", "finite"),
    ),
    "densities that repeat": (
        ("run", "gnss-track", "--q", "1", "1"),
        ("q is (1.0, 1.0)", "different"),
    ),
    "period below a step": (
        ("run", "immae", "--reset-period-s", "0.01"),
        ("--reset-period-s is 0.01", "at least one filter period of 0.05 s"),
    ),
    "period that is no multiple": (
        ("run", "immae", "--filter-period-s", "0.055"),
        ("--filter-period-s is 0.055", "whole number of inertial samples"),
    ),
    "log that is missing": (
        ("run", "gnss-track", "--log", "/nowhere/at.pos"),
        ("/nowhere/at.pos",),
    ),
    "no log": (("run", "gnss-track"), ("log is not given", ".pos")),
    "options of list": (("list", "--all"), ("--all",)),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_gets_one_sentence(
    name: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments, words = BAD[name]
    said = refused(capsys, *arguments)
    for word in words:
        assert word in said
    assert not list(tmp_path.iterdir())


def test_directory_that_cannot_be_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    taken = tmp_path / "file"
    taken.write_text("kept")
    said = refused(capsys, "run", "immae", *TINY, "--out", str(taken / "below"))
    assert str(taken) in said
    assert taken.read_text() == "kept"
    if os.geteuid() != 0:
        closed = tmp_path / "closed"
        closed.mkdir()
        closed.chmod(stat.S_IRUSR | stat.S_IXUSR)
        assert str(closed) in refused(capsys, "run", "immae", *TINY, "--out", str(closed))


def run_process(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "jaxnav", *arguments],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **environment},
    )


def test_study_refuses_32_bit_floats(tmp_path: Path) -> None:
    done = run_process("run", "immae", *TINY, "--out", str(tmp_path), JAX_ENABLE_X64="0")
    assert done.returncode == BAD_INPUT
    assert done.stderr.count("\n") == 1
    assert "jax_enable_x64 is False" in done.stderr
    assert not list(tmp_path.iterdir())


def test_help_does_not_import_jax() -> None:
    script = (
        "import sys; from jaxnav.cli import main; code = main(sys.argv[1:]);"
        "loaded = {'jax', 'matplotlib', 'rich.console'} & set(sys.modules);"
        "assert not loaded, loaded; assert code == 0"
    )
    for arguments in (["--help"], ["run", "--help"]):
        subprocess.run([sys.executable, "-c", script, *arguments], check=True, capture_output=True)


def test_help_of_a_study_lists_its_parameters(capsys: pytest.CaptureFixture[str]) -> None:
    for name in STUDIES:
        assert main(["run", name, "--help"]) == OK
        said = capsys.readouterr().out
        assert f"usage: jaxnav run {name}" in said
        assert "--scenario" in said


def test_run_writes_a_summary_that_other_programs_can_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "with space"
    assert main(["run", "immae", *TINY, "--scenario", "all", "--out", str(out)]) == OK
    said = capsys.readouterr().out
    for scenario, figures in (("matched-noise", "figure-3"), ("noise-step", "figure-5")):
        assert scenario in said
        folder = out / scenario
        document = json.loads((folder / "summary.json").read_text())
        assert document["schema"] == 1
        assert (document["study"], document["scenario"]) == ("immae", scenario)
        assert (document["runs"], document["seed"]) == (2, 0)
        assert document["config"]["duration_s"] == 6
        assert document["provenance"]["x64"] is True
        assert list(document["methods"]) == ["kf", "mmae", "immae", "floor", "markov", "oracle"]
        for measures in document["methods"].values():
            for axis in ("yaw", "pitch", "roll"):
                assert measures["rmse"][axis]["unit"] == "arcsec"
                assert measures["rmse"][axis]["value"] > 0
        for claim in document["claims"]:
            assert {"id", "text", "published", "measured", "ci95", "verdict", "why"} == set(claim)
        drawn = sorted(path.name for path in folder.glob("*.png"))
        assert len(drawn) == 3
        assert any(name.startswith(figures) for name in drawn)


def test_json_goes_to_standard_output(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "immae", *TINY, "--json", "--out", str(tmp_path)]) == OK
    document = json.loads(capsys.readouterr().out)
    assert document["scenario"] == "noise-step"
    assert document == json.loads((tmp_path / "summary.json").read_text())


def test_diverged_runs_are_reported_and_set_the_exit_code(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A filter that believes neither its sensors nor its prior moves loses the attitude."""
    theta = [f"{factor}e-12" for factor in (1, 2, 3, 4, 5)]
    mistuned = ("--kf-theta", "1e-12", "--theta", *theta, "--p0-attitude-arcsec", "1e-3")
    code = main(["run", "immae", *TINY, *mistuned, "--out", str(tmp_path)])
    assert code == DIVERGED
    assert "of 2 runs diverged" in capsys.readouterr().out
    document = json.loads((tmp_path / "summary.json").read_text())
    assert document["methods"]["kf"]["diverged"] == 2


def test_flight_of_half_a_second_is_drawn(tmp_path: Path) -> None:
    assert main(["run", "immae", *TINY[:4], "--duration-s", "0.5", "--out", str(tmp_path)]) == OK
    assert (tmp_path / "trmse.png").is_file()


def test_interrupt_has_its_own_exit_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("jaxnav.studies.immae.study.run_study", interrupted)
    assert main(["run", "immae", *TINY, "--out", str(tmp_path)]) == INTERRUPTED
    assert "interrupted" in capsys.readouterr().err


def test_list_and_doctor(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == OK
    assert capsys.readouterr().out.startswith("jaxnav 0.")
    assert main(["list"]) == OK
    said = capsys.readouterr().out
    for word in ("immae", "noise-step", "square_root_kf", "windowed_reset", ".pos"):
        assert word in said
    for mark in (":class:", ":func:", "``", "Return"):
        assert mark not in said
    assert main(["doctor"]) == OK
    said = capsys.readouterr().out
    for word in ("jaxlib", "x64", "compiled programs", "compiler option"):
        assert word in said


def test_no_arguments_show_the_usage(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == BAD_INPUT
    assert "usage: jaxnav" in capsys.readouterr().out
