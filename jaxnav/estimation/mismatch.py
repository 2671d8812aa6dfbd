"""What a filter's error really is when its noise is mis-set: covariance analysis along a path."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.filters.innovation import innovation_info, mask_noise, measurement_of
from jaxnav.estimation.filters.linearise import jacobians
from jaxnav.estimation.types import (
    Filter,
    FilterParams,
    Gaussian,
    Info,
    Input,
    Matrix,
    Model,
    Obs,
    Point,
)
from jaxnav.numerics.linalg import cholesky, solve_lower, solve_lower_transposed, symmetrise


class Mismatch(NamedTuple):
    """Parameters of :func:`mismatched`: what the filter believes, and what is true."""

    believed: FilterParams
    actual: FilterParams


class MismatchState(NamedTuple):
    """The path's point, the covariance that the filter believes, and that of its actual error."""

    x: Point
    believed: Matrix
    actual: Matrix


def mismatched(model: Model, truth: Callable[[Input], tuple[Point, Point]]) -> Filter:
    """Return the analysis of a Kalman filter whose noise is not the true one, as a filter.

    With the gain ``K`` of the believed covariance, and ``A = I - K H``,

        P = A (Phi P Phi' + Q_true) A' + K R_true K'

    is the covariance of the filter's actual error, to first order along the path; no run of it is
    drawn. The estimate has the path's point and this covariance; the state has both. Values of the
    observations are not used, and the info's are those of the believed filter with an innovation of
    zero.

    Args:
        model: The model; Jacobians are taken on the path.
        truth: ``(u) -> (x, y)`` the points of the path at the start and the end of the step, which
            the input carries.

    Returns:
        A filter with parameters :class:`Mismatch`.

    References:
        Maybeck (1979), Stochastic Models, Estimation, and Control, vol. 1, section 6.8.
    """

    def init(params: Mismatch) -> MismatchState:
        return MismatchState(
            params.actual.initial.mean, params.believed.initial.cov, params.actual.initial.cov
        )

    def predict(params: Mismatch, state: MismatchState, u: Input) -> MismatchState:
        before, after = truth(u)
        Phi, _ = jacobians(model, params.actual.model, before, u, state.actual.shape[0])

        def moved(P: Array, own: FilterParams) -> Array:
            return symmetrise(Phi @ P @ Phi.T) + model.process_noise(own.model, before, u)

        believed, actual = (
            moved(state.believed, params.believed),
            moved(state.actual, params.actual),
        )
        return MismatchState(after, believed, actual)

    def update(
        params: Mismatch, state: MismatchState, u: Input, obs: Obs
    ) -> tuple[MismatchState, Info]:
        n = state.actual.shape[0]
        _, H = jacobians(model, params.actual.model, state.x, u, n)
        measurement = measurement_of(model, params.believed.model, state.x, u, obs)
        valid = measurement.obs.valid
        H = jnp.where(valid[:, None], H, 0)
        noise = mask_noise(model.observation_noise(params.actual.model, state.x, u), valid)
        S = symmetrise(H @ state.believed @ H.T) + measurement.noise
        root = cholesky(S)
        K = solve_lower_transposed(root.factor, solve_lower(root.factor, H @ state.believed)).T
        K = jnp.where(valid[None] & root.positive_definite, K, 0)
        A = jnp.eye(n, dtype=H.dtype) - K @ H

        def corrected(P: Array, R: Array) -> Array:
            return symmetrise(A @ P @ A.T + K @ R @ K.T)

        moved = MismatchState(
            state.x,
            corrected(state.believed, measurement.noise),
            corrected(state.actual, noise),
        )
        return moved, innovation_info(jnp.zeros_like(S[0]), S, root, measurement, jnp.array(False))

    def estimate(state: MismatchState) -> Gaussian:
        return Gaussian(state.x, state.actual)

    def restart(state: MismatchState, estimate: Gaussian) -> MismatchState:
        return MismatchState(estimate.mean, state.believed, estimate.cov)

    return Filter(init, predict, update, estimate, restart, model.retract, model.local)
