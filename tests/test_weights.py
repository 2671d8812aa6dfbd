"""Weight rules at the edges: underflow, vetoes, padding, and what the smooth reset keeps."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.compiling import compiled
from jaxnav.estimation.banks.imm import uniform_switching
from jaxnav.estimation.banks.log_weights import normalise, uniform
from jaxnav.estimation.banks.mixture import mixture_info, moment_match
from jaxnav.estimation.banks.reset import WindowedReset, windowed_reset
from jaxnav.estimation.banks.rule import WeightRule
from jaxnav.estimation.banks.weights import (
    Penalty,
    bayes,
    chain,
    fixed,
    floor,
    forget,
    markov,
    penalty,
    switch,
    switched,
)
from jaxnav.estimation.types import Flag, Gaussian, Info

MODELS = 3
RESET = WindowedReset(jnp.array(20.0), jnp.array(0.9), jnp.array(0.05))
PENALTY = Penalty(*map(jnp.array, (0.3, 0.15, 200.0, 0.2, 0.5)))
RULES: dict[str, tuple[WeightRule, tuple]] = {
    "bayes": (chain(bayes()), ((),)),
    "penalty": (chain(penalty()), (PENALTY,)),
    "floor": (chain(bayes(), floor()), ((), jnp.array(1e-6))),
    "forget": (chain(forget(), bayes()), (jnp.array(0.98), ())),
    "markov": (chain(markov(), bayes()), (jnp.array(1e-3), ())),
    "switch": (chain(switch(), bayes()), (uniform_switching(MODELS, 1e-3), ())),
    "reset": (chain(bayes(), windowed_reset()), ((), RESET)),
    "smooth reset": (chain(bayes(), windowed_reset(smooth=True)), ((), RESET)),
}
each_rule = pytest.mark.parametrize("name", RULES)


def info_of(log_likelihood: jax.Array) -> Info:
    """The part of a bank's info that the rules read, for innovations of unit variance."""
    zero = jnp.zeros(log_likelihood.shape[0])
    flags = jnp.zeros(log_likelihood.shape[0], jnp.int32)
    known = jnp.isfinite(log_likelihood)
    nis = jnp.where(known, -2 * log_likelihood - math.log(2 * math.pi), 0)
    none = flags[:, None] > 0
    one = jnp.ones((zero.size, 1, 1))
    return Info(zero[:, None], one, log_likelihood, nis, flags, flags, none, none)


def weigh(
    name: str, rows: jax.Array, prior: jax.Array | None = None, params: tuple | None = None
) -> jax.Array:
    """Log-weights (T, M) of a rule over log-likelihoods (T, M)."""
    rule, own = RULES[name]
    own = own if params is None else params
    start = normalise(jnp.zeros(rows.shape[1]) if prior is None else prior)

    def step(carry: tuple, row: jax.Array) -> tuple[tuple, jax.Array]:
        memory, log_weights, k = carry
        log_weights = rule.predict(own, memory, log_weights, k)
        memory, log_weights = rule.update(own, memory, log_weights, info_of(row), k)
        return (memory, log_weights, k + 1), log_weights

    first = (rule.init(own, start), start, jnp.int32(1))
    return compiled(lambda rows: jax.lax.scan(step, first, rows)[1])(rows)


@each_rule
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_weights_sum_to_one_through_underflow(name: str, dtype: jnp.dtype) -> None:
    """One step in which every likelihood underflows, and 10,000 steps with a wrong model."""
    rows = jnp.broadcast_to(jnp.array([-1.0, -1.5, -9.0]), (10_000, MODELS))
    rows = rows.at[5].set(-5e5).astype(dtype)
    params = jax.tree.map(lambda leaf: leaf.astype(dtype), RULES[name][1])
    start = normalise(jnp.zeros(MODELS, dtype))
    w = np.exp(np.asarray(weigh(name, rows, start, params), np.float64))
    assert np.all(np.isfinite(w))
    assert np.abs(w.sum(axis=1) - 1).max() <= 4 * MODELS * np.finfo(dtype).eps
    assert w[-1].argmax() == 0


@each_rule
def test_members_alike_keep_equal_weights(name: str) -> None:
    rng = np.random.default_rng(0)
    rows = jnp.array(np.repeat(rng.normal(size=(500, 1)), MODELS, axis=1))
    np.testing.assert_allclose(np.exp(weigh(name, rows)), 1 / MODELS, atol=1e-12)


def leaking(transition: jax.Array) -> jax.Array:
    """A transition matrix with two models more, to which every model goes and that go to all."""
    to_padding = jnp.full((MODELS, 2), 0.05)
    from_padding = jnp.full((2, MODELS + 2), 1 / (MODELS + 2))
    return jnp.concatenate(
        [jnp.concatenate([0.9 * transition, to_padding], axis=1), from_padding], axis=0
    )


@each_rule
def test_padding_changes_nothing_and_stays_out(name: str) -> None:
    rng = np.random.default_rng(1)
    rows = jnp.array(rng.normal(size=(300, MODELS)))
    padded = jnp.concatenate([rows, 100 + rows[:, :2]], axis=1)
    prior = jnp.array([0.0, 0.0, 0.0, -jnp.inf, -jnp.inf])
    params = (leaking(RULES[name][1][0]), ()) if name == "switch" else None
    plain, wide = weigh(name, rows), weigh(name, padded, prior, params)
    np.testing.assert_allclose(wide[:, :MODELS], plain, atol=1e-12)
    assert np.all(np.isneginf(wide[:, MODELS:]))


@each_rule
@pytest.mark.parametrize("veto", [-jnp.inf, jnp.nan])
def test_veto_of_all_keeps_weights_and_of_one_drops_it(name: str, veto: float) -> None:
    rows = jnp.zeros((6, MODELS)).at[2].set(veto)
    np.testing.assert_allclose(np.exp(weigh(name, rows)), 1 / MODELS, atol=1e-12)
    dropped = np.exp(weigh(name, jnp.zeros((6, MODELS)).at[2, 1].set(veto)))
    np.testing.assert_array_equal(dropped[2:, 1], 0)
    np.testing.assert_allclose(dropped[2:, [0, 2]], 0.5, atol=1e-12)


@pytest.mark.parametrize("name", ["floor", "markov", "switch", "reset"])
def test_a_model_that_was_ruled_out_comes_back(name: str) -> None:
    """After 2000 steps against it, a model that turns right leads within two windows."""
    wrong = jnp.broadcast_to(jnp.array([0.0, -2.0, -8.0]), (2000, MODELS))
    right = jnp.broadcast_to(jnp.array([-2.0, 0.0, -8.0]), (40, MODELS))
    log_weights = weigh(name, jnp.concatenate([wrong, right]))
    assert log_weights[-1].argmax() == 1
    assert weigh("bayes", jnp.concatenate([wrong, right]))[-1].argmax() == 0


def test_windows_that_agree_never_reset() -> None:
    rng = np.random.default_rng(2)
    rows = jnp.array([[0.0, -1.5, -4.0]]) + jnp.array(0.1 * rng.normal(size=(400, MODELS)))
    np.testing.assert_allclose(weigh("reset", rows), weigh("bayes", rows), atol=1e-12)


@pytest.mark.parametrize("name", ["floor", "forget", "markov", "smooth reset", "penalty"])
def test_gradient_of_a_rules_parameter(name: str) -> None:
    """The gradient by a rule's own parameters is finite and is the central difference."""
    rng = np.random.default_rng(4)
    rows = jnp.array(rng.normal(size=(60, MODELS)))
    target = jnp.array(rng.normal(size=(60, MODELS)))
    leaves, tree = jax.tree.flatten(RULES[name][1])

    @compiled
    def score(values: jax.Array) -> jax.Array:
        params = tree.unflatten([values[i] for i in range(len(leaves))])
        return jnp.sum(jnp.exp(weigh(name, rows, None, params)) * target)

    values = jnp.stack(leaves)
    gradient = jax.grad(score)(values)
    for i, value in enumerate(leaves):
        h = 1e-5 * value
        ahead, behind = score(values.at[i].add(h)), score(values.at[i].add(-h))
        np.testing.assert_allclose(gradient[i], (ahead - behind) / (2 * h), rtol=1e-5, atol=1e-7)


def test_switched_is_the_dense_product() -> None:
    """With an impossible move, a model that nothing goes to and one that takes no part."""
    Pi = np.array(
        [[0.7, 0.0, 0.0, 0.3], [0.2, 0.0, 0.5, 0.3], [0.6, 0.0, 0.4, 0.0], [0.25, 0.25, 0.25, 0.25]]
    )
    w = np.array([0.5, 0.3, 0.2, 0.0])
    with np.errstate(divide="ignore"):
        log_weights = jnp.array(np.log(w))
    after, origins = (np.exp(np.asarray(part)) for part in switched(log_weights, jnp.array(Pi)))
    kept = Pi * (np.arange(4) < 3)
    expected = w @ kept
    np.testing.assert_allclose(after, expected / expected.sum(), rtol=1e-14)
    for j in (0, 2):
        np.testing.assert_allclose(origins[:, j], w * Pi[:, j] / expected[j], rtol=1e-14)
    for j in (1, 3):
        np.testing.assert_array_equal(origins[:, j], np.eye(4)[j])


def test_switch_of_equal_probabilities_is_markov() -> None:
    rows = jnp.array(np.random.default_rng(6).normal(size=(300, MODELS)))
    np.testing.assert_allclose(weigh("switch", rows), weigh("markov", rows), rtol=1e-12)


def test_fixed_weights_do_not_move() -> None:
    rule = fixed()
    start = normalise(jnp.array([0.0, -1.0, -jnp.inf]))
    _, after = rule.update((), rule.init((), start), start, info_of(jnp.arange(3.0)), jnp.int32(1))
    np.testing.assert_array_equal(after, start)
    np.testing.assert_allclose(np.exp(uniform(start)), [0.5, 0.5, 0.0])


def test_mixture_is_moment_matched_and_ignores_members_left_out() -> None:
    rng = np.random.default_rng(3)
    means = rng.normal(size=(MODELS, 2))
    covs = np.stack([np.eye(2) * (i + 1) for i in range(MODELS)])
    means[2], covs[2] = np.nan, np.nan
    log_weights = jnp.log(jnp.array([0.3, 0.7, 0.0]))
    mixed = moment_match(log_weights, Gaussian(jnp.array(means), jnp.array(covs)))
    expected = 0.3 * means[0] + 0.7 * means[1]
    np.testing.assert_allclose(mixed.mean, expected, rtol=1e-14)
    spread = 0.3 * 0.7 * np.outer(means[0] - means[1], means[0] - means[1])
    np.testing.assert_allclose(mixed.cov, 0.3 * covs[0] + 0.7 * covs[1] + spread, rtol=1e-13)


def test_info_of_a_bank_flags_a_veto_of_all() -> None:
    info = info_of(jnp.full(MODELS, jnp.nan))
    mixed = mixture_info(normalise(jnp.zeros(MODELS)), info)
    assert mixed.flags == Flag.ALL_MODELS_VETOED
    assert mixed.log_likelihood == -np.inf


SEEN = 40
"""Steps of the tests of the penalty."""


def innovations(S: np.ndarray, true: float, seed: int, steps: int = SEEN) -> Info:
    """Infos ``(T, M)`` of members that all see the same innovations, of a variance ``true``."""
    nu = np.sqrt(true) * np.random.default_rng(seed).normal(size=(steps, 1))
    nis = nu**2 / S
    flags = jnp.zeros(nis.shape, jnp.int32)
    log_likelihood = -0.5 * (nis + np.log(2 * np.pi * S))
    variance = np.broadcast_to(S, nis.shape)[..., None, None]
    wide = jnp.array(np.broadcast_to(nu, nis.shape)[..., None])
    none = flags[..., None] > 0
    seen = jnp.array(variance), jnp.array(log_likelihood), jnp.array(nis)
    return Info(wide, *seen, flags, flags, none, none)


@compiled
def penalised(params: Penalty, infos: Info, start: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Counts (T,) and log-weights (T, M) of the penalty rule over infos."""
    rule = penalty()

    def step(carry: tuple[Any, jax.Array], info: Info) -> tuple[tuple, tuple]:
        carry = rule.update(params, *carry, info, jnp.int32(0))
        return carry, carry

    return jax.lax.scan(step, (rule.init(params, start), start), infos)[1]


def settings(*values: float, **named: float) -> Penalty:
    """A penalty whose parameters are arrays."""
    return Penalty(*(jnp.array(value, float) for value in Penalty(*values, **named)))


VARIANCES = np.array([1.0, 2.0, 0.3])
EVEN = normalise(jnp.zeros(3))


def test_penalty_of_one_half_and_the_normaliser_is_bayes() -> None:
    infos = innovations(VARIANCES, 1.0, 7)
    _, found = penalised(settings(0.5, 0.0, normaliser=1.0), infos, EVEN)
    np.testing.assert_allclose(found, weigh("bayes", infos.log_likelihood), rtol=0, atol=1e-13)


@pytest.mark.parametrize(
    "values", [(0.5, 0.15), (0.7, 0.4, 12.0, 0.2, 0.6), (1.0, 0.0, 5.0)], ids=str
)
def test_penalty_follows_its_schedule(values: tuple[float, ...]) -> None:
    """Increasing as in the paper, growing and decaying, decaying; steps without data not counted.

    The weights of the loop are products, so that the schedule is that of the docstring.
    """
    infos = innovations(VARIANCES, 1.0, 8)
    heard = np.random.default_rng(9).uniform(size=SEEN) > 0.3
    heard[0] = False
    nothing = jnp.where(jnp.array(heard)[:, None], 0, int(Flag.NO_OBSERVATION)).astype(jnp.int32)
    kept = jnp.array(heard)[:, None]
    infos = infos._replace(
        log_likelihood=jnp.where(kept, infos.log_likelihood, 0),
        nis=jnp.where(kept, infos.nis, 0),
        flags=nothing,
    )
    count, found = penalised(settings(*values), infos, EVEN)
    np.testing.assert_array_equal(count, np.cumsum(heard))
    own, w, k = Penalty(*values), np.ones(3) / 3, 0
    for i in range(SEEN):
        if heard[i]:
            k += 1
            rho = own.least + own.scale * k**own.exponent * np.exp(-k / own.memory)
            w = w * np.exp(-rho * np.asarray(infos.nis[i]))
            w = w * (2 * np.pi * VARIANCES) ** (-own.normaliser / 2)
            w = w / w.sum()
        np.testing.assert_allclose(np.exp(found[i]), w, rtol=1e-11)


def test_penalty_vetoes_a_failed_member_and_leaves_out_one_that_takes_no_part() -> None:
    infos = innovations(VARIANCES, 1.0, 10)
    failed = infos.log_likelihood.at[5].set(-jnp.inf).at[9, 0].set(-jnp.inf)
    infos = infos._replace(log_likelihood=failed, nis=jnp.where(jnp.isfinite(failed), infos.nis, 0))
    count, found = penalised(settings(), infos, normalise(jnp.array([0.0, 0.0, -jnp.inf])))
    np.testing.assert_array_equal(count, np.arange(1, SEEN + 1))
    # All failed: the weights are kept. Then the first is ruled out, for good.
    np.testing.assert_allclose(found[5], found[4], rtol=1e-14)
    assert np.all(np.isfinite(found[8, :2]))
    np.testing.assert_array_equal(found[9:, 0], -np.inf)
    np.testing.assert_array_equal(found[9:, 1], 0)
    np.testing.assert_array_equal(found[:, 2], -np.inf)


def test_without_its_normaliser_the_penalty_prefers_the_larger_noise() -> None:
    """Members with the true variance of the innovation and with twice that, 400 steps."""
    infos = innovations(np.array([1.0, 2.0]), 1.0, 11, 400)
    odds = {}
    for name, own in (("paper", settings()), ("bayes", settings(0.5, 0.0, normaliser=1.0))):
        w = penalised(own, infos, normalise(jnp.zeros(2)))[1]
        odds[name] = np.asarray(w[:, 1] - w[:, 0])
    # Each datum moves the odds by rho nis / 2 towards the larger variance, whatever it says.
    assert np.all(np.diff(odds["paper"]) > 0)
    mean = 0.5 * np.sum(0.5 * np.arange(1, 401) ** 0.15)
    assert odds["paper"][-1] == pytest.approx(mean, rel=0.2)
    # The divergence of the true density from the other, (log 2 - 1 / 2) / 2 a step.
    assert odds["bayes"][-1] == pytest.approx(-200 * (np.log(2) - 0.5), rel=0.5)
