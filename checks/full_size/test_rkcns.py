"""The study rkcns at full length: the bars of position and bias, consistency, and ablations."""

from dataclasses import replace

import numpy as np
import pytest

from checks.full_size import Note
from jaxnav.estimation.metrics import chi2_mean_bounds, rmse_ratio
from jaxnav.studies.attitude import AXES
from jaxnav.studies.base import StudyResult
from jaxnav.studies.rkcns.ablations import LINEAR, run_ablations, run_campaign
from jaxnav.studies.rkcns.claims import POSITION
from jaxnav.studies.rkcns.config import RkcnsConfig
from jaxnav.studies.rkcns.methods import METHODS
from jaxnav.studies.rkcns.study import run_study

BARE = RkcnsConfig(runs=48, ablations=False, cost=False)
"""Flights at full length, enough of them for every interval that is asserted here; the command line
runs a hundred."""


@pytest.fixture(scope="module")
def listed() -> StudyResult:
    (result,) = run_study(BARE)
    return result


def position_square(result: StudyResult, method: str) -> np.ndarray:
    return result.arrays["mean_square"][:, METHODS.index(method), :3].sum(axis=-1)


def test_listed_sensors_at_full_length(listed: StudyResult, note: Note) -> None:
    """The bars of position and bias, and the verdicts that follow from near-linearity."""
    gain = rmse_ratio(position_square(listed, "conventional"), position_square(listed, "ckf"))
    note("conventional over ckf, position", gain)
    assert gain.low > 3
    for name in METHODS[1:]:
        bias = listed.methods[name]["rmse"]["accel_bias"]["value"]
        note(f"accelerometer bias of {name}, micro-g", bias)
        assert bias < 10
        assert listed.methods[name]["diverged"] == 0
    assert listed.methods["conventional"]["rmse"]["accel_bias"]["value"] > 80
    claims = {claim.id: claim.verdict for claim in listed.claims}
    for told in ("refraction-improves-position", "accelerometer-bias-estimated"):
        assert claims[told] == "reproduced"
    assert claims["attitude-not-improved"] == "reproduced"
    for axis in POSITION:
        assert claims[f"iterated-ckf-beats-ckf-{axis}"] == "not reproduced"
    same = rmse_ratio(position_square(listed, "iterated-ckf"), position_square(listed, "ckf"))
    note("iterated-ckf over ckf, position", same)
    assert max(abs(same.low - 1), abs(same.high - 1)) < 1e-4
    for axis in AXES:
        assert claims[f"attitude-level-{axis}"] == "not reproduced"


def test_listed_filters_are_consistent(listed: StudyResult, note: Note) -> None:
    """All fifteen states at twelve times, initial errors drawn from P0."""
    low, high = chi2_mean_bounds(15, listed.runs)
    anees = listed.arrays["anees"][np.linspace(20, 439, 12).astype(int)]
    note("mean NEES", anees)
    assert np.all((low < anees) & (anees < high))


def test_augmentation_takes_the_bias_of_the_logarithm_away(note: Note) -> None:
    """At 40 km it is the largest error of a filter that takes the noise for additive."""
    high = replace(BARE, tangent_km=(39.0, 41.0), point_spread=0.1)
    square = run_campaign(high, keep=1).rows.mean_square[:, :, :3].sum(axis=-1)
    ckf, modified, bound = (
        square[:, METHODS.index(name)] for name in ("ckf", "modified-iterated-ckf", "oracle")
    )
    gain, short = rmse_ratio(modified, ckf), rmse_ratio(modified, bound)
    note("modified-iterated-ckf over ckf, position", gain)
    note("modified-iterated-ckf over oracle, position", short)
    assert gain.high < 0.8
    assert short.high < 1.05


def test_iteration_pays_where_the_position_is_lost(note: Note) -> None:
    (result,) = run_study(replace(BARE, scenario="strong-nonlinearity"))
    for name in ("iterated-ckf", "modified-iterated-ckf"):
        ratio = rmse_ratio(position_square(result, name), position_square(result, "ckf"))
        note(f"{name} over ckf, position", ratio)
        assert ratio.high < 0.2
        bound = rmse_ratio(position_square(result, name), position_square(result, "oracle"))
        note(f"{name} over oracle, position", bound)
        assert bound.high < 1.2
    assert {claim.verdict for claim in result.claims} == {"reproduced"}
    low, high = chi2_mean_bounds(15, result.runs)
    assert low < result.methods["iterated-ckf"]["final_anees"] < high


def test_the_printed_constants_cost_position_and_consistency(
    listed: StudyResult, note: Note
) -> None:
    chosen = [v for v in LINEAR if v.label in ("printed constants", "constraint alone")]
    outcomes = {(o.label, o.method): o for o in run_ablations(BARE, chosen)}
    own = listed.methods["ckf"]["rmse_position"]["value"]
    printed = outcomes["printed constants", "ckf"]
    note("printed constants over own, position", printed.position.value / own)
    assert printed.position.value > 3 * own
    assert printed.anees > 100
    alone = outcomes["constraint alone", "ckf"].position
    unaided = listed.methods["conventional"]["rmse_position"]["value"]
    note("constraint alone over unaided, position", alone.value / unaided)
    assert abs(alone.value / unaided - 1) < 0.1, "it shows the bias and leaves the position"
