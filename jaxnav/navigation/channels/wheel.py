"""Wheel speed: the forward velocity of an unsteered axle, with a scale error that may be carried.

    z = (1 + s) (M (C' v + w x l_axle)) in x,   M = exp([mounting]x)

The scale error ``s`` is that of the rolling radius: tyre pressure, wear and load are up to a few
per cent. A speed without a sign needs its sign from the gear.

References:
    Groves (2013), section 6.3.
"""

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.carried import carried_or
from jaxnav.estimation.models import Channel
from jaxnav.estimation.types import Input, Params, Point
from jaxnav.navigation.channels.steered import Axle, axle_velocity
from jaxnav.navigation.earth import WGS84, Earth

SCALE = "wheel_scale"
"""Name of the carried state ``(1,)``, measured over true less one, that the channel sees."""


def wheel_speed(
    axle: Callable[[Params, Point, Input], Axle],
    sigma: Callable[[Params], Array],
    earth: Earth = WGS84,
) -> Channel:
    """Return the channel ``(1,)`` of the speed of the wheels of an axle [m/s].

    A carried state :data:`SCALE` is the scale error of what is observed.

    Args:
        axle: ``(params, x, u) -> Axle`` of the model; its own ``sigma`` is not used.
        sigma: ``(params) -> ()``, standard deviation of a speed [m/s].
        earth: The Earth.
    """

    def observe(params: Params, x: Point, u: Input) -> Array:
        forward = axle_velocity(axle(params, x, u), x, earth)[:1]
        return forward * (1.0 + carried_or(x, SCALE, 1, 0.0))

    return Channel(1, observe, lambda params, x, u: jnp.reshape(sigma(params) ** 2, (1,)))
