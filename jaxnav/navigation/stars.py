"""Directions of stars: proper motion, and the rotation from the catalogue's to the launch frame."""

from typing import NamedTuple

import numpy as np
from jax import Array
from numpy.typing import NDArray

Values = NDArray[np.float64]


class StarCatalogue(NamedTuple):
    """Stars of a catalogue, in ICRS axes.

    Attributes:
        hip: ``(N,)`` numbers in the Hipparcos catalogue.
        right_ascension: ``(N,) [rad]`` at the epoch.
        declination: ``(N,) [rad]`` at the epoch.
        motion_ra: ``(N,) [rad/yr]`` proper motion in right ascension, times cos(declination).
        motion_dec: ``(N,) [rad/yr]`` proper motion in declination.
        magnitude: ``(N,)``.
        epoch: Julian year of the positions.
    """

    hip: NDArray[np.int64]
    right_ascension: Values
    declination: Values
    motion_ra: Values
    motion_dec: Values
    magnitude: Values
    epoch: float


def brighter(catalogue: StarCatalogue, magnitude: float) -> StarCatalogue:
    """Return the stars that are no fainter than a magnitude.

    Raises:
        ValueError: If there is none.
    """
    kept = catalogue.magnitude <= magnitude
    if not kept.any():
        raise ValueError(
            f"no star of the catalogue is as bright as magnitude {magnitude:g}; the brightest is "
            f"of {catalogue.magnitude.min():g}"
        )
    columns = {
        name: column[kept] for name, column in catalogue._asdict().items() if name != "epoch"
    }
    return catalogue._replace(**columns)


def directions(catalogue: StarCatalogue, year: Array | float) -> Values:
    """Return unit vectors ``(N, 3)`` in ICRS axes, with proper motion to a Julian year.

        s = u + (t - t0) (p mu_ra + q mu_dec),  normalised

    with ``p`` and ``q`` the unit vectors to the east and to the north at ``u``, so that nothing is
    singular at the poles. Parallax is left out, at most 0.8 arcsec and for nine in ten of the
    stars to magnitude 6.5 below 0.03, and so is the radial velocity, at most 0.1 arcsec in thirty
    years (61 Cygni). The directions are those seen from the barycentre of the solar system at rest:
    the aberration by the Earth's motion, up to 20.5 arcsec, is not in them.

    References:
        ESA (1997), The Hipparcos and Tycho Catalogues, vol. 1, section 1.5.5.
    """
    ra, dec = catalogue.right_ascension, catalogue.declination
    u, p, q = _triad(ra, dec)
    motion = p * catalogue.motion_ra[:, None] + q * catalogue.motion_dec[:, None]
    moved = u + (year - catalogue.epoch) * motion
    return moved / np.linalg.norm(moved, axis=1, keepdims=True)


def dcm_launch_icrs(
    latitude: Array | float, sidereal_time: Array | float, azimuth: Array | float
) -> Values:
    """Return the rotation ``(3, 3)`` from ICRS axes to those of the launch-inertial frame.

    The axis y is the vertical of the spherical Earth at lift-off, x the direction of flight, z to
    its right. The Earth's pole is taken for that of the ICRS: precession, a third of a degree since
    J2000, moves the launch point among the stars and nothing else.

    Args:
        latitude: Geocentric latitude of the launch point [rad].
        sidereal_time: Local sidereal time at lift-off [rad].
        azimuth: Of the axis x from north by east [rad].
    """
    up, east, north = _triad(np.array([sidereal_time]), np.array([latitude]))
    x = np.cos(azimuth) * north[0] + np.sin(azimuth) * east[0]
    return np.stack([x, up[0], np.cross(x, up[0])])


def _triad(longitude: Values, latitude: Values) -> tuple[Values, Values, Values]:
    """Return unit vectors outwards, to the east and to the north ``(N, 3)``."""
    sl, cl = np.sin(longitude), np.cos(longitude)
    sb, cb = np.sin(latitude), np.cos(latitude)
    zero = np.zeros_like(longitude)
    return (
        np.stack([cb * cl, cb * sl, sb], axis=1),
        np.stack([-sl, cl, zero], axis=1),
        np.stack([-sb * cl, -sb * sl, cb], axis=1),
    )
