"""The study arekf at full length: what its filters must reach, and their consistency."""

import numpy as np
import pytest

from checks.full_size import Note
from jaxnav.estimation.metrics import chi2_mean_bounds
from jaxnav.estimation.montecarlo import Campaign
from jaxnav.studies.arekf.analysis import ratio_map
from jaxnav.studies.arekf.claims import assess, change
from jaxnav.studies.arekf.config import ArekfConfig
from jaxnav.studies.arekf.methods import KINDS, METHODS
from jaxnav.studies.arekf.study import epochs_of, run_campaign

FACTORS = (1.0, 3.0, 10.0, 20.0)
RUNS = 64
"""Flights at full length, enough of them for every interval that is asserted here; the command line
runs 150."""


@pytest.fixture(scope="module")
def drift() -> dict[float, Campaign]:
    return {factor: run_campaign(ArekfConfig(runs=RUNS), factor) for factor in FACTORS}


def test_identified_noise_is_as_good_as_the_true_one(
    drift: dict[float, Campaign], note: Note
) -> None:
    for factor, campaign in drift.items():
        assert campaign.finite.all()
        for kind in KINDS:
            found = change(campaign, "arekf", "oracle", kind)
            note(f"arekf over oracle, {kind}, noise {factor:g} times", found)
            assert max(abs(found.low), abs(found.high)) < 0.03


def test_noise_ten_times_too_small_costs_attitude_and_velocity(
    drift: dict[float, Campaign], note: Note
) -> None:
    for kind in KINDS[:2]:
        found = change(drift[10.0], "ekf", "arekf", kind)
        note(f"ekf over arekf, {kind}", found)
        assert found.value > 0.8
    assert abs(change(drift[10.0], "ekf", "arekf", "position").value) < 0.05
    config = ArekfConfig(factors=FACTORS)
    claims = {claim.id: claim for claim in assess(config, drift, None)}
    for rival in ("liekf", "se23-ekf", "versoria-ekf"):
        assert claims[f"{rival}-beats-ekf"].verdict == "not testable"
    assert change(drift[10.0], "mmae", "oracle", "attitude").high < 0.03
    assert change(drift[10.0], "versoria-ekf", "ekf", "velocity").low > 0


def test_what_the_monte_carlo_finds_is_what_covariance_foretells(
    drift: dict[float, Campaign], note: Note
) -> None:
    expected = ratio_map(ArekfConfig(factors=FACTORS)).ratio[0, :, -1]
    for i, factor in enumerate(FACTORS[1:], start=1):
        for j, kind in enumerate(KINDS):
            found = change(drift[factor], "ekf", "arekf", kind)
            note(f"ekf over arekf, {kind}, noise {factor:g} times", found)
            # the interval is of 95 %; twice its width holds nine of nine but for one in a thousand
            half = found.high - found.low
            assert abs(found.value + 1 - expected[i, j]) < max(half, 0.02)


def test_arekf_is_consistent_and_the_ekf_is_not(drift: dict[float, Campaign], note: Note) -> None:
    """All fifteen states at twelve times, initial errors drawn from P0."""
    low, high = chi2_mean_bounds(15, RUNS)
    for factor, campaign in drift.items():
        nees = campaign.mean_curve["nees"]
        nees = nees[epochs_of(len(nees))]
        for name in ("arekf", "oracle"):
            own = nees[:, METHODS.index(name)]
            note(f"mean NEES of {name}, noise {factor:g} times", own)
            assert np.all((low < own) & (own < high))
        ekf = nees[:, METHODS.index("ekf")]
        assert np.all(ekf > high) if factor >= 3 else np.all((low < ekf) & (ekf < high))


def test_where_bias_limits_the_filter_its_noise_hardly_matters(note: Note) -> None:
    campaign = run_campaign(ArekfConfig(scenario="bias-dominated", runs=RUNS), 20.0)
    for kind in KINDS:
        found = change(campaign, "ekf", "arekf", kind)
        note(f"ekf over arekf, {kind}", found)
        assert found.high < 0.1


def test_versoria_pays_with_outliers_and_invariance_with_a_lost_heading(note: Note) -> None:
    spoiled = run_campaign(ArekfConfig(scenario="outliers", runs=RUNS), 1.0)
    for kind in KINDS:
        found = change(spoiled, "versoria-ekf", "ekf", kind)
        note(f"versoria-ekf over ekf, {kind}", found)
        assert found.high < -0.1
    lost = run_campaign(ArekfConfig(scenario="large-heading-error", runs=RUNS), 1.0)
    low, high = chi2_mean_bounds(15, RUNS)
    for name in ("liekf", "se23-ekf"):
        for kind in KINDS:
            found = change(lost, name, "ekf", kind)
            note(f"{name} over ekf, {kind}", found)
            assert found.high < -0.2
        assert low < lost.rows.final_nees[:, METHODS.index(name)].mean() < high
    assert lost.rows.final_nees[:, METHODS.index("ekf")].mean() > high
