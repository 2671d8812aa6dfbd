"""The study mmae-ukf at full length: what its banks must reach, consistency, and settling."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from checks.full_size import Note
from jaxnav.compiling import compiled
from jaxnav.estimation.filters.kalman import ekf
from jaxnav.estimation.filters.sigma_point import ukf
from jaxnav.estimation.metrics import chi2_mean_bounds, mean_interval, nees, rmse_ratio
from jaxnav.estimation.montecarlo import Campaign
from jaxnav.estimation.run import run
from jaxnav.estimation.types import Filter, FilterParams, Gaussian, Obs
from jaxnav.navigation.states import local_total
from jaxnav.studies.base import StudyResult
from jaxnav.studies.mmae_ukf.claims import assess, gain
from jaxnav.studies.mmae_ukf.config import MmaeUkfConfig
from jaxnav.studies.mmae_ukf.methods import (
    BANKS,
    METHODS,
    Member,
    informed,
    model_factors,
    model_of,
    setup_of,
)
from jaxnav.studies.mmae_ukf.simulation import build_world, fly
from jaxnav.studies.mmae_ukf.study import run_campaign, run_study
from jaxnav.studies.mmae_ukf.sweep import ANGLES_DEG, FORMS

PAPER = MmaeUkfConfig(runs=32)
"""Flights at full length, enough of them for every interval that is asserted here; the command line
runs a hundred."""


@pytest.fixture(scope="module")
def paper() -> Campaign:
    return run_campaign(PAPER)


def judge_fading_and_oracle(campaign: Campaign, note: Note) -> None:
    """What holds in either direction of the schedule."""
    assert campaign.finite.all()
    for bank, single in (("mmae-ekf", "ekf"), ("mmae-ukf", "ukf")):
        plain = gain(campaign, bank, single)
        note(f"{bank} over {single}", plain)
        assert plain.high < 0
        assert -0.025 < plain.value < -0.01
    for bank in ("immae-ukf", "imm-ukf"):
        found = gain(campaign, bank, "ukf")
        note(f"{bank} over ukf", found)
        assert found.value < -0.05
    best = gain(campaign, "oracle", "ukf")
    note("oracle over ukf", best)
    assert -0.095 < best.value < -0.07
    squares = campaign.rows.mean_square.mean(axis=-1)
    for name in METHODS[:-1]:
        assert rmse_ratio(squares[:, METHODS.index(name)], squares[:, -1]).low > 1
    for ours, rival in (("ukf", "ekf"), ("mmae-ukf", "mmae-ekf")):
        same = gain(campaign, ours, rival)
        note(f"{ours} over {rival}", same)
        assert max(abs(same.low), abs(same.high)) < 0.005


def test_paper_at_full_length(paper: Campaign, note: Note) -> None:
    judge_fading_and_oracle(paper, note)
    claims = {claim.id: claim for claim in assess(PAPER, paper, None)}
    for bank, single in (("mmae-ekf", "ekf"), ("mmae-ukf", "ukf")):
        assert claims[f"{bank}-beats-{single}"].verdict == "reproduced"
    for ours, rival in (("ukf", "ekf"), ("mmae-ukf", "mmae-ekf")):
        assert claims[f"{ours}-beats-{rival}"].verdict == "not reproduced"
    assert claims["hammersley-spreads-better"].verdict == "reproduced"
    assert claims["mmae-ukf-costs-most"].verdict == "not testable"


def test_plain_bank_remembers_and_the_others_forget(paper: Campaign, note: Note) -> None:
    """At the end the noise is twice nominal; the plain bank stays with the flight's average."""
    weights = paper.mean_curve["weights"]
    factors = np.log2(model_factors(PAPER)[:, 0])
    mean_factor = {
        name: 2 ** (weights[-200:, BANKS.index(name)].mean(axis=0) @ factors) for name in BANKS
    }
    note("mean factor at the end", list(mean_factor.values()))
    assert mean_factor["mmae-ukf"] < 1.5
    assert mean_factor["imm-ukf"] > mean_factor["mmae-ukf"] + 0.3
    assert mean_factor["immae-ukf"] > mean_factor["mmae-ukf"] + 0.2


def test_reversed_schedule(note: Note) -> None:
    """Half as many flights, with the same program: the bars are at 2.6 standard errors or more."""
    judge_fading_and_oracle(run_campaign(replace(PAPER, scenario="reversed", runs=16)), note)


@pytest.fixture(scope="module")
def short() -> StudyResult:
    """Half a minute; its sweep, of ten seconds at the noise of the first third, is the whole one's.

    A quarter of the command line's runs.
    """
    config = MmaeUkfConfig(
        scenario="large-misalignment", runs=24, models=2, duration_s=30.0, settle_s=1.0, cost=False
    )
    (result,) = run_study(config)
    return result


def test_large_misalignment_separates_the_filters(short: StudyResult, note: Note) -> None:
    """With Euler angles the UKF settles sooner; with rotation vectors the filters are alike."""
    times = short.arrays["settling"]
    middle = np.median(times, axis=-1)
    euler, vector = FORMS.index("euler"), FORMS.index("rotation-vector")
    twenty = ANGLES_DEG.index(20.0)
    note("median time to settle by form, angle and filter, s", middle)
    assert middle[euler, twenty, 1] < middle[euler, twenty, 0]
    assert mean_interval(times[euler, twenty, 1] - times[euler, twenty, 0]).high < 0
    np.testing.assert_allclose(middle[vector, :, 0], middle[vector, :, 1], atol=0.051)


def test_matched_filters_are_consistent_and_mistuned_ones_are_not(note: Note) -> None:
    """Full state, errors drawn from P0, the whole flight: NEES at twelve times."""
    runs, epochs = 50, np.arange(499, 6000, 500)
    config = MmaeUkfConfig()
    world, setup = build_world(config), setup_of(config)
    keys = jax.random.split(jax.random.key(9), runs)
    model = model_of(setup)

    def nees_of(filter: Filter, *shares: float) -> list[np.ndarray]:
        """Return the mean NEES at each time, where a share of the gyros' noise is believed in."""
        filter = informed(filter)

        def one(key: jax.Array, share: jax.Array) -> jax.Array:
            noise = world.noise._replace(gyro_noise=share * world.noise.gyro_noise)
            flight = fly(key, world, setup.period, setup.imu_step, setup.star)
            initial = Gaussian(flight.start, jnp.diag(world.prior_sigma**2))
            trace = run(
                filter,
                Member(FilterParams(noise, initial), jnp.array(True)),
                flight.inputs,
                Obs(flight.z, jnp.ones(flight.z.shape, bool)),
                record=lambda state, info: (state.x, state.P),
            )
            x, P = jax.tree.map(lambda leaf: leaf[epochs], trace.record)
            truth = jax.tree.map(lambda leaf: leaf[epochs], flight.truth)
            return jax.vmap(nees)(jax.vmap(local_total)(truth, x), P)

        @compiled
        def over_runs(keys: jax.Array, share: jax.Array) -> jax.Array:
            return jax.lax.map(lambda key: one(key, share), keys, batch_size=25)

        return [np.asarray(over_runs(keys, jnp.array(share))).mean(axis=0) for share in shares]

    low, high = chi2_mean_bounds(15, runs)
    extended, mistuned = nees_of(ekf(model), 1.0, 0.1**0.5)
    (unscented,) = nees_of(ukf(model), 1.0)
    note("mean NEES of ekf", extended)
    note("mean NEES of ukf", unscented)
    note("mean NEES of ekf, a tenth of the noise", mistuned)
    for matched in (extended, unscented):
        assert np.all((low < matched) & (matched < high))
    assert np.all(mistuned[1:] > high)
