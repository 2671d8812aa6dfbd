"""Error model of a strapdown inertial system aided by a star tracker, launch-inertial frame.

Fifteen states: misalignment phi, velocity error dv, position error dr (all in inertial axes,
computed minus true), gyro drift eps and accelerometer bias nabla (body axes, measured minus true):

    phi' = C eps,   dv' = -[f]x phi + F_a dr + C nabla,   dr' = dv,   eps' = nabla' = 0

with ``C_computed = (I + [phi]x) C_true``. The star tracker observes phi. Attitude and drift form an
autonomous subsystem; velocity, position and bias are not observable from attitude.

References:
    Si, Wang, Niu, Eqs. (19)-(24).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.models import Process, observing, shared
from jaxnav.estimation.types import Model
from jaxnav.navigation.channels.star import misalignment
from jaxnav.navigation.earth import gravity_gradient_launch_inertial
from jaxnav.navigation.states import ATTITUDE_LAYOUT
from jaxnav.navigation.strapdown.base import NavState
from jaxnav.navigation.strapdown.launch_inertial import NavSolution
from jaxnav.numerics.lie import skew
from jaxnav.numerics.linalg import matmul, rotated_diagonal


class SinsCnsParams(NamedTuple):
    """Noise of the model.

    Attributes:
        gyro_noise: ``(3,) [rad/s]`` standard deviation of one gyro sample, body axes.
        accel_noise: ``(3,) [m/s^2]`` standard deviation of one accelerometer sample, body axes.
        star_noise: ``(3,) [rad]`` standard deviation of the star tracker.
        noise_scale: Factor theta on the variances of both inertial noises, ``Q = theta Q0``.
    """

    gyro_noise: Array
    accel_noise: Array
    star_noise: Array
    noise_scale: Array


class SinsCnsInput(NamedTuple):
    """The SINS solution that the error model is linearised about, over one filter period.

    Attributes:
        dcm: C_ib ``(3, 3)``.
        minus_force_skew: ``-[f]x`` ``(3, 3) [m/s^2]``, f the specific force in inertial axes.
        gravity_gradient: F_a ``(3, 3) [1/s^2]``.
        true_scale: True factor on the inertial noise variances, for an informed filter only.
    """

    dcm: Array
    minus_force_skew: Array
    gravity_gradient: Array
    true_scale: Array


def inputs_from_solution(
    start: NavState, solution: NavSolution, period: float, radius: Array | float, true_scale: Array
) -> SinsCnsInput:
    """Return the model's inputs ``(K, ...)`` from a mechanised solution.

    The attitude of a step is the one half-way, by averaging its ends; the specific force is the
    mean over the period.

    Args:
        start: Navigation state at t0.
        solution: Mechanised solution at the ends of the K periods.
        period: Filter period [s].
        radius: Distance from the Earth's centre to the launch point [m].
        true_scale: ``(K,)`` true factor on the noise variances.
    """
    dcm = jnp.concatenate([start.dcm[None], solution.state.dcm])
    position = solution.state.position
    return SinsCnsInput(
        dcm=0.5 * (dcm[:-1] + dcm[1:]),
        minus_force_skew=-jax.vmap(skew)(solution.specific_velocity / period),
        gravity_gradient=jax.vmap(gravity_gradient_launch_inertial, in_axes=(0, None))(
            position, radius
        ),
        true_scale=true_scale,
    )


def sins_cns(period: float, imu_step: float) -> Model:
    """Return the 15-state error model, discretised as ``Phi = I + F T``.

    The process noise is ``G Q0 G' theta T T_imu``: ``Q0`` holds variances per sample, and a period
    ``T`` sums ``T / T_imu`` independent samples of length ``T_imu``. (The paper does not say how it
    discretises ``Q0``; of the possible readings this one alone gives its error level.)

    Args:
        period: Filter period ``T`` [s].
        imu_step: Interval of the inertial samples ``T_imu`` [s].

    Returns:
        A linear model with :class:`SinsCnsParams` and :class:`SinsCnsInput`; one channel,
        "attitude" ``(3,)``.
    """

    def transition(params: SinsCnsParams, x: Array, u: SinsCnsInput) -> Array:
        del params
        phi, dv, dr, eps, nabla = jnp.split(x, 5)
        force = (
            matmul(u.minus_force_skew, phi) + matmul(u.gravity_gradient, dr) + matmul(u.dcm, nabla)
        )
        return jnp.concatenate(
            [phi + period * matmul(u.dcm, eps), dv + period * force, dr + period * dv, eps, nabla]
        )

    def process_noise(params: SinsCnsParams, x: Array, u: SinsCnsInput) -> Array:
        del x
        spread = params.noise_scale * period * imu_step
        attitude = rotated_diagonal(u.dcm, spread * params.gyro_noise**2)
        velocity = rotated_diagonal(u.dcm, spread * params.accel_noise**2)
        return jnp.pad(attitude, ((0, 12), (0, 12))) + jnp.pad(velocity, ((3, 9), (3, 9)))

    process = Process(transition, process_noise)
    return observing(process, {"attitude": misalignment()}, parts=shared)


def sins_cns_attitude(period: float, imu_step: float) -> Model:
    """Return the autonomous 6-state part (phi, eps) of :func:`sins_cns`, same parameters."""
    s = ATTITUDE_LAYOUT

    def transition(params: SinsCnsParams, x: Array, u: SinsCnsInput) -> Array:
        del params
        return jnp.concatenate([x[s.phi] + period * matmul(u.dcm, x[s.eps]), x[s.eps]])

    def process_noise(params: SinsCnsParams, x: Array, u: SinsCnsInput) -> Array:
        del x
        spread = params.noise_scale * period * imu_step
        return jnp.pad(rotated_diagonal(u.dcm, spread * params.gyro_noise**2), ((0, 3), (0, 3)))

    process = Process(transition, process_noise)
    return observing(process, {"attitude": misalignment()}, parts=shared)
