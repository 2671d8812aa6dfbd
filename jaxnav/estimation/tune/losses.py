"""Losses of a filter or a whole bank along a trajectory, and their weighted sums.

A loss is a :class:`Term`: numbers of each step, whose mean over steps and runs it turns into one
number. Terms over the same run share it, so a sum of three costs one pass of the filter.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.metrics import nees
from jaxnav.estimation.run import run
from jaxnav.estimation.types import Filter, Gaussian, Info, Input, Obs, Params
from jaxnav.numerics.linalg import safe_sqrt


class Term(NamedTuple):
    """A loss along a trajectory.

    Attributes:
        step: ``(estimate, info, truth) -> (k,)`` numbers of one step, to be averaged.
        combine: ``(k,) -> scalar`` the loss from their mean over steps and runs.
    """

    step: Callable[[Gaussian, Info, Any], Array]
    combine: Callable[[Array], Array]


ErrorOf = Callable[[Gaussian, Any], Gaussian]
"""``(estimate, truth) -> (error (n,), its covariance (n, n))``, in any units."""


def likelihood() -> Term:
    """Return the negative log-likelihood of the innovations per step [nats].

    For a bank it is that of the predictive mixture. It needs no truth.
    """
    return Term(lambda estimate, info, truth: -info.log_likelihood[None], lambda mean: mean[0])


def rmse(error: ErrorOf) -> Term:
    """Return the root of the mean square of the error's norm, in the error's unit."""

    def step(estimate: Gaussian, info: Info, truth: Any) -> Array:
        del info
        return jnp.sum(error(estimate, truth).mean ** 2)[None]

    return Term(step, lambda mean: safe_sqrt(mean[0]))


def nis_consistency() -> Term:
    """Return the squared logarithm of the mean NIS over its degrees of freedom; no truth.

    Zero for a consistent filter, whatever its accuracy. Of a bank it judges the moment-matched
    prediction.
    """

    def step(estimate: Gaussian, info: Info, truth: Any) -> Array:
        del estimate, truth
        # The innovation of a channel that is not valid is exactly zero.
        channels = jnp.sum(info.innovation != 0).astype(info.nis.dtype)
        return jnp.stack([info.nis, channels])

    def combine(mean: Array) -> Array:
        nis, channels = jnp.where(mean[1] > 0, mean, 1)
        return jnp.log(nis / channels) ** 2

    return Term(step, combine)


def nees_consistency(error: ErrorOf) -> Term:
    """Return the squared logarithm of the mean NEES over its degrees of freedom."""

    def step(estimate: Gaussian, info: Info, truth: Any) -> Array:
        del info
        e, P = error(estimate, truth)
        return nees(e, P)[None] / e.shape[0]

    return Term(step, lambda mean: jnp.log(mean[0]) ** 2)


def step_means(
    filter: Filter,
    terms: Mapping[str, Term],
    params: Params,
    inputs: Input,
    observations: Obs,
    truth: Any = (),
    *,
    segment: int = 0,
) -> dict[str, Array]:
    """Run a filter once and return the mean over steps of each term's numbers.

    Args:
        filter: The filter or bank.
        terms: The losses by name.
        params: The filter's parameters.
        inputs: As for :func:`~jaxnav.estimation.run.run`.
        observations: Likewise.
        truth: Pytree with a leading time axis, for terms that need it.
        segment: Length of the segments that the backward pass computes again; see
            :func:`~jaxnav.estimation.run.run`. About the root of the number of steps keeps the
            memory of the gradient small.
    """

    def predict(params: Params, state: Any, u: tuple[Input, Any]) -> Any:
        return filter.predict(params, state, u[0])

    def update(
        params: Params, state: Any, u: tuple[Input, Any], obs: Obs
    ) -> tuple[Any, dict[str, Array]]:
        state, info = filter.update(params, state, u[0], obs)
        estimate = filter.estimate(state)
        return state, {name: term.step(estimate, info, u[1]) for name, term in terms.items()}

    scored = filter._replace(predict=predict, update=update)
    trace = run(
        scored,
        params,
        (inputs, truth),
        observations,
        record=_numbers,
        segment=segment,
    )
    return jax.tree.map(lambda numbers: jnp.mean(numbers, axis=0), trace.record)


def _numbers(state: Any, numbers: Any) -> Any:
    del state
    return numbers


def weigh(
    terms: Mapping[str, Term], means: Mapping[str, Array], weights: Mapping[str, float]
) -> Array:
    """Return the weighted sum of losses from the means ``(..., k)`` of runs of equal length.

    Args:
        terms: The losses by name.
        means: What :func:`step_means` gave, with any leading axes of runs.
        weights: Weight of each loss; one that is not named is left out.
    """
    values = [
        weight * terms[name].combine(jnp.mean(means[name].reshape(-1, means[name].shape[-1]), 0))
        for name, weight in weights.items()
    ]
    return sum(values[1:], values[0])


def negative_log_likelihood(
    filter: Filter, params: Params, inputs: Input, observations: Obs, *, segment: int = 0
) -> Array:
    """Return the negative log-likelihood of the innovations per step [nats].

    For a bank it is that of the predictive mixture. ``segment`` is that of
    :func:`~jaxnav.estimation.run.run`; about the root of the number of steps keeps the memory of
    the gradient small.
    """
    trace = run(filter, params, inputs, observations, record=_log_likelihood, segment=segment)
    return -jnp.mean(trace.record)


def _log_likelihood(state: Any, info: Info | Mapping[str, Info]) -> Array:
    del state
    if isinstance(info, Mapping):
        raise ValueError(
            f"filter is a panel of {', '.join(info)}; it must be one filter or bank, which has one "
            "likelihood"
        )
    return info.log_likelihood
