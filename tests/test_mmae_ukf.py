"""The study mmae-ukf: the figures it must reach at full length, consistency, and bad input."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.compiling import compiled
from jaxnav.estimation.filters.kalman import ekf
from jaxnav.estimation.filters.sigma_point import ukf
from jaxnav.estimation.metrics import chi2_mean_bounds, mean_interval, nees, rmse_ratio
from jaxnav.estimation.montecarlo import Campaign
from jaxnav.estimation.run import run
from jaxnav.estimation.types import Filter, FilterParams, Gaussian, Obs
from jaxnav.navigation.models.sins_cns import LAYOUT
from jaxnav.navigation.models.sins_total import local
from jaxnav.studies.attitude import AXES
from jaxnav.studies.base import ConfigError, StudyResult
from jaxnav.studies.mmae_ukf.claims import assess, gain
from jaxnav.studies.mmae_ukf.config import MmaeUkfConfig
from jaxnav.studies.mmae_ukf.figures import draw
from jaxnav.studies.mmae_ukf.methods import (
    BANKS,
    METHODS,
    Member,
    informed,
    model_factors,
    model_of,
    run_one,
    setup_of,
)
from jaxnav.studies.mmae_ukf.simulation import build_world, fly
from jaxnav.studies.mmae_ukf.study import run_campaign, run_study
from jaxnav.studies.mmae_ukf.sweep import ANGLES_DEG, FILTERS, FORMS
from jaxnav.units import DEG


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"models": 0}, "models is 0"),
        ({"model_range": (4.0, 0.25)}, "model_range"),
        ({"alpha": 0.0}, "alpha is 0.0"),
        ({"kappa": -15.0}, "kappa is -15.0; it must be above -15"),
        ({"misalignment_deg": 120.0}, "misalignment_deg is 120.0"),
        (
            {"scenario": "large-misalignment", "misalignment_deg": 85.0},
            "sigma points stay within half a turn",
        ),
        ({"duration_s": 600.0}, "duration_s is 600.0; it must be below 465 s"),
        ({"star": "quaternion"}, "star is quaternion; it must be one of rotation-vector, euler"),
        ({"switching": 1.0}, "switching is 1.0"),
        ({"filter_period_s": 0.013}, "filter_period_s is 0.013"),
        ({"scenario": "large-misalignment", "duration_s": 8.0}, "settle_s is 10.0"),
        ({"runs": 0}, "runs is 0"),
    ],
)
def test_configuration_refuses_what_means_nothing(given: dict, told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        MmaeUkfConfig(**given)


def test_models_are_hammersley_points_in_log_space() -> None:
    factors = model_factors(MmaeUkfConfig())
    regular = (np.arange(1, 11) - 0.5) / 10
    np.testing.assert_allclose(factors[:, 0], 0.25 * 16**regular, rtol=1e-14)
    halves = [1 / 2, 1 / 4, 3 / 4, 1 / 8, 5 / 8, 3 / 8, 7 / 8, 1 / 16, 9 / 16, 5 / 16]
    np.testing.assert_allclose(factors[:, 1], 0.25 * 16 ** np.array(halves), rtol=1e-14)


@pytest.mark.parametrize(
    ("config", "thirds"),
    [
        (MmaeUkfConfig(scenario="paper", duration_s=3.0), (0.25, 1.0, 4.0)),
        (MmaeUkfConfig(scenario="reversed", duration_s=3.0), (4.0, 1.0, 0.25)),
    ],
)
def test_true_noise_changes_in_thirds(
    config: MmaeUkfConfig, thirds: tuple[float, float, float]
) -> None:
    world = build_world(config)
    np.testing.assert_array_equal(world.step_scale, np.repeat(thirds, 20))
    np.testing.assert_array_equal(world.sample_scale, np.repeat(thirds, 100))


def test_flights_start_with_errors_from_the_prior() -> None:
    """Two thousand starts: standard deviations of P0; the large error has its size exactly."""
    for scenario in ("paper", "large-misalignment"):
        config = MmaeUkfConfig(scenario=scenario, duration_s=0.1, settle_s=0.0)
        world = build_world(config)
        setup = setup_of(config)

        def start_error(key: jax.Array, world=world, setup=setup) -> jax.Array:
            flight = fly(key, world, setup.period, setup.imu_step, setup.star)
            still = jax.tree.map(lambda leaf: leaf[0], flight.truth)
            lift_off = jax.tree.map(lambda leaf: leaf[0], world.trajectory.state)
            true = still._replace(**lift_off._asdict())
            return local(true, flight.start)

        keys = jax.random.split(jax.random.key(3), 2000)
        errors = np.asarray(compiled(jax.vmap(start_error))(keys))
        sigma = np.asarray(world.prior_sigma)
        free = np.r_[3:15] if scenario == "large-misalignment" else np.r_[0:15]
        spread = errors.std(axis=0) / sigma
        # a standard deviation of 2000 draws scatters by 1.6 %; five times that
        assert np.all(np.abs(spread[free] - 1) < 0.08)
        if scenario == "large-misalignment":
            size = np.linalg.norm(errors[:, LAYOUT.phi], axis=1)
            np.testing.assert_allclose(size, 20 * DEG, rtol=1e-12)
            assert np.all(np.abs(errors[:, LAYOUT.phi].mean(axis=0)) < 5 * sigma[:3] / 2000**0.5)


def test_run_is_made_once_per_shape() -> None:
    setup = setup_of(MmaeUkfConfig())
    assert run_one(setup, 10) is run_one(setup_of(MmaeUkfConfig(seed=3)), 10)


PAPER = MmaeUkfConfig(runs=32)
"""Flights at full length, enough of them for every interval that is asserted here; the command line
runs a hundred."""


@pytest.fixture(scope="module")
def paper() -> Campaign:
    return run_campaign(PAPER)


def judge_fading_and_oracle(campaign: Campaign) -> None:
    """What holds in either direction of the schedule."""
    assert campaign.finite.all()
    for bank, single in (("mmae-ekf", "ekf"), ("mmae-ukf", "ukf")):
        plain = gain(campaign, bank, single)
        assert plain.high < 0
        assert -0.025 < plain.value < -0.01
    for bank in ("immae-ukf", "imm-ukf"):
        assert gain(campaign, bank, "ukf").value < -0.05
    assert -0.095 < gain(campaign, "oracle", "ukf").value < -0.07
    squares = campaign.rows.mean_square.mean(axis=-1)
    for name in METHODS[:-1]:
        assert rmse_ratio(squares[:, METHODS.index(name)], squares[:, -1]).low > 1
    for ours, rival in (("ukf", "ekf"), ("mmae-ukf", "mmae-ekf")):
        same = gain(campaign, ours, rival)
        assert max(abs(same.low), abs(same.high)) < 0.005


@pytest.mark.slow
def test_paper_at_full_length(paper: Campaign) -> None:
    judge_fading_and_oracle(paper)
    claims = {claim.id: claim for claim in assess(PAPER, paper, None)}
    for bank, single in (("mmae-ekf", "ekf"), ("mmae-ukf", "ukf")):
        assert claims[f"{bank}-beats-{single}"].verdict == "reproduced"
    for ours, rival in (("ukf", "ekf"), ("mmae-ukf", "mmae-ekf")):
        assert claims[f"{ours}-beats-{rival}"].verdict == "not reproduced"
    assert claims["hammersley-spreads-better"].verdict == "reproduced"
    assert claims["mmae-ukf-costs-most"].verdict == "not testable"


@pytest.mark.slow
def test_plain_bank_remembers_and_the_others_forget(paper: Campaign) -> None:
    """At the end the noise is twice nominal; the plain bank stays with the flight's average."""
    weights = paper.mean_curve["weights"]
    factors = np.log2(model_factors(PAPER)[:, 0])
    mean_factor = {
        name: 2 ** (weights[-200:, BANKS.index(name)].mean(axis=0) @ factors) for name in BANKS
    }
    assert mean_factor["mmae-ukf"] < 1.5
    assert mean_factor["imm-ukf"] > mean_factor["mmae-ukf"] + 0.3
    assert mean_factor["immae-ukf"] > mean_factor["mmae-ukf"] + 0.2


@pytest.mark.slow
def test_reversed_schedule() -> None:
    """Half as many flights, with the same program: the bars are at 2.6 standard errors or more."""
    judge_fading_and_oracle(run_campaign(replace(PAPER, scenario="reversed", runs=16)))


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


@pytest.mark.slow
def test_results_hold_every_method_and_array(short: StudyResult) -> None:
    assert tuple(short.methods) == METHODS
    assert set(short.methods["ekf"]["rmse"]) == set(AXES)
    assert 0 <= short.methods["ukf"]["settled_quickly"] <= 1
    assert set(short.dims) <= set(short.arrays)
    for name, axes in short.dims.items():
        assert short.arrays[name].ndim == len(axes), name
    assert short.arrays["trmse"].shape == (600, 7, 3)
    weights = short.arrays["mean_weights"]
    assert weights.shape == (600, len(BANKS), 2)
    np.testing.assert_allclose(weights.sum(axis=-1), 1, atol=1e-12)
    assert {claim.verdict for claim in short.claims[:-1]} == {"not testable"}
    assert short.arrays["settling"].shape == (len(FORMS), len(ANGLES_DEG), len(FILTERS), 24)


@pytest.mark.slow
def test_figures_are_drawn(short: StudyResult, tmp_path: Path) -> None:
    paths = draw(short, tmp_path)
    assert [path.name for path in paths][-1] == "settling.png"
    assert all(path.stat().st_size > 10_000 for path in paths)


@pytest.mark.slow
def test_large_misalignment_separates_the_filters(short: StudyResult) -> None:
    """With Euler angles the UKF settles sooner; with rotation vectors the filters are alike."""
    times = short.arrays["settling"]
    middle = np.median(times, axis=-1)
    euler, vector = FORMS.index("euler"), FORMS.index("rotation-vector")
    twenty = ANGLES_DEG.index(20.0)
    assert middle[euler, twenty, 1] < middle[euler, twenty, 0]
    assert mean_interval(times[euler, twenty, 1] - times[euler, twenty, 0]).high < 0
    np.testing.assert_allclose(middle[vector, :, 0], middle[vector, :, 1], atol=0.051)


@pytest.mark.slow
def test_matched_filters_are_consistent_and_mistuned_ones_are_not() -> None:
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
            return jax.vmap(nees)(jax.vmap(local)(truth, x), P)

        @compiled
        def over_runs(keys: jax.Array, share: jax.Array) -> jax.Array:
            return jax.lax.map(lambda key: one(key, share), keys, batch_size=25)

        return [np.asarray(over_runs(keys, jnp.array(share))).mean(axis=0) for share in shares]

    low, high = chi2_mean_bounds(15, runs)
    extended, mistuned = nees_of(ekf(model), 1.0, 0.1**0.5)
    (unscented,) = nees_of(ukf(model), 1.0)
    for matched in (extended, unscented):
        assert np.all((low < matched) & (matched < high))
    assert np.all(mistuned[1:] > high)
