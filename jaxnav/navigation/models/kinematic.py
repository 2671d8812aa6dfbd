"""Kinematic models: a point that moves with white acceleration."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.models import Channel, Process, observing, shared
from jaxnav.estimation.types import Model


class KinematicParams(NamedTuple):
    """Noise of the model.

    Attributes:
        density: Power spectral density of the acceleration [m^2/s^3], the same on every axis.
        position_sigma: Standard deviation of a position fix [m], the same on every axis.
    """

    density: Array
    position_sigma: Array


class KinematicInput(NamedTuple):
    """Length of the step ``dt`` [s]; a step of zero length changes nothing."""

    dt: Array


def constant_velocity(axes: int) -> Model:
    """Return the constant-velocity model on independent axes, observed by position fixes.

    The state is position ``(axes,) [m]`` then velocity ``(axes,) [m/s]``;

        Q = density [dt^3/3, dt^2/2; dt^2/2, dt]   for each axis.

    References:
        Bar-Shalom, Li, Kirubarajan (2001), section 6.2.2.
    """
    position, velocity = slice(0, axes), slice(axes, 2 * axes)

    def transition(params: KinematicParams, x: Array, u: KinematicInput) -> Array:
        del params
        return jnp.concatenate([x[position] + u.dt * x[velocity], x[velocity]])

    def process_noise(params: KinematicParams, x: Array, u: KinematicInput) -> Array:
        dt, one = u.dt, jnp.eye(axes, dtype=x.dtype)
        blocks = [[dt**3 / 3 * one, dt**2 / 2 * one], [dt**2 / 2 * one, dt * one]]
        return params.density * jnp.block(blocks)

    def observe(params: KinematicParams, x: Array, u: KinematicInput) -> Array:
        del params, u
        return x[position]

    def observation_noise(params: KinematicParams, x: Array, u: KinematicInput) -> Array:
        del u
        return jnp.full(axes, params.position_sigma**2, x.dtype)

    fix = Channel(axes, observe, observation_noise)
    return observing(Process(transition, process_noise), {"position": fix}, parts=shared)
