"""The interacting bank: what it equals in its limits, what breaks others, and what it refuses."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.estimation.banks.imm import imm, imm_params, mix, uniform_switching
from jaxnav.estimation.banks.log_weights import normalise
from jaxnav.estimation.banks.mixture import BankParams, mmae, moment_match
from jaxnav.estimation.banks.weights import switched
from jaxnav.estimation.filters.kalman import ekf, kf
from jaxnav.estimation.run import run
from jaxnav.estimation.tune.losses import negative_log_likelihood
from jaxnav.estimation.types import Filter, FilterParams, Flag, Gaussian, Model, Obs, replicate
from jaxnav.navigation.models.sins_total import SinsTotalInput, SinsTotalParams, sins_total
from jaxnav.navigation.states import SinsTotal, retract_total
from jaxnav.numerics.lie import dcm_from_euler
from jaxnav.units import ARCSEC, DEG, DEG_PER_HOUR, MICRO_G

STEPS = 40


class Factors(NamedTuple):
    """Factors on the noises of the test's model."""

    q: Array
    r: Array


TRANSITION = np.array([[1.0, 0.5], [0.0, 0.9]])
MODEL = Model(
    transition=lambda p, x, u: jnp.asarray(TRANSITION) @ x,
    process_noise=lambda p, x, u: p.q * jnp.diag(jnp.array([0.01, 0.1])),
    observe=lambda p, x, u: x[:1],
    # the input breaks the observation of a step
    observation_noise=lambda p, x, u: p.r * u * jnp.ones(1),
)
SINGLE, IMM, MMAE = kf(MODEL), imm(kf(MODEL)), mmae(kf(MODEL))
SWITCHING = jnp.array([[0.9, 0.06, 0.04], [0.1, 0.85, 0.05], [0.02, 0.08, 0.9]])


def single(q: float = 1.0, r: float = 1.0) -> FilterParams:
    return FilterParams(
        Factors(jnp.array(q), jnp.array(r)), Gaussian(jnp.zeros(2), jnp.diag(jnp.array([4.0, 1.0])))
    )


def bank(q: list[float], r: list[float], transition: Any, prior: Any = None) -> BankParams:
    members = replicate(single(), len(q))._replace(model=Factors(jnp.array(q), jnp.array(r)))
    return BankParams(members, transition, prior)


THREE = partial(bank, [0.2, 1.0, 8.0], [1.0, 0.5, 2.0])


def watched(filter: Filter, state: Any, info: Any) -> tuple[Gaussian, Any, Array]:
    """Estimate, info and weights of a step."""
    return filter.estimate(state), info, getattr(state, "log_weights", jnp.zeros(1))


WATCH = {filter: partial(watched, filter) for filter in (SINGLE, IMM, MMAE)}


def filtered(filter: Filter, params: Any, z: np.ndarray, scale: np.ndarray | None = None) -> Any:
    """Run over ``(T, 1)`` with a factor on R per step; return estimates, infos and weights."""
    factors = np.ones(len(z)) if scale is None else scale
    obs = Obs(jnp.array(z), jnp.ones(z.shape, bool))
    return run(filter, params, jnp.array(factors), obs, record=WATCH[filter]).record


DATA = np.cumsum(np.random.default_rng(0).normal(size=(STEPS, 1)), axis=0)


def assert_close(actual: Any, expected: Any, tolerance: float = 1e-12) -> None:
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance)


def test_identity_transition_is_mmae() -> None:
    expected = filtered(MMAE, THREE(()), DATA)
    assert_close(filtered(IMM, THREE(jnp.eye(3)), DATA), expected)
    different, _, _ = filtered(IMM, THREE(SWITCHING), DATA)
    assert np.abs(different.mean - expected[0].mean).max() > 1e-3


def test_one_model_is_the_filter() -> None:
    estimate, info, _ = filtered(IMM, bank([1.0], [1.0], jnp.ones((1, 1))), DATA)
    expected, lone, _ = filtered(SINGLE, single(), DATA)
    assert_close((estimate, info), (expected, lone))


def test_members_alike_keep_equal_weights_and_are_the_filter() -> None:
    params = bank([1.0] * 3, [1.0] * 3, uniform_switching(3, 0.1))
    estimate, info, log_weights = filtered(IMM, params, DATA)
    expected, lone, _ = filtered(SINGLE, single(), DATA)
    assert_close((estimate, info.log_likelihood), (expected, lone.log_likelihood))
    np.testing.assert_allclose(np.exp(log_weights), 1 / 3, atol=1e-12)


def test_step_that_no_model_explains() -> None:
    """A NIS of 1e6 for every model: each likelihood is zero in float64."""
    z = DATA.copy()
    z[20] += 1e4
    estimate, info, log_weights = filtered(IMM, THREE(SWITCHING), z)
    assert info.log_likelihood[20] < -1e5
    assert np.abs(np.exp(log_weights).sum(axis=1) - 1).max() <= 12 * np.finfo(float).eps
    assert np.all(np.isfinite(estimate.mean))
    assert np.all(np.isfinite(estimate.cov))


def test_model_that_turns_right_leads_within_twenty_steps() -> None:
    rng = np.random.default_rng(1)
    z = rng.normal(size=(10_020, 1))
    z[10_000:] *= 6
    params = bank([1e-6, 1e-6, 1e-6], [1.0, 36.0, 1e4], uniform_switching(3, 1e-3))
    _, _, log_weights = filtered(IMM, params, z)
    w = np.exp(np.asarray(log_weights))
    assert np.all(np.isfinite(w))
    assert np.abs(w.sum(axis=1) - 1).max() <= 12 * np.finfo(float).eps
    assert w[9999].argmax() == 0
    assert w[-1, 1] > 0.9


def test_veto_of_all_keeps_the_predicted_weights() -> None:
    scale = np.ones(STEPS)
    scale[10] = -1e6
    estimate, info, log_weights = filtered(IMM, THREE(SWITCHING), DATA, scale)
    assert info.flags[10] & Flag.ALL_MODELS_VETOED
    assert info.flags[10] & Flag.NOT_POSITIVE_DEFINITE
    assert info.log_likelihood[10] == -np.inf
    before, after = np.exp(log_weights[9]), np.exp(log_weights[10])
    np.testing.assert_allclose(after, before @ SWITCHING, rtol=1e-12)
    assert np.all(np.asarray(info.flags)[11:] == 0)
    assert np.all(np.isfinite(estimate.mean))


def test_padding_changes_nothing() -> None:
    """A member that takes no part is not a number, and all go to it as it would go to all."""
    plain = filtered(IMM, THREE(SWITCHING), DATA)
    leaking = np.full((4, 4), 0.25)
    leaking[:3, :3], leaking[:3, 3] = 0.8 * SWITCHING, 0.2
    prior = jnp.array([0.0, 0.0, 0.0, -jnp.inf])
    params = bank([0.2, 1.0, 8.0, np.nan], [1.0, 0.5, 2.0, np.nan], jnp.array(leaking), prior)
    estimate, info, log_weights = filtered(IMM, params, DATA)
    assert_close((estimate, info, log_weights[:, :3]), plain)
    assert np.all(np.isneginf(log_weights[:, 3]))


@pytest.mark.parametrize("broken", [np.nan, -1e6])
def test_member_that_fails_leaves_the_others_finite(broken: float) -> None:
    params = bank([0.2, 1.0, 8.0], [1.0, broken, 2.0], SWITCHING)
    estimate, info, log_weights = filtered(IMM, params, DATA)
    assert np.all(np.isfinite(estimate.mean))
    assert np.all(np.isfinite(estimate.cov))
    assert np.all(np.isfinite(info.log_likelihood))
    np.testing.assert_array_equal(np.exp(log_weights[:, 1]), 0)


def test_mixing_keeps_the_moments_of_the_bank() -> None:
    rng = np.random.default_rng(2)
    roots = rng.normal(size=(3, 2, 1))  # of rank one: nothing to spare
    members = Gaussian(jnp.array(rng.normal(size=(3, 2))), jnp.array(roots @ roots.mT))
    log_weights = jnp.log(jnp.array([0.5, 0.3, 0.2]))
    moved = switched(log_weights, SWITCHING)
    mixed = mix(moved.origins, log_weights, members, SINGLE)
    assert np.linalg.eigvalsh(mixed.cov).min() > -1e-15
    assert_close(moment_match(moved.log_weights, mixed), moment_match(log_weights, members), 1e-14)


def test_gradient_by_the_switching_probability() -> None:
    obs = Obs(jnp.array(DATA), jnp.ones(DATA.shape, bool))

    @compiled
    def loss(p: Array) -> Array:
        params = THREE(uniform_switching(3, p))
        return negative_log_likelihood(IMM, params, jnp.ones(STEPS), obs)

    for p in (0.02, 0.3):
        numeric = (loss(jnp.array(p + 1e-5)) - loss(jnp.array(p - 1e-5))) / 2e-5
        np.testing.assert_allclose(jax.grad(loss)(jnp.array(p)), numeric, rtol=1e-7)


def test_bad_transition_matrices_are_named() -> None:
    members = THREE(()).members
    assert imm_params(members, SWITCHING).rule is SWITCHING
    cases = {
        "row 1 .* sums to 0.9; ": SWITCHING.at[1, 0].set(0.0),
        "entry -0.1; none": SWITCHING.at[0].set(jnp.array([0.9, 0.2, -0.1])),
        r"is \(2, 2\); a bank of 3 members needs \(3, 3\)": jnp.eye(2),
    }
    for message, matrix in cases.items():
        with pytest.raises(ValueError, match=message):
            imm_params(members, matrix)
    with pytest.raises(ValueError, match=r"is \(2, 2\); a bank of 3 members needs \(3, 3\)"):
        filtered(IMM, THREE(jnp.eye(2)), DATA)


PERIOD = 0.05
SINS = sins_total(PERIOD, 0.01, 6.371e6)


def navigation(count: int) -> tuple[FilterParams, SinsTotalInput, Obs]:
    """Members that differ in their gyro noise, on a few steps of a boost with a star tracker."""
    sigma = jnp.array(
        [10 * ARCSEC] * 3 + [0.1] * 3 + [10.0] * 3 + [0.1 * DEG_PER_HOUR] * 3 + [50 * MICRO_G] * 3
    )
    truth = SinsTotal(
        dcm_from_euler(jnp.array(80 * DEG), jnp.array(2 * DEG), jnp.array(-30 * DEG)),
        jnp.array([20.0, 300.0, 1.0]),
        jnp.array([100.0, 5e3, -3.0]),
        jnp.zeros(3),
        jnp.zeros(3),
    )
    rng = np.random.default_rng(3)
    start = retract_total(truth, sigma * jnp.array(rng.normal(size=15)))
    noise = SinsTotalParams(
        jnp.full(3, 0.05 * DEG_PER_HOUR),
        jnp.full(3, 10 * MICRO_G),
        jnp.array(50 * MICRO_G),
        jnp.array(300.0),
        jnp.full(3, 5 * ARCSEC),
    )
    members = replicate(FilterParams(noise, Gaussian(start, jnp.diag(sigma**2))), count)
    scale = jnp.array(10.0 ** np.arange(count))
    gyro = members.model.gyro_noise * scale[:, None]
    members = members._replace(model=members.model._replace(gyro_noise=gyro))
    inputs = SinsTotalInput(
        jnp.array(rng.normal(size=(8, 3))) * 0.2 * DEG * PERIOD,
        jnp.array(np.tile([25.0 * PERIOD, 0.0, 0.0], (8, 1))),
        jnp.ones(8),
    )
    seen = SINS.observe(noise, truth, jax.tree.map(lambda leaf: leaf[0], inputs))
    z = seen[None] + 20 * ARCSEC * jnp.array(rng.normal(size=(8, 3)))
    return members, inputs, Obs(z, jnp.ones((8, 3), bool))


@pytest.mark.slow
def test_limits_on_the_manifold() -> None:
    """To 1e-9 of each standard deviation: the tangent space is entered and left every step."""
    base = ekf(SINS)
    members, inputs, obs = navigation(3)
    alone = jax.tree.map(lambda leaf: leaf[0], members)
    one = jnp.array([0.0, -jnp.inf, -jnp.inf])
    interacting, independent = imm(base), mmae(base)
    pairs = [
        ((interacting, jnp.eye(3), jnp.zeros(3)), (independent, (), jnp.zeros(3))),
        ((interacting, SWITCHING, one), (base, None, None)),
    ]
    for left, right in pairs:
        records = [
            run(f, alone if f is base else BankParams(members, rule, prior), inputs, obs).record
            for f, rule, prior in (left, right)
        ]
        (a, seen_a), (b, seen_b) = records
        sigma = np.sqrt(np.diagonal(b.cov, axis1=1, axis2=2))
        apart = jax.vmap(SINS.local)(a.mean, b.mean)
        np.testing.assert_allclose(apart / sigma, 0, atol=1e-9)
        scale = sigma[:, :, None] * sigma[:, None]
        np.testing.assert_allclose((a.cov - b.cov) / scale, 0, atol=1e-9)
        np.testing.assert_allclose(seen_a.log_likelihood, seen_b.log_likelihood, rtol=1e-9)


def test_mixing_on_the_manifold_averages_small_rotations() -> None:
    """Three attitudes 30 arc seconds apart: the middle one, and a variance of 600 more."""
    base = ekf(SINS)
    three, _, _ = navigation(3)
    log_weights = normalise(jnp.zeros(3))
    members = jax.vmap(base.estimate)(jax.vmap(base.init)(three))
    turned = jnp.zeros((3, 15)).at[:, 2].set(jnp.array([-30.0, 0.0, 30.0]) * ARCSEC)
    spread = members._replace(mean=jax.vmap(SINS.retract)(members.mean, turned))
    mixed = mix(jnp.full((3, 3), -jnp.log(3.0)), log_weights, spread, base)
    for j in range(3):
        mean = jax.tree.map(lambda leaf, j=j: leaf[j], mixed.mean)
        middle = jax.tree.map(lambda leaf: leaf[1], spread.mean)
        np.testing.assert_allclose(SINS.local(middle, mean)[:3] / ARCSEC, 0, atol=1e-6)
        gained = mixed.cov[j, 2, 2] - members.cov[0, 2, 2]
        np.testing.assert_allclose(gained / ARCSEC**2, 600, rtol=1e-6)
