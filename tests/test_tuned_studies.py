"""What studies offer to be tuned: losses with the right gradient, and optima worth having."""

from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.compiling import compiled
from jaxnav.config import ConfigError
from jaxnav.estimation.metrics import mean_interval
from jaxnav.estimation.tune.fit import fit, value_and_gradient
from jaxnav.estimation.tune.transforms import POSITIVE, REAL, Transform, between, coordinates
from jaxnav.estimation.types import Info
from jaxnav.studies.arekf.config import ArekfConfig
from jaxnav.studies.arekf.tuning import problem as arekf
from jaxnav.studies.gnss_track.config import GnssTrackConfig
from jaxnav.studies.gnss_track.tuning import problem as gnss_track
from jaxnav.studies.immae.config import ImmaeConfig
from jaxnav.studies.immae.tuning import burst, two_bursts
from jaxnav.studies.immae.tuning import problem as immae
from jaxnav.studies.mmae_ukf.config import MmaeUkfConfig
from jaxnav.studies.mmae_ukf.tuning import problem as mmae_ukf
from jaxnav.studies.rkcns.config import RkcnsConfig
from jaxnav.studies.rkcns.tuning import problem as rkcns
from jaxnav.studies.sage_husa.config import SageHusaConfig
from jaxnav.studies.sage_husa.tuning import Watched, rule_rmse, spells, three_spells
from jaxnav.studies.sage_husa.tuning import problem as sage_husa
from jaxnav.studies.tuned import Measure, Parameter, Problem, hand_set

DRIVE = Path(__file__).resolve().parents[2] / "shared" / "data" / "rtk_drive" / "gnss_1934_sf.pos"
recorded = pytest.mark.skipif(
    not DRIVE.is_file(), reason="the recorded drive is not in ../shared/data"
)


def transforms_of(problem: Problem) -> dict[str, Transform]:
    return {name: own.transform for name, own in problem.parameters.items()}


def check_descent(problem: Problem, runs: int) -> None:
    """The gradient at the hand-set values is right across all coordinates, and leads downhill."""
    free = coordinates(hand_set(problem), transforms_of(problem))
    data = problem.draw(jax.random.key(3), runs)
    graded = compiled(
        value_and_gradient(lambda point: problem.loss(free.constrain(point), data), problem.mode)
    )
    value, gradient = graded(free.start)
    assert np.all(np.asarray(gradient) != 0), "a parameter does nothing"
    across = jnp.sign(gradient) * jnp.linspace(1.0, 2.0, free.start.size)
    h = 1e-4
    below, above = (graded(free.start + end * across)[0] for end in (-h, h))
    slope = float(gradient @ across)
    assert abs((above - below) / (2 * h) - slope) < 1e-5 * slope
    assert graded(free.start - 0.02 * gradient / jnp.linalg.norm(gradient))[0] < value


@recorded
def test_gnss_track_fits_its_bank_on_the_first_half_and_predicts_the_second_better() -> None:
    """By more than any hand-set rule or single filter of the study."""
    problem = gnss_track(GnssTrackConfig(log=DRIVE))
    check_descent(problem, 1)
    data = problem.draw(jax.random.key(0), 1)
    found = fit(
        lambda values: problem.loss(values, data),
        hand_set(problem),
        transform=transforms_of(problem),
        steps=20,
        mode=problem.mode,
    )
    (judge,) = problem.held_out.values()
    scores = judge(found.params, jax.random.key(0), 1)
    assert {"hand-set", "mmae", "immae", "floor", "kf-0.01", "kf-10"} < set(scores)
    for rival in set(scores) - {"tuned"}:
        assert mean_interval(scores["tuned"] - scores[rival]).low > 0, rival


@recorded
def test_gnss_track_judges_the_hand_set_values_as_the_study_does() -> None:
    """The start is the study's Markov bank, whose blocks cover all but a few fixes of the half."""
    problem = gnss_track(GnssTrackConfig(log=DRIVE))
    (judge,) = problem.held_out.values()
    scores = judge(hand_set(problem), jax.random.key(0), 1)
    np.testing.assert_allclose(scores["tuned"], scores["hand-set"], rtol=1e-9)
    best = max(set(scores) - {"tuned"}, key=lambda name: scores[name].mean())
    assert best == "hand-set"


def test_gnss_track_needs_one_log_and_one_rate() -> None:
    with pytest.raises(ConfigError, match="log is not given; it must be the path"):
        gnss_track(GnssTrackConfig())
    with pytest.raises(ConfigError, match="scenario is all; it must be one of full-rate"):
        gnss_track(GnssTrackConfig(log=DRIVE, scenario="all"))


IMMAE = ImmaeConfig(duration_s=6.0, reset_period_s=1.0, theta=(1.0, 10.0, 100.0))
"""A flight of 120 steps, three models."""


def test_immae_loss_falls_against_its_gradient_and_is_judged() -> None:
    """Through the whole bank; the oracle, which knows the noise, is the best of all methods."""
    problem = immae(IMMAE)
    check_descent(problem, 3)
    judge = problem.held_out["noise-step of the paper"]
    scores = judge(hand_set(problem), jax.random.key(4), 24)
    assert set(scores) == {"tuned", "tuned, hard rule", "hand-set", "immae", "markov", "oracle"}
    np.testing.assert_allclose(scores["tuned, hard rule"], scores["hand-set"], rtol=1e-9)
    means = {name: float(values.mean()) for name, values in scores.items()}
    assert min(means, key=lambda name: means[name]) == "oracle"


def test_immae_trains_on_another_pattern_than_it_is_judged_on() -> None:
    steps = 1200
    drawn = jax.vmap(burst, in_axes=(0, None))(jax.random.split(jax.random.key(1), 200), steps)
    drawn = np.asarray(drawn)
    grown = drawn > 1
    assert np.all((np.diff(grown.astype(int), axis=1) == 1).sum(axis=1) == 1)
    assert 0.09 < grown.mean(axis=1).min() < 0.15 < 0.35 < grown.mean(axis=1).max() <= 0.41
    assert 5 <= drawn[grown].min() < 6 < 18 < drawn.max() <= 20
    unseen = np.asarray(two_bursts(steps))
    assert (np.diff((unseen > 1).astype(int)) == 1).sum() == 2


SHORT = SageHusaConfig(
    duration_s=550.0,
    ins_rate_hz=2.0,
    first_noise_s=(500.0, 510.0),
    second_noise_s=(520.0, 530.0),
    forgetting=(0.95, 0.97),
    q_scales=(0.1, 1.0),
)
"""The shortest drive that the study accepts, nearly, and four members."""


def made_up(runs: int, steps: int) -> Watched:
    """What four members might have told: the third is right, the others sure of themselves."""
    rng = np.random.default_rng(5)
    shape = (runs, steps, 4)
    nis = jnp.array(rng.chisquare(6, shape) * [1.3, 1.1, 1.0, 0.8])
    spread = jnp.array([-4.0, -2.0, 0.0, 3.0])
    none = jnp.zeros((*shape, 0))
    flags = jnp.zeros(shape, jnp.int32)
    info = Info(none, none, spread[None, None] - 0.5 * nis, nis, flags, flags, flags > 0, flags > 0)
    return Watched(info, jnp.array(rng.normal(size=(*shape, 2)) * [[2.0], [1.5], [1.0], [3.0]]))


def test_sage_husa_rule_is_tuned_over_members_that_have_run() -> None:
    """The gradient by the rule's parameters, with members that no filter has to run for."""
    start = {
        "penalty_scale": Parameter(0.1, POSITIVE, ""),
        "penalty_exponent": Parameter(0.15, REAL, ""),
        "normaliser": Parameter(0.3, REAL, ""),
        "weight_floor": Parameter(1e-2, between(0.0, 0.25), ""),
    }
    problem = Problem(
        parameters=start,
        draw=lambda key, runs: made_up(runs, 40),
        loss=partial(rule_rmse, True),
        hard=None,
        held_out={},
        measure=Measure("mean-square", "", "m"),
    )
    check_descent(problem, 3)


@pytest.mark.slow
def test_sage_husa_loss_falls_against_its_gradient() -> None:
    """Through the members too, whose derivative is by their forgetting factors alone."""
    check_descent(sage_husa(SHORT), 2)


def test_sage_husa_trains_on_other_spells_than_it_is_judged_on() -> None:
    steps = 1200
    added = jax.vmap(spells, in_axes=(0, None))(jax.random.split(jax.random.key(1), 200), steps)
    noisy = np.asarray(added) > 0
    starts = (np.diff(noisy.astype(int), axis=1) == 1).sum(axis=1)
    assert np.all(starts == 2)
    assert np.all(noisy.mean(axis=1) > 0.15)
    assert np.all(noisy.mean(axis=1) < 0.55)
    levels = np.asarray(added)[noisy]
    assert 3 <= levels.min() < 4 < 13 < levels.max() <= 15
    assert len(np.unique(np.asarray(three_spells(steps)))) == 4


AREKF = ArekfConfig(
    scenario="outliers",
    duration_s=4.0,
    settle_s=0.0,
    align_s=6.0,
    ins_rate_hz=100.0,
    outlier_share=0.2,
)
MMAE_UKF = MmaeUkfConfig(
    scenario="large-misalignment", duration_s=2.0, settle_s=0.0, models=3, reset_period_s=0.5
)
RKCNS = RkcnsConfig(scenario="strong-nonlinearity", duration_s=170.0, ins_rate_hz=20.0)


def check_slope(problem: Problem) -> None:
    """As :func:`check_descent` in one direction, which takes one small program."""
    free = coordinates(hand_set(problem), transforms_of(problem))
    data = problem.draw(jax.random.key(3), 2)
    direction = jnp.where(jnp.arange(free.start.size) % 2, -1.0, 1.0)

    @compiled
    def along(point: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jax.jvp(
            lambda point: problem.loss(free.constrain(point), data), (point,), (direction,)
        )

    # The mean of the slopes over a stretch is the difference of the values at its ends, which is
    # wide enough for the rounding of a loss that iterates on a spread of metres.
    half = 1e-3
    at, weights = np.polynomial.legendre.leggauss(5)
    ahead, behind = (along(free.start + s * half * direction)[0] for s in (1, -1))
    slopes = [along(free.start + s * half * direction)[1] for s in at]
    np.testing.assert_allclose(weights @ slopes / 2, (ahead - behind) / (2 * half), rtol=1e-5)
    value, slope = along(free.start)
    assert along(free.start - 0.01 * jnp.sign(slope) * direction)[0] < value


def test_arekf_loss_falls_against_its_slope() -> None:
    check_slope(arekf(AREKF))


def test_mmae_ukf_loss_falls_against_its_slope() -> None:
    check_slope(mmae_ukf(MMAE_UKF))


@pytest.mark.slow
def test_rkcns_loss_falls_against_its_slope() -> None:
    check_slope(rkcns(RKCNS))


def test_all_scenarios_at_once_are_refused() -> None:
    cases: list[tuple[Any, Any]] = [
        (immae, ImmaeConfig(scenario="all")),
        (sage_husa, SageHusaConfig(scenario="all")),
        (arekf, ArekfConfig(scenario="all")),
        (mmae_ukf, MmaeUkfConfig(scenario="all")),
        (rkcns, RkcnsConfig(scenario="all")),
    ]
    for problem, config in cases:
        with pytest.raises(ConfigError, match="scenario is all; it must be one of"):
            problem(config)
