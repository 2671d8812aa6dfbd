"""Square-root twins: the covariance is carried as a triangular factor that cannot go indefinite."""

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.checks import require_filter_params, require_model, require_prior
from jaxnav.estimation.filters.innovation import (
    innovation_info,
    is_covariance,
    masked_innovation,
    measured_with,
    require_channels,
    require_step,
)
from jaxnav.estimation.filters.linearise import (
    observation_map,
    transition_map,
    with_itself_as_jacobians,
)
from jaxnav.estimation.types import (
    Filter,
    FilterParams,
    Gaussian,
    Info,
    Input,
    Model,
    Obs,
    Point,
)
from jaxnav.numerics.linalg import Cholesky, solve_lower
from jaxnav.numerics.roots import semidefinite_root, tria_beside, tria_of_update


class SquareRootState(NamedTuple):
    """Mean and factor of the covariance.

    Attributes:
        x: A point of the state's manifold.
        L: ``(n, n)``, lower, with ``P = L L'``.
        indefinite: Whether the prior or the process noise since the last update was no covariance.
    """

    x: Point
    L: Array
    indefinite: Array


class ArrayUpdate(NamedTuple):
    """What the triangular array of an update holds.

    Attributes:
        S: ``(m, m)`` innovation covariance.
        root: Its lower factor with its health.
        gain_root: ``(n, m)`` the gain times that factor; zero if the factor is not usable.
        L: ``(n, n)`` factor of the updated covariance; the predicted one if it is not.
    """

    S: Array
    root: Cholesky
    gain_root: Array
    L: Array


def square_root_kf(model: Model) -> Filter:
    """Return the Kalman filter of a linear model in array square-root form.

        [sqrt(Q), Phi L] Theta = [L-, 0]
        [sqrt(R), H L-; 0, L-] Theta = [sqrt(S), 0; K sqrt(S), L]

    with ``Theta`` orthogonal. Parameters, offsets and invalid channels are as in
    :func:`~jaxnav.estimation.filters.kalman.kf`, and so are the errors raised. ``P``, ``Q`` and
    ``R`` may be singular; one that is indefinite loses the columns of its negative pivots, with a
    flag. Gradients need ``[sqrt(Q), Phi L]`` of full row rank.

    Range: on the ill-conditioned update of Grewal and Andrews the covariance is right to 1e-6 for a
    ratio of measurement to prior sigma of 1e-9 in float64, to 1e-3 for 1e-4 in float32; the
    gradient of the log-likelihood is right to 1e-6 for 1e-8 in float64.

    References:
        Kailath, Sayed, Hassibi (2000), Linear Estimation, section 12.3.
    """
    filter = square_root_ekf(with_itself_as_jacobians(model))
    return filter._replace(model=model, on=square_root_kf)


def square_root_ekf(model: Model) -> Filter:
    """Return the extended Kalman filter in the form of :func:`square_root_kf`.

    The maps ``Phi`` and ``H`` are those of :func:`~jaxnav.estimation.filters.kalman.ekf`. Range
    and rank of the gradients are as for the linear filter.
    """
    require_model(model)
    check = partial(require_filter_params, model)

    def init(params: FilterParams) -> SquareRootState:
        require_prior(model, params.initial)
        x, P = params.initial
        return SquareRootState(x, semidefinite_root(P).factor, ~is_covariance(P))

    def predict(params: FilterParams, state: SquareRootState, u: Input) -> SquareRootState:
        x, push = transition_map(model, params.model, state.x, u, state.L.shape[0])
        Q = model.process_noise(params.model, state.x, u)
        require_step(model, state.x, x, Q)
        noise = semidefinite_root(Q)
        indefinite = state.indefinite | ~noise.semidefinite
        return SquareRootState(x, tria_beside(noise.factor, push(state.L)), indefinite)

    def update(
        params: FilterParams, state: SquareRootState, u: Input, obs: Obs
    ) -> tuple[SquareRootState, Info]:
        z_pred, push = observation_map(model, params.model, state.x, u, state.L.shape[0])
        require_channels(obs, z_pred.shape)
        measurement = measured_with(model.observation_noise(params.model, state.x, u), obs)
        obs, R = measurement.obs, measurement.noise
        nu = masked_innovation(model, obs, z_pred)
        HL = jnp.where(obs.valid[:, None], push(state.L), 0)
        triangle = tria_of_update(semidefinite_root(R).factor, HL, state.L)
        done = read_array(triangle, HL.shape[0], state.L)
        x = model.retract(state.x, done.gain_root @ solve_lower(done.root.factor, nu))
        info = innovation_info(nu, done.S, done.root, measurement, state.indefinite, rooted=True)
        return SquareRootState(x, done.L, jnp.zeros_like(state.indefinite)), info

    def estimate(state: SquareRootState) -> Gaussian:
        return Gaussian(state.x, state.L @ state.L.T)

    def restart(state: SquareRootState, estimate: Gaussian) -> SquareRootState:
        root = semidefinite_root(estimate.cov)
        indefinite = state.indefinite | ~root.semidefinite
        return SquareRootState(estimate.mean, root.factor, indefinite)

    retract, local = model.retract, model.local
    return Filter(
        init, predict, update, estimate, restart, retract, local, check, model, square_root_ekf
    )


def read_array(triangle: Array, m: int, predicted: Array) -> ArrayUpdate:
    """Take the triangle ``(m + n, m + n)`` of an update's array apart.

    Args:
        triangle: Lower, with a non-negative diagonal.
        m: Number of channels.
        predicted: ``(n, n)`` factor to keep if the update has to be skipped.
    """
    root = _checked(triangle[:m, :m])
    gain = jnp.where(root.positive_definite, triangle[m:, :m], 0)
    L = jnp.where(root.positive_definite, triangle[m:, m:], predicted)
    return ArrayUpdate(root.factor @ root.factor.T, root, gain, L)


def _checked(root: Array) -> Cholesky:
    """Return the lower factor ``(m, m)`` of an innovation covariance with its health."""
    pivots = jnp.diag(root)
    positive = jnp.all(pivots > 0)
    factor = jnp.where(positive, root, jnp.eye(root.shape[0], dtype=root.dtype))
    # The factor was never squared: it keeps twice the digits a covariance would.
    ratio = jnp.min(pivots / jnp.sqrt(jnp.sum(factor * factor, axis=1)))
    return Cholesky(factor, positive, jnp.where(positive, ratio, 0))
