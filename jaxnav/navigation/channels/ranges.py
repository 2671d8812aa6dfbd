"""Ranges to beacons at known places, with an offset of the clock that may be carried.

    z_i = |r_e(p + C l) - b_i| + c

References:
    Groves (2013), sections 7.1.4 and 11.1.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.carried import carried_or
from jaxnav.estimation.models import Channel
from jaxnav.estimation.types import Input, Point
from jaxnav.navigation.earth import displaced, ecef_from_geodetic
from jaxnav.numerics.linalg import matmul, safe_norm

OFFSET = "range_offset"
"""Name of the carried state ``(1,) [m]`` that all ranges have in common, if there is one."""


class Beacons(NamedTuple):
    """Parameters of the channel, N beacons.

    Attributes:
        position: Where they are ``(N, 3)``, geodetic.
        sigma: Standard deviations of the ranges ``(N,) [m]``.
        lever_arm: From the inertial sensors to the antenna ``(3,) [m]``, body axes.
    """

    position: Array
    sigma: Array
    lever_arm: Array


def ranges(count: int) -> Channel:
    """Return the channel ``(N,)`` of ranges to beacons [m], with :class:`Beacons` parameters.

    A carried state :data:`OFFSET` is added to each. At a beacon itself a range has no direction:
    there its derivative is zero.

    Args:
        count: Number of beacons ``N``.
    """

    def observe(params: Beacons, x: Point, u: Input) -> Array:
        del u
        shape = jnp.shape(params.position)
        if shape != (count, 3):
            raise ValueError(f"the beacons' positions are {shape}; they must be ({count}, 3)")
        antenna = displaced(x.position, matmul(x.dcm, params.lever_arm))
        ray = jax.vmap(ecef_from_geodetic)(params.position) - ecef_from_geodetic(antenna)[None]
        return jax.vmap(safe_norm)(ray) + carried_or(x, OFFSET, 1, 0.0)

    return Channel(count, observe, lambda params, x, u: jnp.asarray(params.sigma) ** 2)
