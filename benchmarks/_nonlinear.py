"""A nonlinear problem in a vector space, which other libraries can filter too, and its oracle.

Fifteen states, three measurements, dense matrices and a sine in both functions:

    x+ = x + T (A x + 0.1 sin(x)) + w,   z = H x + 0.5 sin(H x) + v

The covariance of an extended or sigma-point filter depends on its data here, so that every run has
its own. The measurement noise is one, beside which the 1e-9 that some peers add to an innovation
covariance is nothing.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from benchmarks._peers import TILE, Missing
from jaxnav.estimation.types import FilterParams, Gaussian, Model

STATES, CHANNELS = 15, 3
PERIOD = 0.05
SINE, SEEN_SINE = 0.1, 0.5
ALPHA, BETA, KAPPA = 1.0, 2.0, 0.0
"""The unscented rule of all contestants."""

Answer = tuple[Any, Any]
"""Means ``(runs, T, 15)`` and log-likelihoods ``(runs,)``, or ``(runs, T)`` of the steps."""
Calls = dict[str, Callable[[], Answer]]


class Nonlinear(NamedTuple):
    """What is filtered, NumPy arrays.

    Attributes:
        A: ``(15, 15)``.
        H: ``(3, 15)``.
        Q: ``(15, 15)`` process noise of a step.
        R: ``(3, 3)``.
        P0: ``(15, 15)``; the mean at t0 is zero.
        z: ``(runs, T, 3)``.
    """

    A: np.ndarray
    H: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    P0: np.ndarray
    z: np.ndarray

    def shortened(self, runs: int, lane_steps: int) -> "Nonlinear":
        """Return the first runs, as far as the number of filter steps goes."""
        return self._replace(z=self.z[:runs, : max(lane_steps // runs, 1)])


def make_nonlinear(steps: int, runs: int, seed: int = 0) -> Nonlinear:
    """Draw the matrices and simulate the observations of every run."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(STATES, STATES)) / STATES**0.5 - 1.5 * np.eye(STATES)
    H = rng.normal(size=(CHANNELS, STATES)) / STATES**0.5
    mixing = rng.normal(size=(STATES, STATES)) / STATES**0.5
    Q = PERIOD * (mixing @ mixing.T + np.eye(STATES))
    R, P0 = np.eye(CHANNELS), np.eye(STATES)
    x, root = rng.normal(size=(runs, STATES)), np.linalg.cholesky(Q)
    z = np.zeros((runs, steps, CHANNELS))
    for k in range(steps):
        x = _moved(A, x.T).T + rng.normal(size=x.shape) @ root.T
        z[:, k] = _seen(H, x.T).T + rng.normal(size=(runs, CHANNELS))
    return Nonlinear(A, H, Q, R, P0, z)


def transition(A: Array, x: Array) -> Array:
    """Return ``f(x)``, for the JAX libraries."""
    return x + PERIOD * (A @ x + SINE * jnp.sin(x))


def observe(H: Array, x: Array) -> Array:
    """Return ``h(x)``, for the JAX libraries."""
    linear = H @ x
    return linear + SEEN_SINE * jnp.sin(linear)


class Matrices(NamedTuple):
    """Parameters of :func:`nonlinear_model`, as in :class:`Nonlinear`."""

    A: Array
    H: Array
    Q: Array
    R: Array


def nonlinear_params(problem: Nonlinear) -> FilterParams:
    """Return the parameters of the library's filters."""
    matrices = Matrices(*(jnp.asarray(m) for m in problem[:4]))
    return FilterParams(matrices, Gaussian(jnp.zeros(STATES), jnp.asarray(problem.P0)))


def nonlinear_model() -> Model:
    """Return the library's model, with parameters :class:`Matrices` and automatic Jacobians."""
    return Model(
        transition=lambda p, x, u: transition(p.A, x),
        process_noise=lambda p, x, u: p.Q,
        observe=lambda p, x, u: observe(p.H, x),
        observation_noise=lambda p, x, u: p.R,
    )


def _moved(A: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return ``f`` of columns ``(15, ...)``."""
    return x + PERIOD * (A @ x + SINE * np.sin(x))


def _seen(H: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return ``h`` of columns ``(15, ...)``."""
    return H @ x + SEEN_SINE * np.sin(H @ x)


def _moved_slope(A: np.ndarray, x: np.ndarray) -> np.ndarray:
    return np.eye(STATES) + PERIOD * (A + SINE * np.diag(np.cos(x)))


def _seen_slope(H: np.ndarray, x: np.ndarray) -> np.ndarray:
    return (1 + SEEN_SINE * np.cos(H @ x))[:, None] * H


def oracle(problem: Nonlinear, run: int, rule: str) -> tuple[np.ndarray, float]:
    """Filter one run by the textbook, a loop over time.

    Args:
        problem: The problem.
        run: Index of the run.
        rule: "ekf", "ukf", "ckf", or "ckf-kept" for a cubature filter whose update uses the
            propagated points again.

    Returns:
        Means ``(T, 15)`` and the log-likelihood.
    """
    x, P, total, means = np.zeros(STATES), problem.P0, 0.0, []
    for z in problem.z[run]:
        x, P, points = _predicted(problem, rule, x, P)
        z_pred, S, cross = _expected(problem, rule, x, P, points)
        nu, K = z - z_pred, np.linalg.solve(S, cross.T).T
        x, P = x + K @ nu, P - K @ S @ K.T
        P = (P + P.T) / 2
        nis = nu @ np.linalg.solve(S, nu)
        total -= 0.5 * (nis + np.log(np.linalg.det(2 * np.pi * S)))
        means.append(x)
    return np.array(means), total


def first_prediction(problem: Nonlinear, rule: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the moments before the first update, for libraries whose prior they are."""
    return _predicted(problem, rule, np.zeros(STATES), problem.P0)[:2]


def _predicted(
    problem: Nonlinear, rule: str, x: np.ndarray, P: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the predicted moments and, of a sigma-point rule, the propagated points."""
    if rule == "ekf":
        Phi = _moved_slope(problem.A, x)
        P = Phi @ P @ Phi.T + problem.Q
        return _moved(problem.A, x), (P + P.T) / 2, np.empty(0)
    points = _moved(problem.A, _points(rule, x, P))
    for_mean, for_cov = _weights(rule)
    x = points @ for_mean
    off = points - x[:, None]
    P = off * for_cov @ off.T + problem.Q
    return x, (P + P.T) / 2, points


def _expected(
    problem: Nonlinear, rule: str, x: np.ndarray, P: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the observation's mean and covariance and its covariance with the state."""
    if rule == "ekf":
        H = _seen_slope(problem.H, x)
        return _seen(problem.H, x), H @ P @ H.T + problem.R, P @ H.T
    if rule != "ckf-kept":
        points = _points(rule, x, P)
    for_mean, for_cov = _weights(rule)
    seen = _seen(problem.H, points)
    z = seen @ for_mean
    off = seen - z[:, None]
    return z, off * for_cov @ off.T + problem.R, (points - x[:, None]) * for_cov @ off.T


def _points(rule: str, x: np.ndarray, P: np.ndarray) -> np.ndarray:
    """Return the points as columns, the centre first if the rule has one."""
    spread = ALPHA * (STATES + KAPPA) ** 0.5 if rule == "ukf" else STATES**0.5
    offsets = spread * np.linalg.cholesky(P)
    centre = [np.zeros((STATES, 1))] if rule == "ukf" else []
    return x[:, None] + np.concatenate([*centre, offsets, -offsets], axis=1)


def _weights(rule: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights of the points for means and for covariances."""
    if rule != "ukf":
        equal = np.full(2 * STATES, 0.5 / STATES)
        return equal, equal
    scaled = ALPHA**2 * (STATES + KAPPA)
    for_mean = np.full(2 * STATES + 1, 0.5 / scaled)
    for_mean[0] = 1 - STATES / scaled
    for_cov = for_mean.copy()
    for_cov[0] += 1 - ALPHA**2 + BETA
    return for_mean, for_cov


class Peer(NamedTuple):
    """Another library's filter.

    Attributes:
        name: Of the library, for the table.
        method: Of the filter, for the table.
        rule: Which of the oracle's answers it should give.
        lane_steps: Filter steps over all runs in one timed call, at most.
        prepare: ``(problem) -> calls``, by the way they spread the work. Raises
            :class:`~benchmarks._peers.Missing`.
        runs: Largest number of runs it is asked for; it has no batch if 1.
    """

    name: str
    method: str
    rule: str
    lane_steps: int
    prepare: Callable[[Nonlinear], Calls]
    runs: int = 2**31


def jax_calls(series: Callable[[Nonlinear], Callable[[Array], Answer]]) -> Callable:
    """Return how a user runs a JAX filter over runs, as in :func:`benchmarks._peers.jax_calls`."""

    def prepare(problem: Nonlinear) -> Calls:
        filter_one = series(problem)
        z = jnp.asarray(problem.z)
        calls = {"vmap": jax.jit(jax.vmap(filter_one))}
        if len(z) > TILE:
            calls["tiles"] = jax.jit(lambda z: jax.lax.map(filter_one, z, batch_size=TILE))
        return {name: lambda call=call: call(z) for name, call in calls.items()}

    return prepare


def dynamax_series(rule: str) -> Callable[[Nonlinear], Callable[[Array], Answer]]:
    """Return dynamax's extended or unscented filter."""

    def series(problem: Nonlinear) -> Callable[[Array], Answer]:
        try:
            from dynamax import nonlinear_gaussian_ssm as ssm  # pyright: ignore
        except ImportError as error:
            raise Missing("dynamax is not installed") from error
        A, H, Q, R = (jnp.asarray(m) for m in (problem.A, problem.H, problem.Q, problem.R))
        x, P = (jnp.asarray(m) for m in first_prediction(problem, rule))
        f, h = (lambda x: transition(A, x)), (lambda x: observe(H, x))
        params = ssm.ParamsNLGSSM(x, P, f, Q, h, R)
        kept = ["filtered_means"]

        def filter_one(z: Array) -> Answer:
            if rule == "ekf":
                out = ssm.extended_kalman_filter(params, z, output_fields=kept)
            else:
                numbers = ssm.UKFHyperParams(ALPHA, BETA, KAPPA)  # pyright: ignore
                out = ssm.unscented_kalman_filter(params, z, numbers, output_fields=kept)
            return out.filtered_means, out.marginal_loglik

        return filter_one

    return series


def smcx_series(rule: str) -> Callable[[Nonlinear], Callable[[Array], Answer]]:
    """Return smcx's extended or unscented filter."""

    def series(problem: Nonlinear) -> Callable[[Array], Answer]:
        try:
            import smcx  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise Missing("smcx is not installed") from error
        A, H, Q, R = (jnp.asarray(m) for m in (problem.A, problem.H, problem.Q, problem.R))
        x, P = (jnp.asarray(m) for m in first_prediction(problem, rule))
        f, h = (lambda x: transition(A, x)), (lambda x: observe(H, x))

        def filter_one(z: Array) -> Answer:
            if rule == "ekf":
                F, slope = jax.jacfwd(f), jax.jacfwd(h)
                out = smcx.extended_kalman_filter(x, P, f, F, Q, h, slope, R, z)
            else:
                out = smcx.unscented_kalman_filter(
                    x, P, f, Q, h, R, z, alpha=ALPHA, beta=BETA, kappa=KAPPA
                )
            return out.filtered_means, out.marginal_loglik

        return filter_one

    return series


def cuthbert_series(problem: Nonlinear) -> Callable[[Array], Answer]:
    """Return cuthbert's filter in square-root form, linearised at the estimate."""
    try:
        from cuthbert import filter as run_filter  # pyright: ignore[reportMissingImports]
        from cuthbert.gaussian import moments  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise Missing("cuthbert is not installed") from error
    A, H = jnp.asarray(problem.A), jnp.asarray(problem.H)
    Q, R, P0 = (jnp.asarray(np.linalg.cholesky(m)) for m in (problem.Q, problem.R, problem.P0))

    def dynamics(state: Any, model_inputs: Any) -> tuple[Callable, Array]:
        del model_inputs
        return lambda x: (transition(A, x), Q), state.mean

    def observation(state: Any, model_inputs: Any) -> tuple[Callable, Array, Array]:
        return lambda x: (observe(H, x), R), state.mean, model_inputs

    def filter_one(z: Array) -> Answer:
        built = moments.build_filter(jnp.zeros(STATES), P0, dynamics, observation)
        states = run_filter(built, z, built.init_prepare())
        return states.mean[1:], states.log_normalizing_constant[-1]

    return filter_one


def filterpy_calls(rule: str) -> Callable[[Nonlinear], Calls]:
    """Return filterpy's loop over time, one run."""

    def prepare(problem: Nonlinear) -> Calls:
        try:
            from filterpy import kalman  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise Missing("filterpy is not installed") from error
        A, H = problem.A, problem.H

        class Extended(kalman.ExtendedKalmanFilter):
            def predict_x(self, u: Any = 0) -> None:
                del u
                self.F = _moved_slope(A, self.x)
                self.x = _moved(A, self.x)

        def moved(x: np.ndarray, dt: float) -> np.ndarray:
            del dt
            return _moved(A, x)

        def seen(x: np.ndarray) -> np.ndarray:
            return _seen(H, x)

        def make() -> Any:
            if rule == "ekf":
                return Extended(STATES, CHANNELS)
            if rule == "ukf":
                points = kalman.MerweScaledSigmaPoints(STATES, ALPHA, BETA, KAPPA)
                unscented = kalman.UnscentedKalmanFilter
                return unscented(STATES, CHANNELS, PERIOD, seen, moved, points)
            return kalman.CubatureKalmanFilter(STATES, CHANNELS, PERIOD, seen, moved)

        def call() -> Answer:
            kf, means, total = make(), [], 0.0
            kf.x, kf.P, kf.Q, kf.R = np.zeros(STATES), problem.P0.copy(), problem.Q, problem.R
            for z in problem.z[0]:
                kf.predict()
                if rule == "ekf":
                    kf.update(z, lambda x: _seen_slope(H, x), seen)
                else:
                    # its cubature filter keeps columns
                    kf.update(z if rule == "ukf" else z[:, None])
                total += kf.log_likelihood
                means.append(kf.x.reshape(-1).copy())
            return np.array(means)[None], np.array([total])

        return {"loop": call}

    return prepare


PEERS = (
    Peer("dynamax", "ekf", "ekf", 64_000, jax_calls(dynamax_series("ekf"))),
    Peer("smcx", "ekf", "ekf", 64_000, jax_calls(smcx_series("ekf"))),
    Peer("filterpy, one run", "ekf", "ekf", 500, filterpy_calls("ekf"), runs=1),
    Peer("cuthbert", "square_root_ekf", "ekf", 6_400, jax_calls(cuthbert_series)),
    Peer("dynamax", "ukf", "ukf", 16_000, jax_calls(dynamax_series("ukf"))),
    Peer("smcx", "ukf", "ukf", 16_000, jax_calls(smcx_series("ukf"))),
    Peer("filterpy, one run", "ukf", "ukf", 200, filterpy_calls("ukf"), runs=1),
    Peer("filterpy, one run", "ckf, redraw=False", "ckf-kept", 200, filterpy_calls("ckf"), runs=1),
)
