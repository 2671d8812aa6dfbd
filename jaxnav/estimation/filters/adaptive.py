"""Adaptive filters: noise that is estimated from the innovations as they come."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.filters.given_noise import given, with_given_noise
from jaxnav.estimation.filters.innovation import mask_noise
from jaxnav.estimation.types import Filter, FilterParams, Gaussian, Info, Input, Model, Obs

LEAST_EXCESS = 1e-2
"""Smallest ratio of observed to predicted excess that counts in one update; noise makes the
observed one negative at times."""


class Adaptation(NamedTuple):
    """Parameters of :func:`innovation_adaptive`.

    Attributes:
        memory: Updates over which innovations are averaged, at least one.
        low: Smallest factor on the process noise.
        high: Largest factor.
    """

    memory: Array | float = 100.0
    low: Array | float = 1e-2
    high: Array | float = 1e4


class AdaptiveState(NamedTuple):
    """The filter's state, the log of the factor on Q, and the averages it follows from."""

    inner: Any
    log_factor: Array
    observed: Array
    predicted: Array


def innovation_adaptive(build: Callable[[Model], Filter], model: Model) -> Filter:
    """Return a filter that scales its process noise until its innovations are as large as expected.

    With ``P-`` the predicted covariance, innovations have the covariance ``H P- H' + R``. What they
    have beyond ``R``, and what is predicted, are averaged over channels in units of ``R`` and over
    updates with a memory of ``W``:

        a = mean((nu^2 - R) / R),   b = mean(H P- H' / R)
        log s = log s + log(a / b) / W,   Q = s Q_model,   s in [low, high]

    Parameters are :class:`~jaxnav.estimation.types.FilterParams` with :class:`Adaptation` as
    ``adaptation``. One factor for the whole Q is what a few channels can tell; the full matrix
    ``K C K'`` of Mohamed and Schwarz is of their rank, and loses the structure of the model.

    Args:
        build: The filter to make adaptive; any of this library that takes a model.
        model: The model.

    References:
        Mohamed and Schwarz (1999), Journal of Geodesy 73(4); Ding, Wang, Rizos, Kinlyside (2007),
        Journal of Navigation 60(3), for the scaling of Q by the ratio of traces.
    """
    base = build(with_given_noise(model))

    def init(params: FilterParams) -> AdaptiveState:
        zero = jnp.zeros((), params.initial.cov.dtype)
        return AdaptiveState(base.init(params), zero, zero, zero)

    def predict(params: FilterParams, state: AdaptiveState, u: Input) -> AdaptiveState:
        scaled = given(params, jnp.exp(state.log_factor), 0.0)
        return state._replace(inner=base.predict(scaled, state.inner, u))

    def update(
        params: FilterParams, state: AdaptiveState, u: Input, obs: Obs
    ) -> tuple[AdaptiveState, Info]:
        own = Adaptation() if params.adaptation == () else params.adaptation
        x = base.estimate(state.inner).mean
        R = mask_noise(model.observation_noise(params.model, x, u), obs.valid)
        inner, info = base.update(given(params, 1.0, R), state.inner, u, obs)
        return _followed(own, state._replace(inner=inner), info, jnp.diag(R), obs.valid), info

    def estimate(state: AdaptiveState) -> Gaussian:
        return base.estimate(state.inner)

    def restart(state: AdaptiveState, estimate: Gaussian) -> AdaptiveState:
        return state._replace(inner=base.restart(state.inner, estimate))

    return Filter(init, predict, update, estimate, restart, model.retract, model.local)


def _followed(
    own: Adaptation, state: AdaptiveState, info: Info, R: Array, valid: Array
) -> AdaptiveState:
    """Move the averages and the factor with one innovation; nothing moves without data."""
    channels = jnp.maximum(jnp.sum(valid), 1).astype(R.dtype)

    def mean(values: Array) -> Array:
        return jnp.sum(jnp.where(valid, values / R, 0)) / channels

    rate = jnp.where(jnp.any(valid), 1 / own.memory, 0).astype(R.dtype)
    excess = jnp.diag(info.innovation_cov) - R
    observed = state.observed + rate * (mean(info.innovation**2 - R) - state.observed)
    predicted = state.predicted + rate * (mean(excess) - state.predicted)
    known = predicted > 0
    ratio = jnp.where(known, observed, 1) / jnp.where(known, predicted, 1)
    moved = state.log_factor + rate * jnp.log(jnp.maximum(ratio, LEAST_EXCESS))
    bounded = jnp.clip(moved, jnp.log(own.low), jnp.log(own.high))
    return AdaptiveState(state.inner, bounded.astype(R.dtype), observed, predicted)
