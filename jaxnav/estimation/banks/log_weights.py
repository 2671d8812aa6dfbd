"""Weights of a bank as logarithms: ``-inf`` marks a member that takes no part."""

import jax
import jax.numpy as jnp
from jax import Array


def normalise(log_weights: Array) -> Array:
    """Return log-weights ``(M,)`` whose weights sum to one; all ``-inf`` stays as it is."""
    shifted = from_peak(log_weights)
    some = jnp.any(active(shifted))
    return shifted - jnp.where(some, jax.nn.logsumexp(jnp.where(some, shifted, 0)), 0)


def from_peak(values: Array) -> Array:
    """Return log-values ``(M,)`` less their largest, which rounds nothing that matters.

    A sum of weights taken at the level of log-likelihoods of -1e6 would be right to 1e-10 only.
    """
    peak = jax.lax.stop_gradient(jnp.max(values))
    return values - jnp.where(jnp.isfinite(peak), peak, 0)


def active(log_weights: Array) -> Array:
    """Return which members ``(M,)`` take part."""
    return log_weights > -jnp.inf


def uniform(log_weights: Array) -> Array:
    """Return equal log-weights ``(M,)`` over the members that take part."""
    members = active(log_weights)
    return jnp.where(members, -jnp.log(jnp.sum(members).astype(log_weights.dtype)), -jnp.inf)


def member_log_likelihood(log_likelihood: Array) -> Array:
    """Return the members' log-likelihoods ``(M,)`` with a failed member's NaN as a veto."""
    return jnp.where(jnp.isnan(log_likelihood), -jnp.inf, log_likelihood)
