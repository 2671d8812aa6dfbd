"""The standard atmosphere and how it bends starlight.

A ray is named by its tangent height h, that of its lowest point. With the refractive index
``n = 1 + k rho`` and the radius ``a`` of the Earth, Bouguer's rule keeps ``n r sin z`` constant
along it, so its straight continuation passes the Earth's centre at ``a + h_a = n(h) (a + h)``: h_a
is the apparent height. R, the refraction angle, is the whole bending. Heights are in metres above
the sphere, angles in radians; k belongs to the mean wavelength.

References:
    US Standard Atmosphere 1976, NOAA-S/T 76-1562; Shi, Chen, Wang (2023), Eqs. (31)-(33).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from jaxnav.compiling import compiled
from jaxnav.navigation.earth import MEAN_RADIUS

REFRACTIVITY = 2.25e-4
"""Refractivity of air by its density, ``k = (n - 1) / rho`` [m^3/kg]."""
TOP = 86e3
"""Top of the model atmosphere [m]."""

# Base geopotential heights [m] and lapse rates [K/m] of US76, Table 4; the last layer, isothermal,
# continues the seven of the standard.
_BASES = np.array([0, 11e3, 20e3, 32e3, 47e3, 51e3, 71e3, 84852.0])
_LAPSES = np.array([-6.5e-3, 0, 1e-3, 2.8e-3, 0, -2.8e-3, -2e-3, 0])
_TEMPERATURES = 288.15 + np.cumsum(np.append(0, _LAPSES[:-1] * np.diff(_BASES)))
_GEOPOTENTIAL_RADIUS = 6356766.0
_GAS_CONSTANT = 8314.32 / 28.9644
_GRAVITY_BY_GAS = 9.80665 / _GAS_CONSTANT
_SPLITS = np.append(
    _GEOPOTENTIAL_RADIUS * _BASES / (_GEOPOTENTIAL_RADIUS - _BASES), [TOP + 30e3, TOP + 120e3]
)
LAYERS = tuple(float(height) for height in _SPLITS[1:-3])
"""Heights [m] at which the lapse rate jumps, and with it the slope of the refraction angle."""


def _fall(xp: Any, rise: Any, temperature: Any, lapse: Any) -> tuple[Any, Any]:
    """Return by how much ln rho falls over a rise [m] in a layer, and its rate there [1/m]."""
    sloping = lapse != 0
    ratio = xp.where(sloping, lapse, 1) * rise / temperature
    # Only the sloping layers read the logarithm; its argument must be sound for all.
    log = xp.log1p(xp.where(sloping, ratio, 0)) / xp.where(sloping, lapse, 1)
    rate = _GRAVITY_BY_GAS + lapse
    path = xp.where(sloping, log, rise / temperature)
    return rate * path, rate / (temperature + lapse * rise)


_LOG_DENSITIES = np.log(101325 / (_GAS_CONSTANT * 288.15)) - np.cumsum(
    np.append(0, _fall(np, np.diff(_BASES), _TEMPERATURES[:-1], _LAPSES[:-1])[0])
)
_PRESSURES = np.exp(_LOG_DENSITIES) * _GAS_CONSTANT * _TEMPERATURES


def _in_layer(height: Array, *of: np.ndarray) -> tuple[Array, list[Array]]:
    """Return the height's rise above the base of its layer, geopotential [m], and the layer's."""
    geopotential = height * (_GEOPOTENTIAL_RADIUS / (_GEOPOTENTIAL_RADIUS + height))
    layer = jnp.searchsorted(jnp.asarray(_BASES[1:]), geopotential, side="right")
    base, *found = (jnp.asarray(values)[layer] for values in (_BASES, *of))
    return geopotential - base, found


def _log_density(height: Array | float) -> tuple[Array, Array]:
    """Return ln of the density in kg/m^3 and its derivative by height [1/m]."""
    height = jnp.asarray(height, float)
    rise, (lapse, base, log_base) = _in_layer(height, _LAPSES, _TEMPERATURES, _LOG_DENSITIES)
    fall, rate = _fall(jnp, rise, base, lapse)
    return log_base - fall, -rate * (_GEOPOTENTIAL_RADIUS / (_GEOPOTENTIAL_RADIUS + height)) ** 2


def density(height: Array | float) -> Array:
    """Return the density of air [kg/m^3] of the US Standard Atmosphere 1976.

    Above :data:`TOP` the air is taken as isothermal at the temperature there, so the density goes
    on falling exponentially; below the surface the lapse rate of the troposphere continues.

    Args:
        height: Geometric height [m], any shape.

    References:
        US Standard Atmosphere 1976, Eqs. (18), (23), (33a), (33b), (42), Table 4.
    """
    return jnp.exp(_log_density(height)[0])


def temperature(height: Array | float) -> Array:
    """Return the molecular-scale temperature [K] of the US Standard Atmosphere 1976.

    Args:
        height: Geometric height [m], any shape.

    References:
        US Standard Atmosphere 1976, Eq. (23), Table 4.
    """
    rise, (lapse, base) = _in_layer(jnp.asarray(height, float), _LAPSES, _TEMPERATURES)
    return base + lapse * rise


def pressure(height: Array | float) -> Array:
    """Return the pressure of air [Pa] of the US Standard Atmosphere 1976.

    Args:
        height: Geometric height [m], any shape.

    References:
        US Standard Atmosphere 1976, Eqs. (33a), (33b).
    """
    return density(height) * _GAS_CONSTANT * temperature(height)


def pressure_height(pressure: Array | float) -> Array:
    """Return the geometric height [m] at which the standard atmosphere has a pressure.

    The inverse of :func:`pressure`, in closed form; NaN where the pressure is not positive.

    Args:
        pressure: Of the air [Pa], any shape.

    References:
        US Standard Atmosphere 1976, Eqs. (19), (33a), (33b).
    """
    pressure = jnp.asarray(pressure, float)
    layer = jnp.searchsorted(-jnp.asarray(_PRESSURES[1:]), -pressure, side="right")
    base, lapse, at_base, below = (
        jnp.asarray(values)[layer] for values in (_BASES, _LAPSES, _TEMPERATURES, _PRESSURES)
    )
    depth = jnp.log(below / jnp.where(pressure > 0, pressure, jnp.nan)) / _GRAVITY_BY_GAS
    sloping = lapse != 0
    path = jnp.where(sloping, jnp.expm1(lapse * depth) / jnp.where(sloping, lapse, 1), depth)
    geopotential = base + at_base * path
    return geopotential * _GEOPOTENTIAL_RADIUS / (_GEOPOTENTIAL_RADIUS - geopotential)


def apparent_height(
    height: Array | float,
    density_scale: Array | float = 1.0,
    radius: Array | float = MEAN_RADIUS,
) -> Array:
    """Return the apparent height ``h + k rho (radius + h)`` [m] of a ray.

    Args:
        height: Tangent height [m], any shape.
        density_scale: Factor on the density of the standard atmosphere.
        radius: Radius of the Earth [m].

    References:
        Shi, Chen, Wang (2023), Eq. (32), with the two radii of its second line told apart.
    """
    return height + REFRACTIVITY * density_scale * density(height) * (radius + height)


def refraction_angle(
    height: Array | float,
    density_scale: Array | float = 1.0,
    radius: Array | float = MEAN_RADIUS,
    nodes: int = 24,
) -> Array:
    """Return the bending [rad] of a ray that comes from and goes to space, by Bouguer's integral.

        R = -2 b int_{r_t}^inf n'(r) / (n sqrt(n^2 r^2 - b^2)) dr,   b = n(r_t) r_t

    With ``r = r_t + s^2`` the integrand is smooth at the tangent point. Gauss-Legendre panels meet
    at the boundaries of the atmosphere's layers and end 120 km above :data:`TOP`, where the density
    is 1e-10 of that there.

    The lapse rate jumps at the boundaries, so R has a root-like kink just below each: below 11 km,
    where it is largest, R falls with the height's fall for some 150 m.

    Args:
        height: Tangent height [m], a scalar; ``jax.vmap`` for many.
        density_scale: Factor on the density of the standard atmosphere.
        radius: Radius of the Earth [m].
        nodes: Nodes of each panel; the default is exact to 1e-9 relative.

    Raises:
        ValueError: If a height outside 0 to :data:`TOP` or a density factor that is not positive
            is given as a number; traced values are not looked at.

    References:
        Born and Wolf (1999), Principles of Optics, Sec. 3.2, for the rule n r sin z = const.
    """
    check_height("height", height)
    if not isinstance(density_scale, Tracer) and not np.all(np.asarray(density_scale) > 0):
        raise ValueError(f"density_scale must be positive, got {density_scale}")
    height = jnp.asarray(height, float)
    k = REFRACTIVITY * density_scale
    abscissae, weights = (jnp.asarray(of) for of in np.polynomial.legendre.leggauss(nodes))
    above = jnp.asarray(_SPLITS) - height
    higher = above > 0
    edges = jnp.where(higher, jnp.sqrt(jnp.where(higher, above, 1)), 0)
    half = 0.5 * jnp.diff(edges)
    s = (edges[:-1] + half)[:, None] + half[:, None] * abscissae[None]
    # Panels below the tangent point have no width; they are evaluated at a harmless place.
    s = jnp.where(half[:, None] > 0, s, 1)
    log_here, rate = _log_density(height + s**2)
    log_tangent, _ = _log_density(height)
    bending = k * jnp.exp(log_here)
    index, tangent = 1 + bending, radius + height
    b = tangent + k * jnp.exp(log_tangent) * tangent
    # n r - b, free of the cancellation of two radii: it is of the order of s^2.
    excess = index * s**2 + k * jnp.exp(log_tangent) * jnp.expm1(log_here - log_tangent) * tangent
    total = index * (tangent + s**2) + b
    integrand = -4 * b * bending * rate * s / (index * jnp.sqrt(excess * total))
    return jnp.sum(half[:, None] * weights[None] * integrand)


def check_height(name: str, height: Array | float) -> None:
    """Raise ``ValueError`` for a tangent height, given as a number, that no ray can have."""
    if isinstance(height, Tracer):
        return
    values = np.asarray(height)
    if not np.all((values >= 0) & (values <= TOP)):
        raise ValueError(f"{name} must be a tangent height from 0 to {TOP:.0f} m, got {height}")


class RefractionTable(NamedTuple):
    """Refraction angles of the standard atmosphere on a uniform grid of tangent heights.

    Attributes:
        low: Lowest tangent height [m].
        step: Interval of the grid [m].
        log_angle: ln of the angle in radians ``(N,)``.
    """

    low: Array
    step: Array
    log_angle: Array


def tabulate(
    low: float = 0.0, high: float = TOP, step: float = 100.0, radius: float = MEAN_RADIUS
) -> RefractionTable:
    """Return a table of :func:`refraction_angle`.

    Args:
        low: Lowest tangent height [m]; rays below it count as blocked.
        high: Highest tangent height [m]; rays above it count as straight.
        step: Interval of the grid [m], made a little smaller where it does not divide the range.
        radius: Radius of the Earth [m].

    Raises:
        ValueError: If the heights are not in order within 0 to :data:`TOP`, or the step is not
            positive.
    """
    check_height("low", low)
    check_height("high", high)
    if not low < high:
        raise ValueError(f"low must be below high, got {low} and {high}")
    if not step > 0:
        raise ValueError(f"step must be positive, got {step}")
    heights = np.linspace(low, high, int(np.ceil((high - low) / step * (1 - 1e-12))) + 1)
    log_angles = np.log(refraction_angles(heights, radius))
    grid = heights[1] - heights[0]
    return RefractionTable(*(jnp.asarray(part, float) for part in (low, grid, log_angles)))


def refraction_angles(heights: np.ndarray, radius: float = MEAN_RADIUS) -> np.ndarray:
    """Return :func:`refraction_angle` [rad] at tangent heights ``(N,) [m]``, in one program."""
    return np.asarray(_refraction_angles(heights, radius))


@compiled
def _refraction_angles(heights: Array, radius: Array) -> Array:
    return jax.vmap(lambda h: refraction_angle(h, radius=radius))(heights)


def table_angle(table: RefractionTable, height: Array) -> Array:
    """Return the refraction angle [rad] by interpolation, linear in ln R.

    With a step of 100 m the error is 1e-6 relative for most heights, but 2e-3 in the cell under the
    kink at 32 km and 8e-3 in that at 11 km. Outside the table ln R continues along the first or the
    last interval.

    A run whose density is ``1 + d`` times the standard one has about ``1 + d`` times the angle; the
    error of that is of second order, some ``0.4 d k rho r / H`` relative with the scale height H:
    9e-5 at 20 km for d = 1 %, 4e-5 at 25 km.

    Args:
        table: The table.
        height: Tangent height [m], any shape.
    """
    place = (height - table.low) / table.step
    cell = jnp.clip(jnp.floor(place).astype(int), 0, table.log_angle.shape[0] - 2)
    left, right = table.log_angle[cell], table.log_angle[cell + 1]
    return jnp.exp(left + (place - cell.astype(place.dtype)) * (right - left))
