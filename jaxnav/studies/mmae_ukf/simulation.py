"""Flights of the study: the truth that all runs share, and one run as the filters see it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.compiling import compiled, host
from jaxnav.navigation.channels.star import observe_attitude
from jaxnav.navigation.earth import meridian_radius
from jaxnav.navigation.models.sins_total import SinsTotalInput, SinsTotalParams, StarForm
from jaxnav.navigation.sense import imu_samples, initial_error, opposite_biases
from jaxnav.navigation.sensors.imu import ImuErrors, markov_error
from jaxnav.navigation.states import LAYOUT, SinsTotal, retract_total
from jaxnav.navigation.strapdown.base import NavState
from jaxnav.navigation.strapdown.increments import accumulate
from jaxnav.navigation.trajectory.base import Trajectory
from jaxnav.navigation.trajectory.boost import BoostProfile, fly_boost
from jaxnav.numerics.lie import euler_from_dcm, so3_log
from jaxnav.studies.mmae_ukf.config import MmaeUkfConfig
from jaxnav.units import ARCSEC, DEG, DEG_PER_HOUR, MICRO_G


class World(NamedTuple):
    """What all runs share.

    Attributes:
        trajectory: True motion at the inertial rate.
        epochs: True motion at the filter's epochs, leading axis ``K``.
        sample_scale: ``(N,)`` true factor on the noise variances at each inertial sample.
        step_scale: ``(K,)`` the same at each filter step.
        noise: Nominal noise of the sensors.
        prior_sigma: ``(15,)`` standard deviations of P0.
        misalignment: Size of the initial attitude error [rad]; zero draws it from P0.
    """

    trajectory: Trajectory
    epochs: NavState
    sample_scale: Array
    step_scale: Array
    noise: SinsTotalParams
    prior_sigma: Array
    misalignment: Array


class Run(NamedTuple):
    """One simulated flight as the filters see it, and the truth to judge them by.

    Attributes:
        start: The state that the filters start from.
        inputs: What the inertial sensors report, leading axis ``K``.
        z: ``(K, 3) [rad]`` what the star tracker reports.
        truth: ``(K)`` true states.
    """

    start: SinsTotal
    inputs: SinsTotalInput
    z: Array
    truth: SinsTotal


def launch_radius(config: MmaeUkfConfig) -> float:
    """Return the radius of the Earth [m]: the meridian's radius of curvature."""
    return float(compiled(meridian_radius)(config.latitude_deg * DEG))


def noise_of(config: MmaeUkfConfig) -> SinsTotalParams:
    """Return the nominal noise of the sensors."""
    return SinsTotalParams(
        gyro_noise=host.full(3, config.gyro_noise_deg_h * DEG_PER_HOUR),
        accel_noise=host.full(3, config.accel_noise_ug * MICRO_G),
        bias_sigma=host.array(config.accel_error_ug * MICRO_G),
        bias_time=host.array(config.accel_error_time_s),
        star_noise=host.full(3, config.star_noise_arcsec * ARCSEC),
    )


def prior_sigma(config: MmaeUkfConfig) -> Array:
    """Return the standard deviations ``(15,)`` of P0."""
    attitude = config.p0_attitude_arcsec * ARCSEC
    if config.scenario == "large-misalignment":
        attitude = config.misalignment_deg * DEG / 3**0.5
    return host.repeat(
        host.array(
            [
                attitude,
                config.p0_velocity,
                config.p0_position,
                config.p0_drift_deg_h * DEG_PER_HOUR,
                config.accel_error_ug * MICRO_G,
            ]
        ),
        3,
    )


def true_scale(config: MmaeUkfConfig) -> Array:
    """Return the true factor on the noise variances at each filter step ``(K,)``."""
    third = 3 * host.arange(config.steps) // config.steps
    return host.array(config.schedule)[third] ** 2


def build_world(config: MmaeUkfConfig) -> World:
    """Fly the trajectory and prepare what all runs share."""
    every = config.samples_per_step
    trajectory = fly_boost(
        BoostProfile(),
        steps=config.steps * every,
        step=config.imu_step,
        radius=launch_radius(config),
    )
    step_scale = true_scale(config)
    large = config.scenario == "large-misalignment"
    return World(
        trajectory=trajectory,
        epochs=jax.tree.map(lambda leaf: host.asarray(leaf)[every::every], trajectory.state),
        sample_scale=host.repeat(step_scale, every),
        step_scale=step_scale,
        noise=noise_of(config),
        prior_sigma=prior_sigma(config),
        misalignment=host.array(config.misalignment_deg * DEG if large else 0.0),
    )


def fly(key: Array, world: World, period: float, imu_step: float, star: StarForm) -> Run:
    """Simulate one flight: initial errors, inertial sensors, star tracker.

    Args:
        key: The run's key.
        world: What all runs share.
        period: Filter period [s].
        imu_step: Interval of the inertial samples [s].
        star: How the star tracker reports its attitude.
    """
    start_key, bias_key, imu_key, star_key = jax.random.split(key, 4)
    every = round(period / imu_step)
    error0 = _initial_error(start_key, world)
    drift, bias0 = opposite_biases(error0)
    samples = world.sample_scale.shape[0]
    bias = markov_error(
        bias_key, world.noise.bias_sigma, world.noise.bias_time, bias0, imu_step, samples
    )
    errors = ImuErrors(world.noise.gyro_noise, world.noise.accel_noise, drift, bias)
    motion = world.trajectory
    sensed = imu_samples(imu_key, motion, errors, imu_step, world.sample_scale)
    dtheta, dvel = accumulate(*sensed, every)
    seen = observe_attitude(star_key, world.epochs.dcm, world.noise.star_noise)
    report = {"rotation-vector": so3_log, "euler": euler_from_dcm}[star]
    pad = jax.tree.map(lambda leaf: leaf[0], motion.state)
    lift_off = SinsTotal(pad.dcm, pad.velocity, pad.position, jnp.zeros(3), jnp.zeros(3))
    at_epochs = jnp.concatenate([bias[every::every], bias[-1:]])
    return Run(
        start=retract_total(lift_off, error0.at[LAYOUT.eps.start :].set(0)),
        inputs=SinsTotalInput(dtheta, dvel, world.step_scale),
        z=jax.vmap(report)(seen),
        truth=SinsTotal(*world.epochs, jnp.broadcast_to(drift, at_epochs.shape), at_epochs),
    )


def _initial_error(key: Array, world: World) -> Array:
    """Draw the initial error ``(15,)`` from P0, the attitude's of a given size if there is one."""
    drawn = initial_error(key, world.prior_sigma)
    phi = drawn[LAYOUT.phi]
    sized = phi * world.misalignment / jnp.sqrt(jnp.sum(phi * phi))
    return drawn.at[LAYOUT.phi].set(jnp.where(world.misalignment > 0, sized, phi))
