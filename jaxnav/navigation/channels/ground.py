"""Height above the ground: what a radar or laser altimeter that looks straight down sees.

    z = h - g(latitude, longitude)

References:
    Groves (2013), section 6.2.2.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.models import Channel
from jaxnav.estimation.types import Input, Point


class Altimeter(NamedTuple):
    """Parameters of the channel.

    Attributes:
        sigma: Standard deviation of a height [m], of the instrument and of the map.
    """

    sigma: Array


def height_above(surface: Callable[[Array, Array], Array]) -> Channel:
    """Return the channel ``(1,)`` of the height above a surface [m], with :class:`Altimeter`.

    Args:
        surface: ``(latitude, longitude) -> ()``, the ellipsoidal height of the ground [m] at a
            place [rad]; differentiable, as by interpolation in a map that is not coarser than the
            uncertainty of the position.
    """

    def observe(params: Altimeter, x: Point, u: Input) -> Array:
        del params, u
        return jnp.reshape(x.position[2] - surface(x.position[0], x.position[1]), (1,))

    return Channel(1, observe, lambda params, x, u: jnp.reshape(params.sigma**2, (1,)))
