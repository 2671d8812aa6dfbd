"""GNSS receiver: positions and velocities with noise, outliers, outages and a dilution gate.

    velocity:  v + C (w x l) - w_ie x C l + t a,   a = C (f - nabla) + g - (2 w_ie + w_en) x v
    position:  p + C l + t v   as latitude, longitude, height, with the residual in metres

where ``t`` is how much later than its step a fix is valid; the first order in it leaves
``a t^2 / 2``, a millimetre for 25 ms and 3 m/s^2. That the velocity of the antenna about the
sensors changes over ``t`` is left out.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.models import Channel
from jaxnav.estimation.types import Input, Params, Point
from jaxnav.navigation.earth import WGS84, Earth, displaced, earth_rate, offset_between
from jaxnav.navigation.states import LAYOUT, ErrorForm, SinsLevel
from jaxnav.navigation.strapdown.local_level import pull
from jaxnav.numerics.linalg import matmul


class GnssErrors(NamedTuple):
    """Errors of a receiver's fixes, independent from fix to fix.

    Attributes:
        velocity_sigma: ``(3,) [m/s]`` east, north, up.
        position_sigma: ``(3,) [m]`` east, north, up.
        outlier_share: Probability that a fix is an outlier.
        outlier_scale: Factor on both standard deviations in an outlier.
    """

    velocity_sigma: Array
    position_sigma: Array
    outlier_share: Array | float = 0.0
    outlier_scale: Array | float = 1.0


class Antenna(NamedTuple):
    """What the channels of a receiver have to know at a step.

    Attributes:
        lever_arm: From the inertial sensors to the antenna ``(3,) [m]``, body axes.
        rate: Angular rate as measured ``(3,) [rad/s]``, body axes.
        velocity_sigma: ``(3,) [m/s]`` standard deviation of a velocity, east, north, up.
        position_sigma: ``(3,) [m]`` of a position.
        lag: How much later than the end of the step a fix is valid [s]; ``None`` where it is not.
        force: Mean specific force of the step as measured ``(3,) [m/s^2]``, body axes; needed where
            there is a lag.
        error: What the receiver's positions are off by ``(3,) [m]``, east, north, up, beside white
            noise; ``None`` where that is no state.
    """

    lever_arm: Array
    rate: Array
    velocity_sigma: Array
    position_sigma: Array
    lag: Array | None = None
    force: Array | None = None
    error: Array | None = None


Reading = Callable[[Params, Point, Input], Antenna]
"""How a model's parameters, states and inputs tell of the antenna."""


def receiver(antenna: Reading, form: ErrorForm, earth: Earth = WGS84) -> dict[str, Channel]:
    """Return the channels "velocity" and "position" of a receiver, for states like ``SinsLevel``.

    Their derivatives leave out how Earth rate turns with the attitude. The measured rate is taken
    as exact: its noise looks like turning, so that a lever arm that is carried loses a little
    variance on a straight too (a tenth in two minutes of fixes at 1 Hz, 0.3 deg/sqrt(h), 0.03 m/s).

    Args:
        antenna: ``(params, x, u) -> Antenna`` of the model.
        form: The definition of the state's error.
        earth: The Earth.
    """

    def moving(params: Params, x: SinsLevel, u: Input) -> tuple[Array, Array]:
        a = antenna(params, x, u)
        turning = a.rate - x.drift - matmul(x.dcm.T, earth_rate(x.position[0], earth))
        return antenna_motion(x.dcm, x.velocity, x.position, turning, a.lever_arm, earth)

    def velocity(params: Params, x: SinsLevel, u: Input) -> Array:
        a, v = antenna(params, x, u), moving(params, x, u)[0]
        if a.lag is None:
            return v
        return v + a.lag * (_felt(x, a) + pull(x.position, x.velocity, earth))

    def position(params: Params, x: SinsLevel, u: Input) -> Array:
        a, (v, p) = antenna(params, x, u), moving(params, x, u)
        late = p if a.lag is None else displaced(p, a.lag * v, earth)
        return late if a.error is None else displaced(late, a.error, earth)

    def by_velocity(params: Params, x: SinsLevel, u: Input) -> Callable[[Array], Array]:
        a = antenna(params, x, u)
        swung = _swung(x, a)

        def seen(dx: Array) -> Array:
            d = form.to_additive(x, dx)
            moved = swung(d)
            if a.lag is None:
                return moved
            surge = jnp.cross(d[LAYOUT.phi], _felt(x, a)) - matmul(x.dcm, d[LAYOUT.nabla])
            return moved + a.lag * surge

        return seen

    def by_position(params: Params, x: SinsLevel, u: Input) -> Callable[[Array], Array]:
        a = antenna(params, x, u)
        arm, swung = matmul(x.dcm, a.lever_arm), _swung(x, a)

        def seen(dx: Array) -> Array:
            d = form.to_additive(x, dx)
            moved = d[LAYOUT.dr] + jnp.cross(d[LAYOUT.phi], arm)
            return moved if a.lag is None else moved + a.lag * swung(d)

        return seen

    return {
        "velocity": Channel(
            3,
            velocity,
            lambda params, x, u: antenna(params, x, u).velocity_sigma ** 2,
            differential=by_velocity,
        ),
        "position": Channel(
            3,
            position,
            lambda params, x, u: antenna(params, x, u).position_sigma ** 2,
            lambda z, z_pred: offset_between(z_pred, z, earth),
            by_position,
        ),
    }


def _felt(x: Point, antenna: Antenna) -> Array:
    """Return the mean specific force of the step ``(3,) [m/s^2]``, east, north, up."""
    return matmul(x.dcm, antenna.force - x.bias)


def _swung(x: Point, antenna: Antenna) -> Callable[[Array], Array]:
    """Return the derivative of the antenna's velocity by additive errors."""
    arm, s = antenna.lever_arm, LAYOUT
    swung = matmul(x.dcm, jnp.cross(antenna.rate - x.drift, arm))

    def seen(d: Array) -> Array:
        drifted = matmul(x.dcm, jnp.cross(d[s.eps], arm))
        return d[s.dv] + jnp.cross(d[s.phi], swung) - drifted

    return seen


def observe_gnss(
    key: Array, velocity: Array, position: Array, errors: GnssErrors, earth: Earth = WGS84
) -> Array:
    """Return fixes ``(K, 6)``: velocity east, north, up [m/s], then latitude, longitude, height.

    Args:
        key: Random key.
        velocity: ``(K, 3) [m/s]`` of the antenna.
        position: ``(K, 3)`` geodetic, of the antenna.
        errors: The receiver's errors.
        earth: The Earth.
    """
    noise_key, outlier_key = jax.random.split(key)
    count = velocity.shape[0]
    white = jax.random.normal(noise_key, (count, 6), velocity.dtype)
    wild = jax.random.uniform(outlier_key, (count, 1), velocity.dtype) < errors.outlier_share
    white = white * jnp.where(wild, errors.outlier_scale, 1.0).astype(white.dtype)
    offset = white[:, 3:] * errors.position_sigma[None]
    moved = jax.vmap(lambda p, d: displaced(p, d, earth))(position, offset)
    return jnp.concatenate([velocity + white[:, :3] * errors.velocity_sigma[None], moved], axis=1)


def antenna_motion(
    dcm: Array,
    velocity: Array,
    position: Array,
    rate: Array,
    lever_arm: Array,
    earth: Earth = WGS84,
) -> tuple[Array, Array]:
    """Return velocity ``(3,)`` and geodetic position ``(3,)`` of an antenna on the body.

    Args:
        dcm: C_nb ``(3, 3)``.
        velocity: Of the inertial sensors ``(3,) [m/s]``, east, north, up.
        position: Of the inertial sensors, geodetic ``(3,)``.
        rate: Angular rate of the body against the Earth ``(3,) [rad/s]``, body axes.
        lever_arm: From the inertial sensors to the antenna ``(3,) [m]``, body axes.
        earth: The Earth.
    """
    swung = matmul(dcm, jnp.cross(rate, lever_arm))
    return velocity + swung, displaced(position, matmul(dcm, lever_arm), earth)


def outages(time: Array, spans: Sequence[tuple[float, float]]) -> Array:
    """Return which times ``(K,) [s]`` are outside all spans ``[start, end)`` of lost signal."""
    kept = jnp.ones(time.shape, bool)
    for start, end in spans:
        kept = kept & ~((time >= start) & (time < end))
    return kept


def dilution_gate(dilution: Array, limit: float) -> Array:
    """Return which fixes ``(K,)`` have a dilution of precision at most ``limit``, and a finite one.

    References:
        Yang et al. (2025), who take fixes whose position dilution is within a threshold, so that
        the noise of those that are left stays within an order of magnitude.
    """
    return jnp.isfinite(dilution) & (dilution <= limit)
