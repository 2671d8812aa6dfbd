"""Strapdown inertial system in the local level frame, aided by positions and velocities of GNSS.

The state is the navigation solution itself, driven by inertial increments: attitude C_nb, velocity,
geodetic position, gyro drift and accelerometer bias (measured minus true). How its error is
defined is a choice (:mod:`~jaxnav.navigation.states`), and with it one extended Kalman
filter is the usual error-state filter, the left-invariant one or that on SE_2(3).

References:
    Yang et al. (2025), "Adaptive filter parameter reconstruction technology for rocket inertial
    navigation/satellite integrated navigation system", PeerJ Computer Science 11:e3040, Eqs.
    (1)-(11) and (17), all of them images that are not available: the equations here are the
    standard ones, Groves (2013), chapters 5 and 14.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.carried import Law, carrying, check_carried, own_params
from jaxnav.estimation.models import Process, observing, shared
from jaxnav.estimation.types import Model
from jaxnav.navigation.channels.gnss import Antenna, receiver
from jaxnav.navigation.earth import (
    WGS84,
    Earth,
    displaced,
    earth_rate,
    metres_per_radian,
    normal_gravity,
    transport_rate,
)
from jaxnav.navigation.states import LAYOUT, ErrorForm, LevelError, SinsLevel, error_form
from jaxnav.navigation.strapdown.base import NavState
from jaxnav.navigation.strapdown.local_level import level_step
from jaxnav.numerics.lie import skew, so3_exp, so3_left_jacobian
from jaxnav.numerics.linalg import computed_once, matmul, rotated_diagonal


class SinsGnssParams(NamedTuple):
    """Noise of the model, each ``(3,)``, and where the antenna is.

    Attributes:
        gyro_noise: Angle random walk ``N_g`` [rad/sqrt(s)], body axes.
        accel_noise: Velocity random walk ``N_a`` [m/s/sqrt(s)], body axes.
        gyro_walk: Random walk of the gyro drift [rad/s/sqrt(s)].
        accel_walk: Random walk of the accelerometer bias [m/s^2/sqrt(s)].
        velocity_noise: Standard deviation of a GNSS velocity [m/s], east, north, up.
        position_noise: Standard deviation of a GNSS position [m], east, north, up.
        lever_arm: From the inertial sensors to the antenna [m], body axes.
    """

    gyro_noise: Array
    accel_noise: Array
    gyro_walk: Array
    accel_walk: Array
    velocity_noise: Array
    position_noise: Array
    lever_arm: Array


class SinsGnssInput(NamedTuple):
    """What the inertial sensors report over one filter period.

    Attributes:
        dtheta: ``(3,) [rad]`` rotation vector of the body over the period.
        gain: ``(3,) [m/s]`` integral of the specific force in the body axes of the period's start
            (see :func:`~jaxnav.navigation.strapdown.increments.accumulate`).
        rate: ``(3,) [rad/s]`` angular rate at the end of the period, for the lever arm.
        dt: Length of the period [s]; with zero or less nothing moves and no noise is added.
    """

    dtheta: Array
    gain: Array
    rate: Array
    dt: Array


CARRIED = {"lever_arm": 3, "position_error": 3, "gyro_scale": 3, "accel_scale": 3}
"""States that may be carried, and their sizes.

``lever_arm`` [m] takes the place of the parameter; ``position_error`` [m] is what the receiver's
positions are off by, east, north, up, beside white noise; the scale errors of the inertial sensors
are measured over true less one, by axis.
"""


def sins_gnss(
    error: LevelError = "additive",
    origin: Array | None = None,
    earth: Earth = WGS84,
    *,
    carry: Mapping[str, Law] | None = None,
) -> Model:
    """Return the process :func:`inertial` as a receiver sees it.

        z = (v + C (w x l) - w_ie x C l,  p + C l)

    The residual of a position is in metres, of first order in the distance; what is observed is
    latitude, longitude and height.

    Args:
        error: The definition of the error.
        origin: Geodetic position about which the right-invariant error turns.
        earth: The Earth.
        carry: States to carry besides, by name, with their laws. The model makes use of those of
            :data:`CARRIED`; any other is for channels that are added.

    Returns:
        A model with :class:`SinsGnssParams` and :class:`SinsGnssInput`, the channels "velocity" and
        "position" of :func:`~jaxnav.navigation.channels.gnss.receiver` and analytic Jacobians. One
        that carries states has :class:`~jaxnav.estimation.carried.CarriedParams` of these.

    Raises:
        ValueError: If the error is not a known one, the right-invariant one has no origin, or a
            state cannot be carried.
    """
    form = level_form(error, origin, earth)
    process, parts = inertial(form, earth), shared
    if carry:
        check_carried(carry, CARRIED)
        process = carrying(process, carry, period=lambda u: u.dt, inputs=unscaled)
        parts = own_params
    return observing(process, receiver(antenna, form, earth), parts=parts)


def antenna(params: SinsGnssParams, x: Any, u: SinsGnssInput) -> Antenna:
    """Return what the channels of a receiver read of parameters, carried states and inputs."""
    return Antenna(
        getattr(x, "lever_arm", params.lever_arm),
        unscaled(getattr(x, "carried", {}), u).rate,
        params.velocity_noise,
        params.position_noise,
        error=getattr(x, "position_error", None),
    )


def unscaled(carried: Mapping[str, Array], u: SinsGnssInput) -> SinsGnssInput:
    """Return inputs less the scale errors of the sensors that are carried: ``u / (1 + scale)``."""
    if "gyro_scale" in carried:
        turn = 1 + carried["gyro_scale"]
        u = u._replace(dtheta=u.dtheta / turn, rate=u.rate / turn)
    if "accel_scale" in carried:
        u = u._replace(gain=u.gain / (1 + carried["accel_scale"]))
    return u


def level_form(error: LevelError, origin: Array | None, earth: Earth) -> ErrorForm:
    """Return a definition of the error by its name, refused if it turns about nothing.

    Raises:
        ValueError: If the error is not a known one, or the right-invariant one has no origin.
    """
    if error == "right-invariant" and origin is None:
        raise ValueError("the right-invariant error turns about an origin; give a position")
    return error_form(error, jnp.zeros(3) if origin is None else origin, earth)


def inertial(form: ErrorForm, earth: Earth = WGS84) -> Process:
    """Return the process of 15 states, driven by the increments of one filter period.

        attitude, velocity, position by :func:`~jaxnav.navigation.strapdown.local_level.level_step`
        with dtheta - T eps,  gain - T (nabla + eps x gain / 2)
        Q = diag(N_g^2, N_a^2, 0, K_g^2, K_a^2) T  in body axes, turned into the error's

    Its derivative leaves out terms that ``(w_ie + w_en) T`` makes small next to others of the same
    block, and how Earth rate and transport rate change with position.

    Args:
        form: The definition of the error.
        earth: The Earth.
    """

    def transition(params: SinsGnssParams, x: SinsLevel, u: SinsGnssInput) -> SinsLevel:
        del params
        return _advanced(x, u, earth)

    def process_noise(params: SinsGnssParams, x: SinsLevel, u: SinsGnssInput) -> Array:
        return _process_noise(form, params, x, u)

    def differential(
        params: SinsGnssParams, x: SinsLevel, u: SinsGnssInput
    ) -> Callable[[Array], Array]:
        del params
        ahead = _advanced(x, u, earth)
        moved = _transition_differential(x, ahead, u, earth)
        return lambda dx: form.from_additive(ahead, moved(form.to_additive(x, dx)))

    return Process(transition, process_noise, form.retract, form.local, differential)


def _length(u: SinsGnssInput) -> Array:
    return jnp.maximum(u.dt, 0)


def _corrected(x: SinsLevel, u: SinsGnssInput) -> tuple[Array, Array]:
    """Return rotation vector and gain less what the state says is error; none without a period.

    A drift also turns the axes in which the gains of the period were summed.
    """
    dt, live = _length(u), u.dt > 0
    turn = jnp.where(live, u.dtheta, 0) - dt * x.drift
    gain = jnp.where(live, u.gain, 0)
    return turn, gain - dt * (x.bias + 0.5 * jnp.cross(x.drift, gain))


def _advanced(x: SinsLevel, u: SinsGnssInput, earth: Earth) -> SinsLevel:
    turn, gain = _corrected(x, u)
    moved = level_step(NavState(x.dcm, x.velocity, x.position), turn, gain, _length(u), earth)
    return SinsLevel(*moved, x.drift, x.bias)


def _process_noise(
    form: ErrorForm, params: SinsGnssParams, x: SinsLevel, u: SinsGnssInput
) -> Array:
    none = jnp.zeros((3, 3), x.bias.dtype)
    blocks = [
        rotated_diagonal(x.dcm, params.gyro_noise**2),
        rotated_diagonal(x.dcm, params.accel_noise**2),
        none,
        jnp.diag(params.gyro_walk**2),
        jnp.diag(params.accel_walk**2),
    ]
    rows = [[own if i == j else none for j in range(5)] for i, own in enumerate(blocks)]
    columns = jax.vmap(lambda d: form.from_additive(x, d), in_axes=1, out_axes=1)
    return _length(u) * columns(columns(jnp.block(rows)).T)


class _Slopes(NamedTuple):
    """Blocks of the transition's derivative by additive errors, each ``(3, 3)`` unless said.

    Attributes:
        back: Turns attitude errors with the frame.
        felt: Specific velocity gained ``(3,) [m/s]``, whose cross product turns into velocity.
        by_drift: Of the gain by the gyro drift, which turns the axes that it was summed in.
        turned_by_drift: Of the attitude error by the gyro drift.
        frame: Of the rotation of the frame by velocity.
        pull: Of gravity, Coriolis and transport acceleration by velocity.
        gradient: Of gravity by height, ``()``.
        stretch: Metres per unit of position after the step over those before, ``(3,)``.
    """

    back: Array
    felt: Array
    by_drift: Array
    turned_by_drift: Array
    frame: Array
    pull: Array
    gradient: Array
    stretch: Array


def _slopes(x: SinsLevel, ahead: SinsLevel, u: SinsGnssInput, earth: Earth) -> _Slopes:
    dt = _length(u)
    turn, gain = _corrected(x, u)
    p = displaced(x.position, 0.5 * dt * x.velocity, earth)
    v = 0.5 * (x.velocity + ahead.velocity)
    rates = earth_rate(p[0], earth), transport_rate(p, v, earth)
    one = jnp.eye(3, dtype=v.dtype)
    # Transport rate is linear in velocity, and so are its columns.
    frame = jax.vmap(lambda e: transport_rate(p, e, earth), out_axes=1)(one)
    coriolis = skew(2 * rates[0] + rates[1]) - matmul(skew(v), frame)
    _, slope = jax.jvp(lambda h: normal_gravity(p[0], h, earth), (p[2],), (jnp.ones_like(p[2]),))
    back = so3_exp(-dt * (rates[0] + rates[1]))
    swap = jnp.array([1, 0, 2])
    metres = [metres_per_radian(at, earth) for at in (x.position, ahead.position)]
    return computed_once(
        _Slopes(
            back=back,
            felt=matmul(x.dcm, gain),
            by_drift=0.5 * dt * matmul(x.dcm, skew(jnp.where(u.dt > 0, u.gain, 0))),
            turned_by_drift=-dt * matmul(back, matmul(x.dcm, so3_left_jacobian(turn))),
            frame=dt * frame,
            pull=-dt * coriolis,
            gradient=-dt * slope,
            stretch=(metres[1] / metres[0])[swap],
        )
    )


def _transition_differential(
    x: SinsLevel, ahead: SinsLevel, u: SinsGnssInput, earth: Earth
) -> Callable[[Array], Array]:
    """Return the derivative of the transition in additive errors as a function of ``(15,)``."""
    s, dt = LAYOUT, _length(u)
    by = _slopes(x, ahead, u, earth)
    vertical = jnp.array([0.0, 0.0, 1.0], x.velocity.dtype)

    def moved(d: Array) -> Array:
        sensed = matmul(by.by_drift, d[s.eps]) - dt * matmul(x.dcm, d[s.nabla])
        df = jnp.cross(d[s.phi], by.felt) + sensed
        middle = d[s.dv] + 0.5 * df
        lower = by.gradient * (d[s.dr][2] + 0.5 * dt * d[s.dv][2])
        gained = df + matmul(by.pull, middle) + lower * vertical
        turned = matmul(by.back, d[s.phi]) + matmul(by.turned_by_drift, d[s.eps])
        return jnp.concatenate(
            [
                turned - matmul(by.frame, middle),
                d[s.dv] + gained,
                by.stretch * d[s.dr] + dt * (d[s.dv] + 0.5 * gained),
                d[s.eps],
                d[s.nabla],
            ]
        )

    return moved
