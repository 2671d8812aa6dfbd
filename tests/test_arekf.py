"""The study arekf: the figures it must reach at full length, consistency, and bad input."""

from pathlib import Path

import numpy as np
import pytest

from jaxnav.estimation.metrics import chi2_mean_bounds
from jaxnav.estimation.montecarlo import Campaign
from jaxnav.studies.arekf.analysis import GRADES, ratio_map
from jaxnav.studies.arekf.claims import assess, change
from jaxnav.studies.arekf.config import ArekfConfig
from jaxnav.studies.arekf.figures import draw
from jaxnav.studies.arekf.methods import AXES, KINDS, METHODS
from jaxnav.studies.arekf.study import epochs_of, run_campaign, run_study
from jaxnav.studies.base import ConfigError


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"scenario": "calm"}, "scenario is calm; it must be one of noise-drift, bias-dominated"),
        ({"factors": (1.0, 1.0)}, "factors"),
        ({"factors": (2.0, 10.0)}, "such that one of them is 1"),
        ({"reported": 4.0}, "reported is 4.0; it must be one of the factors"),
        ({"duration_s": 200.0}, "duration_s is 200.0; it must be at most 124 s"),
        ({"filter_period_s": 0.0333}, "filter_period_s is 0.0333"),
        ({"gnss_rate_hz": 7.0}, "gnss_rate_hz is 7.0"),
        ({"align_s": 1.0}, "align_s is 1.0; it must be at least 1.28 s"),
        ({"arw_deg_sqrt_h": -1.0}, "arw_deg_sqrt_h is -1.0; it must be positive"),
        ({"gnss_velocity": float("nan")}, "gnss_velocity is nan"),
        ({"outlier_share": 0.7}, r"outlier_share is 0.7; it must be in \[0, 0.5\)"),
        ({"p0_attitude_deg": (1.0, 1.0)}, "it must be three numbers"),
        ({"heading_deg": 120.0}, "heading_deg is 120.0; it must be at most 90"),
        ({"settle_s": 120.0}, "settle_s is 120.0"),
        ({"versoria_width": -0.1}, "versoria_width is -0.1"),
        ({"iae_memory": 0.5}, "iae_memory is 0.5"),
        ({"runs": 0}, "runs is 0"),
    ],
)
def test_configuration_refuses_what_means_nothing(given: dict, told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        ArekfConfig(**given)


def test_the_map_is_of_the_noise_and_not_of_the_bias() -> None:
    found = ratio_map(ArekfConfig(factors=(1.0, 10.0)))
    noisy, biased = (list(GRADES).index(name) for name in ("noise-dominated", "bias-dominated"))
    np.testing.assert_allclose(found.ratio[:, 0], 1, rtol=1e-12)
    assert np.all(found.ratio >= 1 - 1e-9), "the true noise is the best to believe"
    attitude, velocity, position = found.ratio[noisy, 1, -1]
    assert attitude > 1.8
    assert velocity > 1.8
    assert position < 1.05
    assert found.ratio[biased].max() < 1.1


FACTORS = (1.0, 3.0, 10.0, 20.0)
RUNS = 64
"""Flights at full length, enough of them for every interval that is asserted here; the command line
runs 150."""


@pytest.fixture(scope="module")
def drift() -> dict[float, Campaign]:
    return {factor: run_campaign(ArekfConfig(runs=RUNS), factor) for factor in FACTORS}


@pytest.mark.slow
def test_identified_noise_is_as_good_as_the_true_one(drift: dict[float, Campaign]) -> None:
    for campaign in drift.values():
        assert campaign.finite.all()
        for kind in KINDS:
            found = change(campaign, "arekf", "oracle", kind)
            assert max(abs(found.low), abs(found.high)) < 0.03


@pytest.mark.slow
def test_noise_ten_times_too_small_costs_attitude_and_velocity(
    drift: dict[float, Campaign],
) -> None:
    for kind in KINDS[:2]:
        assert change(drift[10.0], "ekf", "arekf", kind).value > 0.8
    assert abs(change(drift[10.0], "ekf", "arekf", "position").value) < 0.05
    config = ArekfConfig(factors=FACTORS)
    claims = {claim.id: claim for claim in assess(config, drift, None)}
    for rival in ("liekf", "se23-ekf", "versoria-ekf"):
        assert claims[f"{rival}-beats-ekf"].verdict == "not testable"
    assert change(drift[10.0], "mmae", "oracle", "attitude").high < 0.03
    assert change(drift[10.0], "versoria-ekf", "ekf", "velocity").low > 0


@pytest.mark.slow
def test_what_the_monte_carlo_finds_is_what_covariance_foretells(
    drift: dict[float, Campaign],
) -> None:
    expected = ratio_map(ArekfConfig(factors=FACTORS)).ratio[0, :, -1]
    for i, factor in enumerate(FACTORS[1:], start=1):
        for j, kind in enumerate(KINDS):
            found = change(drift[factor], "ekf", "arekf", kind)
            # the interval is of 95 %; twice its width holds nine of nine but for one in a thousand
            half = found.high - found.low
            assert abs(found.value + 1 - expected[i, j]) < max(half, 0.02)


@pytest.mark.slow
def test_arekf_is_consistent_and_the_ekf_is_not(drift: dict[float, Campaign]) -> None:
    """All fifteen states at twelve times, initial errors drawn from P0."""
    low, high = chi2_mean_bounds(15, RUNS)
    for factor, campaign in drift.items():
        nees = campaign.mean_curve["nees"]
        nees = nees[epochs_of(len(nees))]
        for name in ("arekf", "oracle"):
            own = nees[:, METHODS.index(name)]
            assert np.all((low < own) & (own < high))
        ekf = nees[:, METHODS.index("ekf")]
        assert np.all(ekf > high) if factor >= 3 else np.all((low < ekf) & (ekf < high))


@pytest.mark.slow
def test_where_bias_limits_the_filter_its_noise_hardly_matters() -> None:
    campaign = run_campaign(ArekfConfig(scenario="bias-dominated", runs=RUNS), 20.0)
    for kind in KINDS:
        assert change(campaign, "ekf", "arekf", kind).high < 0.1


@pytest.mark.slow
def test_versoria_pays_with_outliers_and_invariance_with_a_lost_heading() -> None:
    spoiled = run_campaign(ArekfConfig(scenario="outliers", runs=RUNS), 1.0)
    for kind in KINDS:
        assert change(spoiled, "versoria-ekf", "ekf", kind).high < -0.1
    lost = run_campaign(ArekfConfig(scenario="large-heading-error", runs=RUNS), 1.0)
    low, high = chi2_mean_bounds(15, RUNS)
    for name in ("liekf", "se23-ekf"):
        for kind in KINDS:
            assert change(lost, name, "ekf", kind).high < -0.2
        assert low < lost.rows.final_nees[:, METHODS.index(name)].mean() < high
    assert lost.rows.final_nees[:, METHODS.index("ekf")].mean() > high


@pytest.mark.slow
def test_results_of_the_sweep_hold_every_filter_and_array(tmp_path: Path) -> None:
    config = ArekfConfig(
        scenario="r-sweep", runs=4, duration_s=4.0, settle_s=1.0, align_s=5.0, cost=False
    )
    (result,) = run_study(config)
    assert tuple(result.methods) == tuple(f"ekf-{factor:g}" for factor in config.r_factors)
    errors = result.methods["ekf-1"]["rmse"]
    assert {"attitude", "velocity", "position"} <= set(errors)
    for kind in KINDS:
        parts = [errors[f"{kind}_{axis}"]["value"] for axis in AXES]
        assert np.hypot.reduce(parts) == pytest.approx(errors[kind]["value"], rel=1e-12)
    # what believes the least of the fixes strays the most from them
    position = [result.methods[f"ekf-{f:g}"]["rmse"]["position"]["value"] for f in (1, 100)]
    assert position[1] > position[0]
    assert set(result.dims) <= set(result.arrays)
    for name, axes in result.dims.items():
        assert result.arrays[name].ndim == len(axes), name
    paths = draw(result, tmp_path)
    assert [path.name for path in paths][:3] == [
        "figure-3-position.png",
        "figure-4-velocity.png",
        "figure-5-attitude.png",
    ]
    assert all(path.stat().st_size > 10_000 for path in paths)
    assert {claim.verdict for claim in result.claims} == {"not testable"}
