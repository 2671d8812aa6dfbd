"""Strapdown inertial system in free flight, aided by stars seen through the atmosphere's limb.

The state is that of :mod:`~jaxnav.navigation.models.sins_total`: attitude, velocity, position, gyro
drift and accelerometer bias, here a constant. After burn-out and above the atmosphere the specific
force is zero: the accelerometers are not integrated but observed, and what they report is their
bias. Three sensors make the channels, in this order:

    "attitude" (3) of a star tracker, "rays" (n) of refracted stars, "accelerometer" (3)

References:
    Shi, Chen, Wang (2023), Eqs. (32)-(42); of the rays see
    :mod:`~jaxnav.navigation.channels.refraction`.
"""

from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.models import Process, observing, shared
from jaxnav.estimation.types import Model
from jaxnav.navigation.atmosphere import RefractionTable
from jaxnav.navigation.channels.free_fall import free_fall
from jaxnav.navigation.channels.refraction import RayForm, limb_stars
from jaxnav.navigation.channels.star import tracker, turned_by_noise
from jaxnav.navigation.earth import gravity_launch_inertial
from jaxnav.navigation.limb import HeightModel
from jaxnav.navigation.states import LAYOUT, SinsTotal, local_total, retract_total
from jaxnav.numerics.lie import so3_exp, so3_log
from jaxnav.numerics.linalg import matmul, rotated_diagonal
from jaxnav.numerics.ode import rk4


class SinsRkcnsParams(NamedTuple):
    """Noise of the model, and the atmosphere that the filter believes in.

    Attributes:
        gyro_noise: ``(3,) [rad/s]`` standard deviation of one gyro sample, body axes.
        accel_noise: ``(3,) [m/s^2]`` standard deviation of one accelerometer sample, body axes.
        star_noise: ``(3,) [rad]`` standard deviation of the star tracker, inertial axes.
        refraction_noise: Standard deviation of a refraction angle [rad].
        density_sigma: Relative standard deviation of the atmosphere's density, one for all stars of
            an epoch and drawn anew at each; an error that lasts is modelled too well.
        disturbance: Density of an unmodelled white acceleration [m/s^2/sqrt(Hz)].
        atmosphere: Height of a ray by its angle; of the form "angle", the angle by the height.
    """

    gyro_noise: Array
    accel_noise: Array
    star_noise: Array
    refraction_noise: Array
    density_sigma: Array
    disturbance: Array
    atmosphere: HeightModel | RefractionTable


class SinsRkcnsInput(NamedTuple):
    """What the gyros report over one filter period, and the stars at the limb at its end.

    Attributes:
        dtheta: ``(3,) [rad]`` rotation vector of the body over the period.
        star: ``(n, 3)`` true directions of the stars, unit vectors in launch-inertial axes.
        angle: ``(n,) [rad]`` their refraction angles as measured.
        density: Density of the atmosphere relative to the model; 1 unless told.
        before: True state at the start of the period, for an informed filter only.
        after: True state at its end, likewise.
    """

    dtheta: Array
    star: Array
    angle: Array
    density: Array
    before: Any = ()
    after: Any = ()


def observations(star_dcm: Array, angle: Array, accel: Array, ray: RayForm = "height") -> Array:
    """Return the values of the channels ``(3 + n + 3,)``; those of differences of heights are zero.

    Args:
        star_dcm: C_ib ``(3, 3)`` of the star tracker.
        angle: ``(n,) [rad]`` measured refraction angles.
        accel: ``(3,) [m/s^2]`` mean output of the accelerometers over the period.
        ray: The model's form.
    """
    rays = angle if ray == "angle" else jnp.zeros_like(angle)
    return jnp.concatenate([so3_log(star_dcm), rays, accel])


def sins_rkcns(
    period: float, imu_step: float, radius: float, stars: int, ray: RayForm = "height"
) -> Model:
    """Return the process :func:`falling` as a star tracker, stars at the limb and rest see it.

        z = (log C, h_atmosphere(R) - h_ray(r, s, R) or R(r, s) for each star, nabla)

    In ``noisy`` the noise of attitude, angles, density and accelerometers enters where it arises,
    in ``observation_noise`` to first order.

    Args:
        period: Filter period ``T`` [s].
        imu_step: Interval of the inertial samples [s].
        radius: Distance from the Earth's centre to the launch point, and to sea level [m].
        stars: Number of stars at the limb in each input; with none there is no channel of them.
        ray: How refraction is observed, as differences of heights or as angles.

    Returns:
        A model with :class:`SinsRkcnsParams` and :class:`SinsRkcnsInput` on the manifold of
        :class:`~jaxnav.navigation.states.SinsTotal` and the channels "attitude" ``(3,)``, "rays"
        ``(stars,)`` and "accelerometer" ``(3,)``.

    Raises:
        ValueError: If ``ray`` is neither, or ``stars`` is negative.
    """
    channels = {
        "attitude": turned_by_noise(tracker()),
        "rays": limb_stars(stars, radius, ray),
        "accelerometer": free_fall(period, imu_step),
    }
    if stars == 0:
        del channels["rays"]
    return observing(falling(period, imu_step, radius), channels, parts=shared)


def falling(period: float, imu_step: float, radius: float) -> Process:
    """Return the process of 15 states in free flight.

        C+ = C exp([dtheta - T eps]x),   (v, r)' = (g(r), v),   eps+ = eps,   nabla+ = nabla

    Args:
        period: Filter period ``T`` [s].
        imu_step: Interval of the inertial samples [s].
        radius: Distance from the Earth's centre to the launch point [m].
    """

    def transition(params: SinsRkcnsParams, x: SinsTotal, u: SinsRkcnsInput) -> SinsTotal:
        del params

        def pulled(t: Array, vr: tuple[Array, Array]) -> tuple[Array, Array]:
            del t
            return gravity_launch_inertial(vr[1], radius), vr[0]

        start = jnp.zeros((), x.position.dtype)
        v, r = rk4(pulled, start, (x.velocity, x.position), period)
        dcm = matmul(x.dcm, so3_exp(u.dtheta - period * x.drift))
        return SinsTotal(dcm, v, r, x.drift, x.bias)

    noise = partial(_process_noise, period, imu_step)
    return Process(transition, noise, retract_total, local_total)


def _process_noise(
    period: float, imu_step: float, params: SinsRkcnsParams, x: SinsTotal, u: SinsRkcnsInput
) -> Array:
    del u
    s = LAYOUT
    turned = rotated_diagonal(x.dcm, period * imu_step * params.gyro_noise**2)
    pushed = params.disturbance**2 * jnp.eye(3, dtype=x.dcm.dtype)
    Q = jnp.zeros((15, 15), x.dcm.dtype)
    Q = Q.at[s.phi, s.phi].set(turned).at[s.dv, s.dv].set(period * pushed)
    Q = Q.at[s.dr, s.dr].set(period**3 / 3 * pushed)
    both = period**2 / 2 * pushed
    return Q.at[s.dv, s.dr].set(both).at[s.dr, s.dv].set(both)
