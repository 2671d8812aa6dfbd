"""Total state of a strapdown inertial system aided by a star tracker, launch-inertial frame.

The state is the navigation solution itself, driven by the increments of the inertial sensors:
attitude C_ib, velocity, position, gyro drift eps and accelerometer error nabla (body axes, measured
minus true), the last a first-order Markov process. Its tangent space has fifteen coordinates in the
blocks of :data:`~jaxnav.navigation.states.LAYOUT`; the attitude's is the small rotation
phi in inertial axes with ``C_computed = exp([phi]x) C_true``.

References:
    Zhao, Chen, He, Ge (2018), IEEE/CAA JAS 5(6), Eqs. (31)-(40). The paper never states its state
    vector; this is the reading under which its nonlinear filters differ from linear ones.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.models import Process, observing, shared
from jaxnav.estimation.types import Model
from jaxnav.navigation.channels.star import StarForm, tracker
from jaxnav.navigation.earth import gravity_gradient_launch_inertial, gravity_launch_inertial
from jaxnav.navigation.states import LAYOUT, SinsTotal, local_total, retract_total
from jaxnav.numerics.lie import so3_exp, so3_left_jacobian
from jaxnav.numerics.linalg import matmul, rotated_diagonal


class SinsTotalParams(NamedTuple):
    """Noise of the model.

    Attributes:
        gyro_noise: ``(3,) [rad/s]`` standard deviation of one gyro sample, body axes.
        accel_noise: ``(3,) [m/s^2]`` standard deviation of one accelerometer sample, body axes.
        bias_sigma: Stationary standard deviation of the accelerometer error [m/s^2], each axis.
        bias_time: Its correlation time [s].
        star_noise: ``(3,) [rad]`` standard deviation of the star tracker, inertial axes.
    """

    gyro_noise: Array
    accel_noise: Array
    bias_sigma: Array
    bias_time: Array
    star_noise: Array


class SinsTotalInput(NamedTuple):
    """What the inertial sensors report over one filter period.

    Attributes:
        dtheta: ``(3,) [rad]`` rotation vector of the body over the period.
        dvel: ``(3,) [m/s]`` integral of the specific force in the body axes of the period's start
            (see :func:`~jaxnav.navigation.strapdown.increments.accumulate`).
        true_scale: True factor on the variances of both noises, for an informed filter only.
    """

    dtheta: Array
    dvel: Array
    true_scale: Array


def sins_total(
    period: float, imu_step: float, radius: Array | float, star: StarForm = "rotation-vector"
) -> Model:
    """Return the process :func:`inertial` as a star tracker sees it.

    Args:
        period: Filter period ``T`` [s].
        imu_step: Interval of the inertial samples ``T_imu`` [s].
        radius: Distance from the Earth's centre to the launch point [m].
        star: How the attitude is observed (:func:`~jaxnav.navigation.channels.star.tracker`): as a
            rotation vector, or as the angles of the paper.

    Returns:
        A model with :class:`SinsTotalParams` and :class:`SinsTotalInput`, one channel, "attitude"
        ``(3,)``, and analytic Jacobians.

    Raises:
        ValueError: If ``star`` is neither.
    """
    return observing(inertial(period, imu_step, radius), {"attitude": tracker(star)}, parts=shared)


def inertial(period: float, imu_step: float, radius: Array | float) -> Process:
    """Return the process of 15 states, driven by the increments of one filter period.

        C+ = C exp([dtheta - T eps]x)
        v+ = v + C (dvel - T nabla - T/2 eps x dvel) + g(r + v T/2) T
        r+ = r + (v + v+) T/2
        eps+ = eps,   nabla+ = exp(-T / tau) nabla

    The process noise of attitude and velocity is ``Q0 T T_imu`` with ``Q0`` the variances per
    sample, as for :func:`~jaxnav.navigation.models.sins_cns.sins_cns`.

    Args:
        period: Filter period ``T`` [s].
        imu_step: Interval of the inertial samples ``T_imu`` [s].
        radius: Distance from the Earth's centre to the launch point [m].
    """

    def transition(params: SinsTotalParams, x: SinsTotal, u: SinsTotalInput) -> SinsTotal:
        pull = gravity_launch_inertial(x.position + 0.5 * period * x.velocity, radius)
        velocity = x.velocity + matmul(x.dcm, _felt(period, x, u)) + period * pull
        return SinsTotal(
            dcm=matmul(x.dcm, so3_exp(u.dtheta - period * x.drift)),
            velocity=velocity,
            position=x.position + 0.5 * period * (x.velocity + velocity),
            drift=x.drift,
            bias=jnp.exp(-period / params.bias_time) * x.bias,
        )

    def process_noise(params: SinsTotalParams, x: SinsTotal, u: SinsTotalInput) -> Array:
        del u
        spread = period * imu_step
        attitude = rotated_diagonal(x.dcm, spread * params.gyro_noise**2)
        velocity = rotated_diagonal(x.dcm, spread * params.accel_noise**2)
        driven = params.bias_sigma**2 * -jnp.expm1(-2 * period / params.bias_time)
        bias = driven * jnp.eye(3, dtype=x.bias.dtype)
        return (
            jnp.pad(attitude, ((0, 12), (0, 12)))
            + jnp.pad(velocity, ((3, 9), (3, 9)))
            + jnp.pad(bias, ((12, 0), (12, 0)))
        )

    differential = partial(_transition_differential, period, radius)
    return Process(transition, process_noise, retract_total, local_total, differential)


def _felt(period: float, x: SinsTotal, u: SinsTotalInput) -> Array:
    """Return the velocity increment ``(3,) [m/s]`` in body axes, less what the state says is error.

    A drift also turns the axes in which the increments of the period were summed.
    """
    return u.dvel - period * (x.bias + 0.5 * jnp.cross(x.drift, u.dvel))


def _transition_differential(
    period: float, radius: Array | float, params: SinsTotalParams, x: SinsTotal, u: SinsTotalInput
) -> Callable[[Array], Array]:
    """Return the derivative of the transition as a function of a tangent vector ``(15,)``."""
    s = LAYOUT
    pushed = matmul(x.dcm, _felt(period, x, u))
    turning = matmul(x.dcm, so3_left_jacobian(u.dtheta - period * x.drift))
    pull = gravity_gradient_launch_inertial(x.position + 0.5 * period * x.velocity, radius)
    fading = jnp.exp(-period / params.bias_time)

    def moved(d: Array) -> Array:
        sensed = d[s.nabla] + 0.5 * jnp.cross(d[s.eps], u.dvel)
        gained = (
            jnp.cross(d[s.phi], pushed)
            - period * matmul(x.dcm, sensed)
            + period * matmul(pull, d[s.dr] + 0.5 * period * d[s.dv])
        )
        return jnp.concatenate(
            [
                d[s.phi] - period * matmul(turning, d[s.eps]),
                d[s.dv] + gained,
                d[s.dr] + period * (d[s.dv] + 0.5 * gained),
                d[s.eps],
                fading * d[s.nabla],
            ]
        )

    return moved
