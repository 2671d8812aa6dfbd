"""Robust and adaptive filters: loops in NumPy, outliers, heavy tails, a process noise found."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.estimation.filters.adaptive import Adaptation, innovation_adaptive
from jaxnav.estimation.filters.kalman import ekf
from jaxnav.estimation.filters.robust import Correntropy, Versoria, correntropy, versoria
from jaxnav.estimation.filters.sigma_point import ukf
from jaxnav.estimation.run import run, simulate
from jaxnav.estimation.types import Filter, FilterParams, Gaussian, Model, NonAdditive, Obs
from tests.oracles.kalman import Linear
from tests.oracles.matrices import central_difference, random_spd
from tests.oracles.robust import adapted, correntropy_weight, reweighted, versoria_weight


class Static(NamedTuple):
    """Parameters of a constant state that is observed."""

    H: Array
    R: Array


STATIC = Model(
    transition=lambda p, x, u: x,
    process_noise=lambda p, x, u: jnp.zeros((x.shape[0], x.shape[0])),
    observe=lambda p, x, u: p.H @ x,
    observation_noise=lambda p, x, u: p.R,
)


def updated(filter: Filter, kernel: Any, prior: Gaussian, noise: Static, obs: Obs):
    """Estimate and info after one update of the prior."""
    params = FilterParams(noise, prior, own=kernel)
    state, info = filter.update(params, filter.init(params), jnp.zeros(()), obs)
    return filter.estimate(state), info


@pytest.mark.parametrize(
    ("kind", "iterations"), [("versoria", 1), ("versoria", 3), ("correntropy", 2)]
)
def test_update_equals_the_loop_of_reweighted_updates(kind: str, iterations: int) -> None:
    """Two states, three channels of correlated noise, any of them missing, with outliers."""
    rng = np.random.default_rng(1)
    count = 60
    x, P, R = rng.normal(size=(count, 2)), random_spd(rng, count, 2), random_spd(rng, count, 3)
    H = rng.normal(size=(count, 3, 2))
    z = 3 * rng.normal(size=(count, 3)) + 20 * (rng.uniform(size=(count, 3)) < 0.2)
    valid = rng.uniform(size=(count, 3)) > 0.25
    width, power = rng.uniform(0, 0.5, count), rng.choice([1.0, 1.5, 2.0, 3.0], count)
    bandwidth = rng.uniform(1, 5, count)
    build, kernel = {
        "versoria": (versoria, Versoria(jnp.array(width), jnp.array(power))),
        "correntropy": (correntropy, Correntropy(jnp.array(bandwidth))),
    }[kind]
    given = (
        kernel,
        Gaussian(jnp.array(x), jnp.array(P)),
        Static(jnp.array(H), jnp.array(R)),
        Obs(jnp.array(z), jnp.array(valid)),
    )
    filter = build(ekf(STATIC), iterations=iterations)
    estimate, info = compiled(jax.vmap(partial(updated, filter)))(*given)
    plain = compiled(jax.vmap(partial(updated, ekf(STATIC))))(*given)[1]
    for k in range(count):
        weight = {
            "versoria": lambda e, k=k: versoria_weight(e, width[k], power[k]),
            "correntropy": lambda e, k=k: correntropy_weight(e, bandwidth[k]),
        }[kind]
        mean, cov = reweighted(x[k], P[k], H[k], R[k], z[k], valid[k], weight, iterations)
        # Correlated noise over the least weight of 1e-8 leaves half of the digits to either side.
        np.testing.assert_allclose(estimate.mean[k], mean, rtol=5e-7, atol=5e-8)
        np.testing.assert_allclose(estimate.cov[k], cov, rtol=5e-7, atol=5e-8)
    # The verdict on the data is that of the plain update.
    np.testing.assert_allclose(info.log_likelihood, plain.log_likelihood, rtol=1e-13)
    np.testing.assert_allclose(info.nis, plain.nis, rtol=1e-13)
    np.testing.assert_array_equal(info.iterations, 1 + iterations)
    assert np.all(np.isfinite(estimate.mean))


def scalar(prior_mean, prior_var, z) -> tuple[Gaussian, Static, Obs]:
    """A scalar problem with unit noise, any leading axes."""
    shape = np.shape(z)
    one = jnp.ones((*shape, 1, 1))
    prior = Gaussian(
        jnp.broadcast_to(jnp.array(prior_mean), shape)[..., None],
        jnp.broadcast_to(jnp.array(prior_var), shape)[..., None, None],
    )
    return prior, Static(one, one), Obs(jnp.array(z)[..., None], jnp.ones((*shape, 1), bool))


ROBUST = {
    "versoria": (partial(versoria, iterations=20), Versoria(0.1, 2.0)),
    "correntropy": (partial(correntropy, iterations=20), Correntropy(3.0)),
}


@pytest.mark.parametrize("kind", ROBUST)
def test_fixed_point_is_the_least_of_the_criterion(kind: str) -> None:
    """Brute force: the criterion on a grid of estimates; z up to four sigma of it away."""
    build, kernel = ROBUST[kind]
    z, variance = np.linspace(0, 4, 9), 0.5
    filter = build(ekf(STATIC))
    prior, noise, obs = scalar(0.0, variance, z)
    kernels = jax.tree.map(lambda leaf: jnp.full(9, leaf), kernel)
    estimate, _ = compiled(jax.vmap(partial(updated, filter)))(kernels, prior, noise, obs)
    grid = np.linspace(-1, 5, 600_001)
    losses: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        "versoria": lambda e: -1 / (1 + 0.1 * e**2) / (2 * 0.1),
        "correntropy": lambda e: -(3.0**2) * np.exp(-(e**2) / (2 * 3.0**2)),
    }
    for k in range(9):
        criterion = grid**2 / (2 * variance) + losses[kind](z[k] - grid)
        assert abs(grid[criterion.argmin()] - estimate.mean[k, 0]) < 1.1e-5
        weight = {
            "versoria": lambda e: versoria_weight(e, 0.1, 2.0),
            "correntropy": lambda e: correntropy_weight(e, 3.0),
        }[kind]
        x = 0.0
        for _ in range(500):
            w = weight(z[k] - x)
            x = w * z[k] / (w + 1 / variance)
        assert abs(x - estimate.mean[k, 0]) < 1e-7


@pytest.mark.parametrize("kind", ["versoria", "correntropy"])
def test_outlier_is_thrown_away_and_good_data_after_a_poor_prior_is_not(kind: str) -> None:
    """An outlier of 100 sigma; then a prior that is off by 80 sigma of the data, and says so."""
    build = {"versoria": versoria, "correntropy": correntropy}[kind]
    # prior variance, measurement
    cases = scalar(0.0, np.array([0.25, 1.0, 1e4, 1e4]), np.array([100.0, 100.0, 80.0, -150.0]))
    robust, _ = compiled(jax.vmap(partial(updated, build(ekf(STATIC))), (None, 0, 0, 0)))(
        (), *cases
    )
    plain, _ = compiled(jax.vmap(partial(updated, ekf(STATIC)), (None, 0, 0, 0)))((), *cases)
    share = np.asarray(robust.mean / plain.mean)[:, 0]
    assert np.all(np.abs(share[:2]) < 0.02)
    np.testing.assert_allclose(share[2:], 1, rtol=1e-4)
    assert np.all(np.asarray(robust.cov)[2:, 0, 0] < 1.001)
    # The second kernel of the class is its default.
    named = {"versoria": Versoria(), "correntropy": Correntropy()}[kind]
    again, _ = compiled(jax.vmap(partial(updated, build(ekf(STATIC))), (None, 0, 0, 0)))(
        named, *cases
    )
    np.testing.assert_array_equal(again.mean, robust.mean)


def test_gradients_by_the_kernel_are_right_also_at_a_zero_residual() -> None:
    """Against differences of the loop in NumPy; the second problem has residuals of zero."""
    rng = np.random.default_rng(3)
    x, P, R = np.array([0.2, -0.1]), random_spd(rng, 1, 2)[0], random_spd(rng, 1, 2)[0]
    data = x + np.array([[4.0, -2.5], [0.0, 0.0]])
    point = np.array([0.3, 1.7, 2.5])
    direction = np.array([1.0, -0.7])

    def loss(theta: Array, z: Array) -> Array:
        obs, prior = Obs(z, jnp.ones(2, bool)), Gaussian(jnp.array(x), jnp.array(P))
        total = jnp.zeros(())
        for build, kernel in (
            (versoria, Versoria(theta[0], theta[1])),
            (correntropy, Correntropy(theta[2])),
        ):
            estimate, _ = updated(
                build(ekf(STATIC)), kernel, prior, Static(jnp.eye(2), jnp.array(R)), obs
            )
            total = total + direction @ estimate.mean + jnp.sum(estimate.cov)
        return total

    def looped(theta: np.ndarray, z: np.ndarray) -> np.ndarray:
        total = np.zeros(())
        for weight in (
            lambda e: versoria_weight(e, theta[0], theta[1]),
            lambda e: correntropy_weight(e, theta[2]),
        ):
            mean, cov = reweighted(x, P, np.eye(2), R, z, np.ones(2, bool), weight, 2)
            total = total + direction @ mean + np.sum(cov)
        return total

    by_kernel, by_data = compiled(jax.vmap(jax.grad(loss, (0, 1)), (None, 0)))(point, data)
    for k, z in enumerate(data):
        expected = [
            central_difference(lambda t, z=z: looped(t, z), point, e, 1e-3) for e in np.eye(3)
        ]
        np.testing.assert_allclose(by_kernel[k], expected, rtol=1e-8, atol=1e-10)
    expected = [central_difference(lambda z: looped(point, z), data[0], e, 1e-3) for e in np.eye(2)]
    np.testing.assert_allclose(by_data[0], expected, rtol=1e-8, atol=1e-10)
    # Weights are one and flat there: nothing moves with the kernel, and the data as in the plain.
    np.testing.assert_array_equal(by_kernel[1], 0)
    gain = P @ np.linalg.inv(P + R)
    np.testing.assert_allclose(by_data[1], 2 * direction @ gain, rtol=1e-12)


def test_noise_that_does_not_add_is_refused() -> None:
    noisy = NonAdditive(lambda p, x, v, u: x + v, lambda p, x, u: jnp.ones(1))
    one = Model(
        transition=lambda p, x, u: x,
        process_noise=lambda p, x, u: jnp.eye(1),
        observe=lambda p, x, u: x,
        observation_noise=lambda p, x, u: jnp.ones(1),
        noisy=noisy,
    )
    for build in (versoria, correntropy):
        with pytest.raises(ValueError, match="noise that does not add"):
            build(ekf(one))


def test_a_robust_update_needs_an_iteration() -> None:
    for build in (versoria, correntropy):
        with pytest.raises(ValueError, match="iterations is 0"):
            build(ekf(STATIC), iterations=0)


class Walk(NamedTuple):
    """Factors on the noise of :data:`MOVING`."""

    q: Array
    r: Array


PHI = np.array([[1.0, 1.0], [0.0, 1.0]])
Q = np.array([[1 / 3, 0.5], [0.5, 1.0]])
R = np.array([[1.0, 0.3], [0.3, 0.5]])
MOVING = Model(
    transition=lambda p, x, u: jnp.array(PHI) @ x,
    process_noise=lambda p, x, u: p.q * jnp.array(Q),
    observe=lambda p, x, u: x,
    observation_noise=lambda p, x, u: p.r * jnp.array(R),
)
TRUE = Walk(jnp.array(0.1), jnp.array(1.0))
PRIOR = Gaussian(jnp.zeros(2), jnp.eye(2))


class Sample(NamedTuple):
    """Runs of the true model: states ``(N, T, 2)`` and data, clean and with outliers."""

    x: Array
    z: Array
    wild: Array


def sample(seed: int, runs: int, steps: int) -> Sample:
    """Draw runs; 5 % of the data have ten times the noise in ``wild``."""
    rng = np.random.default_rng(seed)
    w = np.sqrt(0.1) * rng.normal(size=(runs, steps, 2)) @ np.linalg.cholesky(Q).T
    v = rng.normal(size=(runs, steps, 2)) @ np.linalg.cholesky(R).T
    outlier = rng.uniform(size=(runs, steps, 1)) < 0.05
    start = rng.normal(size=(runs, 2))
    move = compiled(
        jax.vmap(lambda x, w, v: simulate(MOVING, TRUE, x, jnp.zeros(w.shape[0]), w, v))
    )
    x, z = move(start, w, v)
    return Sample(x, z, z + jnp.array(np.where(outlier, 9.0, 0.0) * v))


def means(filter: Filter, params: FilterParams, z: Array) -> np.ndarray:
    """Estimates ``(N, T, 2)``."""

    def one(z: Array) -> Array:
        obs = Obs(z, jnp.ones(z.shape, bool))
        return run(filter, params, jnp.zeros(z.shape[0]), obs).record[0].mean

    return np.asarray(compiled(jax.vmap(one))(z))


def rms(errors: np.ndarray) -> np.ndarray:
    """Root mean square of each state over runs and times, without the first ten steps."""
    return np.sqrt(np.mean(np.asarray(errors)[:, 10:] ** 2, axis=(0, 1)))


def test_heavy_tails_cost_a_robust_filter_little() -> None:
    """Row 18 of the hard inputs: 5 % of the data at 10 sigma, 64 runs."""
    data = sample(4, 64, 150)
    params = FilterParams(TRUE, PRIOR)
    both = jnp.concatenate([data.z, data.wild])

    def ratio(filter: Filter) -> tuple[np.ndarray, np.ndarray]:
        error = means(filter, params, both) - np.concatenate([data.x, data.x])
        return rms(error[:64]), rms(error[64:])

    clean, plain = ratio(ekf(MOVING))
    assert plain[0] > 2 * clean[0], "the plain filter fails the row"
    of = {}
    for build in (versoria, correntropy):
        own, robust = ratio(build(ekf(MOVING)))
        of[build] = own, robust
        assert np.all(robust < 1.2 * clean)
        assert np.all(own < 1.03 * clean), "what it costs where there is no outlier"
    again = ratio(versoria(ukf(MOVING)))
    np.testing.assert_allclose(again, of[versoria], rtol=1e-9)


def test_adaptive_filter_equals_the_loop() -> None:
    """With lost data: steps without any do not move the factor."""
    steps, rng = 60, np.random.default_rng(6)
    valid = rng.uniform(size=(steps, 2)) > 0.3
    valid[20:25] = False
    z = np.asarray(sample(5, 1, steps).wild[0])
    same = np.broadcast_to
    model = Linear(
        same(PHI, (steps, 2, 2)), same(0.1 * Q, (steps, 2, 2)), np.eye(2), R, np.zeros(2), np.eye(2)
    )
    filter = innovation_adaptive(ekf(MOVING))

    @compiled
    def one(memory: Array, low: Array, high: Array) -> tuple[Array, Array]:
        params = FilterParams(TRUE, PRIOR, own=Adaptation(memory, low, high))
        return run(
            filter,
            params,
            jnp.zeros(steps),
            Obs(jnp.array(z), jnp.array(valid)),
            record=lambda state, info: (state.inner.x, jnp.exp(state.log_factor)),
        ).record

    for memory, low, high in ((8.0, 1e-3, 1e6), (4.0, 0.8, 1.5)):
        mean, factor = one(memory, low, high)
        expected = adapted(model, z, valid, memory, (low, high))
        np.testing.assert_allclose(mean, expected[0], rtol=0, atol=1e-11)
        np.testing.assert_allclose(factor, expected[1], rtol=1e-11)
        np.testing.assert_array_equal(factor[20:25], factor[19])
        assert np.ptp(expected[1]) > 0.2
    assert factor.min() == pytest.approx(0.8, rel=1e-14)
    assert factor.max() == pytest.approx(1.5, rel=1e-14)


def test_adaptive_filter_finds_a_process_noise_off_by_ten_in_sigma() -> None:
    """Both ways, 32 runs: with a memory of 50 the mean log of the factor ends within 0.25 of it."""
    steps = 1200
    data = sample(7, 32, steps)
    filter = innovation_adaptive(ekf(MOVING))

    def one(off: Array, z: Array) -> tuple[Array, Array]:
        params = FilterParams(TRUE._replace(q=TRUE.q * off), PRIOR, own=Adaptation(50.0, 1e-3, 1e3))
        return run(
            filter,
            params,
            jnp.zeros(steps),
            Obs(z, jnp.ones(z.shape, bool)),
            record=lambda state, info: (state.inner.x, state.log_factor),
        ).record

    offs = jnp.array([1e-2, 1.0, 1e2])
    mean, log_factor = compiled(jax.vmap(jax.vmap(one, (None, 0)), (0, None)))(offs, data.z)
    off = np.asarray(log_factor)[:, :, -1] + np.log(np.asarray(offs))[:, None]
    # From run to run 0.25; what comes from far above is still on its way, a step is at most 1 / 50.
    assert np.all(np.abs(off.mean(axis=1)) < 0.25), off.mean(axis=1)
    assert np.all(off.std(axis=1) < 0.35), off.std(axis=1)
    assert np.all(np.abs(log_factor) <= np.log(1e3) * (1 + 1e-14))
    plain = [
        means(ekf(MOVING), FilterParams(TRUE._replace(q=q), PRIOR), data.z) for q in 0.1 * offs
    ]
    reached, mistuned = (
        np.array([rms((np.asarray(m) - data.x)[:, 600:]) for m in over]) for over in (mean, plain)
    )
    assert np.all(reached < 1.03 * mistuned[1])
    assert np.all(mistuned[[0, 2]] > 1.1 * mistuned[1])


@pytest.mark.parametrize("kind", ["versoria", "innovation_adaptive"])
def test_gradient_of_a_run(kind: str) -> None:
    """By noise and settings, of errors and likelihood: against differences of the same run."""
    model = Model(
        transition=lambda p, x, u: 0.9 * x,
        process_noise=lambda p, x, u: p.q * jnp.eye(1),
        observe=lambda p, x, u: x,
        observation_noise=lambda p, x, u: p.r * jnp.eye(1),
    )
    adaptive = kind == "innovation_adaptive"
    filter = innovation_adaptive(ekf(model)) if adaptive else versoria(ekf(model))
    z = jnp.array(np.random.default_rng(8).normal(size=(12, 1))).at[6].mul(10)
    valid = jnp.ones((12, 1), bool).at[3].set(False)

    def loss(theta: Array) -> Array:
        params = FilterParams(
            Walk(jnp.exp(theta[0]), jnp.exp(theta[1])),
            Gaussian(jnp.zeros(1), jnp.eye(1)),
            Adaptation(100 * theta[2], 0.01, 100.0) if adaptive else Versoria(theta[2], theta[3]),
        )
        estimate, info = run(filter, params, jnp.zeros(12), Obs(z, valid)).record
        return jnp.sum(estimate.mean**2) - jnp.sum(info.log_likelihood)

    point = np.array([-2.0, 0.1, 0.05, 2.0])
    value, gradient = compiled(loss), compiled(jax.grad(loss))(point)
    expected = [
        central_difference(lambda t: np.asarray(value(t)), point, e, 1e-4) for e in np.eye(4)
    ]
    assert np.all(np.abs(expected[: 3 if adaptive else 4]) > 1e-3)
    np.testing.assert_allclose(gradient, expected, rtol=1e-7, atol=1e-9)
