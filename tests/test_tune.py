"""Tuning by gradient: domains, losses, descent, and noise that is found again."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxnav.compiling import compiled
from jaxnav.estimation.banks.mixture import BankParams, bank, mmae, reweighed
from jaxnav.estimation.banks.reset import WindowedReset, windowed_reset
from jaxnav.estimation.banks.weights import bayes, chain, floor, markov
from jaxnav.estimation.filters.kalman import kf
from jaxnav.estimation.run import run
from jaxnav.estimation.tune.fit import Validation, fit, fit_lbfgs
from jaxnav.estimation.tune.inspect import check_gradient, fisher, profile
from jaxnav.estimation.tune.losses import (
    likelihood,
    nees_consistency,
    negative_log_likelihood,
    nis_consistency,
    rmse,
    step_means,
    weigh,
)
from jaxnav.estimation.tune.transforms import (
    COVARIANCE,
    FIXED,
    POSITIVE,
    REAL,
    SIMPLEX,
    UNIT,
    above,
    between,
    coordinates,
)
from jaxnav.estimation.types import FilterParams, Gaussian, Model, Obs, replicate
from jaxnav.studies.immae.config import ImmaeConfig
from jaxnav.studies.immae.tuning import noise_loss

PARAMS = {
    "cov": jnp.array([[4.0, 1.0], [1.0, 2.0]]),
    "count": jnp.array(3.0),
    "rate": jnp.array([0.2, 0.7]),
    "share": jnp.array([0.5, 0.3, 0.2]),
    "shift": jnp.array(-1.5),
    "still": jnp.array([1.0, -2.0]),
    "time": jnp.array(2.5),
    "width": jnp.array(4.0),
}
DOMAINS = {
    "cov": COVARIANCE,
    "count": POSITIVE,
    "rate": UNIT,
    "share": SIMPLEX,
    "shift": REAL,
    "still": FIXED,
    "time": above(2.0),
    "width": between(3.0, 7.0),
}


def test_coordinates_lead_back_and_stay_in_the_domain() -> None:
    free = coordinates(PARAMS, DOMAINS)
    assert free.labels == (
        *("count", "cov[0]", "cov[1]", "cov[2]", "rate[0]", "rate[1]", "share[0]", "share[1]"),
        *("shift", "time", "width"),
    )
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-14),
        free.constrain(free.start),
        PARAMS,
    )
    moved = free.constrain(free.start + jnp.array([3.0, -4.0, 5.0, -6.0] * 2 + [7.0, -8.0, 9.0]))
    assert np.all(np.linalg.eigvalsh(moved["cov"]) > 0)
    assert moved["share"].sum() == pytest.approx(1)
    assert moved["share"].min() > 0
    assert 3 < moved["width"] < 7
    assert moved["time"] > 2
    np.testing.assert_array_equal(moved["still"], PARAMS["still"])
    np.testing.assert_allclose(free.values(free.start)[4:6], PARAMS["rate"], rtol=1e-14)
    np.testing.assert_array_equal(free.values(free.start)[1:4], free.start[1:4])


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("cov", [[1.0, 2.0], [2.0, 1.0]], "symmetric and positive definite"),
        ("cov", [[1.0, 0.5], [0.0, 1.0]], "symmetric and positive definite"),
        ("rate", [0.2, 1.0], "between 0 and 1"),
        ("share", [0.5, 0.3, 0.3], "positive with the sum 1"),
        ("time", 2.0, "above 2 and finite"),
        ("width", 8.0, "between 3 and 7"),
        ("shift", np.nan, "finite"),
    ],
)
def test_a_value_outside_its_domain_is_named(name: str, value: Any, said: str) -> None:
    with pytest.raises(ValueError, match=rf"^{name} is .*; it must be {said}$"):
        coordinates({name: jnp.array(value)}, {name: DOMAINS[name]})


def test_there_must_be_something_to_tune_and_bounds_in_order() -> None:
    with pytest.raises(ValueError, match="every parameter is fixed"):
        coordinates({"a": 1.0}, FIXED)
    with pytest.raises(ValueError, match="must be finite and in order"):
        between(2.0, 2.0)


def bowl(params: dict[str, jax.Array]) -> jax.Array:
    return (params["a"] - 3.0) ** 2 + (params["b"] - 0.2) ** 2


BOWL: Any = {"a": 1.0, "b": 0.9}
DOMAIN_OF_BOWL: Any = {"a": POSITIVE, "b": UNIT}


@pytest.mark.parametrize("mode", ["reverse", "forward"])
def test_fit_finds_the_minimum_of_a_bowl_in_constrained_coordinates(mode: str) -> None:
    found = fit(bowl, BOWL, transform=DOMAIN_OF_BOWL, steps=400, mode=mode)
    assert abs(found.params["a"] - 3.0) < 1e-3
    assert abs(found.params["b"] - 0.2) < 1e-3
    assert found.loss == np.nanmin(found.history)
    assert found.rejected == 0
    assert found.stopped == "steps"
    few = fit_lbfgs(bowl, BOWL, transform=DOMAIN_OF_BOWL, steps=40, mode=mode)
    assert abs(few.params["a"] - 3.0) < 1e-4
    assert abs(few.params["b"] - 0.2) < 1e-4
    assert few.stopped == "converged"
    assert len(few.history) < 40


def test_steps_that_are_not_finite_are_taken_back() -> None:
    def cliff(params: jax.Array) -> jax.Array:
        return jnp.where(params > 2.0, jnp.nan, (params - 1.9) ** 2)

    found = fit(cliff, 1.0, optimiser=optax.sgd(10.0), steps=40)
    assert found.rejected > 0
    assert np.isnan(found.history).sum() == found.rejected
    assert found.params <= 2.0
    assert found.loss <= (1.0 - 1.9) ** 2
    walled = fit_lbfgs(lambda p: cliff(p) + 1 / (2.0 - p), 0.1, steps=40)
    assert walled.params < 2.0
    assert np.isnan(walled.history).sum() == walled.rejected


def test_fit_refuses_a_start_outside_the_domain_or_without_a_loss() -> None:
    for way in (fit, fit_lbfgs):
        with pytest.raises(ValueError, match=r"is -1\.0; it must be positive"):
            way(lambda p: p, -1.0)
        with pytest.raises(ValueError, match=r"not finite at 1\.0"):
            way(lambda p: p * jnp.nan, 1.0)
    with pytest.raises(ValueError, match="'sideways'; it must be 'reverse' or 'forward'"):
        fit(bowl, BOWL, mode="sideways")


def test_batches_and_validation_choose_the_parameters() -> None:
    """Each batch pulls elsewhere; the validation knows the middle, and ends the fit."""
    pulls = jnp.array([2.0, 4.0])

    def noisy(params: jax.Array, pull: jax.Array) -> jax.Array:
        return (params - pull) ** 2

    seen: list[int] = []

    def batches(number: int) -> jax.Array:
        seen.append(number)
        return pulls[number % 2]

    check = Validation(noisy, (jnp.array(3.0),), every=2, patience=3)
    found = fit(
        noisy, 1.0, batches=batches, validation=check, optimiser=optax.adam(0.05), steps=300
    )
    assert found.stopped == "patience"
    assert seen == list(range(len(found.history)))
    assert len(found.history) < 301
    assert found.loss == found.validation[:, 1].min()
    assert abs(found.params - 3.0) < 0.1
    last = fit(noisy, 1.0, batches=lambda number: pulls[0], steps=3)
    assert last.loss == last.history[-1]


def test_check_profile_and_fisher_of_a_known_loss() -> None:
    """Of n samples of a normal density: the mean's sigma is s / sqrt(n), that of s s / sqrt(2n)."""
    rng = np.random.default_rng(5)
    x = jnp.asarray(2.0 + 0.5 * rng.standard_normal(400))

    def loss(params: dict[str, jax.Array], x: jax.Array) -> jax.Array:
        z = (x - params["mean"]) / params["s"]
        return jnp.mean(0.5 * z**2) + jnp.log(params["s"])

    domains: Any = {"mean": REAL, "s": POSITIVE}
    found = fit_lbfgs(loss, {"mean": 0.0, "s": 1.0}, data=(x,), transform=domains)
    s = float(np.std(x))
    np.testing.assert_allclose(float(found.params["mean"]), float(np.mean(x)), rtol=1e-5)
    np.testing.assert_allclose(float(found.params["s"]), s, rtol=1e-5)
    known = fisher(loss, found.params, x.size, data=(x,), transform=domains)
    np.testing.assert_allclose(known.sigma["mean"], s / np.sqrt(x.size), rtol=1e-4)
    np.testing.assert_allclose(known.sigma["s"], s / np.sqrt(2 * x.size), rtol=1e-4)
    away: Any = {"mean": 0.0, "s": 1.0}
    checked = check_gradient(loss, away, data=(x,), transform=domains)
    assert checked.labels == ("mean", "s")
    assert checked.error < 1e-7
    around = profile(loss, found.params, data=(x,), transform=domains, points=5, width=0.5)
    assert around.loss.shape == (2, 5)
    assert np.all(around.loss.argmin(axis=1) == 2)
    np.testing.assert_allclose(around.value[1], s * np.exp(around.offset), rtol=1e-5)
    with pytest.raises(ValueError, match=r"not positive definite in mean, s"):
        fisher(lambda params, x: -loss(params, x), away, 1, data=(x,), transform=domains)


SCALAR = Model(
    transition=lambda p, x, u: x,
    process_noise=lambda p, x, u: jnp.diag(p),
    observe=lambda p, x, u: x,
    observation_noise=lambda p, x, u: jnp.array([1.0, 2.0]),
)


def test_losses_are_those_of_the_records() -> None:
    """Likelihood, RMSE and consistency of a bank in one pass, against its records."""
    rng = np.random.default_rng(7)
    walked = np.cumsum(rng.standard_normal((3, 40, 2)), axis=1)
    truth = jnp.asarray(walked)
    z = jnp.asarray(walked + rng.standard_normal(walked.shape) * [1.0, 2.0**0.5])
    valid = jnp.ones((40, 2), bool).at[3].set(False).at[5, 0].set(False)
    prior = Gaussian(jnp.zeros(2), jnp.eye(2))
    members = replicate(FilterParams(jnp.ones(2), prior), 2)
    members = members._replace(model=jnp.array([[0.5, 0.5], [2.0, 2.0]]))
    filter, params, inputs = mmae(kf(SCALAR)), BankParams(members, ()), jnp.zeros(40)

    def error(estimate: Gaussian, true: jax.Array) -> Gaussian:
        return Gaussian(estimate.mean - true, estimate.cov)

    terms = {
        "likelihood": likelihood(),
        "rmse": rmse(error),
        "nis": nis_consistency(),
        "nees": nees_consistency(error),
    }

    def means(z: jax.Array, truth: jax.Array) -> dict[str, jax.Array]:
        return step_means(filter, terms, params, inputs, Obs(z, valid), truth, segment=7)

    found = compiled(jax.vmap(means))(z, truth)
    estimate, info = jax.vmap(lambda z: run(filter, params, inputs, Obs(z, valid)).record)(z)
    e = np.asarray(estimate.mean - truth)
    nees = np.einsum("rti,rtij,rtj->rt", e, np.linalg.inv(estimate.cov), e)
    expected = {
        "likelihood": -np.mean(info.log_likelihood),
        "rmse": np.sqrt(np.mean(np.sum(e**2, axis=-1))),
        "nis": np.log(np.sum(info.nis) / (3 * float(valid.sum()))) ** 2,
        "nees": np.log(np.mean(nees) / 2) ** 2,
    }
    for name, value in expected.items():
        np.testing.assert_allclose(weigh(terms, found, {name: 1.0}), value, rtol=1e-12)
    weights = {"likelihood": 2.0, "nis": 0.5}
    total = 2 * expected["likelihood"] + 0.5 * expected["nis"]
    np.testing.assert_allclose(weigh(terms, found, weights), total, rtol=1e-12)
    alone = negative_log_likelihood(filter, params, inputs, Obs(z[0], valid))
    np.testing.assert_allclose(alone, found["likelihood"][0, 0], rtol=1e-12)


def test_a_rule_over_members_that_have_run_gives_the_weights_of_their_bank() -> None:
    rng = np.random.default_rng(8)
    z = jnp.asarray(np.cumsum(rng.standard_normal((40, 2)), axis=0))
    valid = jnp.ones((40, 2), bool).at[3].set(False)
    members = replicate(FilterParams(jnp.ones(2), Gaussian(jnp.zeros(2), jnp.eye(2))), 3)
    members = members._replace(model=jnp.array([[0.2, 0.2], [1.0, 1.0], [5.0, 5.0]]))
    rule = chain(markov(), bayes(), windowed_reset(), floor())
    given = (jnp.array(0.01), (), WindowedReset(7.0, 0.6), jnp.array(1e-3))
    params = BankParams(members, given, jnp.array([0.0, -1.0, 0.5]))
    observations, inputs = Obs(z, valid), jnp.zeros(40)

    def weights(state: Any, info: Any) -> jax.Array:
        del info
        return state.log_weights

    expected = run(bank(kf(SCALAR), rule), params, inputs, observations, record=weights).record
    each = jax.vmap(lambda own: run(kf(SCALAR), own, inputs, observations).record[1], out_axes=1)
    watched = run(reweighed(rule), params, each(members), observations, record=weights).record
    np.testing.assert_allclose(watched, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_noise_wrong_by_a_hundred_is_found_again() -> None:
    """On 64 flights of 100 s, from both sides: one standard error of the factor is about 3 %."""
    config = ImmaeConfig(scenario="matched-noise", duration_s=100.0, initial="drawn")
    loss = noise_loss(config, jax.random.key(11), runs=64)
    found = [fit_lbfgs(loss, start, steps=100, mode="forward") for start in (0.01, 100.0)]
    for one in found:
        assert abs(one.params - 1.0) < 0.1
        assert one.rejected == 0
        assert len(one.history) <= 100
    np.testing.assert_allclose(found[0].params, found[1].params, rtol=1e-4)
    checked = check_gradient(loss, 2.0)
    assert checked.error < 1e-6
    known = fisher(loss, found[0].params, 64 * config.steps, mode="forward")
    assert 0.02 < float(known.sigma) < 0.04
