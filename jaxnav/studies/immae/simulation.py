"""The truth of the study: trajectory, IMU, one open-loop SINS and a star tracker per run."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.compiling import compiled, host
from jaxnav.estimation.run import simulate
from jaxnav.navigation.channels.star import observe_attitude
from jaxnav.navigation.earth import meridian_radius
from jaxnav.navigation.models.sins_cns import (
    SinsCnsInput,
    SinsCnsParams,
    inputs_from_solution,
    sins_cns,
)
from jaxnav.navigation.sense import imu_samples, initial_error
from jaxnav.navigation.sensors.imu import ImuErrors
from jaxnav.navigation.states import LAYOUT
from jaxnav.navigation.strapdown.base import NavState
from jaxnav.navigation.strapdown.increments import rotation_compensated
from jaxnav.navigation.strapdown.launch_inertial import NavSolution, mechanise_launch_inertial
from jaxnav.navigation.trajectory.base import Trajectory
from jaxnav.navigation.trajectory.rocket import RocketProfile, fly
from jaxnav.numerics.lie import euler_error_from_rotation, so3_exp, so3_local
from jaxnav.numerics.linalg import matmul
from jaxnav.studies.immae.config import ImmaeConfig
from jaxnav.units import ARCSEC, DEG, DEG_PER_HOUR, MICRO_G


class World(NamedTuple):
    """What all runs share.

    Attributes:
        trajectory: True motion at the inertial rate.
        dcm: ``(K, 3, 3)`` true attitude at the filter's epochs.
        euler_map: ``(K, 3, 3)`` from a small rotation to errors of pitch, yaw, roll.
        sample_scale: ``(N,)`` true factor on the noise variances at each inertial sample.
        step_scale: ``(K,)`` the same at each filter step.
        noise: True noise of the sensors; its ``noise_scale`` is one.
        radius: Distance from the Earth's centre to the launch point [m].
        start_mean: ``(15,)`` mean of the initial error state.
        start_root: ``(15, 15)`` root of the covariance of the initial error state.
        nominal: The model's inputs along the true trajectory, for the linear chain.
    """

    trajectory: Trajectory
    dcm: Array
    euler_map: Array
    sample_scale: Array
    step_scale: Array
    noise: SinsCnsParams
    radius: Array
    start_mean: Array
    start_root: Array
    nominal: SinsCnsInput


class Run(NamedTuple):
    """One simulated flight as the filters see it, and the truth to judge them by.

    Attributes:
        inputs: Inputs of the error model, leading axis ``K``.
        z: ``(K, 3) [rad]`` computed attitude against the star tracker's.
        error: ``(K, 15)`` true error state of the SINS.
    """

    inputs: SinsCnsInput
    z: Array
    error: Array


def noise_of(config: ImmaeConfig) -> SinsCnsParams:
    """Return the sensors' noise of Table 1, with factor one."""
    return SinsCnsParams(
        gyro_noise=host.full(3, config.gyro_noise_deg_h * DEG_PER_HOUR),
        accel_noise=host.full(3, config.accel_noise_ug * MICRO_G),
        star_noise=host.full(3, config.star_noise_arcsec * ARCSEC),
        noise_scale=host.ones(()),
    )


def prior_sigma(config: ImmaeConfig) -> Array:
    """Return the standard deviations ``(15,)`` of P0.

    The paper's list of P0 has fourteen entries, one drift too few, and gives the attitude as
    (6", 10", 10") where Table 1 has deviations of (10", 6", 10"); here each block has one value.
    """
    blocks = [
        config.p0_attitude_arcsec * ARCSEC,
        config.p0_velocity,
        config.p0_position,
        config.p0_drift_deg_h * DEG_PER_HOUR,
        config.p0_bias_ug * MICRO_G,
    ]
    return host.repeat(blocks, 3)


def table_errors(config: ImmaeConfig) -> Array:
    """Return the initial error state ``(15,)`` of Table 1."""
    s, error = LAYOUT, host.zeros(15)
    error[s.phi] = host.array(config.initial_misalignment_arcsec) * ARCSEC
    error[s.eps] = config.gyro_drift_deg_h * DEG_PER_HOUR
    error[s.nabla] = config.accel_bias_ug * MICRO_G
    return error


def true_scale(config: ImmaeConfig, count: int) -> Array:
    """Return the true factor on Q0 for ``count`` equal parts of the flight ``(count,)``."""
    thrice = 3 * host.arange(count)
    step = config.step_theta if config.scenario == "noise-step" else 1.0
    return host.where((thrice >= count) & (thrice < 2 * count), step, 1.0)


def build_world(config: ImmaeConfig) -> World:
    """Fly the trajectory and prepare what all runs share."""
    every = config.samples_per_step
    radius = compiled(meridian_radius)(config.latitude_deg * DEG)
    profile = RocketProfile(pitch_start=config.initial_pitch_deg * DEG)
    trajectory = fly(profile, steps=config.steps * every, step=config.imu_step, radius=radius)
    scale = true_scale(config, config.steps)
    dcm, euler_map, nominal = _at_epochs(trajectory, radius, scale, config.filter_period_s, every)
    drawn = config.initial == "drawn"
    return World(
        trajectory=trajectory,
        dcm=dcm,
        euler_map=euler_map,
        sample_scale=host.repeat(scale, every),
        step_scale=scale,
        noise=noise_of(config),
        radius=radius,
        start_mean=host.zeros(15) if drawn else table_errors(config),
        start_root=host.diag(prior_sigma(config)) if drawn else host.zeros((15, 15)),
        nominal=nominal,
    )


@compiled(static_argnums=(3, 4))
def _at_epochs(
    trajectory: Trajectory, radius: Array, scale: Array, period: float, every: int
) -> tuple[Array, Array, SinsCnsInput]:
    """Return attitudes, their maps to Euler angles and the model's inputs on the filter's clock."""
    epochs = jax.tree.map(lambda leaf: leaf[every::every], trajectory.state)
    start = jax.tree.map(lambda leaf: leaf[0], trajectory.state)
    turned = jax.vmap(rotation_compensated)(trajectory.dtheta, trajectory.dvel)
    specific = jax.vmap(matmul)(trajectory.state.dcm[:-1], turned)
    gained = jnp.sum(specific.reshape(-1, every, 3), axis=1)
    solution = NavSolution(epochs, gained)
    inputs = inputs_from_solution(start, solution, period, radius, scale)
    return epochs.dcm, jax.vmap(euler_error_from_rotation)(epochs.dcm), inputs


def fly_sins(key: Array, world: World, period: float, imu_step: float) -> Run:
    """Simulate one run of the paper's figure 2: IMU, open-loop mechanisation, star tracker.

    Args:
        key: The run's key.
        world: What all runs share.
        period: Filter period [s].
        imu_step: Interval of the inertial samples [s].
    """
    start_key, imu_key, star_key = jax.random.split(key, 3)
    error0 = world.start_mean + initial_error(start_key, world.start_root)
    true0 = jax.tree.map(lambda leaf: leaf[0], world.trajectory.state)
    start = NavState(
        dcm=matmul(so3_exp(error0[LAYOUT.phi]), true0.dcm),
        velocity=true0.velocity + error0[LAYOUT.dv],
        position=true0.position + error0[LAYOUT.dr],
    )
    errors = ImuErrors(
        world.noise.gyro_noise, world.noise.accel_noise, error0[LAYOUT.eps], error0[LAYOUT.nabla]
    )
    dtheta, dvel = imu_samples(imu_key, world.trajectory, errors, imu_step, world.sample_scale)
    every = round(period / imu_step)
    solution = mechanise_launch_inertial(start, dtheta, dvel, imu_step, world.radius, every)
    star = observe_attitude(star_key, world.dcm, world.noise.star_noise)
    return Run(
        inputs=inputs_from_solution(start, solution, period, world.radius, world.step_scale),
        z=jax.vmap(so3_local)(star, solution.state.dcm),
        error=_solution_error(solution.state, world, error0, every),
    )


def _solution_error(state: NavState, world: World, error0: Array, every: int) -> Array:
    """Return the error state ``(K, 15)`` of a mechanised solution, computed minus true."""
    truth = jax.tree.map(lambda leaf: leaf[every::every], world.trajectory.state)
    constant = jnp.broadcast_to(error0[LAYOUT.eps.start :], (truth.dcm.shape[0], 6))
    return jnp.concatenate(
        [
            jax.vmap(so3_local)(truth.dcm, state.dcm),
            state.velocity - truth.velocity,
            state.position - truth.position,
            constant,
        ],
        axis=1,
    )


def fly_linear(key: Array, world: World, period: float, imu_step: float) -> Run:
    """Simulate one run of the error model itself along the true trajectory."""
    start_key, process_key, star_key = jax.random.split(key, 3)
    steps = world.dcm.shape[0]
    model = sins_cns(period, imu_step)
    sigma = jnp.sqrt(world.step_scale * period * imu_step)[:, None]
    white = sigma * jax.random.normal(process_key, (steps, 6), sigma.dtype)
    dcm = world.nominal.dcm
    gyro = jax.vmap(matmul)(dcm, white[:, :3] * world.noise.gyro_noise[None])
    accel = jax.vmap(matmul)(dcm, white[:, 3:] * world.noise.accel_noise[None])
    process = jnp.concatenate([gyro, accel, jnp.zeros((steps, 9), gyro.dtype)], axis=1)
    star = jax.random.normal(star_key, (steps, 3), sigma.dtype) * world.noise.star_noise[None]
    start = world.start_mean + initial_error(start_key, world.start_root)
    error, z = simulate(model, world.noise, start, world.nominal, process, star)
    return Run(world.nominal, z, error)
