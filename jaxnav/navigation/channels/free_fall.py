"""Accelerometers of a vehicle in free fall: what they report is their bias.

References:
    Shi, Chen, Wang (2023), Eqs. (40)-(42).
"""

from jax import Array

from jaxnav.estimation.models import Channel
from jaxnav.estimation.types import Input, Params, Point


def free_fall(period: float, imu_step: float) -> Channel:
    """Return the channel ``(3,)`` of the accelerometers' mean output [m/s^2], body axes.

    Its parameters have ``accel_noise``, ``(3,) [m/s^2]`` standard deviation of one sample.

    Args:
        period: Period of the filters, over which samples are averaged [s].
        imu_step: Interval of the inertial samples [s].
    """

    def noise(params: Params, x: Point, u: Input) -> Array:
        del x, u
        return params.accel_noise**2 * (imu_step / period)

    return Channel(3, lambda params, x, u: x.bias, noise)
