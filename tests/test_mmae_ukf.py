"""The study mmae-ukf: the figures it must reach at full length, consistency, and bad input."""

from pathlib import Path

import jax
import numpy as np
import pytest

from jaxnav.compiling import compiled
from jaxnav.config import ConfigError
from jaxnav.navigation.states import LAYOUT, local_total
from jaxnav.studies.attitude import AXES
from jaxnav.studies.base import StudyResult
from jaxnav.studies.mmae_ukf.config import MmaeUkfConfig
from jaxnav.studies.mmae_ukf.figures import draw
from jaxnav.studies.mmae_ukf.methods import (
    BANKS,
    METHODS,
    model_factors,
    run_one,
    setup_of,
)
from jaxnav.studies.mmae_ukf.simulation import build_world, fly
from jaxnav.studies.mmae_ukf.study import run_study
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
            return local_total(true, flight.start)

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


@pytest.fixture(scope="module")
def short() -> StudyResult:
    """Half a minute of few flights, and the sweep of ten seconds."""
    config = MmaeUkfConfig(
        scenario="large-misalignment", runs=4, models=2, duration_s=30.0, settle_s=1.0, cost=False
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
    assert short.arrays["settling"].shape == (len(FORMS), len(ANGLES_DEG), len(FILTERS), 4)


@pytest.mark.slow
def test_by_euler_angles_the_unscented_filter_settles_sooner(short: StudyResult) -> None:
    """A sample of ``checks/full_size``."""
    times = short.arrays["settling"]
    twenty = times[:, ANGLES_DEG.index(20.0)].mean(axis=-1)
    euler, vector = twenty[FORMS.index("euler")], twenty[FORMS.index("rotation-vector")]
    assert euler[FILTERS.index("ukf")] < euler[FILTERS.index("ekf")]
    assert abs(vector[0] - vector[1]) < 0.06


@pytest.mark.slow
def test_figures_are_drawn(short: StudyResult, tmp_path: Path) -> None:
    paths = draw(short, tmp_path)
    assert [path.name for path in paths][-1] == "settling.png"
    assert all(path.stat().st_size > 10_000 for path in paths)
