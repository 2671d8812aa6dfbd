"""A vehicle on the ground: the SINS/GNSS model with sensors whose clocks differ, and constraints.

A car moves the way it points: of the velocity of its rear axle, the parts to the side and upwards
are zero but for slip, bumps and the springs. That, and rest at a stop, are observations like any
other: channels that are valid where they hold. They carry the filter while fixes are missing.

References:
    Dissanayake, Sukkarieh, Nebot, Durrant-Whyte (2001), IEEE Trans. Robotics and Automation 17(5),
    for the constraints; Groves (2013), sections 15.3 and 15.4.1.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.carried import Law, carrying, check_carried, own_params
from jaxnav.estimation.models import adapted, observing, shared
from jaxnav.estimation.types import Model
from jaxnav.navigation.channels.gnss import Antenna, receiver
from jaxnav.navigation.channels.rest import Stop, zero_velocity
from jaxnav.navigation.channels.steered import Axle, steered
from jaxnav.navigation.earth import WGS84, Earth
from jaxnav.navigation.models import sins_gnss
from jaxnav.navigation.models.sins_gnss import (
    SinsGnssInput,
    SinsGnssParams,
    antenna,
    inertial,
    level_form,
    unscaled,
)
from jaxnav.navigation.states import LevelError

FIXES = ("velocity", "position")
"""Channels of the receiver."""
CONSTRAINTS = ("steered", "rest")
"""Channels of the constraints: all observe zero."""
CARRIED = sins_gnss.CARRIED | {"mounting": 3, "time_offset": 1}
"""States that may be carried, and their sizes: besides those of the SINS/GNSS model ``mounting``
[rad] and ``time_offset`` [s], which take the place of the parameters."""


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
    carry: Mapping[str, Law] | None = None,
) -> Model:
    """Return the 15-state model of a vehicle on the ground.

    Args:
        error: The definition of the error.
        origin: Geodetic position about which the right-invariant error turns.
        earth: The Earth.
        constrained: Whether there are the channels of the constraints; without them there are those
            of the receiver, and the parameters of the constraints have no effect.
        carry: States to carry besides, by name, with their laws. The model makes use of those of
            :data:`CARRIED`; any other is for channels that are added.

    Returns:
        A model with :class:`VehicleParams` and :class:`VehicleInput`, analytic Jacobians and the
        channels of :func:`~jaxnav.navigation.channels.gnss.receiver`, "velocity" and "position",
        then :func:`~jaxnav.navigation.channels.steered.steered` and "rest",
        :func:`~jaxnav.navigation.channels.rest.zero_velocity`. One that carries states has
        :class:`~jaxnav.estimation.carried.CarriedParams` of :class:`VehicleParams`.

    Raises:
        ValueError: As :func:`~jaxnav.navigation.models.sins_gnss.sins_gnss`.
    """
    form = level_form(error, origin, earth)
    process = adapted(inertial(form, earth), lambda p: p.inner, lambda u: u.inertial)
    parts = shared
    if carry:
        check_carried(carry, CARRIED)
        process = carrying(process, carry, period=lambda u: u.inertial.dt, inputs=_unscaled)
        parts = own_params
    channels = receiver(_late_antenna, form, earth)
    if constrained:
        channels["steered"] = steered(_axle, form, earth)
        channels["rest"] = zero_velocity(_stop, form)
    return observing(process, channels, parts=parts)


def _unscaled(carried: Mapping[str, Array], u: VehicleInput) -> VehicleInput:
    return u._replace(inertial=unscaled(carried, u.inertial))


def _late_antenna(params: VehicleParams, x: Any, u: VehicleInput) -> Antenna:
    plain = antenna(params.inner, x, u.inertial)
    inertial = unscaled(getattr(x, "carried", {}), u.inertial)
    live = inertial.dt > 0
    late = x.time_offset[0] if hasattr(x, "time_offset") else params.time_offset
    return plain._replace(
        velocity_sigma=u.grade * plain.velocity_sigma,
        position_sigma=u.grade * plain.position_sigma,
        lag=late + u.lag,
        force=jnp.where(live, inertial.gain, 0) / jnp.where(live, inertial.dt, 1),
    )


def _axle(params: VehicleParams, x: Any, u: VehicleInput) -> Axle:
    rate = unscaled(getattr(x, "carried", {}), u.inertial).rate
    mounting = getattr(x, "mounting", params.mounting)
    return Axle(params.axle, mounting, rate, params.steered_noise)


def _stop(params: VehicleParams, u: VehicleInput) -> Stop:
    del u
    return Stop(params.rest_noise, params.rest_speed)
