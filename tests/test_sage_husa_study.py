"""The study sage-husa: the figures it must reach at full length, both scenarios, and bad input."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.config import ConfigError
from jaxnav.estimation.banks.mixture import moment_match
from jaxnav.estimation.montecarlo import Campaign
from jaxnav.estimation.types import Gaussian
from jaxnav.navigation.earth import displaced, offset_between
from jaxnav.navigation.states import SinsLevel, error_form
from jaxnav.studies.sage_husa import study
from jaxnav.studies.sage_husa.claims import NOISY, assess, change
from jaxnav.studies.sage_husa.config import SageHusaConfig
from jaxnav.studies.sage_husa.figures import draw
from jaxnav.studies.sage_husa.methods import BANKS, HORIZONTAL, horizontal
from jaxnav.studies.sage_husa.study import compared, run_campaign
from tests.oracles.matrices import random_spd

pytestmark = pytest.mark.usefixtures("optimised_module")


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"scenario": "calm"}, "scenario is calm; it must be one of tuned, mistuned"),
        (
            {"forgetting": (0.9, 1.0)},
            "forgetting is .*; .* numbers, each between 0 and 1",
        ),
        ({"single_forgetting": 0.9}, "single_forgetting is 0.9; it must be one of the forgetting"),
        ({"q_scales": (0.1, 10.0)}, "q_scales is .*; it must be such that one of them is 1"),
        ({"r_scales": (1.0, 1.0)}, "r_scales is .*; it must be different in every entry"),
        ({"clamp": (2.0, 100.0)}, "clamp is .*; it must be a number below 1 and one above"),
        ({"prior_count": -1.0}, "prior_count is -1.0; it must be zero or more"),
        ({"weight_floor": 0.2}, "weight_floor is 0.2; it must be positive and below 1 / 9"),
        ({"fix_interval_s": 0.03}, "fix_interval_s is 0.03; it must be such that there is a whole"),
        ({"first_noise_s": (300.0, 900.0)}, "first_noise_s is .*from 500 s on"),
        ({"second_noise_s": (1000.0, 1500.0)}, "second_noise_s is .*from 1200 to 3500 s"),
        ({"duration_s": 2000.0}, "second_noise_s is .*from 1200 to 2000 s"),
        ({"vrw": 0.0}, "vrw is 0.0; it must be positive"),
        ({"penalty_exponent": -0.1}, "penalty_exponent is -0.1; it must be zero or more"),
        ({"gnss_position": float("inf")}, "gnss_position is inf; it must be finite"),
    ],
)
def test_configuration_refuses_what_means_nothing(given: dict, told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        SageHusaConfig(**given)


def test_horizontal_positions_of_mixtures_are_those_of_the_bank() -> None:
    """Five members some metres apart; one left out."""
    rng = np.random.default_rng(3)
    start = jnp.array([0.6, 1.9, 400.0])
    offset = jnp.array(rng.normal(size=(5, 3)) * [5.0, 8.0, 2.0])
    position = jax.vmap(displaced, in_axes=(None, 0))(start, offset)
    none = jnp.zeros((5, 3))
    mean = SinsLevel(jnp.tile(jnp.eye(3), (5, 1, 1)), none, position, none, none)
    members = Gaussian(mean, jnp.array(random_spd(rng, 5, 15)))
    weights = np.array([[0.1, 0.2, 0.3, 0.4, 0.0], [0.0, 1.0, 0.0, 0.0, 0.0]])
    with np.errstate(divide="ignore"):
        logs = jnp.array(np.log(weights))
    form = error_form("additive", start)
    found = horizontal(logs, members)
    for i in range(2):
        bank = moment_match(logs[i], members, form.retract, form.local)
        off = offset_between(bank.mean.position, found.mean[i])
        np.testing.assert_allclose(off[:2], 0, atol=1e-8)
        # Offsets are taken from another member, where a degree has other metres: 1e-6 in 10 m.
        np.testing.assert_allclose(found.cov[i], bank.cov[HORIZONTAL, HORIZONTAL], rtol=1e-5)


RUNS = 3
"""At full length, which the intervals of the claims need; ``checks/full_size`` has more of them."""


def config_of(scenario: str) -> SageHusaConfig:
    return SageHusaConfig(scenario=scenario, runs=RUNS)  # pyright: ignore[reportArgumentType]


@pytest.fixture(scope="module")
def tuned() -> Campaign:
    return run_campaign(config_of("tuned"))


@pytest.mark.slow
def test_adapting_r_pays_while_the_fixes_are_noisy(tuned: Campaign) -> None:
    """A sample of ``checks/full_size``, without its intervals."""
    assert tuned.finite.all()
    for interval in NOISY:
        for name in ("mmae", "sage-husa", "oracle"):
            assert change(config_of("tuned"), tuned, name, "ukf", interval).value < -0.1


@pytest.mark.slow
def test_results_hold_every_method_weight_and_figure(
    tuned: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The campaign is the one of the other tests."""
    config = config_of("tuned")
    monkeypatch.setattr(study, "run_campaign", lambda config, **options: tuned)
    (result,) = study.run_study(config)
    assert list(result.methods) == compared(config)
    assert set(result.methods["proposed"]["mse"]) == {"east", "north"}
    spans = result.methods["proposed"]["mse"]["north"]
    assert list(spans) == ["700-1200", "1200-1800", "1800-2300"]
    assert all(entry["unit"] == "m^2" and entry["value"] > 0 for entry in spans.values())
    for name, axes in result.dims.items():
        assert result.arrays[name].ndim == len(axes), name
    weights = result.arrays["mean_weights"]
    assert weights.shape == (3500, len(BANKS), 9)
    np.testing.assert_allclose(weights.sum(axis=-1), 1, rtol=1e-9)
    claims = {claim.id: claim for claim in result.claims}
    assert len(claims) == len(result.claims)
    assert claims["proposed-beats-ukf-700-1200"].published == pytest.approx(-0.4646, abs=1e-4)
    assert {claim.verdict for claim in result.claims} <= {"reproduced", "not reproduced"}
    paths = draw(result, tmp_path)
    assert all(path.stat().st_size > 10_000 for path in paths)


@pytest.mark.slow
def test_claims_are_not_judged_away_from_the_papers_numbers(tuned: Campaign) -> None:
    changed = SageHusaConfig(runs=RUNS, penalty_exponent=0.2)
    assert {claim.verdict for claim in assess(changed, tuned)} == {"not testable"}
