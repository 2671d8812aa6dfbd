"""The Earth: WGS84 with its gravity, point-mass gravity, local level frames and their rates."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxnav.numerics.lie import wrapped_angle
from jaxnav.numerics.linalg import safe_norm
from jaxnav.units import STANDARD_GRAVITY

GM = 3.986004418e14
"""Gravitational parameter [m^3/s^2] (WGS84)."""
MEAN_RADIUS = 6.371e6
"""Radius [m] of the spherical Earth that stands for the ellipsoid where its shape is no matter."""


class Earth(NamedTuple):
    """An ellipsoid of revolution that turns, with its normal gravity; the default is WGS84.

    Attributes:
        semi_major: Equatorial radius ``a`` [m].
        flattening: ``f``.
        rate: Rate of rotation [rad/s].
        gravity: Normal gravity at the equator [m/s^2].
        growth: Somigliana's constant ``k``, the growth of gravity to the poles.
        centrifugal: ``m = rate^2 a^2 b / GM``, the centrifugal share at the equator.

    References:
        NGA (2014), World Geodetic System 1984, NGA.STND.0036.
    """

    semi_major: float = 6378137.0
    flattening: float = 1 / 298.257223563
    rate: float = 7.292115e-5
    gravity: float = 9.7803253359
    growth: float = 0.00193185265241
    centrifugal: float = 0.00344978650684

    @property
    def eccentricity2(self) -> float:
        """First eccentricity squared."""
        return self.flattening * (2 - self.flattening)


WGS84 = Earth()
FLAT = Earth(1e18, 0.0, 0.0, STANDARD_GRAVITY, 0.0, 0.0)
"""An Earth that neither turns nor curves, for what holds only there: a sphere so large that near
latitude and longitude zero the local level frame turns by less than 1e-14 rad/s."""


def meridian_radius(latitude: Array | float, earth: Earth = WGS84) -> Array:
    """Return the radius of curvature of the meridian [m] at a geodetic latitude [rad]."""
    e2 = earth.eccentricity2
    return earth.semi_major * (1 - e2) / (1 - e2 * jnp.sin(latitude) ** 2) ** 1.5


def transverse_radius(latitude: Array | float, earth: Earth = WGS84) -> Array:
    """Return the radius of curvature of the prime vertical [m] at a geodetic latitude [rad]."""
    return earth.semi_major / jnp.sqrt(1 - earth.eccentricity2 * jnp.sin(latitude) ** 2)


def normal_gravity(latitude: Array | float, height: Array | float, earth: Earth = WGS84) -> Array:
    """Return normal gravity [m/s^2], downward along the ellipsoid's normal.

    Somigliana's formula on the ellipsoid, of second order in the height above it:

        g0 = g_e (1 + k sin^2 L) / sqrt(1 - e^2 sin^2 L)
        g = g0 (1 - 2 (1 + f + m - 2 f sin^2 L) h / a + 3 h^2 / a^2)

    Args:
        latitude: Geodetic latitude ``L`` [rad].
        height: Ellipsoidal height ``h`` [m].
        earth: The Earth.

    References:
        Groves (2013), Eqs. (2.134) and (2.139), whose northward part, 8e-9 h m/s^2, is left out.
    """
    s2 = jnp.sin(latitude) ** 2
    surface = earth.gravity * (1 + earth.growth * s2) / jnp.sqrt(1 - earth.eccentricity2 * s2)
    f, relative = earth.flattening, height / earth.semi_major
    slope = 2 * (1 + f + earth.centrifugal - 2 * f * s2)
    return surface * (1 - slope * relative + 3 * relative**2)


def earth_rate(latitude: Array, earth: Earth = WGS84) -> Array:
    """Return the Earth's rate ``(3,) [rad/s]`` in east, north, up."""
    zero = jnp.zeros_like(latitude)
    return earth.rate * jnp.stack([zero, jnp.cos(latitude), jnp.sin(latitude)])


def metres_per_radian(position: Array, earth: Earth = WGS84) -> Array:
    """Return ``(3,)`` the metres north, east and up of a unit of latitude, longitude and height."""
    latitude, height = position[0], position[2]
    north = meridian_radius(latitude, earth) + height
    east = (transverse_radius(latitude, earth) + height) * jnp.cos(latitude)
    return jnp.stack([north, east, jnp.ones_like(height)])


def transport_rate(position: Array, velocity: Array, earth: Earth = WGS84) -> Array:
    """Return the rate ``(3,) [rad/s]`` at which east, north, up turn as the vehicle moves.

    ``w_en = (-v_N / (R_M + h), v_E / (R_N + h), v_E tan L / (R_N + h))``; singular at the poles.

    Args:
        position: Latitude, longitude [rad], height [m].
        velocity: East, north, up ``(3,) [m/s]``.
        earth: The Earth.
    """
    latitude, height = position[0], position[2]
    east = velocity[0] / (transverse_radius(latitude, earth) + height)
    north = velocity[1] / (meridian_radius(latitude, earth) + height)
    return jnp.stack([-north, east, east * jnp.tan(latitude)])


def require_wide(position: Array) -> None:
    """Raise ``ValueError`` for a position on the Earth in floats of 32 bits.

    They resolve half a metre there; what a step adds to a position is lost in their rounding.
    """
    dtype = jnp.result_type(position)
    if jnp.finfo(dtype).bits < 64:
        raise ValueError(
            f"a position on the Earth is of {dtype}, which resolves half a metre; it must be of "
            'float64, for which jax.config.update("jax_enable_x64", True) comes first'
        )


def displaced(position: Array, offset: Array, earth: Earth = WGS84) -> Array:
    """Return the geodetic position an offset ``(3,) [m]`` east, north, up away, to first order.

    Raises:
        ValueError: If the position is of 32 bits.
    """
    require_wide(position)
    return position + offset[jnp.array([1, 0, 2])] / metres_per_radian(position, earth)


def offset_between(position: Array, other: Array, earth: Earth = WGS84) -> Array:
    """Return east, north, up ``(3,) [m]`` from a geodetic position to another one near.

    Inverse of :func:`displaced`; the difference of longitudes is taken within half a turn.

    Raises:
        ValueError: If a position is of 32 bits.
    """
    require_wide(position)
    require_wide(other)
    difference = other - position
    turn = wrapped_angle(other[1], position[1])
    metres = metres_per_radian(position, earth) * difference.at[1].set(turn)
    return metres[jnp.array([1, 0, 2])]


def gravity_launch_inertial(r: Array, radius: Array | float) -> Array:
    """Return the gravitation of a point-mass Earth ``(3,) [m/s^2]`` in the launch-inertial frame.

    Args:
        r: Position ``(3,) [m]`` from the launch point; x downrange, y up, z right.
        radius: Distance from the Earth's centre to the launch point [m].
    """
    from_centre = r + jnp.array([0.0, 1.0, 0.0], r.dtype) * radius
    distance = safe_norm(from_centre)
    return -GM / distance**3 * from_centre


def gravity_gradient_launch_inertial(r: Array, radius: Array | float) -> Array:
    """Return the derivative ``(3, 3) [1/s^2]`` of :func:`gravity_launch_inertial` by position.

    ``F_a = -GM / l^3 (I - 3 l l' / |l|^2)`` with ``l = r + (0, radius, 0)``.

    References:
        Si, Wang, Niu, Eq. (23).
    """
    from_centre = r + jnp.array([0.0, 1.0, 0.0], r.dtype) * radius
    distance = safe_norm(from_centre)
    unit = from_centre / distance
    return -GM / distance**3 * (jnp.eye(3, dtype=r.dtype) - 3 * unit[:, None] * unit[None, :])


def ecef_from_geodetic(geodetic: Array) -> Array:
    """Return the Earth-fixed position ``(3,) [m]`` of latitude, longitude [rad] and height [m].

    Raises:
        ValueError: If the position is of 32 bits.
    """
    require_wide(geodetic)
    latitude, longitude, height = geodetic[0], geodetic[1], geodetic[2]
    s, c = jnp.sin(latitude), jnp.cos(latitude)
    normal = transverse_radius(latitude)
    return jnp.stack(
        [
            (normal + height) * c * jnp.cos(longitude),
            (normal + height) * c * jnp.sin(longitude),
            (normal * (1 - WGS84.eccentricity2) + height) * s,
        ]
    )


def dcm_ne(latitude: Array, longitude: Array) -> Array:
    """Return ``C_ne`` ``(3, 3)``, from Earth-fixed axes to east, north, up."""
    sl, cl = jnp.sin(latitude), jnp.cos(latitude)
    so, co = jnp.sin(longitude), jnp.cos(longitude)
    return jnp.stack(
        [
            jnp.stack([-so, co, jnp.zeros_like(so)]),
            jnp.stack([-sl * co, -sl * so, cl]),
            jnp.stack([cl * co, cl * so, sl]),
        ]
    )


def enu_from_geodetic(geodetic: Array, origin: Array) -> Array:
    """Return east, north, up ``(3,) [m]`` of a geodetic point in the level frame at ``origin``."""
    offset = ecef_from_geodetic(geodetic) - ecef_from_geodetic(origin)
    return dcm_ne(origin[0], origin[1]) @ offset
