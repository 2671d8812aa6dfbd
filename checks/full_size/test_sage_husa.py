"""The study sage-husa at full length: what adapting is worth in both scenarios."""

import numpy as np
import pytest

from checks.full_size import Note
from jaxnav.estimation.metrics import chi2_mean_bounds
from jaxnav.estimation.montecarlo import Campaign
from jaxnav.studies.sage_husa.claims import NOISY, best_single, change, right_weight
from jaxnav.studies.sage_husa.config import SageHusaConfig
from jaxnav.studies.sage_husa.methods import BANKS, methods_of
from jaxnav.studies.sage_husa.study import run_campaign

RUNS = 12


def config_of(scenario: str) -> SageHusaConfig:
    return SageHusaConfig(scenario=scenario, runs=RUNS)  # pyright: ignore[reportArgumentType]


@pytest.fixture(scope="module")
def tuned() -> Campaign:
    return run_campaign(config_of("tuned"))


@pytest.fixture(scope="module")
def mistuned() -> Campaign:
    return run_campaign(config_of("mistuned"))


def test_tuned_adapting_r_pays_while_the_fixes_are_noisy(tuned: Campaign, note: Note) -> None:
    config = config_of("tuned")
    for interval in NOISY:
        rival = best_single(config, tuned, interval)
        found = {
            (name, other): change(config, tuned, name, other, interval)
            for name, other in (
                ("mmae", "ukf"),
                ("sage-husa", "ukf"),
                ("oracle", "mmae"),
                ("proposed", rival),
                ("proposed-bayes-floor", "proposed"),
                ("unnormalised-floor", "proposed-bayes-floor"),
            )
        }
        for (name, other), value in found.items():
            note(f"{name} over {other}, interval {interval}", value)
        for pair in (("mmae", "ukf"), ("sage-husa", "ukf"), ("oracle", "mmae")):
            assert found[pair].high < 0
        assert found["proposed", rival].low > 0, "nothing to repair"
        assert found["proposed-bayes-floor", "proposed"].high < 0
        harm = found["unnormalised-floor", "proposed-bayes-floor"]
        assert harm.low > 0, "the normaliser differs from model to model"


def test_mistuned_the_bank_repairs_q(mistuned: Campaign, note: Note) -> None:
    """By a tenth where the fixes are good; by less than so few runs can show where they are not."""
    config = config_of("mistuned")
    for bank in ("proposed", "proposed-bayes-floor"):
        rival = best_single(config, mistuned, 1)
        found = change(config, mistuned, bank, rival, 1)
        note(f"{bank} over {rival}, interval 1", found)
        assert found.high < -0.03
        for interval in NOISY:
            assert change(config, mistuned, bank, rival, interval).low < 0
            assert change(config, mistuned, bank, "mmae", interval).high < 0
    share = right_weight(config, mistuned.mean_curve["weights"])[-1]
    assert share[list(BANKS).index("proposed")] > 0.9
    assert share[list(BANKS).index("proposed-bayes-floor")] > 0.9


def test_oracle_is_consistent_and_the_fixed_filter_is_not(tuned: Campaign, note: Note) -> None:
    """Means over an interval of correlated errors scatter more than of as many independent runs."""
    config = config_of("tuned")
    nees = tuned.rows.nees.mean(axis=0)
    names = methods_of(config)
    low, high = chi2_mean_bounds(2, RUNS)
    oracle = nees[names.index("oracle"), :3]
    note("mean NEES of oracle", oracle)
    assert np.all((low < oracle) & (oracle < high))
    assert np.all(nees[names.index("ukf")][list(NOISY)] > high)
    assert tuned.finite.all()
    assert np.all(tuned.rows.final_square < 100.0**2)
