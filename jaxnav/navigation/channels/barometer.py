"""Barometer: pressure heights in the standard atmosphere, with a bias that may be carried.

    z = h_r + s (h - h_r) + b

The pressure height of a sample is :func:`~jaxnav.navigation.atmosphere.pressure_height`. In air
that is warmer than the standard one by ``T_std / T = s`` it grows by less than the height does. The
weather, the geoid and the sensor are in ``b``: it drifts by metres in an hour.

References:
    Groves (2013), section 6.2.1.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.carried import carried_or
from jaxnav.estimation.models import Channel
from jaxnav.estimation.types import Input, Point
from jaxnav.navigation.atmosphere import temperature

BIAS = "barometer_bias"
"""Name of the carried state ``(1,) [m]`` that the channel sees, if there is one."""
_ZERO_CELSIUS = 273.15


class Barometer(NamedTuple):
    """Parameters of the channel.

    Attributes:
        sigma: Standard deviation of a pressure height [m].
        reference: Ellipsoidal height ``h_r`` [m] at which the bias is meant: of the start, say.
        stretch: ``s``, by which pressure height grows with height; see :func:`stretch`.
    """

    sigma: Array
    reference: Array
    stretch: Array


def barometer(height: Callable[[Point], Array] = lambda x: x.position[2]) -> Channel:
    """Return the channel ``(1,)`` of the pressure height [m], with :class:`Barometer` parameters.

    A carried state :data:`BIAS` is added to what is observed.

    Args:
        height: ``(x) -> ()``, the ellipsoidal height [m] of a state.
    """

    def observe(params: Barometer, x: Point, u: Input) -> Array:
        del u
        above = params.stretch * (height(x) - params.reference)
        return jnp.reshape(params.reference + above, (1,)) + carried_or(x, BIAS, 1, 0.0)

    return Channel(1, observe, lambda params, x, u: jnp.reshape(params.sigma**2, (1,)))


def stretch(celsius: float | Array, height: float | Array) -> Array:
    """Return ``T_std / T``, by which pressure height grows with height in air of a temperature.

    Args:
        celsius: Temperature of the air [deg C]; all of the air is taken as that much warmer than
            the standard one as it is here.
        height: Where it was measured, above the sea [m].
    """
    return temperature(height) / (celsius + _ZERO_CELSIUS)
