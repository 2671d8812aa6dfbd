"""Initial attitude of a vehicle at rest or on its way: levelling, gyro-compassing, a given heading.

The functions take averages of the sensors ``(3,)`` in body axes and return C_nb, from body axes to
east, north, up. Any body axes will do: a heading is that of a given body axis.
"""

import jax.numpy as jnp
from jax import Array

from jaxnav.navigation.earth import WGS84, Earth, earth_rate
from jaxnav.numerics.linalg import matmul, safe_norm

FORWARD = (1.0, 0.0, 0.0)
"""The body axis that a heading refers to unless told otherwise."""
MIN_COURSE_SPEED = 1.0
"""Speed [m/s] below which the direction of a velocity says little of a heading."""


def align_with_heading(
    force: Array, heading: Array | float, axis: tuple[float, float, float] = FORWARD
) -> Array:
    """Return C_nb ``(3, 3)`` by levelling with gravity and a heading from elsewhere.

    At rest the specific force points up; its error of ``b`` tilts the result by ``b / g``.

    Args:
        force: Mean specific force ``(3,)`` at rest, body axes, in any unit.
        heading: Direction of ``axis`` over ground, from north by east [rad].
        axis: Body axis that the heading is of; not vertical.
    """
    up = force / safe_norm(force)
    towards = jnp.asarray(axis, force.dtype)
    ahead = towards - jnp.sum(towards * up) * up
    ahead = ahead / safe_norm(ahead)
    left = jnp.cross(up, ahead)
    s, c = jnp.sin(jnp.asarray(heading, force.dtype)), jnp.cos(jnp.asarray(heading, force.dtype))
    zero, one = jnp.zeros_like(s), jnp.ones_like(s)
    level = jnp.stack(
        [jnp.stack([s, -c, zero]), jnp.stack([c, s, zero]), jnp.stack([zero, zero, one])]
    )
    return matmul(level, jnp.stack([ahead, left, up]))


def gyro_compass(force: Array, rate: Array) -> Array:
    """Return C_nb ``(3, 3)`` from gravity and the Earth's rate, for gyros that resolve it.

    East is across the mean rate and up. A drift of ``e`` turns the heading by
    ``e / (w_ie cos L)``: 1 deg for 0.2 deg/h at middle latitudes.

    Args:
        force: Mean specific force ``(3,)`` at rest, body axes.
        rate: Mean angular rate ``(3,) [rad/s]`` at rest, body axes.
    """
    up = force / safe_norm(force)
    east = jnp.cross(rate, up)
    east = east / safe_norm(east)
    return jnp.stack([east, jnp.cross(up, east), up])


def course_heading(velocity: Array) -> tuple[Array, Array]:
    """Return the direction of a velocity from north by east [rad], and whether it may be used.

    For vehicles that move the way they point: the heading of a car from its GNSS velocity.

    Args:
        velocity: ``(3,) [m/s]`` east, north, up.
    """
    speed = safe_norm(velocity[:2])
    usable = speed >= MIN_COURSE_SPEED
    east, north = jnp.where(usable, velocity[0], 0), jnp.where(usable, velocity[1], 1)
    return jnp.arctan2(east, north), usable


def static_biases(
    dcm: Array, force: Array, rate: Array, latitude: Array, gravity: Array, earth: Earth = WGS84
) -> tuple[Array, Array]:
    """Return gyro drift and accelerometer bias ``(3,)`` that explain averages at rest.

    What gravity and the Earth's rate would give at the attitude is taken off. After levelling, the
    bias is known along the vertical only; its other components are in the tilt.

    Args:
        dcm: C_nb at rest.
        force: Mean specific force ``(3,) [m/s^2]``, body axes.
        rate: Mean angular rate ``(3,) [rad/s]``, body axes.
        latitude: Geodetic [rad].
        gravity: Normal gravity [m/s^2].
        earth: The Earth.
    """
    up = gravity * jnp.array([0.0, 0.0, 1.0], force.dtype)
    still = matmul(dcm.T, earth_rate(latitude, earth))
    return rate - still, force - matmul(dcm.T, up)
