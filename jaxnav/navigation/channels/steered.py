"""A vehicle that moves the way it points: to the side and upwards only by slip and springs.

    0 = (M (C' v + w x l_axle)) in y and z,   M = exp([mounting]x)

References:
    Dissanayake, Sukkarieh, Nebot, Durrant-Whyte (2001), IEEE Trans. Robotics and Automation 17(5);
    Groves (2013), section 15.4.1.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.models import Channel
from jaxnav.estimation.types import Input, Params
from jaxnav.navigation.earth import WGS84, Earth, earth_rate
from jaxnav.navigation.states import LAYOUT, ErrorForm, SinsLevel
from jaxnav.numerics.lie import so3_exp
from jaxnav.numerics.linalg import matmul


class Axle(NamedTuple):
    """What the channel has to know at a step.

    Attributes:
        arm: From the inertial sensors to the middle of the rear axle ``(3,) [m]``, sensors' axes.
        mounting: ``(3,) [rad]`` rotation vector that takes the sensors' axes to the vehicle's
            (x forward, y left, z up): ``exp([mounting]x) v_body``.
        rate: Angular rate as measured ``(3,) [rad/s]``, sensors' axes.
        sigma: ``(2,) [m/s]`` standard deviation of the lateral and vertical velocity.
    """

    arm: Array
    mounting: Array
    rate: Array
    sigma: Array


def axle_velocity(axle: Axle, x: SinsLevel, earth: Earth = WGS84) -> Array:
    """Return the velocity of an axle ``(3,) [m/s]`` in the vehicle's axes."""
    turning = axle.rate - x.drift - matmul(x.dcm.T, earth_rate(x.position[0], earth))
    v = matmul(x.dcm.T, x.velocity) + jnp.cross(turning, axle.arm)
    return matmul(so3_exp(axle.mounting), v)


def steered(
    axle: Callable[[Params, SinsLevel, Input], Axle], form: ErrorForm, earth: Earth = WGS84
) -> Channel:
    """Return the channel ``(2,)`` of lateral and vertical velocity, which are seen to be zero.

    Its derivative leaves out how Earth rate turns with the attitude.

    Args:
        axle: ``(params, x, u) -> Axle`` of the model.
        form: The definition of the state's error.
        earth: The Earth.
    """

    def observe(params: Params, x: SinsLevel, u: Input) -> Array:
        return axle_velocity(axle(params, x, u), x, earth)[1:]

    def differential(params: Params, x: SinsLevel, u: Input) -> Callable[[Array], Array]:
        a, s = axle(params, x, u), LAYOUT
        M = so3_exp(a.mounting)

        def seen(dx: Array) -> Array:
            d = form.to_additive(x, dx)
            turned = matmul(x.dcm.T, d[s.dv] - jnp.cross(d[s.phi], x.velocity))
            return matmul(M, turned - jnp.cross(d[s.eps], a.arm))[1:]

        return seen

    return Channel(
        2, observe, lambda params, x, u: axle(params, x, u).sigma ** 2, differential=differential
    )
