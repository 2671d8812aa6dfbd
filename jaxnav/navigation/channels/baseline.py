"""Two antennas: heading and pitch of the line between them.

    d = C b,   z = (atan2(d_east, d_north),  atan2(d_up, |d_horizontal|))

The residual of the heading is the shorter way round. A baseline that stands upright has no heading;
close to it the channel says nothing of use.

References:
    Groves (2013), section 10.2.5.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.models import Channel
from jaxnav.estimation.types import Input, Point
from jaxnav.numerics.lie import wrapped_angle
from jaxnav.numerics.linalg import matmul, safe_norm


class Baseline(NamedTuple):
    """Parameters of the channel.

    Attributes:
        vector: From the first antenna to the second ``(3,) [m]``, body axes.
        sigma: Standard deviations of heading and pitch ``(2,) [rad]``.
    """

    vector: Array
    sigma: Array


def baseline() -> Channel:
    """Return the channel ``(2,)`` of heading, from north by east, and pitch [rad].

    Its parameters are a :class:`Baseline`.
    """

    def observe(params: Baseline, x: Point, u: Input) -> Array:
        del u
        d = matmul(x.dcm, params.vector)
        return jnp.stack([jnp.arctan2(d[0], d[1]), jnp.arctan2(d[2], safe_norm(d[:2]))])

    return Channel(2, observe, lambda params, x, u: params.sigma**2, wrapped_angle)
