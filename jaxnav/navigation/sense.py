"""One simulated run of the inertial sensors: errors at the start, and samples along a trajectory.

A filter starts at no drift and no bias, so that the sensors' true ones are the opposite of the
errors that were drawn for the start.
"""

from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.types import Gaussian
from jaxnav.navigation.models.sins_gnss import SinsGnssInput, SinsGnssParams
from jaxnav.navigation.sensors.imu import ImuErrors, corrupt
from jaxnav.navigation.states import LAYOUT, SinsLevel, SinsTotal, error_form
from jaxnav.navigation.strapdown.increments import accumulate
from jaxnav.navigation.trajectory.base import Trajectory

_State = TypeVar("_State", SinsLevel, SinsTotal)


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


def initial_error(key: Array, sigma: Array) -> Array:
    """Draw the error of a state at the start from ``N(0, P0)``.

    Args:
        key: Random key.
        sigma: Standard deviations ``(n,)``, or a root ``(n, n)`` of ``P0``.

    Returns:
        ``(n,)``.
    """
    # A product with a matrix, not with a vector: XLA fuses the latter, and with it the generator,
    # into every sample of the IMU that the drawn drift and bias go to, at twice the cost of a run.
    root = sigma if sigma.ndim == 2 else jnp.diag(sigma)
    return root @ jax.random.normal(key, root.shape[1:], root.dtype)


def opposite_biases(error0: Array) -> tuple[Array, Array]:
    """Return the true gyro drift and accelerometer bias of a filter that starts at none of them."""
    return -error0[LAYOUT.eps], -error0[LAYOUT.nabla]


def imu_samples(
    key: Array,
    motion: Trajectory,
    errors: ImuErrors,
    step: float,
    variance_scale: Array | None = None,
) -> tuple[Array, Array]:
    """Return the increments ``(N, 3)`` that the sensors report along a trajectory.

    Args:
        key: Random key.
        motion: True motion at the inertial rate.
        errors: The sensors' errors.
        step: Interval [s].
        variance_scale: ``(N,)`` factor on the noise variances; the default is one.
    """
    if variance_scale is None:
        variance_scale = jnp.ones(motion.dtheta.shape[0], motion.dtheta.dtype)
    return corrupt(key, errors, motion.dtheta, motion.dvel, step, variance_scale)


def sense_level(
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
    error0 = initial_error(start_key, prior_sigma)
    drift, bias = opposite_biases(error0)
    per_sample = clock.imu_step**-0.5
    errors = ImuErrors(noise.gyro_noise * per_sample, noise.accel_noise * per_sample, drift, bias)
    every = clock.samples_per_step
    turns, gains = imu_samples(imu_key, motion, errors, clock.imu_step)
    dtheta, gain = accumulate(turns, gains, every)
    truth = true_states(SinsLevel, motion, every, drift, bias)
    first, after = (jax.tree.map(lambda leaf, at=at: leaf[at], truth) for at in (0, slice(1, None)))
    mean = error_form("additive", first.position).retract(first, error0)
    inputs = SinsGnssInput(
        dtheta,
        gain,
        turns[every - 1 :: every] / clock.imu_step,
        jnp.full(dtheta.shape[0], clock.step, prior_sigma.dtype),
    )
    return SensedRun(Gaussian(mean, jnp.diag(prior_sigma**2)), errors, inputs, after)


def true_states(
    kind: type[_State], motion: Trajectory, every: int, drift: Array, bias: Array, first: int = 0
) -> _State:
    """Return the true states at the ends of the filter's steps, the start first.

    Args:
        kind: Of the state, by the frame of the motion.
        motion: True motion at the inertial rate.
        every: Inertial samples in a step.
        drift: Gyro drift ``(3,) [rad/s]``, a constant.
        bias: Accelerometer bias ``(3,) [m/s^2]``, a constant.
        first: Inertial sample at which the filter starts.
    """
    at = jax.tree.map(lambda leaf: leaf[first::every], motion.state)
    shape = at.velocity.shape
    constant = jnp.broadcast_to(drift, shape), jnp.broadcast_to(bias, shape)
    return kind(at.dcm, at.velocity, at.position, *constant)
