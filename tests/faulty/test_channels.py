"""Values, noise and priors that are no such thing: left out, flagged or failed, never believed."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnav as jn
from checks.failed_banks import descend, score
from jaxnav.compiling import compiled
from jaxnav.estimation.models import shared
from jaxnav.estimation.types import Flag
from tests.cases import Noise, cases

STEPS = 12
ONE, ALL, LATE = 3, 6, 8
"""Steps at which one channel is broken, all are, and something else happens."""


class Step(NamedTuple):
    """Input of a step: the noise of its observation and of its prediction, each ``(2, 2)``."""

    noise: Any
    process: Any


MODEL = jn.Model(
    transition=lambda p, x, u: jnp.array([[1.0, 0.1], [0.0, 1.0]]) @ x,
    process_noise=lambda p, x, u: p.q * u.process,
    observe=lambda p, x, u: x * jnp.array([1.0, 2.0]),
    observation_noise=lambda p, x, u: p.r * u.noise,
)
PRIOR = jn.FilterParams(
    Noise(jnp.array(1.0), jnp.array(1.0)), jn.Gaussian(jnp.zeros(2), jnp.eye(2))
)
BANKS = ("mmae", "mmae of square roots", "imm")
CASES = {
    name: case
    for name, case in cases(MODEL, PRIOR, 2).items()
    if name in BANKS or isinstance(case.params, jn.FilterParams)
}
each_case = pytest.mark.parametrize("name", CASES)


def with_prior(params: Any, cov: list[list[float]]) -> Any:
    """Return a case's parameters with another covariance at t0, of all members."""

    def replaced(node: Any) -> Any:
        if not isinstance(node, jn.Gaussian):
            return node
        return node._replace(cov=jnp.broadcast_to(jnp.array(cov), node.cov.shape))

    return jax.tree.map(replaced, params, is_leaf=lambda node: isinstance(node, jn.Gaussian))


def steps() -> Step:
    noise = np.tile(np.array([[1.0, 0.1], [0.1, 1.0]]), (STEPS, 1, 1))
    return Step(noise, np.tile(0.01 * np.eye(2), (STEPS, 1, 1)))


def observations() -> jn.Obs:
    z = np.random.default_rng(0).normal(size=(STEPS, 2))
    return jn.Obs(jnp.asarray(z), jnp.ones((STEPS, 2), bool))


def without(obs: jn.Obs) -> jn.Obs:
    valid = np.array(obs.valid)
    valid[ONE, 1] = valid[ALL] = False
    return obs._replace(valid=jnp.asarray(valid))


@partial(compiled, static_argnums=0)
def _batch(filter: jn.Filter, params: Any, inputs: Step, obs: jn.Obs) -> Any:
    return jax.vmap(lambda *given: jn.run(filter, *given).record)(params, inputs, obs)


class Told(NamedTuple):
    numbers: list[np.ndarray]
    flags: np.ndarray


def ran(name: str, cases: list[tuple[Any, Step, jn.Obs]]) -> list[Told]:
    """Run a filter on several cases at once, all traced; a case beside another must not matter."""
    filter = CASES[name].filter
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cases)
    estimate, info = _batch(filter, *stacked)
    results = []
    for i in range(len(cases)):
        numbers = (estimate.mean, estimate.cov, info.log_likelihood, info.nis)
        results.append(Told([np.asarray(leaf)[i] for leaf in numbers], np.asarray(info.flags)[i]))
    return results


@each_case
def test_what_cannot_be_used_is_left_out_and_told(name: str) -> None:
    params, inputs, obs = CASES[name].params, steps(), observations()
    infinite = steps()
    infinite.noise[ONE, 1, 1] = np.inf
    infinite.noise[ALL, [0, 1], [0, 1]] = np.inf
    lost = np.array(obs.z)
    lost[ONE, 1], lost[ALL] = np.nan, (np.inf, -np.inf)
    missing, by_variance, by_value, clean = ran(
        name,
        [
            (params, inputs, without(obs)),
            (params, infinite, obs),
            (params, inputs, obs._replace(z=jnp.asarray(lost))),
            (params, inputs, obs),
        ],
    )
    for other in (by_variance, by_value):
        for a, b in zip(missing.numbers, other.numbers, strict=True):
            np.testing.assert_array_equal(b, a)
    assert not np.any(missing.flags & Flag.NOT_FINITE)
    assert not np.any(by_variance.flags & Flag.NOT_FINITE), "an infinite variance is no fault"
    told = np.flatnonzero(by_value.flags & Flag.NOT_FINITE)
    np.testing.assert_array_equal(told, [ONE, ALL])
    np.testing.assert_array_equal(np.flatnonzero(missing.flags & Flag.NO_OBSERVATION), [ALL])
    assert not np.any(clean.flags)
    assert np.all(np.isfinite(clean.numbers[2]))


def ranging(observe: Any) -> jn.Model:
    """A point that is seen itself, and by something else; it starts at the origin."""
    process = jn.Process(lambda p, x, u: x + u, lambda p, x, u: 0.1 * jnp.eye(2))
    seen = jn.Channel(2, lambda p, x, u: x, lambda p, x, u: jnp.ones(2))
    other = jn.Channel(1, observe, lambda p, x, u: jnp.ones(1))
    return jn.observing(process, {"seen": seen, "range": other}, parts=shared)


def norm(p: Any, x: Any, u: Any) -> Any:
    """The distance from the origin, whose derivative there is not a number."""
    return jnp.linalg.norm(x).reshape(1)


LINEARISING = {
    "ekf": jn.ekf,
    "square_root_ekf": jn.square_root_ekf,
    "iterated_ekf": jn.iterated_ekf,
    "versoria": lambda model: jn.versoria(jn.ekf(model)),
    "gated": lambda model: jn.gated(jn.ekf(model)),
}


@pytest.mark.parametrize("name", LINEARISING)
def test_a_derivative_that_is_not_a_number_stays_where_it_is(name: str) -> None:
    """Of a missing channel it does not exist; of one that arrived the update is skipped."""
    bad, good = ranging(norm), ranging(lambda p, x, u: x[:1])
    z = {"seen": np.arange(8.0).reshape(4, 2), "range": np.ones((4, 1))}
    prior = jn.FilterParams((), jn.Gaussian(jnp.zeros(2), jnp.eye(2)))
    inputs = jnp.concatenate([jnp.zeros((1, 2)), jnp.ones((3, 2))])

    def told(model: jn.Model, valid: Any) -> Any:
        obs = model.stack(z, {"range": valid})
        return jn.run(LINEARISING[name](model), prior, inputs, obs).record

    (ours, info), (theirs, _) = (told(model, np.zeros(4, bool)) for model in (bad, good))
    np.testing.assert_allclose(ours.mean, theirs.mean, rtol=1e-12)
    np.testing.assert_allclose(ours.cov, theirs.cov, rtol=1e-12)
    assert not np.any(info.flags)
    estimate, info = told(bad, np.arange(4) == 0)
    assert info.flags[0] & Flag.NOT_POSITIVE_DEFINITE
    np.testing.assert_array_equal(estimate.mean[0], 0)
    np.testing.assert_allclose(estimate.cov[0], 1.1 * np.eye(2), rtol=1e-12)
    assert not np.any(info.flags[1:])


@each_case
def test_what_is_no_covariance_is_told(name: str) -> None:
    params, obs = CASES[name].params, observations()
    negative, beyond, unknown, shrinking = steps(), steps(), steps(), steps()
    unknown.noise[LATE, 1, 1] = np.nan
    negative.noise[LATE, 0, 0] = -0.5
    beyond.noise[LATE, [0, 1], [1, 0]] = 2.0
    shrinking.process[LATE] = np.diag([0.01, -0.02])
    uneven, indefinite = (
        with_prior(params, cov) for cov in ([[1.0, 0.2], [0.1, 1.0]], [[1.0, 2.0], [2.0, 1.0]])
    )
    cases = [(params, given, obs) for given in (negative, beyond, unknown, shrinking)]
    cases += [(prior, steps(), obs) for prior in (uneven, indefinite)]
    *noisy, moved, crooked, hollow = ran(name, cases)
    for told in noisy:
        np.testing.assert_array_equal(np.flatnonzero(told.flags & Flag.INVALID_NOISE), [LATE])
    assert np.isneginf(noisy[-1].numbers[2][LATE])
    assert np.all(np.isfinite(noisy[-1].numbers[0]))
    assert moved.flags[LATE] & Flag.INDEFINITE
    assert not np.any(moved.flags[:LATE])
    for told in (crooked, hollow):
        assert told.flags[0] & Flag.INDEFINITE


def test_a_failed_bank_scores_worst_and_its_gradient_is_a_number() -> None:
    graded = compiled(jax.vmap(jax.value_and_grad(score, argnums=(0, 1))))
    noise = jnp.array([1.0, -50.0, 1.0, 1.0, 1.0])
    probability = jnp.array([0.1, 0.1, 2.0, -0.5, jnp.nan])
    values, gradients = graded(noise, probability)
    assert np.isfinite(values[0])
    np.testing.assert_array_equal(values[1:], np.inf)
    for gradient in gradients:
        assert np.all(np.isfinite(np.asarray(gradient)[:2])), gradient


def test_a_rule_outside_its_domain_is_told() -> None:
    bank = jn.bank(jn.kf(MODEL), jn.chain(jn.markov(), jn.bayes()))
    members = jn.replicate(PRIOR, 2)

    @compiled
    def flags(probability: jax.Array) -> jax.Array:
        params = jn.BankParams(members, (probability, ()))
        return jn.run(bank, params, steps(), observations()).record[1].flags

    told = flags(jnp.array(2.0))
    assert np.all(np.asarray(told) & Flag.NO_WEIGHTS)
    assert not np.any(np.asarray(flags(jnp.array(0.1))))


def test_a_descent_does_not_end_in_a_failed_bank() -> None:
    """A sample of ``checks/failed_banks.py``: a start that fails is refused, others end sound."""
    failed, sound = (descend(jnp.array(start)) for start in ([-3.0, 0.0], [2.0, 3.0]))
    assert failed is None
    assert sound is not None
    assert np.isfinite(sound)
