"""Drives of the study: the truth that all runs share, and one run as the filters see it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.compiling import host
from jaxnav.estimation.models import adapted
from jaxnav.estimation.types import Gaussian, Model, Obs, SureObs
from jaxnav.navigation.channels.gnss import GnssErrors, observe_gnss
from jaxnav.navigation.earth import displaced
from jaxnav.navigation.models.sins_gnss import SinsGnssInput, SinsGnssParams
from jaxnav.navigation.sense import Clock, sense_level
from jaxnav.navigation.states import SinsLevel
from jaxnav.navigation.trajectory.base import Trajectory
from jaxnav.navigation.trajectory.vehicle import VehicleProfile, drive, town_legs
from jaxnav.studies.sage_husa.config import SageHusaConfig
from jaxnav.units import DEG, DEG_PER_HOUR, DEG_PER_SQRT_HOUR, MICRO_G

BLOCK_S = 50.0
"""Least time that a block of the town takes [s]."""


class World(NamedTuple):
    """What all runs share.

    Attributes:
        trajectory: True motion at the inertial rate.
        noise: True noise of the sensors, as a model's parameters.
        prior_sigma: ``(15,)`` standard deviations at the start.
        added: ``(T,) [m]`` standard deviation of the noise added to east and north of each fix.
    """

    trajectory: Trajectory
    noise: SinsGnssParams
    prior_sigma: Array
    added: Array


class DriveInput(NamedTuple):
    """Input of a step.

    Attributes:
        sensed: What the inertial sensors report.
        added: ``() [m]`` standard deviation of the noise added to east and north of the fix, for
            the filters that know it.
    """

    sensed: SinsGnssInput
    added: Array


class DriveParams(NamedTuple):
    """Parameters of :func:`informed`.

    Attributes:
        own: Those of the model.
        knows: One for a filter that knows of the added noise, zero for others.
    """

    own: SinsGnssParams
    knows: Array | float


class Run(NamedTuple):
    """One simulated drive as the filters see it, and the truth to judge them by.

    Attributes:
        start: What is known at the start; the covariance is that of additive errors.
        inputs: Inputs of the filters, leading axis ``T``.
        fixes: Observations, leading axis ``T``.
        truth: True states at the fixes.
    """

    start: Gaussian
    inputs: DriveInput
    fixes: Obs
    truth: SinsLevel


def informed(model: Model) -> Model:
    """Return the model of SINS/GNSS whose fixes have added noise, for those who know it."""

    def observation_noise(params: DriveParams, x: SinsLevel, u: DriveInput) -> Array:
        horizontal = jnp.array([0.0, 0.0, 0.0, 1.0, 1.0, 0.0], u.added.dtype)
        extra = params.knows * u.added**2 * horizontal
        return model.observation_noise(params.own, x, u.sensed) + extra

    own = adapted(model, lambda params: params.own, lambda u: u.sensed)
    return own._replace(observation_noise=observation_noise)


def clock_of(config: SageHusaConfig) -> Clock:
    """Return the static part of a configuration that a drive depends on."""
    return Clock(1 / config.ins_rate_hz, config.samples_per_step)


def noise_of(config: SageHusaConfig, vrw: float) -> SinsGnssParams:
    """Return the noise of sensors and receiver in SI, with a velocity random walk."""
    none = host.zeros(3)
    return SinsGnssParams(
        gyro_noise=host.full(3, config.arw_deg_sqrt_h * DEG_PER_SQRT_HOUR),
        accel_noise=host.full(3, vrw),
        gyro_walk=none,
        accel_walk=none,
        velocity_noise=host.full(3, config.gnss_velocity),
        position_noise=host.full(3, config.gnss_position),
        lever_arm=none,
    )


def build_world(config: SageHusaConfig) -> World:
    """Drive the profile and prepare what all runs share."""
    legs = town_legs(int(config.duration_s / BLOCK_S) + 1)
    others = (
        config.p0_velocity,
        config.p0_position,
        config.gyro_drift_deg_h * DEG_PER_HOUR,
        config.accel_bias_mg * 1e3 * MICRO_G,
    )
    attitude = host.array(config.p0_attitude_deg) * DEG
    step, samples = 1 / config.ins_rate_hz, config.steps * config.samples_per_step
    return World(
        trajectory=drive(VehicleProfile(legs), steps=samples, step=step),
        noise=noise_of(config, config.true_vrw),
        prior_sigma=host.concatenate([attitude, host.repeat(host.array(others), 3)]),
        added=added_noise(config),
    )


def added_noise(config: SageHusaConfig) -> Array:
    """Return the standard deviation of the noise added to east and north of each fix ``(T,)``."""
    time = config.fix_interval_s * host.arange(1, config.steps + 1, dtype=float)
    first, second = (within(time, span) for span in (config.first_noise_s, config.second_noise_s))
    return host.where(first, config.first_noise, host.where(second, config.second_noise, 0.0))


def within(time: Array, span: tuple[float, float]) -> Array:
    """Return which times are in an interval that is open at its start."""
    return (time > span[0]) & (time <= span[1])


def drive_run(key: Array, world: World, clock: Clock) -> Run:
    """Simulate one drive.

    Args:
        key: The run's key.
        world: What all runs share.
        clock: Rates.
    """
    start_key, imu_key, gnss_key, added_key = jax.random.split(key, 4)
    seen = sense_level(start_key, imu_key, world.trajectory, world.noise, world.prior_sigma, clock)
    fixes = GnssErrors(world.noise.velocity_noise, world.noise.position_noise)
    z = observe_gnss(gnss_key, seen.truth.velocity, seen.truth.position, fixes)
    white = jax.random.normal(added_key, (z.shape[0], 2), z.dtype)
    offset = jnp.pad(white * world.added[:, None], ((0, 0), (0, 1)))
    z = jnp.concatenate([z[:, :3], jax.vmap(displaced)(z[:, 3:], offset)], axis=1)
    inputs = DriveInput(seen.inputs, world.added)
    return Run(seen.start, inputs, SureObs(z, jnp.ones(z.shape, bool)), seen.truth)
