"""States of a strapdown inertial system: layouts, nominal points and forms of their error.

A tangent vector ``(15,)`` has the blocks of :data:`LAYOUT`, whichever the frame; biases always add.
Of a :class:`SinsTotal`, in an inertial frame, attitude is displaced by ``exp([phi]x) C`` and all
else adds. For a :class:`SinsLevel`, in the local level frame, what attitude, velocity and position
are displaced by is the definition's:

* additive: ``exp([phi]x) C``, ``v + dv``, ``p + dr``, resolved east, north, up;
* left-invariant: ``X exp(xi)``, resolved in body axes;
* right-invariant: ``exp(xi) X``, resolved east, north, up, about the origin of the positions.

Here ``X`` is the extended pose of attitude, velocity against the Earth and position from an origin.
On a flat Earth without biases the dynamics of both invariant errors do not depend on the state; on
the ellipsoid Earth rate, transport rate and the gradient of gravity are what remains.

References:
    Barrau and Bonnabel (2017), IEEE Trans. Automatic Control 62(4); Luo, Guo, Chen (2023), whose
    SE_2(3)-EKF Yang et al. (2025) compare with: the right error here, so that it is another filter
    than their invariant one.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxnav.navigation.earth import WGS84, Earth, displaced, offset_between
from jaxnav.numerics.lie import so3_exp, so3_local, so3_log, so3_retract
from jaxnav.numerics.linalg import matmul
from jaxnav.numerics.se23 import ExtendedPose, se23_exp, se23_log

LevelError = Literal["additive", "left-invariant", "right-invariant"]
_POSE = slice(0, 9)
_BIASES = slice(9, 15)


class Layout(NamedTuple):
    """Blocks of the error state."""

    phi: slice = slice(0, 3)
    dv: slice = slice(3, 6)
    dr: slice = slice(6, 9)
    eps: slice = slice(9, 12)
    nabla: slice = slice(12, 15)


class AttitudeLayout(NamedTuple):
    """Blocks of the autonomous attitude part of the error state."""

    phi: slice = slice(0, 3)
    eps: slice = slice(3, 6)


LAYOUT = Layout()
STATES = LAYOUT.nabla.stop
"""Number of the error state's coordinates."""
ATTITUDE_LAYOUT = AttitudeLayout()


class SinsTotal(NamedTuple):
    """A point of the state's manifold.

    Attributes:
        dcm: C_ib ``(3, 3)``.
        velocity: ``(3,) [m/s]``.
        position: ``(3,) [m]`` from the launch point.
        drift: Gyro drift ``(3,) [rad/s]``.
        bias: Accelerometer error ``(3,) [m/s^2]``.
    """

    dcm: Array
    velocity: Array
    position: Array
    drift: Array
    bias: Array


def retract_total(x: SinsTotal, dx: Array) -> SinsTotal:
    """Return the state displaced by a tangent vector ``(15,)``."""
    s = LAYOUT
    return SinsTotal(
        dcm=so3_retract(x.dcm, dx[s.phi]),
        velocity=x.velocity + dx[s.dv],
        position=x.position + dx[s.dr],
        drift=x.drift + dx[s.eps],
        bias=x.bias + dx[s.nabla],
    )


def local_total(x: SinsTotal, y: SinsTotal) -> Array:
    """Return the tangent vector ``(15,)`` from ``x`` to ``y``."""
    return jnp.concatenate(
        [
            so3_local(x.dcm, y.dcm),
            y.velocity - x.velocity,
            y.position - x.position,
            y.drift - x.drift,
            y.bias - x.bias,
        ]
    )


class SinsLevel(NamedTuple):
    """A point of the state's manifold.

    Attributes:
        dcm: C_nb ``(3, 3)``.
        velocity: Against the Earth ``(3,) [m/s]``, east, north, up.
        position: Latitude, longitude [rad] and ellipsoidal height [m].
        drift: Gyro drift ``(3,) [rad/s]``, body axes.
        bias: Accelerometer bias ``(3,) [m/s^2]``, body axes.
    """

    dcm: Array
    velocity: Array
    position: Array
    drift: Array
    bias: Array


class ErrorForm(NamedTuple):
    """A definition of the error.

    Attributes:
        retract: ``(x, dx) -> x``.
        local: ``(x, y) -> dx``; inverse of ``retract``.
        to_additive: ``(x, dx) -> d``, the derivative at zero of the additive error by this one.
        from_additive: ``(x, d) -> dx``, its inverse.
    """

    retract: Callable[[SinsLevel, Array], SinsLevel]
    local: Callable[[SinsLevel, SinsLevel], Array]
    to_additive: Callable[[SinsLevel, Array], Array]
    from_additive: Callable[[SinsLevel, Array], Array]


def error_form(name: LevelError, origin: Array, earth: Earth = WGS84) -> ErrorForm:
    """Return a definition of the error by name.

    Args:
        name: Which.
        origin: Geodetic position ``(3,)`` about which the right-invariant error turns; the
            vehicle's start, say. The others do not use it.
        earth: The Earth.

    Raises:
        ValueError: If there is no such definition.
    """
    if name not in _FORMS:
        raise ValueError(f"error is {name!r}; it must be one of {', '.join(_FORMS)}")
    return _FORMS[name](origin, earth)


def _moved(x: SinsLevel, C: Array, v: Array, offset: Array, dx: Array, earth: Earth) -> SinsLevel:
    drift, bias = x.drift + dx[LAYOUT.eps], x.bias + dx[LAYOUT.nabla]
    return SinsLevel(C, v, displaced(x.position, offset, earth), drift, bias)


def _differences(x: SinsLevel, y: SinsLevel, earth: Earth) -> tuple[Array, Array, Array]:
    """Return what ``y`` is more than ``x`` in velocity, position [m] and biases ``(6,)``."""
    biases = jnp.concatenate([y.drift - x.drift, y.bias - x.bias])
    return y.velocity - x.velocity, offset_between(x.position, y.position, earth), biases


def _additive(origin: Array, earth: Earth) -> ErrorForm:
    del origin
    s = LAYOUT

    def retract(x: SinsLevel, dx: Array) -> SinsLevel:
        C = so3_retract(x.dcm, dx[s.phi])
        return _moved(x, C, x.velocity + dx[s.dv], dx[s.dr], dx, earth)

    def local(x: SinsLevel, y: SinsLevel) -> Array:
        dv, dr, biases = _differences(x, y, earth)
        return jnp.concatenate([so3_local(x.dcm, y.dcm), dv, dr, biases])

    def itself(x: SinsLevel, d: Array) -> Array:
        del x
        return d

    return ErrorForm(retract, local, itself, itself)


def _left(origin: Array, earth: Earth) -> ErrorForm:
    del origin

    def turned(C: Array, d: Array) -> Array:
        three = [matmul(C, d[block]) for block in (LAYOUT.phi, LAYOUT.dv, LAYOUT.dr)]
        return jnp.concatenate([*three, d[_BIASES]])

    def retract(x: SinsLevel, dx: Array) -> SinsLevel:
        step = se23_exp(dx[_POSE])
        dv, dr = matmul(x.dcm, step.v), matmul(x.dcm, step.p)
        return _moved(x, matmul(x.dcm, step.C), x.velocity + dv, dr, dx, earth)

    def local(x: SinsLevel, y: SinsLevel) -> Array:
        dv, dr, biases = _differences(x, y, earth)
        back = x.dcm.T
        step = ExtendedPose(matmul(back, y.dcm), matmul(back, dv), matmul(back, dr))
        return jnp.concatenate([se23_log(step), biases])

    return ErrorForm(
        retract, local, lambda x, dx: turned(x.dcm, dx), lambda x, d: turned(x.dcm.T, d)
    )


def _right(origin: Array, earth: Earth) -> ErrorForm:
    s = LAYOUT

    def carried(x: SinsLevel, d: Array, sign: float) -> Array:
        """Add, or take away, how turning about the origin moves velocity and position."""
        p = offset_between(origin, x.position, earth)
        dv = d[s.dv] + sign * jnp.cross(d[s.phi], x.velocity)
        dr = d[s.dr] + sign * jnp.cross(d[s.phi], p)
        return jnp.concatenate([d[s.phi], dv, dr, d[_BIASES]])

    def retract(x: SinsLevel, dx: Array) -> SinsLevel:
        step = se23_exp(dx[_POSE])
        p = offset_between(origin, x.position, earth)
        v, moved = matmul(step.C, x.velocity) + step.v, matmul(step.C, p) + step.p
        return _moved(x, matmul(step.C, x.dcm), v, moved - p, dx, earth)

    def local(x: SinsLevel, y: SinsLevel) -> Array:
        _, dr, biases = _differences(x, y, earth)
        p = offset_between(origin, x.position, earth)
        C = so3_exp(so3_log(matmul(y.dcm, x.dcm.T)))
        step = ExtendedPose(C, y.velocity - matmul(C, x.velocity), p + dr - matmul(C, p))
        return jnp.concatenate([se23_log(step), biases])

    return ErrorForm(
        retract, local, lambda x, dx: carried(x, dx, 1.0), lambda x, d: carried(x, d, -1.0)
    )


_FORMS = {"additive": _additive, "left-invariant": _left, "right-invariant": _right}
