"""A near-vertical sounding rocket: a smooth history of specific force and attitude."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.navigation.earth import gravity_launch_inertial
from jaxnav.navigation.strapdown.base import NavState
from jaxnav.navigation.trajectory.base import Trajectory, simpson, smooth_step
from jaxnav.numerics.lie import dcm_from_euler, so3_log
from jaxnav.numerics.ode import rk4
from jaxnav.units import DEG


class RocketProfile(NamedTuple):
    """A boost of smooth thrust and pitch, then free flight with a slow roll and a small sway.

    The pitch goes from ``pitch_start`` to ``pitch_end`` between ``pitch_over_time`` and burn-out by
    a C2 step, the axial specific force rises linearly and falls to zero over ``cutoff_time``. In
    free flight the attitude is held but for a roll at a constant rate and sinusoids on pitch and
    yaw, so that the body axes keep turning.

    Attributes:
        burn_time: End of the boost [s].
        accel_start: Axial specific force at lift-off [m/s^2].
        accel_end: Axial specific force at burn-out [m/s^2].
        pitch_start: Pitch on the rail [rad].
        pitch_end: Pitch at burn-out [rad].
        pitch_over_time: Start of the pitch-over [s].
        cutoff_time: Duration of the thrust's decay [s].
        roll_rate: Roll rate in free flight [rad/s].
        sway: Amplitude of the sinusoids in free flight [rad].
        sway_period: Their period [s].
    """

    burn_time: float = 130.0
    accel_start: float = 18.0
    accel_end: float = 45.0
    pitch_start: float = 90.0 * DEG
    pitch_end: float = 80.0 * DEG
    pitch_over_time: float = 10.0
    cutoff_time: float = 1.0
    roll_rate: float = 2.0 * DEG
    sway: float = 2.0 * DEG
    sway_period: float = 60.0


def attitude(profile: RocketProfile, time: Array) -> Array:
    """Return ``C_ib`` ``(3, 3)`` at a time [s]."""
    p = profile
    turned = smooth_step((time - p.pitch_over_time) / (p.burn_time - p.pitch_over_time))
    coast = time - p.burn_time - p.cutoff_time
    free = smooth_step(coast / 20.0)
    phase = 2 * jnp.pi * coast / p.sway_period
    pitch = p.pitch_start + (p.pitch_end - p.pitch_start) * turned
    return dcm_from_euler(
        pitch + free * p.sway * jnp.sin(phase),
        free * p.sway * jnp.cos(phase),
        free * p.roll_rate * coast,
    )


def axial_force(profile: RocketProfile, time: Array) -> Array:
    """Return the specific force along the body's x axis [m/s^2] at a time [s]."""
    p = profile
    boost = p.accel_start + (p.accel_end - p.accel_start) * time / p.burn_time
    return boost * (1 - smooth_step((time - p.burn_time) / p.cutoff_time))


@compiled(static_argnames=("steps", "step"))
def fly(profile: RocketProfile, *, steps: int, step: float, radius: Array | float) -> Trajectory:
    """Integrate the motion of the point mass and derive the perfect increments of its sensors.

    Args:
        profile: The flight.
        steps: Number of intervals ``N``.
        step: Their length [s].
        radius: Distance from the Earth's centre to the launch point [m].

    Returns:
        The trajectory; it starts at rest at the launch point. The attitude does not depend on the
        translational motion, and rotation vectors are exact.
    """
    time = step * jnp.arange(steps + 1, dtype=jnp.result_type(float))
    dcm = jax.vmap(partial(attitude, profile))(time)

    def derivative(t: Array, vr: tuple[Array, Array]) -> tuple[Array, Array]:
        v, r = vr
        force = attitude(profile, t)[:, 0] * axial_force(profile, t)
        return force + gravity_launch_inertial(r, radius), v

    def advance(vr: tuple[Array, Array], t: Array) -> tuple[tuple[Array, Array], tuple]:
        moved = rk4(derivative, t, vr, step)
        return moved, moved

    rest = (jnp.zeros(3, time.dtype), jnp.zeros(3, time.dtype))
    _, (v, r) = jax.lax.scan(advance, rest, time[:-1])
    v = jnp.concatenate([rest[0][None], v])
    r = jnp.concatenate([rest[1][None], r])
    turn = jax.vmap(lambda a, b: so3_log(a.T @ b))(dcm[:-1], dcm[1:])
    return Trajectory(time, NavState(dcm, v, r), turn, _axial_increments(profile, time, step))


def _axial_increments(profile: RocketProfile, time: Array, step: float) -> Array:
    """Return the integrals of the axial force over each interval ``(N, 3)``, by Simpson's rule."""
    force = partial(axial_force, profile)
    start, end = force(time[:-1]), force(time[1:])
    middle = force(time[:-1] + 0.5 * step)
    axial = simpson(start, middle, end, step)
    return axial[:, None] * jnp.array([[1.0, 0.0, 0.0]], time.dtype)
