"""Iterated filters: the Kalman filter where linear, the posterior's mode where not."""

from collections.abc import Callable
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from scipy.optimize import least_squares

from jaxnav.compiling import compiled
from jaxnav.estimation.banks.mixture import BankParams, mmae
from jaxnav.estimation.filters.iterated import (
    iterated_ckf,
    iterated_ekf,
    modified_iterated_ckf,
)
from jaxnav.estimation.filters.kalman import ekf
from jaxnav.estimation.filters.line_search import Search
from jaxnav.estimation.filters.sigma_point import ckf
from jaxnav.estimation.run import run
from jaxnav.estimation.types import (
    Filter,
    FilterParams,
    Flag,
    Gaussian,
    Info,
    Model,
    NonAdditive,
    Obs,
)
from jaxnav.numerics.lie import so3_exp, so3_log
from tests.oracles import rotations
from tests.oracles.kalman import Linear, kalman, kalman_step

MAKERS: dict[str, Callable[..., Filter]] = {
    "ekf": iterated_ekf,
    "ckf": iterated_ckf,
    "modified": modified_iterated_ckf,
}
each_maker = pytest.mark.parametrize("name", MAKERS)
FINE = 1e-4
"""Spread at which points are differences: of second order in it, so 1e-8 of the curvature."""


def still(observe: Callable[[Array], Array], noise: np.ndarray, **slots: Any) -> Model:
    """A state that stays, seen by a function; the parameter is a factor on the noise."""
    return Model(
        transition=lambda p, x, u: x,
        process_noise=lambda p, x, u: jnp.zeros((x.shape[0],) * 2, x.dtype),
        observe=lambda p, x, u: observe(x),
        observation_noise=lambda p, x, u: p * jnp.asarray(noise, p.dtype),
        **slots,
    )


def search(count: int, **entries: Any) -> Search:
    """A search for every member of a batch, as leaves."""
    leaves = (jnp.asarray(leaf, float) for leaf in Search(**entries))
    return Search(*(jnp.broadcast_to(leaf, (count,)) for leaf in leaves))


def batch(prior: Gaussian, noise: Any = 1.0, **entries: Any) -> FilterParams:
    """Parameters for a batch of priors."""
    count = prior.cov.shape[0]
    factor = jnp.broadcast_to(jnp.asarray(noise, float), (count,))
    return FilterParams(factor, prior, own=search(count, **entries))


@cache
def program(filter: Filter) -> Callable[[FilterParams, Obs], tuple[Gaussian, Info]]:
    def one(params: FilterParams, obs: Obs) -> tuple[Gaussian, Info]:
        state, info = filter.update(params, filter.init(params), jnp.zeros(()), obs)
        return filter.estimate(state), info

    return compiled(jax.vmap(one))


def updated(filter: Filter, params: FilterParams, obs: Obs) -> tuple[Gaussian, Info]:
    """Update a batch of priors, each with one observation."""
    return program(filter)(params, obs)


def whole(z: Any) -> Obs:
    """Observations that all arrived."""
    z = jnp.asarray(z, float)
    return Obs(z, jnp.ones(z.shape, bool))


def apart(tree: Any) -> list[Any]:
    """The members of a batch, for NumPy."""
    tree = jax.tree.map(np.asarray, tree)
    count = jax.tree.leaves(tree)[0].shape[0]
    return [jax.tree.map(lambda leaf, i=i: leaf[i], tree) for i in range(count)]


# Linear models

STEPS, SPREADS = 4, (1.0, 0.3, 0.01)
VALID = np.array([[True, True], [True, False], [False, False], [True, True]])


def linear_model() -> tuple[Linear, np.ndarray, Model]:
    """Three states and two channels with correlated noise."""
    rng = np.random.default_rng(1)
    Phi = np.eye(3) + 0.2 * rng.normal(size=(STEPS, 3, 3))
    H, R = np.array([[1.0, 0.0, 0.5], [0.0, 2.0, -0.3]]), np.array([[0.5, 0.1], [0.1, 0.8]])
    P0 = np.array([[1.0, 0.2, 0.0], [0.2, 2.0, 0.0], [0.0, 0.0, 0.5]])
    Q = np.tile(0.1 * np.eye(3), (STEPS, 1, 1))
    model = Model(
        transition=lambda p, x, u: u @ x,
        process_noise=lambda p, x, u: jnp.diag(jnp.full(3, 0.1, x.dtype)),
        observe=lambda p, x, u: jnp.asarray(H, x.dtype) @ x,
        observation_noise=lambda p, x, u: jnp.asarray(R, x.dtype),
    )
    by_hand = Linear(Phi, Q, H, R, np.array([0.5, -0.5, 0.1]), P0)
    return by_hand, rng.normal(size=(STEPS, 2)), model


def run_linear(filter: Filter, dtype: Any) -> tuple[Gaussian, Info]:
    """Run the linear model with three spreads; lost channels hold what must not be used."""
    by_hand, z, _ = linear_model()
    prior = Gaussian(jnp.asarray(by_hand.x0, dtype), jnp.asarray(by_hand.P0, dtype))
    obs = Obs(jnp.asarray(np.where(VALID, z, np.nan), dtype), jnp.asarray(VALID))
    inputs = jnp.asarray(by_hand.Phi, dtype)
    rules = jax.tree.map(
        lambda leaf: leaf.astype(dtype), search(len(SPREADS), spread=np.array(SPREADS))
    )

    def one(rule: Search) -> tuple[Gaussian, Info]:
        return run(filter, FilterParams((), prior, own=rule), inputs, obs).record

    return jax.vmap(one)(rules)


@pytest.mark.parametrize("iterations", [1, 2, 5])
def test_linear_models_give_the_kalman_filter(iterations: int) -> None:
    """Whatever the iterations and the spread; differences over 0.01 lose two digits.

    Two of them without a search, which would hide a second step that is wrong.
    """
    by_hand, z, model = linear_model()
    expected = kalman(by_hand, z, VALID)
    trials = 0 if iterations == 2 else 6
    for name, make in MAKERS.items():
        found, info = run_linear(make(model, iterations=iterations, trials=trials), float)
        for i in range(len(SPREADS)):
            np.testing.assert_allclose(found.mean[i], expected.mean, rtol=1e-11, err_msg=name)
            np.testing.assert_allclose(found.cov[i], expected.cov, rtol=1e-11, atol=1e-13)
            np.testing.assert_allclose(
                info.log_likelihood[i], expected.log_likelihood, rtol=1e-11, atol=1e-15
            )


@each_maker
def test_float32_stays_float32(name: str) -> None:
    """Differences over a hundredth of the prior lose two of seven digits."""
    by_hand, z, model = linear_model()
    expected = kalman(by_hand, z, VALID)
    found, info = run_linear(MAKERS[name](model, iterations=2), jnp.float32)
    for leaf in jax.tree.leaves((found, info)):
        assert leaf.dtype in (jnp.float32, jnp.int32, jnp.bool_)
    for i, bound in enumerate((1e-5, 1e-5, 1e-4)):
        np.testing.assert_allclose(found.mean[i], expected.mean, rtol=0, atol=bound)
        np.testing.assert_allclose(found.cov[i], expected.cov, rtol=0, atol=bound)


SCALAR = still(lambda x: x, np.eye(1))
P, R, NU = np.array([1.0, 4.0, 0.25]), np.array([1.0, 0.5, 2.0]), np.array([1.0, -2.0, 3.0])
SCALARS = batch(Gaussian(jnp.full((3, 1), 0.7), jnp.array(P)[:, None, None]), R)
SEEN = whole(0.7 + NU[:, None])


def test_prior_is_held_fixed() -> None:
    """Twenty iterations are one update: precision 1/P + 1/R, not 1/P + 20/R."""
    for make in MAKERS.values():
        found, _ = updated(make(SCALAR, iterations=20, trials=0), SCALARS, SEEN)
        np.testing.assert_allclose(found.cov[:, 0, 0], 1 / (1 / P + 1 / R), rtol=1e-13)
        np.testing.assert_allclose(found.mean[:, 0], 0.7 + NU * P / (P + R), rtol=1e-13)


def test_the_printed_iteration_diverges() -> None:
    """Eq. (13) in the scalar linear case, with the sign of X_j - X- as printed.

    With y = x - x- and K = P / (P + R) it reads y' = 2 y + K (nu + y), whose fixed point
    -K nu / (1 + K) has the wrong sign and is left by the factor 2 + K in every iteration. In the
    augmented form the noise need not cancel from what is printed: it is held to grow, no more.
    """
    K, counts = P / (P + R), (1, 4, 8)
    for name in ("ckf", "modified"):
        ends = []
        for iterations in counts:
            filter = MAKERS[name](SCALAR, iterations=iterations, printed=True)
            ends.append(np.asarray(updated(filter, SCALARS, SEEN)[0].mean[:, 0]) - 0.7)
        np.testing.assert_allclose(ends[0], K * NU, rtol=1e-12)
        assert np.all(np.abs(ends[2]) > 2**4 * np.abs(ends[1]))
        assert np.all(np.abs(ends[1]) > 2**3 * np.abs(ends[0]))
        if name == "ckf":
            for j, end in zip(counts, ends, strict=True):
                grown = K * NU * ((2 + K) ** j - 1) / (1 + K)
                np.testing.assert_allclose(end, grown, rtol=1e-12)


# Nonlinear models

ANCHORS = np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 4.0]])
STATION = np.array([2.0, -1.5])
SPREAD_NOISE = np.array(
    [[0.02, 0.01, 0, 0], [0.01, 0.03, 0, 0], [0, 0, 0.02, 0.002], [0, 0, 0.002, 0.01]]
)


def seen_from_anchors(x: Array) -> Array:
    """Ranges to three anchors close by, and a bearing whose cut lies among the states."""
    away = x - jnp.asarray(STATION)
    ranges = jnp.sqrt(jnp.sum((x[None] - jnp.asarray(ANCHORS)) ** 2, axis=1))
    return jnp.concatenate([ranges, jnp.arctan2(-away[0], -away[1])[None]])


def seen_by_numpy(x: np.ndarray) -> np.ndarray:
    """Half a turn less, where no cut is near."""
    away = x - STATION
    return np.append(np.linalg.norm(x - ANCHORS, axis=1), np.arctan2(away[0], away[1]))


def wrapped(z: Array, z_pred: Array) -> Array:
    """The residual, that of the bearing within half a turn."""
    misfit = z - z_pred
    turns = 2 * jnp.pi * jnp.round(misfit / (2 * jnp.pi))
    return jnp.where(jnp.arange(misfit.shape[0]) == 3, misfit - turns, misfit)


RANGING = still(seen_from_anchors, SPREAD_NOISE, residual=wrapped)
SHORT = {name: make(RANGING, iterations=3) for name, make in MAKERS.items()}
LONG = {name: make(RANGING, iterations=60) for name, make in MAKERS.items()}
FREE = iterated_ckf(RANGING, iterations=60, trials=0)
COUNT = 24


def cases() -> tuple[Gaussian, Obs]:
    """Priors near the anchors, observations some deviations off, the bearing by whole turns.

    Each has one mode: SciPy finds the same from six starts.
    """
    rng = np.random.default_rng(5)
    mean = 1.5 + rng.normal(size=(COUNT, 2))
    root = 0.7 * rng.normal(size=(COUNT, 2, 2))
    cov = root @ root.transpose(0, 2, 1) + 0.2 * np.eye(2)
    truth = mean + 0.6 * rng.normal(size=(COUNT, 2))
    z = np.array([seen_by_numpy(x) for x in truth]) + 0.1 * rng.normal(size=(COUNT, 4))
    z[:, 3] += 3 * np.pi
    valid = np.ones((COUNT, 4), bool)
    valid[::3, 1] = False
    valid[1::3, 3] = False
    z = np.where(valid, z, np.nan)
    return Gaussian(jnp.array(mean), jnp.array(cov)), Obs(jnp.array(z), jnp.array(valid))


def residuals(prior: Gaussian, obs: Obs) -> Callable[[np.ndarray], np.ndarray]:
    """Return the whitened residuals whose squares sum to the posterior functional."""
    kept = np.asarray(obs.valid)
    inner = np.linalg.inv(np.linalg.cholesky(prior.cov))
    outer = np.linalg.inv(np.linalg.cholesky(SPREAD_NOISE[np.ix_(kept, kept)]))
    z = np.asarray(obs.z) - np.array([0, 0, 0, 3 * np.pi])

    def of(x: np.ndarray) -> np.ndarray:
        return np.concatenate([inner @ (x - prior.mean), outer @ (z - seen_by_numpy(x))[kept]])

    return of


def mode(residual: Callable[[np.ndarray], np.ndarray], start: np.ndarray) -> np.ndarray:
    """Return the least squares that SciPy finds by a trust region and differences."""
    return least_squares(residual, start, xtol=1e-15, ftol=1e-15, gtol=1e-14, jac="3-point").x


def test_strongly_nonlinear_ones_find_the_mode() -> None:
    """Sixty iterations: Gauss-Newton converges linearly where residuals are large."""
    prior, obs = cases()
    expected = np.array(
        [mode(residuals(p, o), p.mean) for p, o in zip(apart(prior), apart(obs), strict=True)]
    )
    for name, filter in LONG.items():
        found, info = updated(filter, batch(prior, spread=FINE), obs)
        np.testing.assert_allclose(found.mean, expected, rtol=0, atol=1e-7, err_msg=name)
        assert np.all(np.asarray(info.flags) == 0)
    # it takes iterating: the update of the ekf is far from the mode
    once, _ = updated(ekf(RANGING), batch(prior), obs)
    assert np.median(np.abs(once.mean - expected).max(axis=1)) > 0.05


def test_the_fixed_point_tends_to_the_mode_with_the_spread_squared() -> None:
    """With the full spread it is that of the statistical linearisation, a tenth of a metre off."""
    prior, obs = cases()

    def found(spread: float) -> np.ndarray:
        return np.asarray(updated(FREE, batch(prior, spread=spread, step=0.5), obs)[0].mean)

    exact = found(FINE)
    far, near, nearer = (np.abs(found(s) - exact).max(axis=1) for s in (1.0, 0.02, 0.01))
    assert far.min() > 0.003
    assert np.median(far) > 0.1
    np.testing.assert_allclose(near / nearer, 4, rtol=0.02)


def textbook(
    h: Callable[[np.ndarray], np.ndarray],
    prior: tuple[np.ndarray, np.ndarray],
    z: np.ndarray,
    noise: np.ndarray | float,
    iterations: int,
    rule: Search,
) -> Gaussian:
    """Iterate Eqs. (12)-(28), put right, on a state that may hold the noise, without a search.

    ``X' = X + a ((x - X) + K (z - Z + H (X - x)))`` with ``H = Pxz' inv(P)`` from points about X.
    """
    x, P = prior
    n, X = len(x), x
    K, Pzz = np.zeros(()), np.zeros(())
    offsets = rule.spread * np.sqrt(n) * np.linalg.cholesky(P).T
    for _ in range(iterations):
        seen = np.array([h(X + sign * o) for sign in (1, -1) for o in offsets])
        Z = seen.mean(axis=0)
        # over the covariance of the points, not that of the prior, where these differ
        Pxz = np.concatenate([offsets, -offsets]).T @ seen / (2 * n * rule.spread**2)
        H = Pxz.T @ np.linalg.inv(P)
        even = 0.5 * (seen[:n] + seen[n:]) - Z
        Pzz = H @ P @ H.T + even.T @ even / n + noise
        K = Pxz @ np.linalg.inv(Pzz)
        X = X + rule.step * ((x - X) + K @ (z - Z + H @ (X - x)))
    return Gaussian(X, jnp.array(P - K @ Pzz @ K.T))


def test_iterations_are_those_of_the_textbook_loop() -> None:
    """In state space, with inverses: mean and covariance, channels lost, for any spread."""
    prior, obs = cases()
    spread, step = np.linspace(0.1, 1.0, COUNT), np.linspace(1.0, 0.3, COUNT)
    filter = iterated_ckf(RANGING, iterations=4, trials=0)
    params = batch(prior, spread=jnp.array(spread), step=jnp.array(step))
    found, info = updated(filter, params, obs)
    np.testing.assert_array_equal(info.iterations, 4)
    for i, (p, o) in enumerate(zip(apart(prior), apart(obs), strict=True)):
        kept = o.valid
        z = (o.z - np.array([0, 0, 0, 3 * np.pi]))[kept]
        expected = textbook(
            lambda x, kept=kept: seen_by_numpy(x)[kept],
            p,
            z,
            SPREAD_NOISE[np.ix_(kept, kept)],
            4,
            Search(spread[i], step[i]),
        )
        np.testing.assert_allclose(found.mean[i], expected.mean, rtol=0, atol=1e-10)
        np.testing.assert_allclose(found.cov[i], expected.cov, rtol=0, atol=1e-11)


def test_one_full_step_is_the_cubature_filter() -> None:
    """And the limit of no spread that of the extended one."""
    prior, obs = cases()
    one = iterated_ckf(RANGING, iterations=1, trials=0)
    for plain, spread, bound in ((ckf(RANGING), 1.0, 1e-11), (ekf(RANGING), FINE, 1e-5)):
        ours, info = updated(one, batch(prior, spread=spread), obs)
        theirs, told = updated(plain, batch(prior)._replace(own=()), obs)
        np.testing.assert_allclose(ours.mean, theirs.mean, rtol=0, atol=bound)
        np.testing.assert_allclose(ours.cov, theirs.cov, rtol=0, atol=bound)
        np.testing.assert_allclose(info.log_likelihood, told.log_likelihood, rtol=100 * bound)
        np.testing.assert_allclose(info.innovation_cov, told.innovation_cov, rtol=100 * bound)
        np.testing.assert_array_equal(info.flags, told.flags)


# An attitude


STARS = np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]])
ATTITUDE = Model(
    transition=lambda p, C, u: C,
    process_noise=lambda p, C, u: jnp.zeros((3, 3)),
    observe=lambda p, C, u: (jnp.asarray(STARS) @ C.T).reshape(-1),
    observation_noise=lambda p, C, u: p * jnp.full(6, 0.04),
    retract=lambda C, phi: so3_exp(phi) @ C,
    local=lambda C, D: so3_log(D @ C.T),
)


def attitudes() -> tuple[Gaussian, Obs]:
    """Priors that are off by a radian, and two noisy star vectors."""
    rng = np.random.default_rng(6)
    C = np.array([rotations.exp(phi) for phi in rng.normal(size=(4, 3))])
    cov = np.tile(np.diag([0.8, 0.5, 0.3]), (4, 1, 1)) + 0.1
    turned = [
        rotations.exp(phi) @ c for phi, c in zip(0.8 * rng.normal(size=(4, 3)), C, strict=True)
    ]
    z = np.array([(STARS @ c.T).ravel() for c in turned]) + 0.2 * rng.normal(size=(4, 6))
    return Gaussian(jnp.array(C), jnp.array(cov)), whole(z)


def test_on_a_manifold() -> None:
    """One full step is the ckf; many find the mode over rotation vectors at the prior."""
    prior, obs = attitudes()
    ours, _ = updated(iterated_ckf(ATTITUDE, iterations=1, trials=0), batch(prior), obs)
    theirs, _ = updated(ckf(ATTITUDE), batch(prior)._replace(own=()), obs)
    np.testing.assert_allclose(ours.mean, theirs.mean, rtol=0, atol=1e-12)
    np.testing.assert_allclose(ours.cov, theirs.cov, rtol=0, atol=1e-12)
    L = np.linalg.cholesky(prior.cov[0])

    def turned(xi: np.ndarray, C: np.ndarray) -> np.ndarray:
        return rotations.exp(L @ xi) @ C

    def found_by_scipy(C: np.ndarray, z: np.ndarray) -> np.ndarray:
        def residual(xi: np.ndarray) -> np.ndarray:
            return np.concatenate([xi, (z - (STARS @ turned(xi, C).T).ravel()) / 0.2])

        return turned(mode(residual, np.zeros(3)), C)

    pairs = zip(np.asarray(prior.mean), np.asarray(obs.z), strict=True)
    expected = np.array([found_by_scipy(C, z) for C, z in pairs])
    assert np.abs(expected - prior.mean).max(axis=(1, 2)).min() > 0.2
    for make in (iterated_ekf, iterated_ckf):
        found, _ = updated(make(ATTITUDE, iterations=40), batch(prior, spread=FINE), obs)
        np.testing.assert_allclose(found.mean, expected, rtol=0, atol=1e-7)


# Noise that does not add


SOURCES = np.array([0.3, 0.15, 0.1, 0.2])


def distorted(x: Array, v: Array) -> Array:
    """Four sources of noise in three channels: in a logarithm, a product and an exponential.

    The first is the implicit form ``0 = g(m - v) - x0^2 / 2`` of a logarithm that is measured.
    """
    return jnp.stack(
        [
            jnp.log(3.0 + v[0]) - 0.5 * x[0] ** 2,
            (1 + v[1]) * x[1] + v[2],
            jnp.exp(0.5 * x[0] * x[1] + v[3]),
        ]
    )


def distorted_by_numpy(y: np.ndarray) -> np.ndarray:
    a, b, *v = y
    return np.array(
        [np.log(3 + v[0]) - a * a / 2, (1 + v[1]) * b + v[2], np.exp(0.5 * a * b + v[3])]
    )


def distorted_model() -> Model:
    def noise(p: Array, x: Array, u: Array) -> Array:
        G = jax.jacfwd(lambda v: distorted(x, v))(jnp.zeros(4))
        return (G * jnp.asarray(SOURCES)[None] ** 2) @ G.T

    model = still(lambda x: distorted(x, jnp.zeros(4)), np.eye(3))
    sources = NonAdditive(lambda p, x, v, u: distorted(x, v), lambda p, x, u: jnp.array(SOURCES**2))
    return model._replace(observation_noise=noise, noisy=sources)


def distorted_cases() -> tuple[Gaussian, Obs]:
    rng = np.random.default_rng(7)
    mean = np.array([1.2, 0.8]) + 0.3 * rng.normal(size=(12, 2))
    cov = np.tile([[0.2, 0.05], [0.05, 0.3]], (12, 1, 1))
    state = mean + 0.4 * rng.normal(size=(12, 2))
    z = np.array(
        [
            distorted_by_numpy(np.append(x, v))
            for x, v in zip(state, SOURCES * rng.normal(size=(12, 4)), strict=True)
        ]
    )
    valid = np.ones((12, 3), bool)
    valid[::3, 2] = False
    valid[1::3, 0] = False
    prior = Gaussian(jnp.array(mean), jnp.array(cov))
    return prior, Obs(jnp.array(np.where(valid, z, np.nan)), jnp.array(valid))


def test_noise_that_does_not_add_is_estimated_with_the_state() -> None:
    """The least |xi|^2 + |v|^2 / s^2 under h(x, v) = z, the noise taken out by hand.

    Of the product, ``s1^2 x1^2 + s2^2`` is the variance of the least noise that gives a misfit. A
    channel that was lost asks for no noise.
    """
    prior, obs = distorted_cases()
    filter = modified_iterated_ckf(distorted_model(), iterations=60)
    found, _ = updated(filter, batch(prior, spread=FINE), obs)
    moved = []
    for i, (p, o) in enumerate(zip(apart(prior), apart(obs), strict=True)):
        inner = np.linalg.inv(np.linalg.cholesky(p.cov))

        def residual(x: np.ndarray, p=p, o=o, inner=inner) -> np.ndarray:
            noise = np.array(
                [
                    (np.exp(o.z[0] + x[0] ** 2 / 2) - 3) / SOURCES[0],
                    (o.z[1] - x[1]) / np.sqrt((SOURCES[1] * x[1]) ** 2 + SOURCES[2] ** 2),
                    (np.log(o.z[2]) - 0.5 * x[0] * x[1]) / SOURCES[3],
                ]
            )
            return np.concatenate([inner @ (x - p.mean), noise[o.valid]])

        expected = mode(residual, p.mean)
        np.testing.assert_allclose(found.mean[i], expected, rtol=0, atol=1e-6)
        moved.append(np.abs(expected - p.mean).max())
    assert np.median(moved) > 0.2


def test_augmented_iterations_are_those_of_the_textbook_loop() -> None:
    """With the full spread and the state and noise as one state, where R enters nowhere else."""
    prior, obs = distorted_cases()
    filter = modified_iterated_ckf(distorted_model(), iterations=3, trials=0)
    found, _ = updated(filter, batch(prior, step=0.8), obs)
    for i, (p, o) in enumerate(zip(apart(prior), apart(obs), strict=True)):
        P = np.diag(np.append(np.zeros(2), SOURCES**2))
        P[:2, :2] = p.cov
        expected = textbook(
            lambda y, kept=o.valid: distorted_by_numpy(y)[kept],
            (np.append(p.mean, np.zeros(4)), P),
            o.z[o.valid],
            0.0,
            3,
            Search(1.0, 0.8),
        )
        np.testing.assert_allclose(found.mean[i], expected.mean[:2], rtol=0, atol=1e-10)
        np.testing.assert_allclose(found.cov[i], expected.cov[:2, :2], rtol=0, atol=1e-11)


def test_noise_that_adds_cancels_from_the_augmented_step() -> None:
    """From every iterate, not only where it converges; given as h + v or not given."""
    prior, obs = cases()
    given = RANGING._replace(
        noisy=NonAdditive(
            lambda p, x, v, u: seen_from_anchors(x) + v,
            lambda p, x, u: p * jnp.asarray(SPREAD_NOISE),
        )
    )
    params = batch(prior, spread=FINE)
    expected, told = updated(SHORT["ckf"], params, obs)
    for filter in (SHORT["modified"], modified_iterated_ckf(given, iterations=3)):
        found, info = updated(filter, params, obs)
        np.testing.assert_allclose(found.mean, expected.mean, rtol=0, atol=1e-6)
        np.testing.assert_allclose(found.cov, expected.cov, rtol=0, atol=1e-6)
        np.testing.assert_allclose(info.log_likelihood, told.log_likelihood, rtol=1e-6)


@pytest.mark.parametrize("sources", [1, 3])
def test_any_number_of_noises(sources: int) -> None:
    """A linear model with noise ``G v``, which one source makes singular, is the Kalman filter."""
    rng = np.random.default_rng(sources)
    H, G, N = rng.normal(size=(2, 2)), rng.normal(size=(2, sources)), 0.3 * np.eye(sources) + 0.1
    P = np.array([[1.0, 0.3], [0.3, 0.5]])
    noisy = NonAdditive(
        lambda p, x, v, u: jnp.array(H) @ x + jnp.array(G) @ v, lambda p, x, u: jnp.array(N)
    )
    model = still(lambda x: jnp.array(H) @ x, G @ N @ G.T, noisy=noisy)
    z = rng.normal(size=(3, 2))
    prior = Gaussian(jnp.zeros((3, 2)), jnp.array(np.tile(P, (3, 1, 1))))
    valid = np.array([[True, True], [False, True], [True, False]])
    found, _ = updated(
        modified_iterated_ckf(model, iterations=4),
        batch(prior),
        Obs(jnp.array(z), jnp.array(valid)),
    )
    linear = Linear(np.eye(2)[None], np.zeros((1, 2, 2)), H, G @ N @ G.T, np.zeros(2), P)
    for i in range(3):
        mean, cov, _ = kalman_step(linear, 0, np.zeros(2), P, z[i], valid[i])
        np.testing.assert_allclose(found.mean[i], mean, rtol=0, atol=1e-12)
        np.testing.assert_allclose(found.cov[i], cov, rtol=0, atol=1e-12)


@each_maker
def test_noise_is_in_the_units_of_the_residual(name: str) -> None:
    """Values in degrees with a residual in metres: the Kalman filter of the metres."""
    rng = np.random.default_rng(5)
    H, R, P = rng.normal(size=(2, 2)), np.diag([4.0, 9.0]), np.array([[30.0, 8.0], [8.0, 20.0]])
    to_metres = 111e3
    model = still(
        lambda x: jnp.array(H) @ x / to_metres,
        R,
        residual=lambda z, predicted: to_metres * (z - predicted),
    )
    z = rng.normal(size=(3, 2)) * 5
    prior = Gaussian(jnp.zeros((3, 2)), jnp.array(np.tile(P, (3, 1, 1))))
    valid = np.array([[True, True], [False, True], [True, False]])
    obs = Obs(jnp.array(z / to_metres), jnp.array(valid))
    found, info = updated(MAKERS[name](model, iterations=4), batch(prior), obs)
    linear = Linear(np.eye(2)[None], np.zeros((1, 2, 2)), H, R, np.zeros(2), P)
    for i in range(3):
        mean, cov, _ = kalman_step(linear, 0, np.zeros(2), P, z[i], valid[i])
        np.testing.assert_allclose(found.mean[i], mean, rtol=0, atol=1e-8)
        np.testing.assert_allclose(found.cov[i], cov, rtol=0, atol=1e-8)
    assert np.all(np.asarray(info.flags) == 0)


# The search


BENT = still(jnp.arctan, np.eye(1))


def bent_cases() -> tuple[Gaussian, np.ndarray, np.ndarray]:
    """Fine observations of arctan(x) far from the prior: a full step overshoots, ever further."""
    x, z = (grid.ravel() for grid in np.meshgrid([-6.0, -3.0, 2.0, 5.0], [-0.8, 0.0, 1.0]))
    R = 10.0 ** np.linspace(-4, -2, len(x))
    P = np.linspace(4.0, 30.0, len(x))
    return Gaussian(jnp.array(x)[:, None], jnp.array(P)[:, None, None]), z, R


def test_the_search_never_climbs_and_saves_what_full_steps_lose() -> None:
    prior, z, R = bent_cases()
    x0, P = np.asarray(prior.mean[:, 0]), np.asarray(prior.cov[:, 0, 0])

    def functional(x: np.ndarray) -> np.ndarray:
        return (x - x0) ** 2 / P + (np.arctan(x) - z) ** 2 / R

    grid = np.linspace(-12, 12, 200_001)
    values = (grid[:, None] - x0) ** 2 / P + (np.arctan(grid)[:, None] - z) ** 2 / R
    least = values.min(axis=0)

    def ends(make: Callable[..., Filter], iterations: int, trials: int) -> np.ndarray:
        filter = make(BENT, iterations=iterations, trials=trials)
        found, _ = updated(filter, batch(prior, R, spread=FINE), whole(z[:, None]))
        return functional(np.asarray(found.mean[:, 0]))

    for make, counts in ((iterated_ekf, (1, 2, 3, 4, 20)), (modified_iterated_ckf, (1, 2, 20))):
        falling = np.array([functional(x0), *(ends(make, count, 6) for count in counts)])
        assert np.all(np.diff(falling, axis=0) <= 1e-9 * falling[:-1])
        np.testing.assert_allclose(falling[-1], least, rtol=1e-4)
        lost = ends(make, 20, 0) > 10 * least
        assert lost.sum() >= len(z) // 2


def test_the_first_step_that_falls_enough_is_taken() -> None:
    """Armijo's rule by hand: with D the Gauss-Newton step, T' = -2 |D|^2 (1 + A^2 / R)."""
    prior, z, R = bent_cases()
    x0, P = np.asarray(prior.mean[:, 0]), np.asarray(prior.cov[:, 0, 0])
    nu, A = z - np.arctan(x0), np.sqrt(P) / (1 + x0**2)
    D = A * nu / (A**2 + R)
    slope = -2 * A * nu / R * D
    filter = iterated_ekf(BENT, iterations=1, trials=9)
    taken = []
    for sufficient, longest in ((1e-4, 1.0), (0.6, 1.0), (0.6, 0.7)):
        params = batch(prior, R, step=longest, sufficient=sufficient)
        found, info = updated(filter, params, whole(z[:, None]))
        length = np.zeros(len(z))
        for trial in longest * 0.5 ** np.arange(9)[::-1]:
            fallen = (trial * D) ** 2 + (np.arctan(x0 + np.sqrt(P) * trial * D) - z) ** 2 / R
            length[fallen <= nu**2 / R + sufficient * trial * slope] = trial
        expected = x0 + np.sqrt(P) * length * D
        np.testing.assert_allclose(found.mean[:, 0], expected, rtol=1e-12)
        np.testing.assert_array_equal(info.iterations, length > 0)
        taken.append(length)
    assert len(np.unique(taken)) > 6


def test_the_smooth_step_is_a_mean_of_trials() -> None:
    """Each weighs the chance that it is accepted and none before it was."""
    prior, z, R = bent_cases()
    x0, P = np.asarray(prior.mean[:, 0]), np.asarray(prior.cov[:, 0, 0])
    nu, A = z - np.arctan(x0), np.sqrt(P) / (1 + x0**2)
    D = A * nu / (A**2 + R)
    temperature, left, length = nu**2 / R / 3, np.ones(len(z)), np.zeros(len(z))
    for trial in 0.5 ** np.arange(4):
        after = (trial * D) ** 2 + (np.arctan(x0 + np.sqrt(P) * trial * D) - z) ** 2 / R
        margin = nu**2 / R - 0.3 * trial * 2 * A * nu / R * D - after
        chance = 1 / (1 + np.exp(-margin / temperature))
        length, left = length + left * chance * trial, left * (1 - chance)
    params = batch(prior, R, sufficient=0.3, temperature=jnp.array(temperature))
    filter = iterated_ekf(BENT, iterations=1, trials=4)
    found, _ = updated(filter, params, whole(z[:, None]))
    np.testing.assert_allclose(found.mean[:, 0], x0 + np.sqrt(P) * length * D, rtol=1e-12)
    assert np.ptp(length) > 0.3


def test_the_smooth_search_tends_to_the_hard_one() -> None:
    """Except where a trial falls by next to nothing, a decision that no temperature makes."""
    prior, z, R = bent_cases()
    filter = iterated_ekf(BENT, iterations=3)

    def found(temperature: float) -> np.ndarray:
        params = batch(prior, R, temperature=temperature)
        return np.asarray(updated(filter, params, whole(z[:, None]))[0].mean)

    hard = found(0.0)
    gaps = [np.abs(found(t) - hard).max() for t in (10.0, 0.1, 1e-9)]
    assert gaps[0] > gaps[1] > gaps[2]
    assert gaps[0] > 0.01
    assert gaps[2] < 1e-8


# Gradients, banks, flags


def seen_in_two_channels(x: Array) -> Array:
    return jnp.stack([jnp.sqrt(jnp.sum(x * x)), jnp.exp(0.5 * x[0]) * x[1]])


GRADED = still(seen_in_two_channels, np.array([[0.05, 0.01], [0.01, 0.08]]))


@each_maker
def test_gradients_are_exact_and_finite(name: str) -> None:
    """Of the mean and the likelihood by prior mean, noise, spread, step length, temperature.

    Against differences of fourth order: with a smooth and a hard search, a channel and all lost,
    and a prior that knows one state.
    """
    filter = MAKERS[name](GRADED, iterations=2, trials=2)
    smooth = [1.0, 1.4, 1.2, 0.3, 0.9, 0.5]
    at = jnp.array([smooth, [*smooth[:5], 0.0], smooth, smooth, smooth])
    valid = np.array([[True] * 2] * 2 + [[True, False], [False] * 2, [True] * 2])
    obs = Obs(jnp.array(np.where(valid, [2.9, 3.2], np.nan)), jnp.array(valid))
    cov = np.tile([[1.0, 0.2], [0.2, 0.7]], (5, 1, 1))
    cov[4] = np.diag([1.0, 0.0])

    def outcome(a: Array, obs: Obs, cov: Array) -> Array:
        rule = Search(spread=a[3], step=a[4], temperature=a[5])
        params = FilterParams(a[2], Gaussian(a[:2], cov), own=rule)
        state, info = filter.update(params, filter.init(params), jnp.zeros(()), obs)
        return jnp.append(filter.estimate(state).mean, info.log_likelihood)

    value, backward = (compiled(jax.vmap(f)) for f in (outcome, jax.jacrev(outcome)))
    exact = np.asarray(backward(at, obs, jnp.array(cov)))
    if name == "ckf":
        forward = compiled(jax.vmap(jax.jacfwd(outcome)))(at, obs, jnp.array(cov))
        np.testing.assert_allclose(forward, exact, rtol=1e-10, atol=1e-12)
    h, columns = 2e-4, []
    for i in range(6):
        ends = [
            value(at + k * h * jnp.eye(6)[i][None], obs, jnp.array(cov)) for k in (-2, -1, 1, 2)
        ]
        columns.append((ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * h))
    numeric = np.stack(columns, axis=-1)
    # a temperature of zero is the end of its range
    np.testing.assert_array_equal(exact[1, :, 5], 0)
    numeric[1, :, 5] = 0
    np.testing.assert_allclose(exact, numeric, rtol=1e-6, atol=1e-8)
    moved_by_search = np.abs(exact[0, :2, 4:])
    assert moved_by_search.min() > 1e-4
    np.testing.assert_allclose(exact[3, :2, :2], np.eye(2), atol=1e-14)


def test_search_of_the_parameters_equals_the_keyword() -> None:
    prior, obs = cases()
    rule = Search(spread=0.4, step=0.7, sufficient=0.3, temperature=0.2)
    params = batch(prior)._replace(own=())
    expected, told = updated(iterated_ckf(RANGING, search=rule), params, obs)
    found, info = updated(SHORT["ckf"], batch(prior, **rule._asdict()), obs)
    np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-12)
    np.testing.assert_allclose(info.log_likelihood, told.log_likelihood, rtol=1e-12)
    plain, _ = updated(SHORT["ckf"], batch(prior), obs)
    assert np.abs(plain.mean - expected.mean).max() > 0.01


def test_members_of_a_bank_may_differ_in_their_search() -> None:
    """Each is the filter of its own search, and the likelihood of the prediction weighs them."""
    prior, obs = cases()
    entries = {"spread": jnp.array([1.0, 0.5, FINE]), "step": jnp.array([0.25, 1.0, 1.0])}
    same = Gaussian(*(jnp.stack([leaf[1]] * 3) for leaf in prior))
    params = batch(same, **entries)
    one = jax.tree.map(lambda leaf: leaf[1], obs)
    bank = mmae(SHORT["ckf"])

    @compiled
    def update(params: FilterParams) -> tuple[Array, Gaussian]:
        given = BankParams(params, ())
        state, _ = bank.update(given, bank.init(given), jnp.zeros(()), one)
        return state.members.x, bank.estimate(state)

    means, mixed = update(params)
    expected, info = updated(
        SHORT["ckf"], params, jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), one)
    )
    np.testing.assert_allclose(means, expected.mean, rtol=1e-12)
    weights = np.exp(info.log_likelihood - np.max(info.log_likelihood))
    weights = weights / weights.sum()
    np.testing.assert_allclose(mixed.mean, weights @ np.asarray(expected.mean), rtol=1e-12)
    assert np.ptp(means, axis=0).min() > 1e-3


BROKEN = np.array([1.0, 1.0, 1.0, -100.0])
"""Factors on the noise: as it is, nothing seen, a broken prior, a broken noise."""


def broken_cases() -> tuple[FilterParams, Obs]:
    prior, obs = cases()
    cov = np.array(prior.cov[:4])
    cov[2] = [[1.0, 2.0], [2.0, 1.0]]
    seen = obs.valid[:4].at[1].set(False)
    params = batch(Gaussian(prior.mean[:4], jnp.array(cov)), BROKEN)
    return params, Obs(jnp.where(seen, obs.z[:4], jnp.nan), seen)


@each_maker
def test_flags(name: str) -> None:
    params, obs = broken_cases()
    found, info = updated(SHORT[name], params, obs)
    flags = [Flag(int(raised)) for raised in info.flags]
    assert flags[0] == 0
    assert flags[1] == Flag.NO_OBSERVATION
    assert flags[2] == Flag.INDEFINITE
    assert flags[3] == Flag.NOT_POSITIVE_DEFINITE | Flag.INVALID_NOISE
    assert np.all(np.isfinite(found.mean[:3]))
    assert np.linalg.eigvalsh(found.cov[:3]).min() > -1e-12
    np.testing.assert_array_equal(found.mean[1], params.initial.mean[1])
    np.testing.assert_allclose(found.cov[1], params.initial.cov[1], rtol=1e-13)
    assert info.log_likelihood[1] == 0
    assert info.log_likelihood[3] == -np.inf
    assert np.all(np.isfinite(info.log_likelihood[:3]))
    assert 1 <= info.iterations[0] <= 3
    assert info.iterations[3] == 0


@each_maker
def test_broken_noise_keeps_the_state(name: str) -> None:
    params, obs = broken_cases()
    found, _ = updated(SHORT[name], params, obs)
    np.testing.assert_array_equal(found.mean[3], params.initial.mean[3])
    np.testing.assert_allclose(found.cov[3], params.initial.cov[3], rtol=1e-13)


def test_indefinite_noise_is_flagged_in_the_augmented_form() -> None:
    model = still(lambda x: x, np.array([[1.0, 2.0], [2.0, 1.0]]))
    params = batch(Gaussian(jnp.zeros((1, 2)), 0.1 * jnp.eye(2)[None]))
    _, info = updated(modified_iterated_ckf(model), params, whole(jnp.ones((1, 2))))
    assert info.flags[0] & (Flag.INDEFINITE | Flag.NOT_POSITIVE_DEFINITE)


def test_no_step_is_counted_where_nothing_is_seen() -> None:
    params, obs = broken_cases()
    for filter in SHORT.values():
        _, info = updated(filter, params, obs)
        assert info.iterations[1] == 0


def test_gradient_beside_a_trial_that_overflows() -> None:
    """From x = -5 the full step for exp(x) = 20 is 3e3 long: its trial is infinite and refused."""
    steep = iterated_ekf(still(jnp.exp, 0.01 * np.eye(1)), iterations=8, trials=12)

    def found(mean: Array) -> Array:
        params = FilterParams(jnp.array(1.0), Gaussian(mean, 100 * jnp.eye(1)))
        state, _ = steep.update(params, steep.init(params), jnp.zeros(()), whole([20.0]))
        return steep.estimate(state).mean[0]

    value, gradient = compiled(jax.value_and_grad(found))(jnp.array([-5.0]))
    np.testing.assert_allclose(value, np.log(20), atol=1e-2)
    assert np.all(np.isfinite(gradient))


def test_gradient_by_the_noise_of_a_perfect_channel() -> None:
    model = still(lambda x: x, np.eye(2))._replace(observation_noise=lambda p, x, u: p)
    filter = modified_iterated_ckf(model, iterations=1)

    def found(noise: Array) -> Array:
        params = FilterParams(noise, Gaussian(jnp.zeros(2), jnp.eye(2)))
        _, info = filter.update(params, filter.init(params), jnp.zeros(()), whole([1.0, 2.0]))
        return info.log_likelihood

    assert np.all(np.isfinite(compiled(jax.grad(found))(jnp.array([0.0, 4.0]))))


def test_bad_arguments_are_named() -> None:
    for make in MAKERS.values():
        with pytest.raises(ValueError, match="iterations is 0; it must be at least 1, and whole"):
            make(RANGING, iterations=0)
        with pytest.raises(ValueError, match="trials is -1; it must be at least 0, and whole"):
            make(RANGING, trials=-1)
    prior, obs = (jax.tree.map(lambda leaf: leaf[0], tree) for tree in cases())
    for wrong, kind in ((0.5, "0.5"), (prior, "a Gaussian")):
        params = FilterParams(jnp.ones(()), prior, own=wrong)
        filter = iterated_ekf(RANGING)
        with pytest.raises(ValueError, match=f"own is {kind}; it must be Search"):
            filter.update(params, filter.init(params), jnp.zeros(()), obs)


@pytest.mark.parametrize("noise", [np.eye(3), np.ones(3)])
def test_noise_of_another_size_is_named(noise: np.ndarray) -> None:
    """As for the other filters, which name the sizes in a ValueError."""
    model = still(lambda x: x, noise)
    params = FilterParams(jnp.ones(()), Gaussian(jnp.zeros(2), jnp.eye(2)))
    for make in MAKERS.values():
        filter = make(model)
        with pytest.raises(ValueError, match=r"\(3.*\(2, 2\) or \(2,\)"):
            filter.update(params, filter.init(params), jnp.zeros(()), whole([1.0, 2.0]))
