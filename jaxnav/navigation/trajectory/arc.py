"""A short, strongly accelerated flight over the ellipsoid, which turns through a wide angle."""

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.navigation.earth import WGS84, Earth
from jaxnav.navigation.trajectory.base import Trajectory, smooth_step
from jaxnav.navigation.trajectory.level import Motion, fall
from jaxnav.numerics.lie import dcm_from_euler
from jaxnav.numerics.linalg import matmul, safe_norm
from jaxnav.units import DEG, STANDARD_GRAVITY


class ArcProfile(NamedTuple):
    """A boost, a pitch-over of more than a right angle, one roll, and drag.

    The axial specific force starts at ``hold``, rises to its plateau and falls to zero by C2 steps
    of ``ramp_time``; its mean over ``boost_time`` is ``mean_force``. Pitch and roll are C2 steps
    between two instants. Drag acts along the body's axis against the speed: attitude and path are
    histories, not a solution of the equations of flight.

    Attributes:
        latitude: Of the launch point [rad].
        longitude: Of the launch point [rad].
        azimuth: Of the flight, from north by east [rad].
        boost_time: End of the boost [s].
        mean_force: Mean axial specific force of the boost [m/s^2].
        hold: Axial specific force at lift-off [m/s^2].
        ramp_time: Duration of its rise, and of its fall [s].
        pitch_start: Pitch at lift-off [rad].
        pitch_end: Pitch at the end [rad].
        pitch_time: Start and end of the pitch-over [s].
        roll: Angle of the roll [rad].
        roll_time: Start and end of the roll [s].
        ballistic: Mass over reference area times drag coefficient [kg/m^2].
        air_density: At the ellipsoid [kg/m^3].
        scale_height: Height over which the density falls by the factor e [m].
    """

    latitude: float = 34.0 * DEG
    longitude: float = 108.0 * DEG
    azimuth: float = 60.0 * DEG
    boost_time: float = 20.0
    mean_force: float = 45.0
    hold: float = STANDARD_GRAVITY
    ramp_time: float = 1.0
    pitch_start: float = 85.0 * DEG
    pitch_end: float = -10.0 * DEG
    pitch_time: tuple[float, float] = (2.0, 118.0)
    roll: float = 360.0 * DEG
    roll_time: tuple[float, float] = (5.0, 65.0)
    ballistic: float = 6000.0
    air_density: float = 1.225
    scale_height: float = 7200.0


def _between(time: Array, span: tuple[float, float]) -> Array:
    return smooth_step((time - span[0]) / (span[1] - span[0]))


def dcm_ln(azimuth: Array | float) -> Array:
    """Return C_ln ``(3, 3)`` from east, north, up to downrange, up, right of an azimuth [rad]."""
    s, c = jnp.sin(jnp.asarray(azimuth)), jnp.cos(jnp.asarray(azimuth))
    zero, one = jnp.zeros_like(s), jnp.ones_like(s)
    return jnp.stack(
        [jnp.stack([s, c, zero]), jnp.stack([zero, zero, one]), jnp.stack([c, -s, zero])]
    )


def attitude(profile: ArcProfile, time: Array) -> Array:
    """Return C_nb ``(3, 3)`` at a time [s]: pitch in the plane of the azimuth, then roll."""
    p = profile
    pitch = p.pitch_start + (p.pitch_end - p.pitch_start) * _between(time, p.pitch_time)
    roll = p.roll * _between(time, p.roll_time)
    return matmul(dcm_ln(p.azimuth).T, dcm_from_euler(pitch, jnp.zeros_like(pitch), roll))


def specific_force(profile: ArcProfile, time: Array, at: Motion) -> Array:
    """Return the specific force ``(3,) [m/s^2]`` in body axes: thrust less drag."""
    p = profile
    velocity, position = at
    start = 0.5 * p.ramp_time * p.hold
    plateau = (p.mean_force * p.boost_time - start) / (p.boost_time - 0.5 * p.ramp_time)
    rise = smooth_step(time / p.ramp_time)
    fall_off = smooth_step((time - p.boost_time) / p.ramp_time + 0.5)
    thrust = p.hold + (plateau - p.hold) * rise - plateau * fall_off
    density = p.air_density * jnp.exp(-position[2] / p.scale_height)
    drag = 0.5 * density / p.ballistic * safe_norm(velocity) ** 2
    return (thrust - drag) * jnp.array([1.0, 0.0, 0.0], velocity.dtype)


@compiled(static_argnames=("steps", "step"))
def fly_arc(profile: ArcProfile, *, steps: int, step: float, earth: Earth = WGS84) -> Trajectory:
    """Integrate the motion of the point mass and derive the perfect increments of its sensors.

    Args:
        profile: The flight.
        steps: Number of intervals ``N``.
        step: Their length [s].
        earth: The Earth.

    Returns:
        The trajectory, in the local level frame; it starts at rest on the ellipsoid.
    """
    start = jnp.array([profile.latitude, profile.longitude, 0.0])
    rest = (jnp.zeros(3, start.dtype), start)
    return fall(
        partial(attitude, profile),
        partial(specific_force, profile),
        rest,
        steps=steps,
        step=step,
        earth=earth,
    )
