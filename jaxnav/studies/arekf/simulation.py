"""Flights of the study: the truth that all runs share, and one run as the filters see it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.compiling import host
from jaxnav.estimation.types import Gaussian, Obs, SureObs
from jaxnav.navigation.channels.gnss import GnssErrors, observe_gnss
from jaxnav.navigation.earth import earth_rate, normal_gravity
from jaxnav.navigation.models.sins_gnss import SinsGnssInput, SinsGnssParams
from jaxnav.navigation.sense import Clock, sense_level
from jaxnav.navigation.sensors.allan import allan_variance, cluster_sizes, slope_rule
from jaxnav.navigation.sensors.imu import ImuErrors, corrupt
from jaxnav.navigation.states import SinsLevel
from jaxnav.navigation.trajectory.arc import ArcProfile, fly_arc
from jaxnav.navigation.trajectory.base import Trajectory
from jaxnav.studies.arekf.config import ArekfConfig, Sensor
from jaxnav.units import DEG, DEG_PER_HOUR, DEG_PER_SQRT_HOUR, HOUR, MICRO_G

LONGEST_CLUSTER_S = 0.35
"""Longest cluster time that the noise is read from [s]: beyond, drifts and few terms decide."""


class World(NamedTuple):
    """What all runs share.

    Attributes:
        trajectory: True motion at the inertial rate.
        noise: True noise of the sensors, as a model's parameters.
        fixes: Errors of the receiver.
        prior_sigma: ``(15,)`` standard deviations at launch.
    """

    trajectory: Trajectory
    noise: SinsGnssParams
    fixes: GnssErrors
    prior_sigma: Array


class Timing(NamedTuple):
    """What fixes the shape of a flight: the static part of a configuration."""

    clock: Clock
    steps_per_fix: int
    steps_per_record: int
    static_samples: int


class Run(NamedTuple):
    """One simulated flight as the filters see it, and the truth to judge them by.

    Attributes:
        start: What is known at launch; the covariance is that of additive errors.
        identified: Angle and velocity random walk from the record at rest, ``(3,)`` each.
        inputs: Inputs of the filters, leading axis ``K``.
        fixes: Observations, leading axis ``K``.
        truth: True states at the records.
    """

    start: Gaussian
    identified: tuple[Array, Array]
    inputs: SinsGnssInput
    fixes: Obs
    truth: SinsLevel


def timing_of(config: ArekfConfig) -> Timing:
    """Return the static part of a configuration that a flight depends on."""
    return Timing(
        Clock(config.imu_step, config.samples_per_step),
        config.steps_per_fix,
        config.steps_per_record,
        config.static_samples,
    )


def noise_of(sensor: Sensor, position: float) -> SinsGnssParams:
    """Return the noise of a grade of sensors with their receiver, in SI.

    Args:
        sensor: The grade.
        position: Standard deviation of a GNSS position [m].
    """
    none = host.zeros(3)
    return SinsGnssParams(
        gyro_noise=host.full(3, sensor.arw * DEG_PER_SQRT_HOUR),
        accel_noise=host.full(3, sensor.vrw / HOUR**0.5),
        gyro_walk=none,
        accel_walk=none,
        velocity_noise=host.full(3, sensor.velocity),
        position_noise=host.full(3, position),
        lever_arm=none,
    )


def prior_sigma(config: ArekfConfig, sensor: Sensor) -> Array:
    """Return the standard deviations ``(15,)`` at launch with a grade of sensors."""
    east, north, up = config.p0_attitude_deg
    heading = config.heading_deg if config.scenario == "large-heading-error" else up
    others = (
        config.p0_velocity,
        config.p0_position,
        sensor.drift * DEG_PER_HOUR,
        sensor.bias * 1e3 * MICRO_G,
    )
    return host.concatenate(
        [host.array([east, north, heading]) * DEG, host.repeat(host.array(others), 3)]
    )


def build_world(config: ArekfConfig) -> World:
    """Fly the trajectory and prepare what all runs share."""
    samples = config.steps * config.samples_per_step
    noise = noise_of(config.sensor, config.gnss_position)
    spoiled = config.scenario == "outliers"
    return World(
        trajectory=fly_arc(ArcProfile(), steps=samples, step=config.imu_step),
        noise=noise,
        fixes=GnssErrors(
            noise.velocity_noise,
            noise.position_noise,
            host.array(config.outlier_share if spoiled else 0.0),
            host.array(config.outlier_scale),
        ),
        prior_sigma=prior_sigma(config, config.sensor),
    )


def fly_run(key: Array, world: World, timing: Timing) -> Run:
    """Simulate one flight: a record at rest, then inertial sensors and receiver in flight.

    Args:
        key: The run's key.
        world: What all runs share.
        timing: Rates and periods.
    """
    start_key, static_key, imu_key, gnss_key = jax.random.split(key, 4)
    seen = sense_level(
        start_key, imu_key, world.trajectory, world.noise, world.prior_sigma, timing.clock
    )
    steps = seen.inputs.dt.shape[0]
    z = observe_gnss(gnss_key, seen.truth.velocity, seen.truth.position, world.fixes)
    arrived = jnp.arange(1, steps + 1) % timing.steps_per_fix == 0
    records = slice(timing.steps_per_record - 1, None, timing.steps_per_record)
    return Run(
        start=seen.start,
        identified=_identified(static_key, world, seen.errors, timing),
        inputs=seen.inputs,
        fixes=SureObs(z, jnp.broadcast_to(arrived[:, None], z.shape)),
        truth=jax.tree.map(lambda leaf: leaf[records], seen.truth),
    )


def _identified(key: Array, world: World, errors: ImuErrors, timing: Timing) -> tuple[Array, Array]:
    """Return the random walks ``(3,)`` of gyros and accelerometers that a record at rest shows."""
    step = timing.clock.imu_step
    pad = jax.tree.map(lambda leaf: leaf[0], world.trajectory.state)
    latitude, height = pad.position[0], pad.position[2]
    up = normal_gravity(latitude, height) * jnp.array([0.0, 0.0, 1.0], latitude.dtype)
    still = pad.dcm.T @ earth_rate(latitude), pad.dcm.T @ up
    shape = (timing.static_samples, 3)
    at_rest = [jnp.broadcast_to(step * mean, shape) for mean in still]
    quiet = jnp.ones(shape[0], latitude.dtype)
    increments = corrupt(key, errors, at_rest[0], at_rest[1], step, quiet)
    longest = LONGEST_CLUSTER_S / (timing.static_samples * step)
    sizes = cluster_sizes(timing.static_samples, longest=longest)

    def walk(samples: Array) -> Array:
        rate = samples / step
        return slope_rule(allan_variance(rate, step, sizes))

    gyro, accel = (jax.vmap(walk, in_axes=1)(samples) for samples in increments)
    return gyro, accel
