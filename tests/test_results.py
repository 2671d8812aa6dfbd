"""Results on disk and as xarray."""

import json
from pathlib import Path

import numpy as np
import pytest

from jaxnav.results import summary, to_xarray, write
from jaxnav.studies.base import Claim, StudyResult


@pytest.fixture
def result() -> StudyResult:
    return StudyResult(
        study="immae",
        scenario="noise-step",
        runs=2,
        seed=0,
        config={"theta": (1.0, 10.0), "log": None},
        methods={"kf": {"rmse": {"yaw": {"value": np.float64(0.2), "se": float("nan")}}}},
        published={},
        claims=[Claim("a", "text", None, float("inf"), None, "not testable", "why")],
        arrays={
            "time": np.arange(3.0),
            "square": np.ones((3, 2)),
            "estimator": np.array(["kf", "mmae"]),
        },
        dims={"time": ("time",), "square": ("time", "estimator")},
    )


def test_summary_has_no_numbers_that_json_cannot_hold(result: StudyResult) -> None:
    document = json.loads(json.dumps(summary(result), allow_nan=False))
    assert document["methods"]["kf"]["rmse"]["yaw"] == {"value": 0.2, "se": None}
    assert document["claims"][0]["measured"] is None
    assert document["config"]["theta"] == [1.0, 10.0]


def test_files_are_whole_and_leave_nothing_beside_them(result: StudyResult, tmp_path: Path) -> None:
    write(result, tmp_path)
    write(result, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["arrays.npz", "summary.json"]
    with np.load(tmp_path / "arrays.npz", allow_pickle=False) as arrays:
        np.testing.assert_array_equal(arrays["square"], result.arrays["square"])


def test_failed_write_keeps_what_was_there(
    result: StudyResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(result, tmp_path)
    before = (tmp_path / "summary.json").read_text()

    def full(self: Path, *arguments: object, **options: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OSError, match="No space left"):
        write(result, tmp_path)
    monkeypatch.undo()
    assert (tmp_path / "summary.json").read_text() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["arrays.npz", "summary.json"]


def test_xarray_has_named_axes(result: StudyResult) -> None:
    dataset = to_xarray(result)
    assert dataset["square"].dims == ("time", "estimator")
    assert float(dataset["square"].sel(estimator="mmae", time=2.0)) == 1.0
    assert dataset.attrs["scenario"] == "noise-step"
