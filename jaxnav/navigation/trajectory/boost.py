"""The boost phase of a launcher: a planar point mass on a programme of pitch."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.navigation.earth import GM, gravity_launch_inertial
from jaxnav.navigation.strapdown.base import NavState
from jaxnav.navigation.trajectory.base import Trajectory, simpson, smooth_step
from jaxnav.numerics.lie import dcm_from_euler
from jaxnav.numerics.linalg import matmul
from jaxnav.numerics.ode import rk4
from jaxnav.units import DEG


class BoostProfile(NamedTuple):
    """A burn at constant thrust and flow of mass, with a pitch-over between two instants.

    The paper prints no numbers for the vehicle, so all defaults are ours. Over 300 s the thrust per
    mass rises from 16 to 45 m/s^2, which at a constant flow is an exhaust velocity of 7.4 km/s: the
    one stage stands for several. The engine burns for as long as the motion is asked for, which
    must end before the mass does, after 465 s by default.

    Attributes:
        thrust: Thrust ``P`` [N].
        mass: Mass at lift-off [kg].
        mass_flow: Loss of mass [kg/s].
        drag_area: Reference area times drag coefficient [m^2].
        air_density: Density of the air at the launch point [kg/m^3].
        scale_height: Height over which it falls by the factor e [m].
        pitch_start: Pitch ``theta_0`` until ``pitch_over_time`` [rad].
        pitch_end: Pitch ``theta_k`` from ``pitch_end_time`` [rad].
        pitch_over_time: Start of the pitch-over ``t1`` [s].
        pitch_end_time: End of the pitch-over ``t2`` [s].
    """

    thrust: float = 480e3
    mass: float = 30e3
    mass_flow: float = 64.5
    drag_area: float = 0.5
    air_density: float = 1.225
    scale_height: float = 7200.0
    pitch_start: float = 90.0 * DEG
    pitch_end: float = 75.0 * DEG
    pitch_over_time: float = 10.0
    pitch_end_time: float = 110.0


class _Motion(NamedTuple):
    """Speed ``() [m/s]`` along the body's x axis, and position ``(3,) [m]``."""

    speed: Array
    position: Array


def pitch(profile: BoostProfile, time: Array) -> Array:
    """Return the pitch [rad] at a time [s], which is also the flight-path angle.

    A C2 step from ``theta_0`` at ``t1`` to ``theta_k`` at ``t2``. The paper's
    ``theta_k + (theta_0 - theta_k) (t2 - t)^2 / (t2 - t1)^2`` jumps in rate at ``t1``, by
    ``2 (theta_0 - theta_k) / (t2 - t1)``, which no gyro would report and no vehicle would fly.

    References:
        Zhao, Chen, He, Ge (2018), IEEE/CAA JAS 5(6), Eq. (32), where ``theta_k`` is printed within
        the denominator.
    """
    p = profile
    turned = smooth_step((time - p.pitch_over_time) / (p.pitch_end_time - p.pitch_over_time))
    return p.pitch_start + (p.pitch_end - p.pitch_start) * turned


def _derivative(profile: BoostProfile, radius: Array | float, time: Array, at: _Motion) -> _Motion:
    """Return the rates of the motion, Eq. (31)."""
    p, theta = profile, pitch(profile, time)
    x, y = at.position[0], at.position[1]
    density = p.air_density * jnp.exp(-y / p.scale_height)
    drag = 0.5 * density * p.drag_area * at.speed**2
    gravity = GM / (x**2 + (radius + y) ** 2)
    sine = jnp.sin(theta)
    rate = (p.thrust - drag) / (p.mass - p.mass_flow * time) - gravity * sine
    direction = jnp.stack([jnp.cos(theta), sine, jnp.zeros_like(sine)])
    return _Motion(rate, at.speed * direction)


def _attitude(profile: BoostProfile, time: Array) -> Array:
    """Return ``C_ib`` ``(3, 3)`` at a time: the body's x axis lies along the velocity."""
    theta = pitch(profile, time)
    return dcm_from_euler(theta, jnp.zeros_like(theta), jnp.zeros_like(theta))


def _specific_force(
    profile: BoostProfile, radius: Array | float, time: Array, at: _Motion
) -> Array:
    """Return the specific force ``(3,) [m/s^2]`` in body axes, Eqs. (33) and (34)."""
    _, turn_rate = jax.jvp(partial(pitch, profile), (time,), (jnp.ones_like(time),))
    along = _derivative(profile, radius, time, at).speed
    acceleration = jnp.stack([along, at.speed * turn_rate, jnp.zeros_like(along)])
    gravity = gravity_launch_inertial(at.position, radius)
    return acceleration - matmul(_attitude(profile, time).T, gravity)


@compiled(static_argnames=("steps", "step"))
def fly_boost(
    profile: BoostProfile, *, steps: int, step: float, radius: Array | float
) -> Trajectory:
    """Integrate the point mass and derive the perfect increments of its sensors.

        v' = (P - X_d) / m - g sin(theta),  x' = v cos(theta),  y' = v sin(theta)
        g = GM / (x^2 + (radius + y)^2)

    The attitude has the body's x axis along the velocity (no angle of attack), so the inertial
    acceleration is ``v' e_t + v theta' e_n``, and the specific force is that less the gravitation.
    The scalar ``g`` of the paper acts along -y, whereas gravitation points to the centre of the
    Earth: the motion is the paper's, and the specific force is against
    :func:`~jaxnav.navigation.earth.gravity_launch_inertial`, so that it absorbs the difference and
    sensors and motion agree exactly. Its normal component is what the prescribed pitch demands.

    Args:
        profile: The flight.
        steps: Number of intervals ``N``.
        step: Their length [s].
        radius: Distance from the Earth's centre to the launch point [m].

    Returns:
        The trajectory; it starts at rest at the launch point. Rotation vectors are exact, velocity
        increments are by Simpson's rule.

    References:
        Zhao, Chen, He, Ge (2018), IEEE/CAA JAS 5(6), Eqs. (31)-(34). Our deviations: the C2 pitch
        programme, and a drag ``X_d`` of an exponential atmosphere and a constant coefficient, of
        which the paper says nothing.
    """
    # Half steps, so that Simpson's rule has the motion in the middle of each interval.
    half = 0.5 * step
    time = half * jnp.arange(2 * steps + 1, dtype=jnp.result_type(float))
    derivative = partial(_derivative, profile, radius)

    def advance(at: _Motion, t: Array) -> tuple[_Motion, _Motion]:
        moved = rk4(derivative, t, at, half)
        return moved, moved

    rest = _Motion(jnp.zeros((), time.dtype), jnp.zeros(3, time.dtype))
    _, moved = jax.lax.scan(advance, rest, time[:-1])
    motion = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), rest, moved)
    force = jax.vmap(partial(_specific_force, profile, radius))(time, motion)
    dvel = simpson(force[:-1:2], force[1::2], force[2::2], step)

    ends = time[::2]
    dcm = jax.vmap(partial(_attitude, profile))(ends)
    velocity = motion.speed[::2, None] * dcm[:, :, 0]
    turned = jnp.diff(pitch(profile, ends))
    dtheta = turned[:, None] * jnp.array([[0.0, 0.0, 1.0]], time.dtype)
    return Trajectory(ends, NavState(dcm, velocity, motion.position[::2]), dtheta, dvel)
