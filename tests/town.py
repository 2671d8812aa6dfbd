"""A simulated drive for tests of sensors and of the states that they need: truth, inputs, fixes."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.navigation.channels.gnss import GnssErrors, antenna_motion, observe_gnss
from jaxnav.navigation.earth import earth_rate
from jaxnav.navigation.models.sins_gnss import SinsGnssParams
from jaxnav.navigation.sense import Clock, SensedRun, sense_level
from jaxnav.navigation.states import SinsLevel
from jaxnav.navigation.trajectory.vehicle import Leg, VehicleProfile, drive
from jaxnav.numerics.linalg import matmul
from jaxnav.units import DEG, DEG_PER_HOUR, DEG_PER_SQRT_HOUR, MICRO_G

CLOCK = Clock(imu_step=0.02, samples_per_step=5)
PRIOR = jnp.repeat(jnp.array([0.5 * DEG, 0.1, 1.0, 20 * DEG_PER_HOUR, 1e3 * MICRO_G]), 3)
"""Standard deviations ``(15,)`` at the start."""
NOISE = SinsGnssParams(
    gyro_noise=jnp.full(3, 0.3 * DEG_PER_SQRT_HOUR),
    accel_noise=jnp.full(3, 2e-3),
    gyro_walk=jnp.zeros(3),
    accel_walk=jnp.zeros(3),
    velocity_noise=jnp.full(3, 0.03),
    position_noise=jnp.array([0.3, 0.3, 0.5]),
    lever_arm=jnp.zeros(3),
)


class Drive(NamedTuple):
    """A drive on the filters' clock, K steps of a tenth of a second.

    Attributes:
        sensed: Inputs, errors and true states.
        rate: ``(K, 3)`` true angular rate against the Earth at the ends of the steps [rad/s].
        fixes: ``(K, 6)`` velocity and position of the antenna with noise, at every step.
        each_second: ``(K,)`` whether a step ends a second.
    """

    sensed: SensedRun
    rate: Array
    fixes: Array
    each_second: np.ndarray


@compiled(static_argnames=("legs", "seconds"))
def _driven(
    key: Array, arm: Array, noise: SinsGnssParams, *, legs: tuple[Leg, ...], seconds: int
) -> tuple[SensedRun, Array, Array]:
    start_key, imu_key, fix_key = jax.random.split(key, 3)
    steps = round(seconds / CLOCK.imu_step)
    motion = drive(VehicleProfile(legs), steps=steps, step=CLOCK.imu_step)
    sensed = sense_level(start_key, imu_key, motion, noise, PRIOR, CLOCK)
    every = CLOCK.samples_per_step
    inertial = motion.dtheta[every - 1 :: every] / CLOCK.imu_step

    def at_antenna(x: SinsLevel, w: Array) -> tuple[Array, Array, Array]:
        own = w - matmul(x.dcm.T, earth_rate(x.position[0]))
        return (own, *antenna_motion(x.dcm, x.velocity, x.position, own, arm))

    rate, velocity, position = jax.vmap(at_antenna)(sensed.truth, inertial)
    errors = GnssErrors(noise.velocity_noise, noise.position_noise)
    return sensed, rate, observe_gnss(fix_key, velocity, position, errors)


def driven(
    seed: int | Array,
    legs: tuple[Leg, ...],
    seconds: int,
    arm: Array | None = None,
    noise: SinsGnssParams = NOISE,
) -> Drive:
    """Drive over level ground with an antenna at the end of an arm ``(3,) [m]``."""
    arm = jnp.zeros(3) if arm is None else arm
    key = jax.random.key(seed)
    sensed, rate, fixes = _driven(key, arm, noise, legs=legs, seconds=seconds)
    steps = round(seconds / CLOCK.step)
    return Drive(sensed, rate, fixes, np.arange(1, steps + 1) % round(1 / CLOCK.step) == 0)
