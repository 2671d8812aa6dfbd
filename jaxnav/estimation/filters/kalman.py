"""The Kalman filter and the extended Kalman filter in Joseph form: one body.

For a linear model the covariance recursion never forms the transition or the observation matrix:
both are applied to the columns of the covariance as functions. A model that is written in blocks
therefore costs what its blocks cost, and nothing in the recursion depends on the data, so that
``vmap`` over runs computes one covariance for all of them.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.ad_checkpoint import checkpoint_name

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
from jaxnav.numerics.conditioning import KEPT, corrected, explained, solved
from jaxnav.numerics.linalg import (
    cholesky,
    matmul,
    solve_positive,
    symmetrise,
)


class KalmanState(NamedTuple):
    """Mean and covariance.

    Attributes:
        x: A point of the state's manifold.
        P: ``(n, n)``, symmetric to rounding.
        indefinite: Whether the prior or the process noise since the last update was no covariance.
    """

    x: Point
    P: Array
    indefinite: Array


def kf(model: Model) -> Filter:
    """Return the Kalman filter of a linear model, with parameters :class:`FilterParams`.

        P- = Phi P Phi' + Q,                     x- = Phi x
        S = H P- H' + R,   K = P- H' inv(S),     x = x- + K nu
        P = (I - K H) P- (I - K H)' + K R K'     (Joseph form)

    ``transition`` and ``observe`` may have an offset that does not depend on the state. Channels
    that are not valid have no effect. An innovation covariance that is not positive definite skips
    the update, raises a flag, and has a log-likelihood of ``-inf``.

    Raises:
        ValueError: If the model has a ``retract``, ``local`` or ``jacobians`` of its own; in a run,
            if shapes do not fit together or the model is not linear in the state.

    Range: on the ill-conditioned update of Grewal and Andrews the covariance is right to 1e-7 for a
    ratio of measurement to prior sigma of 1e-6 in float64, to 1e-3 for 3e-3 in float32; beyond
    that a flag is raised, and :func:`~jaxnav.estimation.filters.square_root.square_root_kf` is the
    form to use.

    References:
        Si, Wang, Niu, "High precision attitude estimation algorithm for SINS/CNS integrated
        navigation with unknown noise characteristics", Eqs. (7)-(13); Bucy and Joseph (1968).
    """
    return ekf(with_itself_as_jacobians(model))._replace(model=model, on=kf)


def ekf(model: Model) -> Filter:
    """Return the extended Kalman filter of a model on a manifold: :func:`kf` about the estimate.

        x- = f(x),   Phi = d local(x-, f(retract(x, d))) / dd,   P- = Phi P Phi' + Q
        nu = residual(z, h(x-)),   H = d residual(h(retract(x-, d)), h(x-)) / dd
        x = retract(x-, K nu)

    at ``d = 0``. The derivatives are automatic unless the model has ``jacobians``. The error of the
    filter is whatever the model's ``retract`` and ``local`` make it: additive, multiplicative or
    invariant. Parameters, masks and flags are as for :func:`kf`, and so is the range.

    The covariance is not transported from the tangent space at ``x-`` to that at ``x``; the
    difference is of the order of the correction, as in the usual error-state filters.

    Raises:
        ValueError: In a run, if shapes do not fit together.

    References:
        Zhao, Chen, He, Ge (2018), IEEE/CAA JAS 5(6), section II; Sola, Deray, Atchuthan (2018), A
        micro Lie theory for state estimation in robotics, section III.
    """
    require_model(model)
    check = partial(require_filter_params, model)

    def init(params: FilterParams) -> KalmanState:
        require_prior(model, params.initial)
        return KalmanState(*params.initial, ~is_covariance(params.initial.cov))

    def predict(params: FilterParams, state: KalmanState, u: Input) -> KalmanState:
        n = state.P.shape[0]
        x, push = transition_map(model, params.model, state.x, u, n)
        # Without the barrier the update computes the predicted mean anew wherever it is used.
        x = jax.lax.optimization_barrier(x)
        Q = model.process_noise(params.model, state.x, u)
        require_step(model, state.x, x, Q)
        indefinite = state.indefinite | jnp.any(jnp.diag(Q) < 0)
        return KalmanState(x, symmetrise(push(push(state.P).T)) + Q, indefinite)

    def update(
        params: FilterParams, state: KalmanState, u: Input, obs: Obs
    ) -> tuple[KalmanState, Info]:
        n = state.P.shape[0]
        z_pred, push = observation_map(model, params.model, state.x, u, n)
        require_channels(obs, z_pred.shape)
        measurement = measured_with(model.observation_noise(params.model, state.x, u), obs)
        obs, R = measurement.obs, measurement.noise
        nu = masked_innovation(model, obs, z_pred)
        # A derivative that is not a number where a channel is missing must not reach a product.
        HP = jnp.where(obs.valid[:, None], push(state.P), 0)
        S = jnp.where(obs.valid[:, None] & obs.valid[None], push(HP.T), 0) + R
        solution = solved(S, cholesky(S), nu)
        root = solution.root
        # S does not couple valid channels with invalid ones: a zero here is a zero in the gain.
        usable = obs.valid[:, None] & root.positive_definite
        B = jnp.where(usable, HP, 0)
        gain = jnp.where(root.positive_definite, solve_positive(root.factor, S, B), 0)
        gain = checkpoint_name(gain, KEPT)
        HA = jnp.where(usable, push(state.P - matmul(B.T, gain)), 0)
        # What the Joseph form adds is zero but for rounding, whatever the parameters are, and so is
        # its derivative.
        joseph = matmul((matmul(R, gain) - HA).T, gain)
        P = state.P - explained(S, B, gain) + jax.lax.stop_gradient(joseph)
        x = model.retract(state.x, corrected(S, B, nu, gain, solution.weighed))
        info = innovation_info(nu, S, root, measurement, state.indefinite, solution=solution)
        return KalmanState(x, P, jnp.zeros_like(state.indefinite)), info

    def estimate(state: KalmanState) -> Gaussian:
        return Gaussian(state.x, symmetrise(state.P))

    def restart(state: KalmanState, estimate: Gaussian) -> KalmanState:
        return KalmanState(*estimate, state.indefinite)

    retract, local = model.retract, model.local
    return Filter(init, predict, update, estimate, restart, retract, local, check, model, ekf)
