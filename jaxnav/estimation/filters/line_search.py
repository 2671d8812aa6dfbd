"""Back-tracking line search with a fixed number of trials, so that it vmaps and has a gradient."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.lax import stop_gradient


class Search(NamedTuple):
    """The numbers of an iterated update: leaves, so that they may be tuned or differ in a bank.

    Attributes:
        spread: Spread of the cubature points about an iterate, as a factor on that of the prior,
            above 0: 1 is the paper's, near 0 makes them differences, and the fixed point the mode.
        step: Longest step tried; the search halves it.
        sufficient: Share of the decrease that the slope promises which a step must reach.
        temperature: 0 takes the first step that reaches it. Above, in units of the functional,
            every acceptance is a sigmoid and the step their mean, which has a gradient.
    """

    spread: Array | float = 1.0
    step: Array | float = 1.0
    sufficient: Array | float = 1e-4
    temperature: Array | float = 0.0


def step_length(
    functional: Callable[[Array], Array], promised: Array, search: Search, trials: int
) -> Array:
    """Return the first of the lengths ``step / 2^i`` by which a functional falls enough, or 0.

    A length whose functional is not finite is refused, and has no part in the gradient.

    Args:
        functional: What is to fall, of the length of the step.
        promised: Its derivative by the length at 0; above 0 counts as 0, which leaves the smooth
            step a kink where the derivative vanishes, of ``sufficient`` times its slope.
        search: The numbers of the search.
        trials: Number of lengths, at least one.

    References:
        Armijo (1966), Pacific Journal of Mathematics 16(1).
    """
    lengths = search.step * 0.5 ** jnp.arange(trials, dtype=promised.dtype)
    soft = jnp.asarray(search.temperature, promised.dtype)
    # Seen first without a derivative: 0 times that of an infinite trial would not be a number.
    known = jnp.isfinite(jax.vmap(functional)(stop_gradient(lengths)))
    tried = jnp.where(known, lengths, 0)
    values = jax.vmap(functional)(jnp.concatenate([jnp.zeros(1, tried.dtype), tried]))
    margin = values[0] + search.sufficient * tried * jnp.minimum(promised, 0) - values[1:]
    smooth = jax.nn.sigmoid(margin / jnp.where(soft > 0, soft, 1))
    accepted = jnp.where(soft > 0, smooth, (margin >= 0).astype(margin.dtype))
    accepted = jnp.where(known, accepted, 0)
    refused = jnp.concatenate([jnp.ones(1, margin.dtype), jnp.cumprod(1 - accepted)[:-1]])
    return jnp.sum(refused * accepted * lengths)
