"""What sensors report of true states, drawn from the noise of their channels."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from jaxnav.estimation.models import Channel, disturbed
from jaxnav.estimation.types import Input, NonAdditive, Params, Point
from jaxnav.numerics.roots import semidefinite_root


def measured(key: Array, channel: Channel, params: Params, states: Point, inputs: Input) -> Array:
    """Return what a sensor reports along true states ``(T, m)``, with the noise of its channel.

    Args:
        key: Random key.
        channel: The sensor.
        params: Its parameters.
        states: True states, leading axis ``T``.
        inputs: Inputs of the steps, leading axis ``T``; ``None`` where the channel needs none.

    Returns:
        ``(T, m)``; not a number where the noise is no covariance.

    Raises:
        ValueError: If it is no channel, what it gives has not its size, or its noise cannot be
            added to its values, which is found where they are concrete and not a number elsewhere:
            :func:`~jaxnav.navigation.channels.gnss.observe_gnss` draws positions on the Earth.
    """
    if not isinstance(channel, Channel):
        raise ValueError(f"channel is {type(channel).__name__}; it must be a Channel")

    def with_noise(params: Params, x: Point, v: Array, u: Input) -> Array:
        return disturbed(channel.residual, channel.observe(params, x, u), v)

    noisy = channel.noisy or NonAdditive(with_noise, channel.noise)

    def one(key: Array, x: Point, u: Input) -> tuple[Array, Array]:
        noise = jnp.asarray(noisy.noise(params, x, u))
        if not jnp.issubdtype(noise.dtype, jnp.floating):
            noise = noise.astype(float)
        white = jax.random.normal(key, noise.shape[:1], noise.dtype)
        root = semidefinite_root(jnp.diag(noise) if noise.ndim == 1 else noise)
        v = jnp.where(root.semidefinite, root.factor, jnp.nan) @ white
        z = noisy.observe(params, x, v, u)
        if z.shape != (channel.size,):
            raise ValueError(
                f"the channel gives {z.shape}; by its size it must be ({channel.size},)"
            )
        return z, jnp.all(jnp.isfinite(z) | ~jnp.isfinite(v))

    count = jax.tree.leaves(states)[0].shape[0]
    z, added = jax.vmap(one)(jax.random.split(key, count), states, inputs)
    if channel.noisy is None and not isinstance(added, Tracer) and not np.all(added):
        raise ValueError(
            "the channel's noise cannot be added to its values, whose residual has other units; "
            "give the channel noisy, which says how it enters"
        )
    return z
