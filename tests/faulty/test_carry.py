"""A drive whose lever arm or mounting is told wrong, and a filter that carries them."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from jaxnav.cli import BAD_INPUT, main
from jaxnav.config import ConfigError
from jaxnav.recorded.analysis import Report, analyse
from jaxnav.recorded.config import FilterConfig, check
from tests.faulty.car import drive, logged

CONFIG = FilterConfig(rate_hz=10.0, outages="off", position_sigma_m=0.5, velocity_sigma=0.1)


@pytest.fixture(scope="module")
def report() -> Report:
    """Filter the clean car with its lever arm told 0.6 m, -0.4 m off, mounting and arm carried."""
    log = logged(drive()[1])
    log = log._replace(lever_arm=np.array([0.6, -0.4, 0.0]))
    return analyse(log, replace(CONFIG, carry=("lever-arm", "mounting")))


def found(report: Report, name: str) -> tuple[np.ndarray, np.ndarray]:
    entry = report.document["carried"][name]
    return np.array(entry["value"]), np.array(entry["sigma"])


def test_a_lever_arm_that_is_told_wrong_is_found(report: Report) -> None:
    """The truth is none: within three sigma and 0.1 m in the plane that the car turns in."""
    value, sigma = found(report, "lever-arm")
    assert np.all(np.abs(value) < 3 * sigma)
    assert np.all(np.abs(value[:2]) < 0.1)
    value, sigma = found(report, "mounting")
    assert np.all(np.abs(value) < 3 * sigma)
    assert np.all(sigma[1:] < 1.0)
    # There is no roll to be seen in how a car moves.
    assert sigma[0] > 1.5


def test_channels_are_told_apart_in_the_summary(report: Report) -> None:
    channels: dict[str, Any] = report.document["channels"]
    assert set(channels) == {"velocity", "position", "steered", "rest"}
    for entry in channels.values():
        assert 0 < entry["updates"] <= entry["arrived"]
        assert entry["updates"] + entry["refused"] == entry["arrived"]
        assert 0 < entry["nis_per_value"] < 3


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"carry": ("lever-am",)}, r"^carry is lever-am, did you mean 'lever-arm'; it must be"),
        ({"carry": ("mounting", "mounting")}, r"^carry is mounting, mounting; it must be each st"),
        (
            {"carry": ("mounting",), "constraints": False},
            r"^carry is mounting; it must be left out without the constraints",
        ),
    ],
)
def test_states_that_cannot_be_carried_are_refused(changes: Any, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        check(replace(CONFIG, **changes))


def test_states_may_be_listed_with_commas(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["filter", "nothing.csv", "--carry=lever-arm,gyro-bias"]) == BAD_INPUT
    assert "carry is gyro-bias" in capsys.readouterr().err
