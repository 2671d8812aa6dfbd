"""The study rkcns: the figures it must reach at full length, consistency, and bad input."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jaxnav.cli import main
from jaxnav.estimation.metrics import chi2_mean_bounds, rmse_ratio
from jaxnav.studies.attitude import AXES
from jaxnav.studies.base import ConfigError, StudyResult
from jaxnav.studies.rkcns.ablations import LINEAR, run_ablations, run_campaign, variations
from jaxnav.studies.rkcns.claims import POSITION
from jaxnav.studies.rkcns.config import RkcnsConfig
from jaxnav.studies.rkcns.cost import flops
from jaxnav.studies.rkcns.figures import draw
from jaxnav.studies.rkcns.methods import METHODS
from jaxnav.studies.rkcns.simulation import build_world
from jaxnav.studies.rkcns.study import run_study

BARE = RkcnsConfig(runs=48, ablations=False, cost=False)
"""Flights at full length, enough of them for every interval that is asserted here; the command line
runs a hundred."""


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"scenario": "paper"}, "scenario is paper; it must be one of listed, inferred"),
        ({"tangent_km": (-1.0, 25.0)}, r"tangent_km is \(-1.0, 25.0\); it must be a lower and a"),
        ({"tangent_km": (20.0, 90.0)}, "between the surface, 0, and the top of the atmosphere, 86"),
        ({"tangent_km": (25.0, 20.0)}, "tangent_km"),
        ({"stars": -1}, "stars is -1; it must be between 0 and 20"),
        ({"density_error": 0.5}, "density_error is 0.5"),
        ({"iterations": 0}, "iterations is 0; it must be between 1 and 50"),
        ({"trials": -1}, "trials is -1"),
        ({"start_s": 100.0}, "start_s is 100.0; it must be at least 131 s"),
        ({"duration_s": 900.0}, "duration_s is 900.0; it must be at most 780 s"),
        ({"duration_s": 160.5}, "a whole number of filter steps from the start of the filters"),
        ({"launch_period_s": 0.007}, "launch_period_s is 0.007"),
        ({"refraction_noise_arcsec": 0.0}, "refraction_noise_arcsec is 0.0; it must be positive"),
        ({"point_spread": float("nan")}, "point_spread is nan"),
        ({"p0_attitude_arcsec": (1.0, 2.0)}, "it must be three numbers"),
        ({"atmosphere": "us76"}, "atmosphere is us76; it must be one of fitted, printed"),
    ],
)
def test_configuration_refuses_what_means_nothing(given: dict, told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        RkcnsConfig(**given)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (None, "no such file or directory; accepted is a table of stars"),
        ("hip,ra\n1,2\n", "line 1: the header does not name ra_deg"),
        (
            "hip,ra_deg,dec_deg,pmra_mas_yr,pmdec_mas_yr,hp_mag\n1,2,3,4,5,9.9\n",
            "magnitude_limit is 6.5; it must be 9.9, the brightest, or above",
        ),
    ],
)
def test_a_bad_catalogue_ends_the_command_before_any_work(
    tmp_path: Path, capsys: pytest.CaptureFixture, text: str | None, told: str
) -> None:
    path, out = tmp_path / "stars.csv", tmp_path / "out"
    if text is not None:
        path.write_text(text)
    assert main(["run", "rkcns", "--catalogue", str(path), "--out", str(out)]) == 2
    message = " ".join(capsys.readouterr().err.split())
    assert told in message
    assert not list(out.glob("**/*")) if out.exists() else True


def test_stars_are_in_the_band_and_each_is_new_after_seconds() -> None:
    world = build_world(replace(BARE, duration_s=200.0))
    limb = world.limb
    assert limb.seen.all(), "three stars at every epoch"
    heights = np.asarray(limb.height)
    assert heights.min() >= 20e3
    assert heights.max() <= 25e3
    np.testing.assert_allclose(np.linalg.norm(limb.star, axis=-1), 1, rtol=1e-12)
    first = {tuple(star) for star in np.asarray(limb.star[0])}
    later = {tuple(star) for star in np.asarray(limb.star[30])}
    assert not first & later
    none = build_world(replace(BARE, duration_s=161.0, stars=0)).limb
    assert not none.seen.any()


def test_every_variation_is_a_valid_configuration() -> None:
    for scenario in ("listed", "inferred", "strong-nonlinearity"):
        config = RkcnsConfig(scenario=scenario)
        for change in variations(config):
            replace(config, **change.changes)
            assert set(change.shown) <= set(change.run)
    assert variations(RkcnsConfig()) == LINEAR


def test_the_papers_count_of_operations() -> None:
    """Eq. (29) for n = m = 1: 20/3 + 10 + 10 + 8 + 2 + 1 + 3 + 1; the others by the same hand."""
    counts = flops(1, 1, 1)
    assert counts["ckf"] == pytest.approx(20 / 3 + 35)
    assert counts["iterated-ckf"] == pytest.approx(23 / 3 + 21 + 8 + 5 + 5)
    assert counts["modified-iterated-ckf"] == pytest.approx(23 / 3 + 26 + 47 + 49 / 3 + 4 + 9 + 5)


@pytest.fixture(scope="module")
def listed() -> StudyResult:
    (result,) = run_study(BARE)
    return result


def position_square(result: StudyResult, method: str) -> np.ndarray:
    return result.arrays["mean_square"][:, METHODS.index(method), :3].sum(axis=-1)


@pytest.mark.slow
def test_listed_sensors_at_full_length(listed: StudyResult) -> None:
    """The bars of position and bias, and the verdicts that follow from near-linearity."""
    gain = rmse_ratio(position_square(listed, "conventional"), position_square(listed, "ckf"))
    assert gain.low > 3
    for name in METHODS[1:]:
        assert listed.methods[name]["rmse"]["accel_bias"]["value"] < 10
        assert listed.methods[name]["diverged"] == 0
    assert listed.methods["conventional"]["rmse"]["accel_bias"]["value"] > 80
    claims = {claim.id: claim.verdict for claim in listed.claims}
    for told in ("refraction-improves-position", "accelerometer-bias-estimated"):
        assert claims[told] == "reproduced"
    assert claims["attitude-not-improved"] == "reproduced"
    for axis in POSITION:
        assert claims[f"iterated-ckf-beats-ckf-{axis}"] == "not reproduced"
    same = rmse_ratio(position_square(listed, "iterated-ckf"), position_square(listed, "ckf"))
    assert max(abs(same.low - 1), abs(same.high - 1)) < 1e-4
    for axis in AXES:
        assert claims[f"attitude-level-{axis}"] == "not reproduced"


@pytest.mark.slow
def test_listed_filters_are_consistent(listed: StudyResult) -> None:
    """All fifteen states at twelve times, initial errors drawn from P0."""
    low, high = chi2_mean_bounds(15, listed.runs)
    anees = listed.arrays["anees"][np.linspace(20, 439, 12).astype(int)]
    assert np.all((low < anees) & (anees < high))


@pytest.mark.slow
def test_augmentation_takes_the_bias_of_the_logarithm_away() -> None:
    """At 40 km it is the largest error of a filter that takes the noise for additive."""
    high = replace(BARE, tangent_km=(39.0, 41.0), point_spread=0.1)
    square = run_campaign(high, keep=1).rows.mean_square[:, :, :3].sum(axis=-1)
    ckf, modified, bound = (
        square[:, METHODS.index(name)] for name in ("ckf", "modified-iterated-ckf", "oracle")
    )
    assert rmse_ratio(modified, ckf).high < 0.8
    assert rmse_ratio(modified, bound).high < 1.05


@pytest.mark.slow
def test_iteration_pays_where_the_position_is_lost() -> None:
    (result,) = run_study(replace(BARE, scenario="strong-nonlinearity"))
    for name in ("iterated-ckf", "modified-iterated-ckf"):
        ratio = rmse_ratio(position_square(result, name), position_square(result, "ckf"))
        assert ratio.high < 0.2
        bound = rmse_ratio(position_square(result, name), position_square(result, "oracle"))
        assert bound.high < 1.2
    assert {claim.verdict for claim in result.claims} == {"reproduced"}
    low, high = chi2_mean_bounds(15, result.runs)
    assert low < result.methods["iterated-ckf"]["final_anees"] < high


@pytest.mark.slow
def test_the_printed_constants_cost_position_and_consistency(
    listed: StudyResult,
) -> None:
    chosen = [v for v in LINEAR if v.label in ("printed constants", "constraint alone")]
    outcomes = {(o.label, o.method): o for o in run_ablations(BARE, chosen)}
    own = listed.methods["ckf"]["rmse_position"]["value"]
    printed = outcomes["printed constants", "ckf"]
    assert printed.position.value > 3 * own
    assert printed.anees > 100
    alone = outcomes["constraint alone", "ckf"].position
    unaided = listed.methods["conventional"]["rmse_position"]["value"]
    assert abs(alone.value / unaided - 1) < 0.1, "it shows the bias and leaves the position"


@pytest.mark.slow
def test_results_hold_every_method_and_array(listed: StudyResult, tmp_path: Path) -> None:
    assert tuple(listed.methods) == METHODS
    assert tuple(listed.methods["ckf"]["rmse"]) == (*POSITION, *AXES, "accel_bias")
    assert set(listed.dims) <= set(listed.arrays)
    for name, axes in listed.dims.items():
        assert listed.arrays[name].ndim == len(axes), name
    assert listed.arrays["time"][[0, -1]].tolist() == [161.0, 600.0]
    paths = draw(listed, tmp_path)
    assert len(paths) == 5
    assert all(path.stat().st_size > 10_000 for path in paths)
