"""The study gnss-track: figures on the recorded drive, and answers to logs that are not right."""

import json
from pathlib import Path

import numpy as np
import pytest

from jaxnav.cli import FAULT, OK, main
from jaxnav.config import ConfigError
from jaxnav.datasets.base import DataError
from jaxnav.studies.gnss_track.config import GnssTrackConfig
from jaxnav.studies.gnss_track.study import run_study

DRIVE = Path(__file__).resolve().parents[2] / "shared" / "data" / "rtk_drive" / "gnss_1934_sf.pos"
recorded = pytest.mark.skipif(
    not DRIVE.is_file(), reason="the recorded drive is not in ../shared/data"
)


@recorded
def test_banks_predict_the_recorded_drive_better_than_any_single_filter() -> None:
    (result,) = run_study(GnssTrackConfig(log=DRIVE))
    likelihood = {name: m["log_likelihood"] for name, m in result.methods.items()}
    best_single = max(value for name, value in likelihood.items() if name.startswith("kf-"))
    assert likelihood["immae"] > best_single > likelihood["mmae"] - 20
    assert likelihood["markov"] > likelihood["immae"]
    # an independent filter found these
    assert abs(best_single - 5637) < 2
    assert abs(likelihood["mmae"] - 5635) < 2
    velocity = {name: m["rmse"]["velocity"]["value"] for name, m in result.methods.items()}
    assert velocity["markov"] < velocity["kf-0.01"] / 3
    assert result.diverged == 0


@recorded
def test_thinned_drive_has_a_fix_a_second() -> None:
    (result,) = run_study(GnssTrackConfig(log=DRIVE, scenario="thinned"))
    np.testing.assert_allclose(np.diff(result.arrays["time"]), 1.0, atol=1e-9)
    likelihood = {name: m["log_likelihood"] for name, m in result.methods.items()}
    assert likelihood["markov"] > likelihood["immae"] > likelihood["mmae"]


def write_log(
    path: Path, seconds: list[float], velocity: bool = True, off: dict[float, float] | None = None
) -> Path:
    """A straight drive to the north at 10 m/s, written as RTKLIB would; fixes at times off by m."""
    lines = []
    for t in seconds:
        latitude = 40.0 + np.degrees((10 * t + (off or {}).get(t, 0.0)) / 6.37e6)
        clock = f"2025/07/08 19:{34 + int(t) // 60:02d}:{t % 60:06.3f}"
        row = f"{clock} {latitude:.9f} -105.0 1600.0 1 20 .01 .01 .01 0 0 0 0 0"
        lines.append(row + (" 10.0 0.0 0.0 .05 .05 .05 0 0 0" if velocity else ""))
    path.write_text("\n".join(lines) + "\n")
    return path


def test_gap_is_predicted_over_and_a_repeated_time_is_counted(tmp_path: Path) -> None:
    seconds = [0.25 * k for k in range(60)] + [30.0 + 0.25 * k for k in range(60)]
    log = write_log(tmp_path / "gap.pos", sorted([*seconds, 5.0]))
    (result,) = run_study(GnssTrackConfig(log=log))
    notes = " ".join(result.notes)
    assert "1 gaps in the log, the longest 15.25 s" in notes
    assert "1 fixes with a repeated time stamp" in notes
    assert result.diverged == 0
    assert result.arrays["time"].size == 119
    assert result.methods["kf-1"]["rmse"]["velocity"]["value"] < 2.0


@pytest.mark.parametrize("off", [20.0, 1.1e3])
def test_a_fix_that_is_off_is_a_fault_by_its_number(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], off: float
) -> None:
    seconds = [0.25 * k for k in range(200)]
    log = write_log(tmp_path / "off.pos", seconds, off={30.0: off})
    out = tmp_path / "out"
    arguments = ["run", "gnss-track", "--log", str(log), "--out", str(out)]
    assert main([*arguments, "--strict"]) == FAULT
    (said,) = (line for line in capsys.readouterr().out.splitlines() if "fix 121" in line)
    document = json.loads((out / "summary.json").read_text())
    assert said.removeprefix("fault: ") in document["faults"]
    assert {entry["verdict"] for entry in document["audit"]} <= {"pass", "doubt", "fault"}
    assert main(arguments) == OK


def test_velocities_of_another_unit_or_axis_are_refused(tmp_path: Path) -> None:
    seconds = [0.25 * k for k in range(200)]
    log = write_log(tmp_path / "plain.pos", seconds)
    for old, new in ((" 10.0 0.0 0.0 ", " 36.0 0.0 0.0 "), (" 10.0 0.0 0.0 ", " 0.0 10.0 0.0 ")):
        other = tmp_path / "other.pos"
        other.write_text(log.read_text().replace(old, new))
        with pytest.raises(DataError, match=r"other\.pos: in ten seconds the positions move by"):
            run_study(GnssTrackConfig(log=other))


def test_a_standard_deviation_unlike_that_of_the_log_is_told(tmp_path: Path) -> None:
    log = write_log(tmp_path / "plain.pos", [0.25 * k for k in range(80)])
    for sigma, told in ((0.02, False), (0.5, True)):
        (result,) = run_study(GnssTrackConfig(log=log, position_sigma=sigma))
        assert any("states a standard deviation of 0.01 m" in note for note in result.notes) == told


def test_log_without_velocity_is_not_scored_against_one(tmp_path: Path) -> None:
    log = write_log(tmp_path / "plain.pos", [0.25 * k for k in range(80)], velocity=False)
    (result,) = run_study(GnssTrackConfig(log=log))
    assert "rmse" not in result.methods["mmae"]
    assert any("no velocity" in note for note in result.notes)
    assert np.isfinite(result.methods["mmae"]["log_likelihood"])


def test_parked_log_has_no_error_at_all(tmp_path: Path) -> None:
    row = "1 20 .01 .01 .01 0 0 0 0 0 0 0 0 .05 .05 .05 0 0 0"
    lines = [f"2025/07/08 19:34:{k / 4:06.3f} 40.0 -105.0 1600.0 {row}" for k in range(80)]
    (tmp_path / "parked.pos").write_text("\n".join(lines))
    (result,) = run_study(GnssTrackConfig(log=tmp_path / "parked.pos"))
    assert result.methods["kf-1"]["rmse"]["velocity"]["value"] == 0


def test_clear_answers_to_what_cannot_be_run(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="log is not given"):
        run_study(GnssTrackConfig())
    with pytest.raises(DataError, match="2 fixes"):
        run_study(GnssTrackConfig(log=write_log(tmp_path / "two.pos", [0.0, 0.25])))
    log = write_log(tmp_path / "slow.pos", [10.0 * k for k in range(5)])
    with pytest.raises(ConfigError, match=r"reset_period_s is 5\.0; .* one step of 10 s"):
        run_study(GnssTrackConfig(log=log))
