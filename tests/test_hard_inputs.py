"""Inputs that break filters: ill-conditioned updates, singular noise, huge priors, long runs."""

from collections.abc import Callable
from fractions import Fraction
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.estimation.banks.mixture import BankParams, mmae
from jaxnav.estimation.filters.iterated import (
    iterated_ckf,
    iterated_ekf,
    modified_iterated_ckf,
)
from jaxnav.estimation.filters.kalman import ekf, kf
from jaxnav.estimation.filters.sigma_point import ckf, square_root_ckf, square_root_ukf, ukf
from jaxnav.estimation.filters.square_root import square_root_ekf, square_root_kf
from jaxnav.estimation.run import run
from jaxnav.estimation.types import (
    Filter,
    FilterParams,
    Flag,
    Gaussian,
    Info,
    Model,
    Obs,
    observed,
    replicate,
)
from jaxnav.numerics.sigma import SigmaRule, cubature, unscented

BUILDERS = {
    "kf": kf,
    "square_root_kf": square_root_kf,
    "ekf": ekf,
    "square_root_ekf": square_root_ekf,
    "ukf": ukf,
    "ckf": ckf,
    "square_root_ukf": square_root_ukf,
    "square_root_ckf": square_root_ckf,
    "iterated_ekf": iterated_ekf,
    "iterated_ckf": iterated_ckf,
    "modified_iterated_ckf": modified_iterated_ckf,
}
COVARIANCE_FORMS = ("kf", "ekf", "ukf", "ckf", "iterated_ckf", "modified_iterated_ckf")
RUNS = ("kf", "square_root_kf", "ukf", "square_root_ckf")
each_filter = pytest.mark.parametrize("name", BUILDERS)
# a run costs seconds to compile: one of each form; of a linear model the extended filters differ
# from the linear ones in how they apply its maps, and the two rules in the weight of the centre
each_run = pytest.mark.parametrize("name", RUNS)
UNSOUND = Flag.ILL_CONDITIONED | Flag.NOT_POSITIVE_DEFINITE | Flag.INDEFINITE


class Matrices(NamedTuple):
    """A time-invariant linear model as parameters."""

    Phi: Array
    Q: Array
    H: Array
    R: Array


MODEL = Model(
    transition=lambda p, x, u: p.Phi @ x,
    process_noise=lambda p, x, u: p.Q,
    observe=lambda p, x, u: p.H @ x,
    observation_noise=lambda p, x, u: p.R,
)
FILTERS: dict[str, Filter] = {name: build(MODEL) for name, build in BUILDERS.items()}
BANKS: dict[str, Filter] = {name: mmae(FILTERS[name]) for name in RUNS}


def static(H: Array, R: Array, P0: Array) -> FilterParams:
    """Parameters of a constant state that is observed."""
    n = P0.shape[0]
    noise = Matrices(jnp.eye(n, dtype=P0.dtype), jnp.zeros((n, n), P0.dtype), H, R)
    return FilterParams(noise, Gaussian(jnp.zeros(n, P0.dtype), P0))


def one_update(name: str, params: FilterParams, z: Array) -> tuple[Gaussian, Info]:
    """Update the prior with one observation."""
    filter = FILTERS[name]
    state, info = filter.update(
        params, filter.init(params), jnp.zeros(()), Obs(z, jnp.ones(z.shape, bool))
    )
    return filter.estimate(state), info


one_update_jit = compiled(one_update, static_argnums=0)


def nearly_parallel(delta: float, dtype: jnp.dtype) -> FilterParams:
    """Two nearly equal measurements, much finer than the prior (Grewal and Andrews, ch. 6)."""
    H = jnp.array([[1, 1, 1], [1, 1, 1 + delta]], dtype)
    return static(H, jnp.full(2, delta**2, dtype), jnp.eye(3, dtype=dtype))


def exact_posterior(delta: float) -> np.ndarray:
    """The covariance after that update, in rational numbers."""
    d = Fraction(delta)
    H = [[Fraction(1)] * 3, [Fraction(1), Fraction(1), 1 + d]]
    S = [[sum(a * b for a, b in zip(row, col, strict=True)) for col in H] for row in H]
    S[0][0] += d * d
    S[1][1] += d * d
    det = S[0][0] * S[1][1] - S[0][1] * S[1][0]
    inverse = [[S[1][1] / det, -S[0][1] / det], [-S[1][0] / det, S[0][0] / det]]
    return np.array(
        [
            [
                float(
                    (i == j)
                    - sum(H[a][i] * inverse[a][b] * H[b][j] for a in (0, 1) for b in (0, 1))
                )
                for j in range(3)
            ]
            for i in range(3)
        ]
    )


@pytest.mark.parametrize(
    ("name", "dtype", "delta", "bound"),
    [
        ("kf", jnp.float64, 1e-4, 1e-12),
        ("kf", jnp.float64, 1e-6, 1e-7),
        ("square_root_kf", jnp.float64, 1e-7, 1e-7),
        ("square_root_kf", jnp.float64, 1e-9, 1e-6),
        ("ekf", jnp.float64, 1e-6, 1e-7),
        ("square_root_ekf", jnp.float64, 1e-9, 1e-6),
        ("ukf", jnp.float64, 1e-6, 1e-7),
        ("ckf", jnp.float64, 1e-6, 1e-7),
        ("iterated_ekf", jnp.float64, 1e-6, 1e-7),
        ("iterated_ckf", jnp.float64, 1e-6, 1e-7),
        ("modified_iterated_ckf", jnp.float64, 1e-6, 1e-7),
        ("square_root_ukf", jnp.float64, 1e-9, 1e-6),
        ("square_root_ckf", jnp.float64, 1e-9, 1e-6),
        ("kf", jnp.float32, 1e-2, 1e-3),
        ("square_root_kf", jnp.float32, 1e-4, 1e-3),
        ("ekf", jnp.float32, 3e-3, 1e-3),
        ("square_root_ekf", jnp.float32, 1e-4, 1e-3),
        ("ukf", jnp.float32, 3e-3, 1e-3),
        ("ckf", jnp.float32, 3e-3, 1e-3),
        ("iterated_ekf", jnp.float32, 3e-3, 1e-3),
        ("iterated_ckf", jnp.float32, 3e-3, 1e-3),
        ("modified_iterated_ckf", jnp.float32, 3e-3, 1e-3),
        ("square_root_ukf", jnp.float32, 1e-4, 1e-3),
        ("square_root_ckf", jnp.float32, 1e-4, 1e-3),
    ],
)
def test_ill_conditioned_update_is_right(
    name: str, dtype: jnp.dtype, delta: float, bound: float
) -> None:
    delta = float(np.asarray(delta, dtype))
    params = nearly_parallel(delta, dtype)
    estimate, info = one_update_jit(name, params, jnp.zeros(2, dtype))
    # the second row of H is rounded to the precision of the filter: judge by what it was given
    expected = exact_posterior(float(params.model.H[1, 2]) - 1)
    if float(params.model.H[1, 2]) - 1 != delta:
        expected = _exact_with_noise(float(params.model.H[1, 2]), delta)
    error = np.abs(np.asarray(estimate.cov, float) - expected).max() / np.abs(expected).max()
    assert error < bound
    assert not info.flags & Flag.NOT_POSITIVE_DEFINITE


def _exact_with_noise(corner: float, sigma: float) -> np.ndarray:
    """As :func:`exact_posterior`, for a corner of H that was rounded, in 60 digits."""
    from decimal import Decimal, getcontext

    getcontext().prec = 60
    h, r = Decimal(corner), Decimal(sigma) ** 2
    one, two = Decimal(1), Decimal(2)
    S = [[3 + r, two + h], [two + h, two + h * h + r]]
    det = S[0][0] * S[1][1] - S[0][1] ** 2
    inverse = [[S[1][1] / det, -S[0][1] / det], [-S[0][1] / det, S[0][0] / det]]
    H = [[one, one, one], [one, one, h]]
    return np.array(
        [
            [
                float(
                    (one if i == j else Decimal(0))
                    - sum(H[a][i] * inverse[a][b] * H[b][j] for a in (0, 1) for b in (0, 1))
                )
                for j in range(3)
            ]
            for i in range(3)
        ]
    )


@pytest.mark.parametrize("name", COVARIANCE_FORMS)
@pytest.mark.parametrize("delta", [1e-8, 1e-10, 1e-14])
def test_covariance_form_flags_what_it_cannot_solve(name: str, delta: float) -> None:
    estimate, info = one_update_jit(name, nearly_parallel(delta, jnp.float64), jnp.zeros(2))
    assert info.flags & UNSOUND
    assert np.all(np.isfinite(estimate.cov))


@pytest.mark.parametrize("name", ["kf", "ukf", "ckf", "iterated_ckf"])
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_no_wrong_covariance_goes_without_a_flag(name: str, dtype: jnp.dtype) -> None:
    """A sweep of 120 cases, from those that are easy to those that are lost to rounding."""
    exponents = np.linspace(2, 15, 120) if dtype == jnp.float64 else np.linspace(1, 7, 120)
    deltas = [float(np.asarray(10.0**-e, dtype)) for e in exponents]
    cases = [nearly_parallel(delta, dtype) for delta in deltas]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cases)
    one = compiled(jax.vmap(lambda params: one_update(name, params, jnp.zeros(2, dtype))))
    estimate, info = one(stacked)
    errors = []
    for params, delta, cov in zip(cases, deltas, np.asarray(estimate.cov, float), strict=True):
        expected = _exact_with_noise(float(params.model.H[1, 2]), delta)
        errors.append(np.abs(cov - expected).max() / np.abs(expected).max())
    wrong = np.array(errors) > 1e-3
    assert wrong.sum() > 40
    assert np.all(np.asarray(info.flags)[wrong] & UNSOUND)


@pytest.mark.parametrize("name", ["square_root_kf", "square_root_ukf", "square_root_ckf"])
def test_gradient_of_the_ill_conditioned_update(name: str) -> None:
    """By a factor on prior and noise alike, at a delta that Joseph's form cannot even update."""
    from decimal import Decimal, getcontext

    getcontext().prec = 60
    delta = 1e-8
    params = nearly_parallel(delta, jnp.float64)
    z = np.array([0.3, 0.3 + 2 * delta])

    def loss(theta: Array) -> Array:
        model = params.model._replace(R=theta * params.model.R)
        prior = params.initial._replace(cov=theta * params.initial.cov)
        _, info = one_update(name, FilterParams(model, prior), jnp.asarray(z))
        return -info.log_likelihood

    # S scales with theta: the loss is log(theta) + NIS / (2 theta) and what does not depend on it
    h, r = Decimal(float(params.model.H[1, 2])), Decimal(delta) ** 2
    S = [3 + r, 2 + h, 2 + h * h + r]
    a, b = (Decimal(float(value)) for value in z)
    nis = (S[2] * a * a - 2 * S[1] * a * b + S[0] * b * b) / (S[0] * S[2] - S[1] ** 2)
    gradient = compiled(jax.grad(loss))(jnp.array(1.0))
    np.testing.assert_allclose(gradient, float(1 - nis / 2), rtol=1e-6)


@each_filter
def test_duplicate_perfect_sensors_are_flagged(name: str) -> None:
    params = static(jnp.array([[1.0, 0.0], [1.0, 0.0]]), jnp.zeros(2), jnp.eye(2))
    estimate, info = one_update_jit(name, params, jnp.ones(2))
    assert info.flags & UNSOUND
    assert np.all(np.isfinite(estimate.mean))
    assert np.all(np.isfinite(estimate.cov))


@each_filter
def test_perfect_knowledge_and_perfect_sensors(name: str) -> None:
    """No prior uncertainty and no noise at all: the update is skipped, with finite gradients."""
    params = static(jnp.array([[1.0, 0.0]]), jnp.zeros(1), jnp.zeros((2, 2)))
    estimate, info = one_update_jit(name, params, jnp.ones(1))
    assert info.flags & Flag.NOT_POSITIVE_DEFINITE
    np.testing.assert_array_equal(estimate.mean, 0)
    np.testing.assert_array_equal(estimate.cov, 0)
    if name in ("kf", "ukf", "ckf"):

        def moved(noise: Array) -> Array:
            model = params.model._replace(R=noise)
            estimate, info = one_update(name, params._replace(model=model), jnp.ones(1))
            return jnp.sum(estimate.mean) + jnp.maximum(info.log_likelihood, -1.0)

        assert np.all(np.isfinite(compiled(jax.grad(moved))(jnp.zeros(1))))


@each_run
@pytest.mark.parametrize("broken", [-1e6, np.nan])
def test_member_that_fails_leaves_the_bank_to_the_others(name: str, broken: float) -> None:
    base = replicate(static(jnp.eye(2), jnp.ones(2), jnp.eye(2)), 2)
    noise = base.model._replace(R=jnp.array([[1.0, 1.0], [broken, 1.0]]))
    params = BankParams(base._replace(model=noise), ())
    z = jnp.array(np.random.default_rng(0).normal(size=(10, 2)))
    estimate, info = run(BANKS[name], params, jnp.zeros(10), observed(z)).record
    alone = static(jnp.eye(2), jnp.ones(2), jnp.eye(2))
    expected, _ = run(FILTERS[name], alone, jnp.zeros(10), observed(z)).record
    np.testing.assert_allclose(estimate.mean, expected.mean, atol=1e-14)
    np.testing.assert_allclose(estimate.cov, expected.cov, atol=1e-14)
    assert np.all(np.isfinite(info.log_likelihood))


def test_linear_filters_refuse_what_they_would_ignore() -> None:
    for build in (kf, square_root_kf):
        with pytest.raises(ValueError, match="its own retract"):
            build(MODEL._replace(retract=lambda x, dx: x + 2 * dx))


@each_filter
def test_one_perfect_channel_of_two(name: str) -> None:
    params = static(jnp.eye(2), jnp.array([0.0, 4.0]), jnp.eye(2))
    estimate, info = one_update_jit(name, params, jnp.array([3.0, 5.0]))
    np.testing.assert_allclose(estimate.mean, [3.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(estimate.cov, np.diag([0.0, 0.8]), atol=1e-12)
    assert info.flags == 0


@each_filter
@pytest.mark.parametrize(
    ("dtype", "prior", "noise"), [(jnp.float64, 1e12, 1e-6), (jnp.float32, 1e6, 1e-3)]
)
def test_huge_prior_and_fine_sensor(
    name: str, dtype: jnp.dtype, prior: float, noise: float
) -> None:
    H = jnp.array([[1.0, 0.5]], dtype)
    params = static(H, jnp.full(1, noise, dtype), prior * jnp.eye(2, dtype=dtype))
    estimate, _ = one_update_jit(name, params, jnp.ones(1, dtype))
    cov = np.asarray(estimate.cov, float)
    assert np.all(np.isfinite(cov))
    # the observed direction is known, the other keeps the prior
    assert np.linalg.eigvalsh(cov).min() >= -8 * np.finfo(dtype).eps * prior
    assert abs(float(H[0] @ estimate.mean) - 1) < 1e-3


LONG_RUNS = ("kf", "square_root_kf", "ukf", "ckf", "square_root_ukf", "square_root_ckf")


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@pytest.mark.parametrize("name", LONG_RUNS)
def test_hundred_thousand_steps_stay_positive(name: str, dtype: jnp.dtype) -> None:
    """Position, velocity and bias on three axes with hardly any process noise (nine states).

    Twenty thousand for the forms that take longer than the Joseph form.
    """
    one, zero = np.eye(3), np.zeros((3, 3))
    dt = 0.01
    Phi = np.block([[one, dt * one, zero], [zero, one, dt * one], [zero, zero, one]])
    noise = Matrices(
        Phi=jnp.asarray(Phi, dtype),
        Q=jnp.diag(jnp.asarray([0.0] * 3 + [1e-8] * 3 + [1e-12] * 3, dtype)),
        H=jnp.asarray(np.hstack([one, zero, zero]), dtype),
        R=jnp.full(3, 1e-4, dtype),
    )
    P0 = jnp.diag(jnp.asarray([1e6] * 3 + [1e2] * 3 + [1.0] * 3, dtype))
    params = FilterParams(noise, Gaussian(jnp.zeros(9, dtype), P0))
    steps = 100_000 if name == "kf" else 20_000
    observations = Obs(jnp.zeros((steps, 3), dtype), jnp.ones((steps, 3), bool))
    final = run(
        FILTERS[name],
        params,
        jnp.zeros(steps, dtype),
        observations,
        record=lambda state, info: info.flags,
    )
    lost = Flag.NOT_POSITIVE_DEFINITE | Flag.INDEFINITE
    assert np.all(np.asarray(final.record)[10:] & lost == 0)
    cov = np.asarray(FILTERS[name].estimate(final.final).cov, float)
    np.testing.assert_array_equal(cov, cov.T)
    sigma = np.sqrt(np.diag(cov))
    correlation = cov / np.outer(sigma, sigma)
    assert np.linalg.eigvalsh(correlation).min() >= (-1e-12 if dtype == jnp.float64 else -1e-5)
    np.testing.assert_allclose(sigma[:3], sigma[0], rtol=1e-3)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@each_run
def test_bad_value_equals_the_masked_run(name: str, bad: float) -> None:
    """First, middle and last step, through the screen for recorded data."""
    rng = np.random.default_rng(0)
    params = static(jnp.eye(2), jnp.ones(2), jnp.eye(2))
    for k in (0, 10, 19):
        z = rng.normal(size=(20, 2))
        z[k, 1] = bad
        mask = np.isfinite(z)
        screened = run(FILTERS[name], params, jnp.zeros(20), observed(jnp.array(z)))
        masked = run(
            FILTERS[name],
            params,
            jnp.zeros(20),
            Obs(jnp.array(np.where(mask, z, 1e300)), jnp.array(mask)),
        )
        for a, b in zip(jax.tree.leaves(screened), jax.tree.leaves(masked), strict=True):
            np.testing.assert_array_equal(a, b)


@each_run
def test_units_do_not_matter(name: str) -> None:
    """The same system in other units, a condition of 1e20: equal after scaling back."""
    rng = np.random.default_rng(1)
    scale = np.array([1.0, 1e-5, 1e5])
    A = np.eye(3) + 0.1 * rng.normal(size=(3, 3))
    H = rng.normal(size=(2, 3))
    P0 = np.diag([1.0, 2.0, 3.0])
    Q = 0.01 * np.eye(3)
    z = jnp.array(rng.normal(size=(50, 2)))

    def filtered(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        noise = Matrices(
            jnp.array(np.diag(s) @ A @ np.diag(1 / s)),
            jnp.array(np.outer(s, s) * Q),
            jnp.array(H / s),
            jnp.full(2, 0.5),
        )
        params = FilterParams(noise, Gaussian(jnp.zeros(3), jnp.array(np.outer(s, s) * P0)))
        estimate, _ = run(FILTERS[name], params, jnp.zeros(50), observed(z)).record
        return np.asarray(estimate.mean) / s, np.asarray(estimate.cov) / np.outer(s, s)

    plain, scaled = filtered(np.ones(3)), filtered(scale)
    np.testing.assert_allclose(scaled[0], plain[0], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(scaled[1], plain[1], rtol=1e-9, atol=1e-9)


class Rules(NamedTuple):
    """Rules for 15 states that take differences of large numbers, and one that does not."""

    cubature: SigmaRule
    fine: SigmaRule
    negative: SigmaRule


RULES = Rules(
    cubature(15), unscented(15, alpha=1e-3), unscented(15, alpha=1.0, beta=0.0, kappa=-12.0)
)


def fifteen_states(build: Callable[[Model], Filter], dtype: jnp.dtype) -> tuple[np.ndarray, ...]:
    """Covariances, least eigenvalues of the correlations and flags of a run with each rule."""
    rng = np.random.default_rng(0)
    mixing, H = rng.normal(size=(15, 15)) / np.sqrt(15), rng.normal(size=(3, 15))
    A, seen, gain = (jnp.asarray(value, dtype) for value in (mixing, H, 0.1))
    filter = build(
        Model(
            transition=lambda p, x, u: 0.95 * x + gain * jnp.sin(A @ x),
            process_noise=lambda p, x, u: 1e-3 * jnp.eye(15, dtype=dtype),
            observe=lambda p, x, u: seen @ x + gain * jnp.sin(x[:3]),
            observation_noise=lambda p, x, u: jnp.full(3, 0.1, dtype),
        )
    )
    z = jnp.asarray(rng.normal(size=(300, 3)), dtype)
    prior = Gaussian(jnp.full(15, 30.0, dtype), jnp.eye(15, dtype=dtype))
    runs = []
    for rule in RULES:
        params = FilterParams((), prior, jax.tree.map(lambda w: jnp.asarray(w, dtype), rule))
        estimate, info = run(filter, params, jnp.zeros(300, dtype), observed(z)).record
        runs.append((np.asarray(estimate.cov, float), np.asarray(info.flags)))
    covs, flags = (np.stack(parts) for parts in zip(*runs, strict=True))
    assert np.all(np.isfinite(covs))
    sigma = np.sqrt(np.abs(np.diagonal(covs, axis1=2, axis2=3)))
    least = np.linalg.eigvalsh(covs / (sigma[..., :, None] * sigma[..., None, :])).min(axis=-1)
    return covs, least, flags


@pytest.mark.usefixtures("optimised_programs")
def test_rules_of_large_weights_stay_positive_or_say_so() -> None:
    """In float32 with 15 states: what a covariance loses in an update shows in the next draw.

    For alpha = 1e-3 the centre weighs -1e6 and differences of points are noise: hardly a flag tells
    that the square-root form, which stays positive, has a wrong covariance.
    """
    exact, _, _ = fifteen_states(ukf, jnp.float64)
    for build in (ukf, square_root_ukf):
        covs, least, flags = fifteen_states(build, jnp.float32)
        mended = (flags & UNSOUND) > 0
        soon = mended[:, :-1] | mended[:, 1:]
        assert np.all((least[:, :-1] > -1e-6) | soon)
        errors = np.abs(covs - exact).max(axis=(1, 2, 3)) / np.abs(exact).max(axis=(1, 2, 3))
        control, fine, negative = errors
        assert control < 1e-3
        assert negative < 1e-3
        assert fine > 0.3
        np.testing.assert_array_equal(np.any(mended, axis=1), [False, True, False])
