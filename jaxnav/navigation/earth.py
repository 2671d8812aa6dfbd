"""The Earth: WGS84, point-mass gravity in the launch-inertial frame, and local level frames."""

import jax.numpy as jnp
from jax import Array

from jaxnav.numerics.linalg import safe_norm

GM = 3.986004418e14
"""Gravitational parameter [m^3/s^2] (WGS84)."""
WGS84_A = 6378137.0
"""Semi-major axis [m]."""
WGS84_F = 1 / 298.257223563
"""Flattening [-]."""
WGS84_E2 = WGS84_F * (2 - WGS84_F)
"""First eccentricity squared [-]."""
MEAN_RADIUS = 6.371e6
"""Radius [m] of the spherical Earth that stands for the ellipsoid where its shape is no matter."""


def meridian_radius(latitude: Array | float) -> Array:
    """Return the radius of curvature of the meridian [m] at a geodetic latitude [rad]."""
    s2 = jnp.sin(latitude) ** 2
    return WGS84_A * (1 - WGS84_E2) / (1 - WGS84_E2 * s2) ** 1.5


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
    """Return the Earth-fixed position ``(3,) [m]`` of latitude, longitude [rad] and height [m]."""
    latitude, longitude, height = geodetic[0], geodetic[1], geodetic[2]
    s, c = jnp.sin(latitude), jnp.cos(latitude)
    normal = WGS84_A / jnp.sqrt(1 - WGS84_E2 * s * s)
    return jnp.stack(
        [
            (normal + height) * c * jnp.cos(longitude),
            (normal + height) * c * jnp.sin(longitude),
            (normal * (1 - WGS84_E2) + height) * s,
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
