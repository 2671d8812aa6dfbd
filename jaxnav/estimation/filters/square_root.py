"""Square-root twins: the covariance is carried as a triangular factor that cannot go indefinite."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.filters.kalman import (
    innovation_info,
    mask_noise,
    masked_innovation,
    require_vector_space,
    tangent_map,
)
from jaxnav.estimation.types import Filter, FilterParams, Gaussian, Info, Input, Model, Obs
from jaxnav.numerics.linalg import Cholesky, semidefinite_root, solve_lower, tria


class SquareRootState(NamedTuple):
    """Mean ``(n,)`` and a lower factor ``L`` ``(n, n)`` of the covariance ``P = L L'``."""

    x: Array
    L: Array


def square_root_kf(model: Model) -> Filter:
    """Return the Kalman filter of a linear model in array (QR) square-root form.

        [Phi L, sqrt(Q)] Theta = [L-, 0]
        [sqrt(R), H L-; 0, L-] Theta = [sqrt(S), 0; K sqrt(S), L]

    with ``Theta`` orthogonal. Parameters, offsets and invalid channels are as in
    :func:`~jaxnav.estimation.filters.kalman.kf`, and so are the errors raised. ``P``, ``Q`` and
    ``R`` may be singular; gradients need ``[Phi L, sqrt(Q)]`` of full row rank. The two QR
    factorisations of a step cost far more than the Joseph form does.

    Batched QR of several host devices at once can wait for ever inside XLA: give ``monte_carlo``
    one device, or set the environment variable ``NPROC`` to 4 or more before JAX starts.

    Range: on the ill-conditioned update of Grewal and Andrews the covariance is right to 1e-6 for a
    ratio of measurement to prior sigma of 1e-9 in float64, to 1e-3 for 1e-4 in float32.

    References:
        Kailath, Sayed, Hassibi (2000), Linear Estimation, section 12.3.
    """
    require_vector_space(model)

    def init(params: FilterParams) -> SquareRootState:
        return SquareRootState(params.initial.mean, semidefinite_root(params.initial.cov))

    def predict(params: FilterParams, state: SquareRootState, u: Input) -> SquareRootState:
        x, push = tangent_map(lambda x: model.transition(params.model, x, u), state.x)
        noise = semidefinite_root(model.process_noise(params.model, state.x, u))
        return SquareRootState(x, tria(jnp.concatenate([push(state.L), noise], axis=1)))

    def update(
        params: FilterParams, state: SquareRootState, u: Input, obs: Obs
    ) -> tuple[SquareRootState, Info]:
        z_pred, push = tangent_map(lambda x: model.observe(params.model, x, u), state.x)
        nu = masked_innovation(model, obs, z_pred)
        R = mask_noise(model.observation_noise(params.model, state.x, u), obs.valid)
        HL = jnp.where(obs.valid[:, None], push(state.L), 0)
        m, n = HL.shape
        array = tria(
            jnp.block([[semidefinite_root(R), HL], [jnp.zeros((n, m), HL.dtype), state.L]])
        )
        root = _checked(array[:m, :m])
        gain = jnp.where(root.positive_definite, array[m:, :m], 0)
        L = jnp.where(root.positive_definite, array[m:, m:], state.L)
        x = state.x + gain @ solve_lower(root.factor, nu)
        S = root.factor @ root.factor.T
        return SquareRootState(x, L), innovation_info(nu, S, root, obs.valid)

    def estimate(state: SquareRootState) -> Gaussian:
        return Gaussian(state.x, state.L @ state.L.T)

    return Filter(init, predict, update, estimate)


def _checked(root: Array) -> Cholesky:
    """Return the lower factor ``(m, m)`` of an innovation covariance with its health."""
    pivots = jnp.diag(root)
    positive = jnp.all(pivots > 0)
    factor = jnp.where(positive, root, jnp.eye(root.shape[0], dtype=root.dtype))
    # The factor was never squared: it keeps twice the digits a covariance would.
    ratio = jnp.min(pivots / jnp.sqrt(jnp.sum(factor * factor, axis=1)))
    return Cholesky(factor, positive, jnp.where(positive, ratio, 0))
