"""Gradients of every filter and bank, over ten steps and ten thousand, and at singular points."""

import ast
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import scipy.optimize
from jax import Array
from jax.test_util import check_jvp, check_vjp

import jaxnav
from checks import long_gradients
from jaxnav.compiling import compiled
from jaxnav.estimation.filters import sigma_point, square_root
from jaxnav.estimation.filters.kalman import kf
from jaxnav.estimation.filters.sage_husa import averaging
from jaxnav.estimation.run import run
from jaxnav.estimation.tune.fit import fit, fit_lbfgs
from jaxnav.estimation.tune.losses import negative_log_likelihood
from jaxnav.estimation.types import FilterParams, Gaussian, Model, Obs
from jaxnav.navigation.atmosphere import refraction_angle
from jaxnav.navigation.channels.refraction import raised
from jaxnav.navigation.limb import ray_height, separation
from jaxnav.numerics.linalg import cholesky, safe_sqrt
from jaxnav.numerics.roots import tria, update_array
from jaxnav.numerics.sigma import SigmaRule
from tests.cases import Noise, cases
from tests.gradient_cases import CASES, PARAMS, log_factors, oscillator, start
from tests.oracles.matrices import central_difference

each_case = pytest.mark.parametrize("name", CASES)


@each_case
def test_gradient_over_ten_steps(name: str) -> None:
    """Backward and forward, by the noise and by every parameter of the case's own."""
    loss, point = log_factors(name, 10), start(name)

    @compiled
    def both(theta: Array, ahead: Array) -> tuple[tuple[Array, Array], Array]:
        return jax.jvp(loss, (theta,), (ahead,)), jax.grad(loss)(theta)

    def value(theta: Any) -> Any:
        return both(theta, theta)[0][0]

    def forward(theta: tuple[Array], ahead: tuple[Array]) -> tuple[Array, Array]:
        return both(*theta, *ahead)[0]

    def backward(theta: Array) -> tuple[Array, Callable[[Array], tuple[Array]]]:
        (now, _), gradient = both(theta, theta)
        return now, lambda weight: (weight * gradient,)

    gradient = np.asarray(both(point, point)[1])
    expected = [central_difference(value, point, e, 1e-3) for e in np.eye(point.size)]
    np.testing.assert_allclose(gradient, expected, rtol=1e-8, atol=1e-11)
    assert np.all(np.abs(gradient[:2]) > 1e-6)
    # both halves of check_grads, which would compile a program for each part
    check_jvp(value, forward, (point,), atol=1e-9, rtol=1e-6, eps=1e-4)
    check_vjp(value, backward, (point,), atol=1e-9, rtol=1e-6, eps=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("name", long_gradients.FEW)
def test_gradient_over_ten_thousand_steps(name: str) -> None:
    """A sample of ``checks/long_gradients.py``, which has all filters and banks."""
    found = long_gradients.compared(name)
    assert long_gradients.faults(name, found) == []


# Singular points


AXIS = jnp.array([0.0, 0.0, 1.0])
ABOVE = jnp.array([0.0, 0.0, 7e6])


def centred(centre: Array) -> Array:
    """The likelihood of a step by the weight of the centre, of which the filter takes the root."""
    filter, params, _ = CASES["square_root_ukf"]
    params = params._replace(own=SigmaRule(2**0.5, 0.25, centre))
    state = filter.predict(params, filter.init(params), jnp.array(0.5))
    obs = Obs(jnp.ones(1), jnp.ones(1, bool))
    return filter.update(params, state, jnp.array(0.5), obs)[1].log_likelihood


SINGULAR: dict[str, tuple[Callable[[Array], Array], Array]] = {
    "root of zero": (safe_sqrt, jnp.array(0.0)),
    "root of a negative number": (safe_sqrt, jnp.array(-1.0)),
    "angle between opposite directions": (lambda b: separation(AXIS, b), -AXIS),
    "star at the zenith, turned": (lambda s: jnp.sum(raised(ABOVE, s, jnp.array(0.1))), AXIS),
    "star at the nadir, turned": (lambda s: jnp.sum(raised(ABOVE, s, jnp.array(0.1))), -AXIS),
    "ray to the zenith": (lambda s: ray_height(ABOVE, s, 1e-3), AXIS),
    "ray to the nadir": (lambda s: ray_height(ABOVE, s, 1e-3), -AXIS),
    "first sample of an average": (lambda b: averaging(b, jnp.array(0.0)), jnp.array(1.0)),
    "endless average": (lambda b: averaging(b, jnp.array(jnp.inf)), jnp.array(1.0)),
    "centre without a weight": (centred, jnp.array(0.0)),
    "refraction at a kink of the air": (refraction_angle, jnp.array(20e3)),
    "factor of a singular matrix": (
        lambda S: jnp.sum(cholesky(S).factor),
        jnp.diag(jnp.array([1.0, 0.0])),
    ),
}


@pytest.mark.parametrize("name", SINGULAR)
def test_value_and_gradient_are_finite_at_a_singular_point(name: str) -> None:
    """Of roots, norms, angles and factors, where the plain functions give infinity or NaN."""
    function, point = SINGULAR[name]
    value, gradient = compiled(jax.value_and_grad(function))(point)
    assert np.isfinite(value)
    assert np.all(np.isfinite(gradient))


DECOMPOSITIONS = {"eig", "eigh", "eigvals", "eigvalsh", "svd", "svdvals", "sqrtm", "pinv", "lstsq"}


def test_no_decomposition_without_a_derivative_is_on_a_differentiated_path() -> None:
    """Their derivatives are NaN at repeated values; those left are of a host or of checks."""
    root, found = Path(jaxnav.__file__).parent, set()
    for folder in ("numerics", "estimation", "navigation"):
        for path in sorted((root / folder).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Attribute) and node.attr in DECOMPOSITIONS:
                    found.add((path.relative_to(root).as_posix(), ast.unparse(node)))
    on_host = ("estimation/checks.py", "estimation/tune/inspect.py")
    checks = {("estimation/debugging.py", "jnp.linalg.eigvalsh")}
    assert found == {(path, "np.linalg.eigvalsh") for path in on_host} | checks


@pytest.mark.parametrize("name", [name for name in CASES if name.startswith("square_root")])
def test_arrays_that_are_triangularised_are_wide_and_of_full_rank(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With process noise of rank one."""
    given = []

    def recorded(array: Callable[..., Array]) -> Callable[..., Array]:
        def call(*parts: Array) -> Array:
            A = array(*parts)
            jax.debug.callback(lambda A: given.append(np.asarray(A)), A)
            return tria(A)

        return call

    for module in (square_root, sigma_point):
        beside = recorded(lambda *parts: jnp.concatenate(parts, axis=1))
        monkeypatch.setattr(module, "tria_beside", beside)
        monkeypatch.setattr(module, "tria_of_update", recorded(update_array))
    filter, params, _ = cases(oscillator(lambda x: x), PARAMS, 1)[name]

    @compiled
    def step(z: Array) -> Any:
        state = filter.predict(params, filter.init(params), jnp.array(0.5))
        return filter.update(params, state, jnp.array(0.5), Obs(z, jnp.ones(1, bool)))

    jax.block_until_ready(step(jnp.ones(1)))
    jax.effects_barrier()
    assert len(given) == (3 if name in ("square_root_ukf", "square_root_ckf") else 2)
    for A in given:
        assert A.shape[1] >= A.shape[0]
        assert np.linalg.svd(A, compute_uv=False).min() > 1e-3


# The optimiser


def variance_loss(variance: Array) -> Array:
    """The negative log-likelihood of data whose mean square is 2."""
    return 0.5 * jnp.log(variance) + 1.0 / variance


@pytest.mark.parametrize("begin", [1e-12, 1e12])
def test_fit_from_twelve_decades_away(begin: float) -> None:
    """The gradient there is 1e12 or flat in the number itself; in its logarithm a way is open."""
    rate = optax.cosine_decay_schedule(1.0, 200)
    steady = optax.chain(optax.clip(0.5), optax.adam(rate))
    found = fit(variance_loss, begin, optimiser=steady, steps=200)
    np.testing.assert_allclose(found.params, 2.0, rtol=1e-3)
    found = fit_lbfgs(variance_loss, begin, steps=200)
    np.testing.assert_allclose(found.params, 2.0, rtol=1e-5)


@pytest.mark.parametrize("begin", [1e-12, 3.0, 1e12])
def test_fit_with_a_rate_of_ten_stays_finite_and_keeps_the_best(begin: float) -> None:
    found = fit(variance_loss, begin, optimiser=optax.adam(10.0), steps=30)
    assert np.isfinite(found.params)
    assert found.loss == np.nanmin(found.history)
    np.testing.assert_allclose(variance_loss(found.params), found.loss, rtol=1e-12)
    assert found.loss <= variance_loss(jnp.array(begin))


def test_loss_that_is_not_a_number_at_one_step_keeps_the_parameters() -> None:
    def broken(variance: Array, bad: Array) -> Array:
        return jnp.where(bad, jnp.nan, variance_loss(variance))

    def fitted(steps: int, at: int) -> Any:
        return fit(
            broken,
            5.0,
            optimiser=optax.adam(0.1),
            steps=steps,
            batches=lambda number: jnp.array(number == at),
        )

    before, hit, after = fitted(6, 99), fitted(7, 7), fitted(8, 7)
    assert hit.params == before.params
    assert hit.rejected == 1
    assert np.isnan(hit.history[7])
    assert np.isfinite(after.history[8])
    assert after.loss < before.loss


def test_a_wall_of_nan_never_replaces_the_best() -> None:
    """The minimum lies on the edge of where the loss is a number."""

    def walled(x: Array) -> Array:
        return jnp.where(x < 2.0, jnp.nan, variance_loss(x) + x)

    for found in (fit(walled, 9.0, optimiser=optax.sgd(10.0)), fit_lbfgs(walled, 9.0)):
        assert found.rejected > 0
        assert found.params >= 2.0
        assert found.loss == np.nanmin(found.history)
        assert found.loss < walled(jnp.array(9.0))


# Against what is known exactly


WALK = Model(
    transition=lambda p, x, u: x,
    process_noise=lambda p, x, u: p.q * jnp.ones((1, 1)),
    observe=lambda p, x, u: x,
    observation_noise=lambda p, x, u: p.r * jnp.ones(1),
)
FROM_ZERO = Gaussian(jnp.zeros(1), jnp.ones((1, 1)))


def test_derivative_of_the_steady_covariance_is_that_of_riccati() -> None:
    """``P = (sqrt(q^2 + 4 q r) - q) / 2`` of a random walk, over ten decades of ``q / r``."""
    q, r = 10.0 ** np.arange(-5, 6), np.full(11, 2.0)
    steps = 8000
    silent = Obs(jnp.zeros((steps, 1)), jnp.ones((steps, 1), bool))

    def steady(q: Array, r: Array) -> Array:
        params = FilterParams(Noise(q, r), FROM_ZERO)
        last = run(kf(WALK), params, jnp.zeros(steps), silent, record=lambda s, i: (), segment=100)
        return last.final.P[0, 0]

    graded = compiled(jax.vmap(jax.value_and_grad(steady, (0, 1))))
    P, (by_q, by_r) = graded(q, r)
    root = np.sqrt(q**2 + 4 * q * r)
    np.testing.assert_allclose(P, 2 * q * r / (root + q), rtol=1e-12)
    # ((q + 2 r) / root - 1) / 2 without its cancellation; the filter's is what terms of one leave
    np.testing.assert_allclose(by_q, 2 * r**2 / (root * (q + 2 * r + root)), rtol=1e-10, atol=1e-16)
    np.testing.assert_allclose(by_r, q / root, rtol=1e-10)


def test_likelihood_and_its_maximum_are_those_of_the_dense_covariance() -> None:
    """A random walk in white noise: the series is one Gaussian vector, maximised by scipy."""
    steps, rng = 80, np.random.default_rng(3)
    walk = rng.normal() + np.cumsum(0.6 * rng.normal(size=steps))
    z = walk + 1.3 * rng.normal(size=steps)
    k = np.arange(1, steps + 1)
    shared = np.minimum(k[:, None], k[None])

    def dense(log_noise: np.ndarray) -> np.ndarray:
        q, r = np.exp(log_noise)
        C = 1.0 + q * shared + r * np.eye(steps)
        _, log_det = np.linalg.slogdet(2 * np.pi * C)
        return 0.5 * (log_det + z @ np.linalg.solve(C, z)) / steps

    def loss(noise: Noise) -> Array:
        observations = Obs(jnp.array(z)[:, None], jnp.ones((steps, 1), bool))
        params = FilterParams(noise, FROM_ZERO)
        return negative_log_likelihood(kf(WALK), params, jnp.zeros(steps), observations)

    tight = {"xatol": 1e-9, "fatol": 1e-15, "maxiter": 2000}
    known = scipy.optimize.minimize(dense, np.zeros(2), method="Nelder-Mead", options=tight)
    found = fit_lbfgs(loss, Noise(jnp.array(1.0), jnp.array(1.0)))
    np.testing.assert_allclose(found.history[0], dense(np.zeros(2)), rtol=1e-12)
    np.testing.assert_allclose(found.loss, known.fun, rtol=1e-9)
    np.testing.assert_allclose(found.params, np.exp(known.x), rtol=1e-3)
