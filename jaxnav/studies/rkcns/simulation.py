"""Flights of the study: the truth that all runs share, and one run as the filters see it."""

from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.compiling import compiled, host
from jaxnav.config import require
from jaxnav.datasets.stars import load_stars
from jaxnav.estimation.filters.kalman import ekf
from jaxnav.estimation.run import run
from jaxnav.estimation.types import FilterParams, Gaussian, SureObs
from jaxnav.navigation.atmosphere import RefractionTable, tabulate
from jaxnav.navigation.channels.refraction import Camera, measure, pick, view
from jaxnav.navigation.channels.star import observe_attitude
from jaxnav.navigation.earth import MEAN_RADIUS
from jaxnav.navigation.limb import seen_refraction
from jaxnav.navigation.models.sins_rkcns import SinsRkcnsInput, observations
from jaxnav.navigation.models.sins_total import SinsTotalInput, SinsTotalParams, sins_total
from jaxnav.navigation.sense import imu_samples, initial_error, opposite_biases, true_states
from jaxnav.navigation.sensors.imu import ImuErrors
from jaxnav.navigation.stars import StarCatalogue, brighter, dcm_launch_icrs, directions
from jaxnav.navigation.states import LAYOUT, SinsTotal, retract_total
from jaxnav.navigation.strapdown.increments import accumulate
from jaxnav.navigation.trajectory.base import Trajectory
from jaxnav.navigation.trajectory.rocket import RocketProfile, fly
from jaxnav.studies.rkcns.config import RkcnsConfig
from jaxnav.units import ARCSEC, DEG, DEG_PER_HOUR, DEG_PER_SQRT_HOUR, MICRO_G

LEAST_SLOTS = 3
"""Fewest places for stars in the observations: one program serves up to so many."""


class Limb(NamedTuple):
    """The refracted stars of each epoch, in ``n`` places.

    Attributes:
        star: ``(K, n, 3)`` true directions in launch-inertial axes.
        seen: ``(K, n)`` whether there is such a star.
        height: ``(K, n) [m]`` tangent heights of their rays in the nominal atmosphere.
    """

    star: Array
    seen: Array
    height: Array


class World(NamedTuple):
    """What all runs share.

    Attributes:
        trajectory: True motion at the inertial rate.
        limb: Refracted stars at the filters' epochs.
        atmosphere: The traced atmosphere.
        noise: Noise of the sensors, as the dead reckoning and the conventional system know it.
        refraction_noise: Standard deviation of a refraction angle [rad].
        density_error: Relative standard deviation of the atmosphere's density.
        prior_sigma: ``(15,)`` standard deviations at launch.
        lost: Standard deviation of the position lost at the start of the filters [m].
    """

    trajectory: Trajectory
    limb: Limb
    atmosphere: RefractionTable
    noise: SinsTotalParams
    refraction_noise: Array
    density_error: Array
    prior_sigma: Array
    lost: Array


class Timing(NamedTuple):
    """What fixes the shape of a flight: the static part of a configuration."""

    imu_step: float
    launch_period: float
    period: float
    launch_samples: int


class Run(NamedTuple):
    """One simulated flight as the filters see it, and the truth to judge them by.

    Attributes:
        start: What dead reckoning knows when the filters start.
        conventional: Inputs of the conventional system, leading axis ``K``.
        limb: Inputs of the system with refraction, likewise; they carry the true states.
        density: True density of the atmosphere relative to the model.
        z: ``(K, 6 + n)`` observations, refraction as differences of heights; the first three are
            the conventional system's.
        valid: ``(K, 6 + n)``.
        truth: ``(K)`` true states.
    """

    start: Gaussian
    conventional: SinsTotalInput
    limb: SinsRkcnsInput
    density: Array
    z: Array
    valid: Array
    truth: SinsTotal


def timing_of(config: RkcnsConfig) -> Timing:
    """Return the static part of a configuration that a flight depends on."""
    return Timing(
        config.imu_step, config.launch_period_s, config.filter_period_s, config.launch_samples
    )


def noise_of(config: RkcnsConfig) -> SinsTotalParams:
    """Return the noise of the inertial sensors per sample, and that of the star tracker."""
    per_sample = config.imu_step**-0.5
    walk = config.random_walk * DEG_PER_SQRT_HOUR * per_sample
    return SinsTotalParams(
        gyro_noise=host.full(3, walk),
        accel_noise=host.full(3, config.accel_noise_ug_sqrt_hz * MICRO_G * per_sample),
        bias_sigma=host.array(config.accel_bias_ug * MICRO_G),
        bias_time=host.array(host.inf),
        star_noise=host.full(3, config.star_noise_arcsec * ARCSEC),
    )


def prior_sigma(config: RkcnsConfig) -> Array:
    """Return the standard deviations ``(15,)`` at launch."""
    return host.concatenate(
        [
            host.array(config.p0_attitude_arcsec) * ARCSEC,
            host.repeat(
                host.array(
                    [
                        config.p0_velocity,
                        config.p0_position,
                        config.gyro_drift_deg_h * DEG_PER_HOUR,
                        config.accel_bias_ug * MICRO_G,
                    ]
                ),
                3,
            ),
        ]
    )


def build_world(config: RkcnsConfig) -> World:
    """Fly the trajectory, look for stars at the limb, and prepare what all runs share.

    Raises:
        DataError: If the star table is missing or malformed.
    """
    every = config.samples_per_step
    samples = config.launch_samples + config.steps * every
    trajectory = fly(RocketProfile(), steps=samples, step=config.imu_step, radius=MEAN_RADIUS)
    atmosphere = standard_atmosphere()
    epochs = trajectory.state.position[config.launch_samples + every :: every]
    return World(
        trajectory=trajectory,
        limb=find_stars(config, atmosphere, epochs),
        atmosphere=atmosphere,
        noise=noise_of(config),
        refraction_noise=host.array(config.refraction_noise * ARCSEC),
        density_error=host.array(config.density_error),
        prior_sigma=prior_sigma(config),
        lost=host.array(config.lost),
    )


def stars_of(config: RkcnsConfig) -> StarCatalogue:
    """Return the stars that the sensors see.

    Raises:
        DataError: If the star table is missing or malformed.
        ConfigError: If none is bright enough.
    """
    catalogue = load_stars(config.catalogue)
    brightest = catalogue.magnitude.min()
    limit = config.magnitude_limit
    require(limit >= brightest, "magnitude_limit", limit, f"{brightest:g}, the brightest, or above")
    return brighter(catalogue, limit)


def slots_of(config: RkcnsConfig) -> int:
    """Return the number of places for stars in an observation."""
    return max(config.stars, LEAST_SLOTS)


def find_stars(config: RkcnsConfig, atmosphere: RefractionTable, positions: Array) -> Limb:
    """Choose the refracted stars at true positions ``(K, 3) [m]`` from the launch point.

    Raises:
        DataError: If the star table is missing or malformed.
    """
    catalogue = stars_of(config)
    launch = dcm_launch_icrs(
        config.latitude_deg * DEG, config.sidereal_deg * DEG, config.azimuth_deg * DEG
    )
    sky = jnp.asarray(directions(catalogue, config.year)) @ jnp.asarray(launch).T
    band = 1e3 * jnp.array(config.tangent_km)
    slots = slots_of(config)
    limb = _choose(slots, atmosphere, sky, jnp.asarray(catalogue.magnitude), band, positions)
    return limb._replace(seen=limb.seen & (jnp.arange(slots) < config.stars)[None])


@compiled(static_argnums=0)
def _choose(
    slots: int,
    atmosphere: RefractionTable,
    sky: Array,
    magnitudes: Array,
    band: Array,
    positions: Array,
) -> Limb:
    """Choose stars at positions ``(K, 3)`` for a camera that sees all round."""
    camera = Camera(jnp.array([0.0, 1.0, 0.0]), jnp.array(jnp.pi), jnp.max(magnitudes))

    def choose(position: Array) -> Limb:
        centred = _from_centre(position)
        seen = view(atmosphere, centred, sky, magnitudes, camera)
        index, found = pick(seen, centred, sky, magnitudes, band[0], band[1], slots)
        return Limb(sky[index], found, seen.tangent_height[index])

    return jax.lax.map(choose, positions)


@cache
def standard_atmosphere() -> RefractionTable:
    """Return the traced standard atmosphere, made once."""
    return tabulate()


def _from_centre(position: Array) -> Array:
    return position + jnp.array([0.0, 1.0, 0.0], position.dtype) * MEAN_RADIUS


def fly_run(key: Array, world: World, timing: Timing) -> Run:
    """Simulate one flight: launch and dead reckoning, then all sensors in free flight.

    Args:
        key: The run's key.
        world: What all runs share.
        timing: Rates and periods.
    """
    start_key, imu_key, star_key, limb_key, density_key, lost_key = jax.random.split(key, 6)
    error0 = initial_error(start_key, world.prior_sigma)
    drift, bias = opposite_biases(error0)
    motion = world.trajectory
    errors = ImuErrors(world.noise.gyro_noise, world.noise.accel_noise, drift, bias)
    turns, gains = imu_samples(imu_key, motion, errors, timing.imu_step)
    launched = timing.launch_samples
    start = _dead_reckoned(world, timing, turns[:launched], gains[:launched], error0)
    turns, gains = turns[launched:], gains[launched:]
    every = round(timing.period / timing.imu_step)
    truth = true_states(SinsTotal, motion, every, drift, bias, launched)
    before, after = (jax.tree.map(lambda leaf, at=at: leaf[at], truth) for at in _ENDS)
    dtheta, dvel = accumulate(turns, gains, every)
    steps = world.limb.seen.shape[0]
    density = 1 + world.density_error * jax.random.normal(density_key, (), error0.dtype)
    angle = _bent(world, after.position, density)
    angle = measure(limb_key, angle, world.refraction_noise)
    tracker = observe_attitude(star_key, after.dcm, world.noise.star_noise)
    # The time average of the specific force, not in the axes of one instant: body axes turn.
    output = jnp.mean(gains.reshape(steps, every, 3), axis=1) / timing.imu_step
    z = jax.vmap(observations)(tracker, angle, output)
    both = jnp.ones((steps, 3), bool)
    return Run(
        start=_lost(lost_key, world, start),
        conventional=SinsTotalInput(dtheta, dvel, jnp.ones(steps, error0.dtype)),
        limb=SinsRkcnsInput(
            dtheta, world.limb.star, angle, jnp.ones(steps, error0.dtype), before, after
        ),
        density=density,
        z=z,
        valid=jnp.concatenate([both, world.limb.seen & (angle > 0), both], axis=1),
        truth=after,
    )


_ENDS = (slice(None, -1), slice(1, None))


def _dead_reckoned(
    world: World, timing: Timing, turns: Array, gains: Array, error0: Array
) -> Gaussian:
    """Return what integrating the inertial sensors from launch gives, with its covariance."""
    pad = jax.tree.map(lambda leaf: leaf[0], world.trajectory.state)
    none = jnp.zeros(3, error0.dtype)
    at_rest = SinsTotal(pad.dcm, pad.velocity, pad.position, none, none)
    believed = retract_total(at_rest, error0.at[LAYOUT.eps.start :].set(0))
    every = round(timing.launch_period / timing.imu_step)
    dtheta, dvel = accumulate(turns, gains, every)
    steps = dtheta.shape[0]
    inputs = SinsTotalInput(dtheta, dvel, jnp.ones(steps, error0.dtype))
    unaided = ekf(sins_total(timing.launch_period, timing.imu_step, MEAN_RADIUS))
    params = FilterParams(world.noise, Gaussian(believed, jnp.diag(world.prior_sigma**2)))
    nothing = SureObs(jnp.zeros((steps, 3), error0.dtype), jnp.zeros((steps, 3), bool))
    final = run(unaided, params, inputs, nothing, record=lambda state, info: ()).final
    return unaided.estimate(final)


def _lost(key: Array, world: World, start: Gaussian) -> Gaussian:
    """Lose the position, by as much as the scenario says."""
    dr = LAYOUT.dr
    away = world.lost * jax.random.normal(key, (3,), world.prior_sigma.dtype)
    more = world.lost**2 * jnp.eye(3, dtype=away.dtype)
    mean = start.mean._replace(position=start.mean.position + away)
    return Gaussian(mean, start.cov.at[dr, dr].add(more))


def _bent(world: World, positions: Array, density: Array) -> Array:
    """Return the true refraction angles ``(K, n) [rad]``; some angle where there is no star."""

    def one(position: Array, star: Array) -> Array:
        found = seen_refraction(world.atmosphere, _from_centre(position), star, density)
        return found.angle

    angles = jax.vmap(jax.vmap(one, in_axes=(None, 0)))(positions, world.limb.star)
    return jnp.where(world.limb.seen, angles, 100 * ARCSEC)
