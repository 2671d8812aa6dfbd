"""Magnetometer: the field of the Earth in body axes, with a hard iron that may be carried.

    z = C' B_n + m

The field is taken as the same all along a drive or flight of some tens of kilometres, where it
turns by less than a tenth of a degree. What is magnetic near the sensor and turns with it is ``m``;
soft iron, which bends the field, is to be calibrated away before.

References:
    Groves (2013), section 6.1.1; Chulliat et al. (2025), The US/UK World Magnetic Model for
    2025-2030, by the package ``pygeomag``.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.estimation.carried import carried_or
from jaxnav.estimation.models import Channel
from jaxnav.estimation.types import Input, Point
from jaxnav.numerics.linalg import matmul
from jaxnav.units import DEG

HARD_IRON = "hard_iron"
"""Name of the carried state ``(3,) [nT]``, body axes, that the channel sees, if there is one."""


class Magnetometer(NamedTuple):
    """Parameters of the channel.

    Attributes:
        field: ``B_n`` ``(3,) [nT]``, east, north, up; see :func:`magnetic_field`.
        sigma: Standard deviation of each axis [nT].
    """

    field: Array
    sigma: Array


def magnetometer() -> Channel:
    """Return the channel ``(3,)`` of the magnetic field in body axes [nT].

    Its parameters are a :class:`Magnetometer`. A carried state :data:`HARD_IRON` is added.
    """

    def observe(params: Magnetometer, x: Point, u: Input) -> Array:
        del u
        return matmul(x.dcm.T, params.field) + carried_or(x, HARD_IRON, 3, 0.0)

    return Channel(3, observe, lambda params, x, u: jnp.broadcast_to(params.sigma**2, (3,)))


def magnetic_field(position: np.ndarray | Array, year: float) -> np.ndarray:
    """Return the field of the Earth ``(3,) [nT]``, east, north, up, by the World Magnetic Model.

    Args:
        position: Geodetic ``(3,)``: latitude, longitude [rad] and ellipsoidal height [m].
        year: The date as a decimal year: 2026.5.

    Raises:
        ImportError: If ``pygeomag`` is not installed.
        ValueError: If no model at hand holds at that date.
    """
    try:
        from pygeomag import GeoMag
    except ImportError as error:
        raise ImportError(
            "the World Magnetic Model needs pygeomag: pip install jaxnav[magnetic]"
        ) from error
    latitude, longitude, height = np.asarray(position, float)
    epoch: Any = year  # annotated too narrowly there
    found = GeoMag(base_year=epoch).calculate(
        glat=latitude / DEG, glon=longitude / DEG, alt=height / 1e3, time=year
    )
    return np.array([found.y, found.x, -found.z])
