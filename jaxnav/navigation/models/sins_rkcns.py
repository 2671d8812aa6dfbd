"""Strapdown inertial system in free flight, aided by stars seen through the atmosphere's limb.

The state is that of :mod:`~jaxnav.navigation.models.sins_total`: attitude, velocity, position, gyro
drift and accelerometer bias, here a constant. After burn-out and above the atmosphere the specific
force is zero: the accelerometers are not integrated but observed, and what they report is their
bias. Three sensors make the channels, in this order:

    the attitude of a star tracker (3), the height of each refracted ray (n), the accelerometers (3)

A star at the limb is seen bent by the angle R. As heights, the atmosphere gives that at which a
ray is bent by R, the geometry that at which it must have passed to reach the vehicle; their
difference is the observation, which is zero. R, and with it its noise, is in both, inside a
logarithm: taken for noise that adds, it leaves a bias of ``H (sigma / R)^2 / 2`` on every height.
As angles, the observation is R itself, by the angle under which the star is seen from a position;
its noise adds, but it is exponential in the position.

References:
    Shi, Chen, Wang (2023), Eqs. (32)-(42). The observation (39) is printed as additive noise on a
    height; the noise here is on the angle, where it arises, and the geometry is exact.
"""

from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.types import Model, NonAdditive
from jaxnav.navigation.atmosphere import RefractionTable
from jaxnav.navigation.earth import gravity_launch_inertial
from jaxnav.navigation.limb import HeightModel, model_height, ray_height, seen_refraction
from jaxnav.navigation.states import LAYOUT, SinsTotal, local_total, retract_total
from jaxnav.numerics.lie import so3_exp, so3_local, so3_log, so3_retract
from jaxnav.numerics.linalg import matmul
from jaxnav.numerics.ode import rk4

RayForm = Literal["height", "angle"]


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


def sins_rkcns(period: float, imu_step: float, radius: float, ray: RayForm = "height") -> Model:
    """Return the 15-state model of free flight.

        C+ = C exp([dtheta - T eps]x),   (v, r)' = (g(r), v),   eps+ = eps,   nabla+ = nabla
        z = (log C, h_atmosphere(R) - h_ray(r, s, R) or R(r, s) for each star, nabla)

    The number of stars is that of the input. In ``noisy`` the noise of attitude, angles, density
    and accelerometers enters where it arises, in ``observation_noise`` to first order.

    Args:
        period: Filter period ``T`` [s].
        imu_step: Interval of the inertial samples [s].
        radius: Distance from the Earth's centre to the launch point, and to sea level [m].
        ray: How refraction is observed, as differences of heights or as angles.

    Returns:
        A model with :class:`SinsRkcnsParams` and :class:`SinsRkcnsInput` on the manifold of
        :class:`~jaxnav.navigation.states.SinsTotal`, ``6 + n`` channels.

    Raises:
        ValueError: If ``ray`` is neither.
    """
    if ray not in _RAYS:
        raise ValueError(f"ray is {ray!r}; it must be one of {', '.join(_RAYS)}")
    rays = _RAYS[ray]

    def transition(params: SinsRkcnsParams, x: SinsTotal, u: SinsRkcnsInput) -> SinsTotal:
        del params

        def falling(t: Array, vr: tuple[Array, Array]) -> tuple[Array, Array]:
            del t
            return gravity_launch_inertial(vr[1], radius), vr[0]

        start = jnp.zeros((), x.position.dtype)
        v, r = rk4(falling, start, (x.velocity, x.position), period)
        dcm = matmul(x.dcm, so3_exp(u.dtheta - period * x.drift))
        return SinsTotal(dcm, v, r, x.drift, x.bias)

    def observed_rays(params: SinsRkcnsParams, x: SinsTotal, v: Array, u: SinsRkcnsInput) -> Array:
        """Return the channels ``(n,)`` of the stars for noise ``(n + 1,)``, density last."""
        centred = x.position + jnp.array([0.0, 1.0, 0.0], v.dtype) * radius
        scale = u.density * (1 + v[-1])
        one = partial(rays, params.atmosphere, radius, centred, scale)
        return jax.vmap(one)(_Ray(u.star, u.angle, v[:-1]))

    def disturbed(params: SinsRkcnsParams, x: SinsTotal, v: Array, u: SinsRkcnsInput) -> Array:
        attitude = so3_log(so3_retract(x.dcm, v[:3]))
        return jnp.concatenate([attitude, observed_rays(params, x, v[3:-3], u), x.bias + v[-3:]])

    def observe(params: SinsRkcnsParams, x: SinsTotal, u: SinsRkcnsInput) -> Array:
        return disturbed(params, x, jnp.zeros(7 + u.angle.shape[0], x.bias.dtype), u)

    def sources(params: SinsRkcnsParams, x: SinsTotal, u: SinsRkcnsInput) -> Array:
        """Return the variances ``(7 + n,)`` of attitude, angles, density and accelerometers."""
        del x
        angles = jnp.broadcast_to(params.refraction_noise**2, u.angle.shape)
        mean_accel = params.accel_noise**2 * (imu_step / period)
        return jnp.concatenate(
            [params.star_noise**2, angles, params.density_sigma[None] ** 2, mean_accel]
        )

    def observation_noise(params: SinsRkcnsParams, x: SinsTotal, u: SinsRkcnsInput) -> Array:
        n = u.angle.shape[0]
        variances = sources(params, x, u)
        zero = jnp.zeros(n + 1, variances.dtype)
        G = jax.jacfwd(lambda v: observed_rays(params, x, v, u))(zero)
        R = jnp.diag(jnp.concatenate([variances[:3], zero[:-1], variances[-3:]]))
        return R.at[3 : 3 + n, 3 : 3 + n].set((G * variances[None, 3:-3]) @ G.T)

    return Model(
        transition,
        partial(_process_noise, period, imu_step),
        observe,
        observation_noise,
        _residual,
        retract_total,
        local_total,
        noisy=NonAdditive(disturbed, sources),
    )


def _process_noise(
    period: float, imu_step: float, params: SinsRkcnsParams, x: SinsTotal, u: SinsRkcnsInput
) -> Array:
    del u
    s = LAYOUT
    turned = matmul(x.dcm * (period * imu_step * params.gyro_noise**2)[None], x.dcm.T)
    pushed = params.disturbance**2 * jnp.eye(3, dtype=x.dcm.dtype)
    Q = jnp.zeros((15, 15), x.dcm.dtype)
    Q = Q.at[s.phi, s.phi].set(turned).at[s.dv, s.dv].set(period * pushed)
    Q = Q.at[s.dr, s.dr].set(period**3 / 3 * pushed)
    both = period**2 / 2 * pushed
    return Q.at[s.dv, s.dr].set(both).at[s.dr, s.dv].set(both)


class _Ray(NamedTuple):
    """A star's direction ``(3,)``, its refraction angle as measured and the noise of that [rad]."""

    star: Array
    measured: Array
    noise: Array


def _height_difference(
    atmosphere: HeightModel, radius: float, position: Array, density: Array, ray: _Ray
) -> Array:
    """Return the height of a ray by the atmosphere less that by the geometry [m]."""
    angle = ray.measured - ray.noise
    by_atmosphere = model_height(atmosphere, angle / density)
    return by_atmosphere - ray_height(position, ray.star, angle, radius)


def _angle(
    atmosphere: RefractionTable, radius: float, position: Array, density: Array, ray: _Ray
) -> Array:
    """Return the angle that is measured [rad]."""
    return seen_refraction(atmosphere, position, ray.star, density, radius).angle + ray.noise


_RAYS = {"height": _height_difference, "angle": _angle}


def _residual(z: Array, z_pred: Array) -> Array:
    turned = so3_local(so3_exp(z_pred[:3]), so3_exp(z[:3]))
    return jnp.concatenate([turned, z[3:] - z_pred[3:]])
