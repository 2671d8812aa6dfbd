"""A vehicle on the ground: the SINS/GNSS model with sensors whose clocks differ, and constraints.

A car moves the way it points: of the velocity of its rear axle, the parts to the side and upwards
are zero but for slip, bumps and the springs. That, and rest at a stop, are observations like any
other: channels that are valid where they hold. They carry the filter while fixes are missing.

References:
    Dissanayake, Sukkarieh, Nebot, Durrant-Whyte (2001), IEEE Trans. Robotics and Automation 17(5),
    for the constraints; Groves (2013), sections 15.3 and 15.4.1.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.models import adapted
from jaxnav.estimation.types import Model
from jaxnav.navigation.earth import WGS84, Earth, displaced, earth_rate, offset_between
from jaxnav.navigation.models.sins_gnss import (
    CHANNELS,
    SinsGnssInput,
    SinsGnssParams,
    sins_gnss,
)
from jaxnav.navigation.states import LAYOUT, LevelError, SinsLevel, error_form
from jaxnav.navigation.strapdown.local_level import pull
from jaxnav.numerics.lie import so3_exp
from jaxnav.numerics.linalg import matmul

CONSTRAINTS = ("lateral", "vertical", "rest_e", "rest_n", "rest_u")
"""Channels of the constraints, after those of the receiver: all observe zero."""
FIXES = slice(0, len(CHANNELS))
STEERED = slice(len(CHANNELS), len(CHANNELS) + 2)
REST = slice(len(CHANNELS) + 2, len(CHANNELS) + 5)

MOST_DOUBT = 40.0
"""Logarithm of the largest factor on the variance of a rest, so that it stays finite."""


class VehicleParams(NamedTuple):
    """Parameters of the model.

    Attributes:
        inner: Those of :func:`~jaxnav.navigation.models.sins_gnss.sins_gnss`.
        time_offset: How much later a fix is valid than its time says [s], beyond the lag that the
            inputs hold.
        mounting: ``(3,) [rad]`` rotation vector that takes the sensors' axes to the vehicle's
            (x forward, y left, z up): ``exp([mounting]x) v_body``.
        axle: ``(3,) [m]`` from the inertial sensors to the middle of the rear axle, sensors' axes.
        steered_noise: ``(2,) [m/s]`` standard deviation of the lateral and vertical velocity.
        rest_noise: Standard deviation of the velocity at a stop [m/s], each axis.
        rest_speed: Speed at which a stop is believed less by half an e [m/s].
    """

    inner: SinsGnssParams
    time_offset: Array
    mounting: Array
    axle: Array
    steered_noise: Array
    rest_noise: Array
    rest_speed: Array


class VehicleInput(NamedTuple):
    """Inputs of a period.

    Attributes:
        inertial: :class:`~jaxnav.navigation.models.sins_gnss.SinsGnssInput`.
        lag: How much later than the end of the period the fix that is observed there is valid [s],
            by its own time; a fraction of the period.
        grade: Factor on the receiver's standard deviations: one, and more for a worse fix.
    """

    inertial: SinsGnssInput
    lag: Array
    grade: Array


def vehicle(
    error: LevelError = "additive",
    origin: Array | None = None,
    earth: Earth = WGS84,
    *,
    constrained: bool = True,
) -> Model:
    """Return the 15-state model of a vehicle on the ground.

        z = (v + t a,  p + t v)  of the antenna,  t = lag + time offset,
            a = C (f - nabla) + g - (2 w_ie + w_en) x v
        0 = (M (C' v + w x l_axle)) in y and z,  M = exp([mounting]x)
        0 = v  at rest, with the noise  sigma exp(v^2 / (2 v_rest^2))

    A car at a constant speed on a smooth road looks to its sensors as if it stood: so a stop is
    believed less, the faster the filter says the vehicle is, and not at all at several times
    ``v_rest``. A filter that is wrong by that much at a true stop is left alone too.

    The first order in ``t`` leaves ``a t^2 / 2``: a millimetre for 25 ms and 3 m/s^2. That the
    velocity of the antenna about the sensors changes over ``t`` is left out.

    Args:
        error: The definition of the error.
        origin: Geodetic position about which the right-invariant error turns.
        earth: The Earth.
        constrained: Whether there are the channels of the constraints; without them there are the
            six of the receiver, and the parameters of the constraints have no effect.

    Returns:
        A model with :class:`VehicleParams` and :class:`VehicleInput`, analytic Jacobians and
        eleven channels, those of the receiver and :data:`CONSTRAINTS`, or six.

    Raises:
        ValueError: As :func:`~jaxnav.navigation.models.sins_gnss.sins_gnss`.
    """
    plain = sins_gnss(error, origin, earth)
    inner = adapted(plain, lambda params: params.inner, lambda u: u.inertial)
    form = error_form(error, jnp.zeros(3) if origin is None else origin, earth)

    def observe(params: VehicleParams, x: SinsLevel, u: VehicleInput) -> Array:
        z = inner.observe(params, x, u)
        lag = params.time_offset + u.lag
        acceleration = _felt(x, u) + pull(x.position, x.velocity, earth)
        parts = [z[:3] + lag * acceleration, displaced(z[3:], lag * z[:3], earth)]
        if constrained:
            parts += [_steered(params, x, u, earth), x.velocity]
        return jnp.concatenate(parts)

    def observation_noise(params: VehicleParams, x: SinsLevel, u: VehicleInput) -> Array:
        fixes = u.grade**2 * inner.observation_noise(params, x, u)
        if not constrained:
            return fixes
        doubt = jnp.minimum(jnp.sum((x.velocity / params.rest_speed) ** 2), MOST_DOUBT)
        rest = jnp.broadcast_to(params.rest_noise**2 * jnp.exp(doubt), (3,))
        return jnp.concatenate([fixes, params.steered_noise**2, rest])

    def residual(z: Array, z_pred: Array) -> Array:
        off = offset_between(z_pred[3:6], z[3:6], earth)
        return jnp.concatenate([z[:3] - z_pred[:3], off, z[6:] - z_pred[6:]])

    def jacobians(
        params: VehicleParams, x: SinsLevel, u: VehicleInput
    ) -> tuple[Callable[[Array], Array], Callable[[Array], Array]]:
        assert inner.jacobians is not None
        moved, fixed = inner.jacobians(params, x, u)
        assert callable(moved)
        assert callable(fixed)
        lag, s = params.time_offset + u.lag, LAYOUT
        felt, steered = _felt(x, u), _steered_differential(params, x)

        def seen(dx: Array) -> Array:
            d, dz = form.to_additive(x, dx), fixed(dx)
            surge = jnp.cross(d[s.phi], felt) - matmul(x.dcm, d[s.nabla])
            parts = [dz[:3] + lag * surge, dz[3:] + lag * dz[:3]]
            if constrained:
                parts += [steered(d), d[s.dv]]
            return jnp.concatenate(parts)

        return moved, seen

    return inner._replace(
        observe=observe,
        observation_noise=observation_noise,
        residual=residual,
        jacobians=jacobians,
    )


def _felt(x: SinsLevel, u: VehicleInput) -> Array:
    """Return the mean specific force of the period ``(3,) [m/s^2]``, east, north, up."""
    live = u.inertial.dt > 0
    dt = jnp.where(live, u.inertial.dt, 1)
    return matmul(x.dcm, jnp.where(live, u.inertial.gain, 0) / dt - x.bias)


def _steered(params: VehicleParams, x: SinsLevel, u: VehicleInput, earth: Earth) -> Array:
    """Return lateral and vertical velocity ``(2,) [m/s]`` of the rear axle."""
    turning = u.inertial.rate - x.drift - matmul(x.dcm.T, earth_rate(x.position[0], earth))
    v = matmul(x.dcm.T, x.velocity) + jnp.cross(turning, params.axle)
    return matmul(so3_exp(params.mounting), v)[1:]


def _steered_differential(params: VehicleParams, x: SinsLevel) -> Callable[[Array], Array]:
    """Return the derivative of :func:`_steered` in additive errors, Earth rate left out."""
    s, M = LAYOUT, so3_exp(params.mounting)

    def differential(d: Array) -> Array:
        turned = matmul(x.dcm.T, d[s.dv] - jnp.cross(d[s.phi], x.velocity))
        return matmul(M, turned - jnp.cross(d[s.eps], params.axle))[1:]

    return differential
