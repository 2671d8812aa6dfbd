"""The Kalman filter in Joseph form.

The covariance recursion never forms the transition or the observation matrix: both are applied to
the columns of the covariance as linear functions. A model that is written in blocks therefore costs
what its blocks cost, and nothing in the recursion depends on the data, so that ``vmap`` over runs
computes one covariance for all of them.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.types import Filter, FilterParams, Flag, Gaussian, Info, Input, Model, Obs
from jaxnav.numerics.linalg import (
    Cholesky,
    cholesky,
    log_det,
    matmul,
    solve_lower,
    solve_lower_transposed,
    symmetrise,
)

DIGITS_LEFT = 1e3
"""Multiple of the machine epsilon below which a Cholesky pivot is called ill-conditioned."""


class KalmanState(NamedTuple):
    """Mean ``(n,)`` and covariance ``(n, n)``, symmetric to rounding."""

    x: Array
    P: Array


def kf(model: Model) -> Filter:
    """Return the Kalman filter of a linear model, with parameters :class:`FilterParams`.

        P- = Phi P Phi' + Q,                     x- = Phi x
        S = H P- H' + R,   K = P- H' inv(S),     x = x- + K nu
        P = (I - K H) P- (I - K H)' + K R K'     (Joseph form)

    ``transition`` and ``observe`` may have an offset that does not depend on the state. Channels
    that are not valid have no effect. An innovation covariance that is not positive definite skips
    the update, raises a flag, and has a log-likelihood of ``-inf``.

    Raises:
        ValueError: If the model has a ``retract``, ``local`` or ``jacobians`` of its own.

    Range: on the ill-conditioned update of Grewal and Andrews the covariance is right to 1e-7 for a
    ratio of measurement to prior sigma of 1e-6 in float64, to 1e-3 for 1e-2 in float32; beyond
    that a flag is raised, and :func:`~jaxnav.estimation.filters.square_root.square_root_kf` is the
    form to use.

    References:
        Si, Wang, Niu, "High precision attitude estimation algorithm for SINS/CNS integrated
        navigation with unknown noise characteristics", Eqs. (7)-(13); Bucy and Joseph (1968).
    """
    require_vector_space(model)

    def init(params: FilterParams) -> KalmanState:
        return KalmanState(*params.initial)

    def predict(params: FilterParams, state: KalmanState, u: Input) -> KalmanState:
        x, push = tangent_map(lambda x: model.transition(params.model, x, u), state.x)
        # Without the barrier the update computes the predicted mean anew wherever it is used.
        x = jax.lax.optimization_barrier(x)
        P = push(push(state.P).T)
        return KalmanState(x, symmetrise(P) + model.process_noise(params.model, state.x, u))

    def update(
        params: FilterParams, state: KalmanState, u: Input, obs: Obs
    ) -> tuple[KalmanState, Info]:
        z_pred, push = tangent_map(lambda x: model.observe(params.model, x, u), state.x)
        nu = masked_innovation(model, obs, z_pred)
        R = mask_noise(model.observation_noise(params.model, state.x, u), obs.valid)
        HP = push(state.P)
        S = jnp.where(obs.valid[:, None] & obs.valid[None], push(HP.T), 0) + R
        root = cholesky(S)
        gain = solve_lower_transposed(root.factor, solve_lower(root.factor, HP))
        # S does not couple valid channels with invalid ones, so a zero gain is all that these need;
        # masks in the products below would keep the compiler from vectorising them. Without the
        # barrier XLA solves again for each of the n^2 entries that use the gain.
        gain = jnp.where(obs.valid[:, None] & root.positive_definite, gain, 0)
        gain = jax.lax.optimization_barrier(gain)
        HA = push(state.P - matmul(HP.T, gain))
        P = state.P - matmul(gain.T, HP) + matmul((matmul(R, gain) - HA).T, gain)
        return KalmanState(state.x + matmul(gain.T, nu), P), innovation_info(nu, S, root, obs.valid)

    def estimate(state: KalmanState) -> Gaussian:
        return Gaussian(state.x, symmetrise(state.P))

    return Filter(init, predict, update, estimate)


def require_vector_space(model: Model) -> None:
    """Raise ``ValueError`` if a model has slots that the linear filters do not use."""
    unused = ("retract", "local", "jacobians")
    own = [name for name in unused if getattr(model, name) is not Model._field_defaults[name]]
    if own:
        raise ValueError(
            f"the model has its own {', '.join(own)}; a linear filter takes models with a vector "
            "as state and no Jacobians"
        )


def tangent_map(
    function: Callable[[Array], Array], x: Array
) -> tuple[Array, Callable[[Array], Array]]:
    """Return ``function(x)`` and the map of columns ``(n, k)`` through its derivative at ``x``."""

    def push(columns: Array) -> Array:
        return jax.vmap(lambda c: jax.jvp(function, (x,), (c,))[1], in_axes=1, out_axes=1)(columns)

    return function(x), push


def masked_innovation(model: Model, obs: Obs, z_pred: Array) -> Array:
    """Return the residual ``(m,)``, zero where no value arrived, whatever the value says."""
    z = jnp.where(obs.valid, obs.z, z_pred)
    return jnp.where(obs.valid, model.residual(z, z_pred), 0)


def mask_noise(R: Array, valid: Array) -> Array:
    """Return the noise covariance ``(m, m)`` with the identity in channels that are not valid.

    Args:
        R: Covariance ``(m, m)`` or its diagonal ``(m,)``.
        valid: ``(m,)`` bool.
    """
    dense = jnp.diag(R) if R.ndim == 1 else R
    both = valid[:, None] & valid[None, :]
    return jnp.where(both, dense, jnp.eye(valid.shape[0], dtype=R.dtype))


def innovation_info(nu: Array, S: Array, root: Cholesky, valid: Array) -> Info:
    """Judge an innovation ``(m,)`` against its covariance ``(m, m)`` and its factor, all masked."""
    usable = root.positive_definite
    whitened = solve_lower(root.factor, nu)
    nis = jnp.where(usable, jnp.sum(whitened * whitened), 0)
    channels = jnp.sum(valid).astype(S.dtype)
    log_likelihood = -0.5 * (nis + log_det(root.factor) + channels * math.log(2 * math.pi))
    few_digits = root.reciprocal_pivot < DIGITS_LEFT * jnp.finfo(S.dtype).eps
    return Info(
        innovation=nu,
        innovation_cov=S,
        log_likelihood=jnp.where(usable, log_likelihood, -jnp.inf),
        nis=nis,
        iterations=jnp.ones((), jnp.int32),
        flags=_flags(valid, usable, few_digits),
    )


def _flags(valid: Array, usable: Array, ill_conditioned: Array) -> Array:
    bits = (
        (~jnp.any(valid), Flag.NO_OBSERVATION),
        (~usable, Flag.NOT_POSITIVE_DEFINITE),
        (usable & ill_conditioned, Flag.ILL_CONDITIONED),
    )
    return sum(
        (jnp.where(raised, int(flag), 0).astype(jnp.int32) for raised, flag in bits),
        jnp.zeros((), jnp.int32),
    )
