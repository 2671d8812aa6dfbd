"""A vehicle at rest: its velocity and turn rate are seen to be zero, by what knows that it stands.

    0 = v   with the noise   sigma exp(v^2 / (2 v_rest^2))
    w = eps + C' w_ie   is all that the gyros measure

A car at a constant speed on a smooth road looks to its sensors as if it stood: so a stop is
believed less, the faster the filter says the vehicle is, and not at all at several times
``v_rest``. A filter that is wrong by that much at a true stop is left alone too.

References:
    Groves (2013), section 15.3.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.models import Channel
from jaxnav.estimation.types import Input, Params
from jaxnav.navigation.earth import WGS84, Earth, earth_rate
from jaxnav.navigation.states import LAYOUT, ErrorForm, SinsLevel
from jaxnav.numerics.linalg import matmul

MOST_DOUBT = 40.0
"""Logarithm of the largest factor on the variance of a rest, so that it stays finite."""


class Stop(NamedTuple):
    """What the channel has to know at a step.

    Attributes:
        sigma: Standard deviation of the velocity at a stop [m/s], each axis.
        speed: Speed at which a stop is believed less by half an e [m/s].
    """

    sigma: Array
    speed: Array


def zero_velocity(stop: Callable[[Params, Input], Stop], form: ErrorForm) -> Channel:
    """Return the channel ``(3,)`` of the velocity at a stop [m/s], east, north, up.

    Args:
        stop: ``(params, u) -> Stop`` of the model.
        form: The definition of the state's error.
    """

    def noise(params: Params, x: SinsLevel, u: Input) -> Array:
        at = stop(params, u)
        doubt = jnp.minimum(jnp.sum((x.velocity / at.speed) ** 2), MOST_DOUBT)
        return jnp.broadcast_to(at.sigma**2 * jnp.exp(doubt), (3,))

    return Channel(
        3,
        lambda params, x, u: x.velocity,
        noise,
        differential=lambda params, x, u: lambda dx: form.to_additive(x, dx)[LAYOUT.dv],
    )


def zero_rate(sigma: Callable[[Params, Input], Array], earth: Earth = WGS84) -> Channel:
    """Return the channel ``(3,)`` of what gyros measure at a stop [rad/s], body axes.

    The measurement is the mean angular rate as measured over the step, which at rest is the drift
    and the Earth's rotation. Its noise is that of the prediction over the step too, which is left
    out: it adds to an attitude what is small beside its own noise.

    Args:
        sigma: ``(params, u) -> ()`` or ``(3,)``, standard deviation of the mean rate [rad/s]: the
            angle random walk over the root of the step's length, and what the standing body shakes.
        earth: The Earth.
    """

    def observe(params: Params, x: SinsLevel, u: Input) -> Array:
        del params, u
        return x.drift + matmul(x.dcm.T, earth_rate(x.position[0], earth))

    return Channel(3, observe, lambda params, x, u: jnp.broadcast_to(sigma(params, u) ** 2, (3,)))
