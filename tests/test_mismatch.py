"""Covariance analysis of a mis-set filter: closed forms, a Monte Carlo, what it leaves out."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.estimation.filters.kalman import ekf
from jaxnav.estimation.mismatch import Mismatch, mismatched
from jaxnav.estimation.run import run, simulate
from jaxnav.estimation.types import FilterParams, Flag, Gaussian, Model, Obs


class Noise(NamedTuple):
    """Factors on Q and R."""

    q: Array
    r: Array


def linear(Phi: np.ndarray, Q: np.ndarray, H: np.ndarray, R: np.ndarray) -> Model:
    """A linear model with factors on its noise."""
    return Model(
        transition=lambda p, x, u: jnp.array(Phi) @ x,
        process_noise=lambda p, x, u: p.q * jnp.array(Q),
        observe=lambda p, x, u: jnp.array(H) @ x,
        observation_noise=lambda p, x, u: p.r * jnp.array(R),
    )


ONE = np.eye(1)
WALK = linear(ONE, ONE, ONE, ONE)


def steady_walk(q: Array, r: Array, believed: Array, wrong_r: Array) -> tuple[Array, Array]:
    """Actual and believed variances of a scalar random walk after many steps."""
    analysis = mismatched(WALK, lambda u: (jnp.zeros(1), jnp.zeros(1)))
    prior = Gaussian(jnp.zeros(1), jnp.eye(1))
    params = Mismatch(
        FilterParams(Noise(believed, wrong_r), prior), FilterParams(Noise(q, r), prior)
    )
    steps = 20_000
    obs = Obs(jnp.zeros((steps, 1)), jnp.ones((steps, 1), bool))
    final = run(analysis, params, jnp.zeros(steps), obs, record=lambda state, info: ()).final
    return final.actual[0, 0], final.believed[0, 0]


def steady_variance(q, r):
    """After an update, from the Riccati equation ``M^2 = q M + q r``, ``P = M - q``."""
    return 0.5 * q + np.sqrt(0.25 * q * q + q * r) - q


def test_random_walk_has_the_variances_of_the_closed_form() -> None:
    """Matched, Q mis-set both ways, R mis-set both ways; in the limit sqrt((s + 1 / s) / 2)."""
    s = np.array([1.0, 2.0, 3.0, 10.0, 1 / 3, 1.0, 1.0])
    factor_r = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 9.0, 0.1])
    program = compiled(jax.vmap(steady_walk))
    r = np.full(7, 4.0)
    for q in (4.0, 4e-3):
        told, wrong_r = q / s**2, factor_r * r
        actual, believed = map(np.asarray, program(np.full(7, q), r, told, wrong_r))
        np.testing.assert_allclose(believed, steady_variance(told, wrong_r), rtol=1e-10)
        K = steady_variance(told, wrong_r) / wrong_r
        expected = ((1 - K) ** 2 * q + K**2 * r) / (1 - (1 - K) ** 2)
        np.testing.assert_allclose(actual, expected, rtol=1e-10)
        np.testing.assert_allclose(actual[0], believed[0], rtol=1e-12)
        assert np.all(actual[1:] > actual[0])
        # Too small a Q or R makes the filter too sure of itself, too large a one the other way.
        np.testing.assert_array_equal(actual[1:] > believed[1:], [1, 1, 1, 0, 0, 1])
    # q / r of 1e-3: a gain of 3 %, by which the limit of small q is off.
    ratio = np.sqrt(actual / actual[0])
    np.testing.assert_allclose(ratio[:5], np.sqrt((s + 1 / s)[:5] / 2), rtol=0.03)
    # R too large by 9 has the gain of Q too small by 9.
    np.testing.assert_allclose(ratio[5], ratio[2], rtol=1e-6)


PHI = np.array([[1.0, 0.5], [0.0, 0.98]])
Q = np.array([[0.05, 0.01], [0.01, 0.2]])
H = np.array([[1.0, 0.0], [0.3, 1.0]])
R = np.array([[1.0, 0.2], [0.2, 2.0]])
MODEL = linear(PHI, Q, H, R)
STEPS, RUNS = 30, 4000
TRUE = FilterParams(
    Noise(jnp.array(1.0), jnp.array(1.0)), Gaussian(jnp.array([1.0, -1.0]), jnp.eye(2))
)
WRONG = FilterParams(
    Noise(jnp.array(0.05), jnp.array(3.0)), Gaussian(TRUE.initial.mean, 0.1 * jnp.eye(2))
)
VALID = np.random.default_rng(1).uniform(size=(STEPS, 2)) > 0.3
VALID[10:14] = False


def analysed(believed: FilterParams, z: Array):
    """Analyse a path that is not at the origin."""
    path = [np.array([1.0, -1.0])]
    for _ in range(STEPS):
        path.append(PHI @ path[-1])
    ends = jnp.array(np.array(path))
    filter = mismatched(MODEL, lambda u: u)
    return run(
        filter,
        Mismatch(believed, TRUE),
        (ends[:-1], ends[1:]),
        Obs(z, jnp.array(VALID)),
        record=lambda state, info: (filter.estimate(state), state.believed, info),
    ).record


def test_monte_carlo_has_the_analysed_covariance() -> None:
    """Four thousand runs with lost channels: each entry within five of its standard errors."""
    rng = np.random.default_rng(2)

    def noise(cov: np.ndarray, *shape: int) -> Array:
        return jnp.array(rng.normal(size=(RUNS, *shape, 2)) @ np.linalg.cholesky(cov).T)

    def one(start: Array, w: Array, v: Array) -> Array:
        x, z = simulate(MODEL, TRUE.model, start, jnp.zeros(STEPS), w, v)
        obs = Obs(z, jnp.array(VALID))
        estimate, _ = run(ekf(MODEL), WRONG, jnp.zeros(STEPS), obs).record
        return estimate.mean - x

    start = TRUE.initial.mean[None] + noise(np.eye(2))
    errors = np.asarray(compiled(jax.vmap(one))(start, noise(Q, STEPS), noise(R, STEPS)))
    estimate, believed, _ = compiled(analysed)(WRONG, jnp.zeros((STEPS, 2)))
    P = np.asarray(estimate.cov)
    sampled = np.einsum("nti,ntj->tij", errors, errors) / RUNS
    variance = np.diagonal(P, axis1=1, axis2=2)
    # Of a product of Gaussians: (P_ii P_jj + P_ij^2) / N.
    spread = np.sqrt((variance[:, :, None] * variance[:, None, :] + P**2) / RUNS)
    np.testing.assert_array_less(np.abs(sampled - P), 5 * spread)
    assert np.all(np.asarray(believed)[5:, 0, 0] < 0.5 * P[5:, 0, 0]), "the test of the test"


def test_matched_analysis_is_the_filter_and_values_are_not_used() -> None:
    plain = run(
        ekf(MODEL), TRUE, jnp.zeros(STEPS), Obs(jnp.zeros((STEPS, 2)), jnp.array(VALID))
    ).record
    one = compiled(analysed)
    estimate, believed, info = one(TRUE, jnp.zeros((STEPS, 2)))
    np.testing.assert_allclose(estimate.cov, believed, rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(believed, plain[0].cov, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(info.innovation_cov, plain[1].innovation_cov, rtol=1e-11)
    np.testing.assert_array_equal(info.flags == Flag.NO_OBSERVATION, ~VALID.any(axis=1))
    np.testing.assert_array_equal(info.innovation, 0)
    path = np.array([np.linalg.matrix_power(PHI, k) @ [1.0, -1.0] for k in range(1, STEPS + 1)])
    np.testing.assert_allclose(estimate.mean, path, rtol=1e-12)
    # Row 14 of the hard inputs: neither NaN in a lost channel nor any value in one that arrived.
    again = one(TRUE, jnp.where(jnp.array(VALID), 7.0, jnp.nan))
    for a, b in zip(
        jax.tree.leaves(again), jax.tree.leaves((estimate, believed, info)), strict=True
    ):
        np.testing.assert_array_equal(a, b)


def test_prior_that_is_believed_too_good() -> None:
    """Without noise and gain the actual covariance is carried, the believed one not used."""
    analysis = mismatched(WALK, lambda u: (jnp.zeros(1), jnp.zeros(1)))
    still = Noise(jnp.array(0.0), jnp.array(1.0))
    params = Mismatch(
        FilterParams(still, Gaussian(jnp.zeros(1), jnp.zeros((1, 1)))),
        FilterParams(still, Gaussian(jnp.zeros(1), 9 * jnp.eye(1))),
    )
    obs = Obs(jnp.zeros((5, 1)), jnp.ones((5, 1), bool))
    final = run(analysis, params, jnp.zeros(5), obs).final
    assert final.believed[0, 0] == 0
    assert final.actual[0, 0] == 9
    moved = analysis.restart(final, Gaussian(jnp.ones(1), 4 * jnp.eye(1)))
    assert analysis.estimate(moved).cov[0, 0] == 4
    assert moved.believed[0, 0] == 0
