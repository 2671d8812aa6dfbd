"""What studies of SINS/GNSS in the local level frame share: one run of the inertial sensors."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.types import Gaussian
from jaxnav.navigation.models.sins_gnss import SinsGnssInput, SinsGnssParams
from jaxnav.navigation.sensors.imu import ImuErrors, corrupt
from jaxnav.navigation.states import LAYOUT, SinsLevel, error_form
from jaxnav.navigation.strapdown.increments import accumulate
from jaxnav.navigation.trajectory.base import Trajectory


class Clock(NamedTuple):
    """Rates: the static part of a configuration that a run depends on.

    Attributes:
        imu_step: Interval of the inertial samples [s].
        samples_per_step: Inertial samples in a step of the filters.
    """

    imu_step: float
    samples_per_step: int

    @property
    def step(self) -> float:
        """Period of the filters [s]."""
        return self.imu_step * self.samples_per_step


class SensedRun(NamedTuple):
    """What the inertial sensors of one run report, and the truth.

    Attributes:
        start: What is known at the start; the covariance is that of additive errors.
        errors: Errors of the sensors.
        inputs: Inputs of the filters, leading axis ``K``.
        truth: True states at the ends of the filters' steps, leading axis ``K``.
    """

    start: Gaussian
    errors: ImuErrors
    inputs: SinsGnssInput
    truth: SinsLevel


def sense(
    start_key: Array,
    imu_key: Array,
    motion: Trajectory,
    noise: SinsGnssParams,
    prior_sigma: Array,
    clock: Clock,
) -> SensedRun:
    """Draw the errors at the start, drift and bias among them, and run the inertial sensors.

    Args:
        start_key: Key of the errors at the start.
        imu_key: Key of the sensors' noise.
        motion: True motion at the inertial rate.
        noise: True noise.
        prior_sigma: ``(15,)`` standard deviations at the start.
        clock: Rates.
    """
    # A product with a matrix, not with a vector: XLA fuses the latter, and with it the generator,
    # into every sample of the IMU that the drawn drift and bias go to.
    sigma = prior_sigma
    error0 = jnp.diag(sigma) @ jax.random.normal(start_key, sigma.shape, sigma.dtype)
    # The filters start at no drift and no bias, so the truth is the opposite of the error.
    drift, bias = -error0[LAYOUT.eps], -error0[LAYOUT.nabla]
    per_sample = clock.imu_step**-0.5
    errors = ImuErrors(noise.gyro_noise * per_sample, noise.accel_noise * per_sample, drift, bias)
    every = clock.samples_per_step
    quiet = jnp.ones(motion.dtheta.shape[0], sigma.dtype)
    turns, gains = corrupt(imu_key, errors, motion.dtheta, motion.dvel, clock.imu_step, quiet)
    dtheta, gain = accumulate(turns, gains, every)
    truth = true_states(motion, every, drift, bias)
    first, after = (jax.tree.map(lambda leaf, at=at: leaf[at], truth) for at in (0, slice(1, None)))
    mean = error_form("additive", first.position).retract(first, error0)
    inputs = SinsGnssInput(
        dtheta,
        gain,
        turns[every - 1 :: every] / clock.imu_step,
        jnp.full(dtheta.shape[0], clock.step, sigma.dtype),
    )
    return SensedRun(Gaussian(mean, jnp.diag(sigma**2)), errors, inputs, after)


def true_states(motion: Trajectory, every: int, drift: Array, bias: Array) -> SinsLevel:
    """Return the true states at the ends of the filter's steps, the start first."""
    at = jax.tree.map(lambda leaf: leaf[::every], motion.state)
    shape = at.velocity.shape
    constant = jnp.broadcast_to(drift, shape), jnp.broadcast_to(bias, shape)
    return SinsLevel(at.dcm, at.velocity, at.position, *constant)
