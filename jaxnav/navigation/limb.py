"""Stars seen through the limb of the atmosphere: the geometry of refraction and a filter's model.

Positions are from the Earth's centre, heights above the sphere [m], angles in radians; a ray is
named by its tangent height, as in :mod:`~jaxnav.navigation.atmosphere`.

References:
    Shi, Chen, Wang (2023), Eqs. (32), (33), (39)-(41).
"""

from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from scipy.interpolate import PPoly, make_lsq_spline

from jaxnav.compiling import compiled
from jaxnav.navigation.atmosphere import (
    LAYERS,
    RefractionTable,
    apparent_height,
    check_height,
    refraction_angles,
    table_angle,
)
from jaxnav.navigation.earth import MEAN_RADIUS
from jaxnav.numerics.linalg import safe_norm
from jaxnav.units import ARCSEC

ANGLE_FLOOR = 0.1 * ARCSEC
"""Angle [rad] below which :func:`model_height` continues along its tangent."""
PIECES = 48
"""Pieces that a :class:`HeightModel` has room for."""
INNER_KNOTS = 8
"""Knots of a fit inside the band, equally spaced in height."""
NEAR_KINKS = (-100.0, 0.0, 50.0, 200.0, 600.0)
"""Further knots, as distances [m] below each height at which the lapse rate jumps."""
_STEPS = 12


def ray_height(
    position: Array, star: Array, angle: Array | float, radius: Array | float = MEAN_RADIUS
) -> Array:
    """Return the apparent height [m] of the ray on which an observer sees a star.

        h_a = sqrt(r^2 - u^2) cos R + u sin R - radius,   u = -r . s

    It is exact above the atmosphere, and smooth in the position and in the angle.

    Args:
        position: Of the observer, ``(3,) [m]`` from the Earth's centre.
        star: Unit vector ``(3,)`` of the star's true direction.
        angle: Refraction angle [rad].
        radius: Radius of the Earth [m].

    Raises:
        ValueError: If a position below the surface is given as numbers.

    References:
        Shi, Chen, Wang (2023), Eqs. (32), (40) are its small-angle form.
    """
    _check_position(position, radius)
    along, across = _components(position, star)
    return across * jnp.cos(angle) + along * jnp.sin(angle) - radius


def _components(position: Array, star: Array) -> tuple[Array, Array]:
    """Return ``u = -r . s`` and ``sqrt(r^2 - u^2)``, the latter without cancellation."""
    return -jnp.dot(position, star), safe_norm(jnp.cross(position, star))


class HeightModel(NamedTuple):
    """Closed form of the apparent height by the refraction angle, for filters.

        h_a(R) = c_0 + c_1 t + c_2 t^2 + c_3 t^3 + slope R,   t = ln(R / 1 arcsec) - knot

    with the coefficients of the piece whose knot is the last below. The cubic is the tangent
    height; ``slope = sqrt(H (radius + h0) / (2 pi))`` turns the angle into ``k rho (radius + h)``,
    as for an exponential atmosphere of scale height H.

    Attributes:
        knots: ``(pieces,)`` lower ends of the pieces in ``ln(R / 1 arcsec)``, infinite after those
            in use, so that all models have one shape. Below all of them the first piece is meant.
        coefficients: ``(pieces, 4) [m]``.
        slope: [m/rad].
    """

    knots: Array
    coefficients: Array
    slope: Array


def model_height(model: HeightModel, angle: Array | float) -> Array:
    """Return the apparent height [m] of a ray by its refraction angle.

    Below :data:`ANGLE_FLOOR`, and so for zero and negative measurements, the height continues along
    the tangent at that angle: finite, continuous with its derivative, and with so steep a slope
    (tens of kilometres per arc second) that a filter gives such a measurement no weight.

    Args:
        model: The model.
        angle: Refraction angle [rad], a scalar; ``jax.vmap`` for many.
    """
    floored = jnp.maximum(angle, ANGLE_FLOOR)
    x = jnp.log(floored / ARCSEC)
    piece = jnp.maximum(jnp.sum(x >= model.knots) - 1, 0)
    c, t = model.coefficients[piece], x - model.knots[piece]
    height = c[0] + t * (c[1] + t * (c[2] + t * c[3])) + model.slope * floored
    rate = (c[1] + t * (2 * c[2] + t * 3 * c[3])) / floored + model.slope
    return height + rate * (angle - floored)


def exponential_model(
    intercept: float = 57.08e3,
    scale_height: float = 6.44e3,
    height: float = 25e3,
    radius: float = MEAN_RADIUS,
) -> HeightModel:
    """Return the model of an exponential atmosphere, ``h = intercept - scale_height ln R``.

    The defaults are the printed constants; against a ray traced through the standard atmosphere
    they err by -0.32 km at 20 km, -0.10 km at 25 km and +0.06 km at 40 km.

    Args:
        intercept: Tangent height [m] of a ray that is bent by one second of arc.
        scale_height: Of the density [m].
        height: Tangent height [m] at which the slope is taken.
        radius: Radius of the Earth [m].

    References:
        Shi, Chen, Wang (2023), Eq. (40), where the heights are in km and R in arc seconds.
    """
    slope = float(np.sqrt(scale_height * (radius + height) / (2 * np.pi)))
    return _of_pieces(np.zeros(1), np.array([[intercept, -scale_height, 0.0, 0.0]]), slope)


def fitted_model(low: float = 20e3, high: float = 40e3, radius: float = MEAN_RADIUS) -> HeightModel:
    """Return the model that fits the traced standard atmosphere over a band of tangent heights.

    A cubic spline in ln R, by least squares, and straight beyond the band; its knots lie closer
    where the lapse rate jumps. From 20 to 40 km it is within 13 m of the trace, 0.6 m in the root
    mean square.

    Args:
        low: Lower end of the band [m].
        high: Upper end [m].
        radius: Radius of the Earth [m].

    Raises:
        ValueError: If the band is not in order within 0 to :data:`~.atmosphere.TOP`.
    """
    check_height("low", low)
    check_height("high", high)
    if not low < high:
        raise ValueError(f"low must be below high, got {low} and {high}")
    kinks = [kink for kink in LAYERS if low < kink < high]
    spaced = np.linspace(low, high, INNER_KNOTS + 2)[1:-1]
    inner = np.concatenate([spaced, *(kink - np.array(NEAR_KINKS) for kink in kinks)])
    inner = np.unique(np.round(inner[(inner > low) & (inner < high)]))
    steps = np.concatenate([[low], inner, [high]])
    # Points between all knots, as least squares needs; a spline's argument rises with the angle.
    grid = np.concatenate([np.linspace(a, b, 24)[:-1] for a, b in pairwise(steps)])
    heights = np.append(grid, high)[::-1]
    angles = refraction_angles(heights, radius)
    # For some metres below a kink the angle falls with the height: the fit goes through the middle.
    order = np.argsort(angles)
    if np.max(np.abs(heights[order] - heights)) > 50:
        raise ValueError(
            f"between {low} and {high} m the refraction angle does not fall with the height, so no "
            "height belongs to an angle; the band must be above 11.1 km"
        )
    heights, angles = heights[order], angles[order]
    x = np.log(angles / ARCSEC)
    scale_height = (high - low) / (x[-1] - x[0])
    slope = float(exponential_model(0.0, scale_height, 0.5 * (low + high), radius).slope)
    apparent = np.asarray(compiled(apparent_height)(heights, radius=radius))
    ends = np.full(4, x[0]), np.full(4, x[-1])
    inner_x = np.interp(-inner, -heights, x)
    knots = np.concatenate([ends[0], np.sort(inner_x), ends[1]])
    spline = PPoly.from_spline(make_lsq_spline(x, apparent - slope * angles, knots, k=3))
    inside = PPoly(spline.c[:, 3:-3], spline.x[3:-3])
    return _of_pieces(*_with_straight_ends(inside), slope)


def _of_pieces(knots: np.ndarray, coefficients: np.ndarray, slope: float) -> HeightModel:
    """Return a model of given pieces, with room for more."""
    unused = PIECES - len(coefficients)
    return HeightModel(
        jnp.asarray(np.pad(knots, (0, unused), constant_values=np.inf), float),
        jnp.asarray(np.pad(coefficients, ((0, unused), (0, 0))), float),
        jnp.asarray(slope, float),
    )


def _with_straight_ends(spline: PPoly) -> tuple[np.ndarray, np.ndarray]:
    """Return knots and coefficients of a cubic spline that goes on straight beyond its ends.

    The piece below the first knot has that knot too: it is the one for which none is below.
    """
    ends = np.array([spline.x[0], spline.x[-1]])
    zero = np.zeros(2)
    below, above = np.stack([spline(ends), spline(ends, 1), zero, zero], axis=1)
    knots = np.concatenate([ends[:1], spline.x])
    return knots, np.concatenate([below[None], spline.c[::-1].T, above[None]])


class Seen(NamedTuple):
    """The ray on which a star is seen.

    Attributes:
        angle: Refraction angle [rad].
        tangent_height: [m].
    """

    angle: Array
    tangent_height: Array


def seen_refraction(
    table: RefractionTable,
    position: Array,
    star: Array,
    density_scale: Array | float = 1.0,
    radius: Array | float = MEAN_RADIUS,
) -> Seen:
    """Return the refraction angle and the tangent height under which a star is truly seen.

    Solves ``n(h) (radius + h) = sqrt(r^2 - u^2) cos R(h) + u sin R(h)`` with ``u = -r . s`` for h
    by Newton's method within a shrinking bracket, to 1e-6 m. Derivatives are those of the implicit
    function. The left side less the right rises with h, except just below 11 km for an observer
    farther than some 2000 km from the limb, who sees several images there: one of them is returned.

    Args:
        table: Angles of the standard atmosphere.
        position: Of the observer, above the atmosphere, ``(3,) [m]`` from the Earth's centre.
        star: Unit vector ``(3,)`` of the star's true direction.
        density_scale: Factor on the density; it multiplies the table's angles.
        radius: Radius of the Earth [m], as of the table.

    Returns:
        The ray. The angle is zero for a star that is not seen through the table's heights. The
        height is then that of the straight line's lowest point, if that is above the table (the
        observer's own for a star that is not behind the limb), or, if even the ray at the table's
        lowest height passes below the observer, that height less the distance by which it does:
        below the table, a star is occulted.

    Raises:
        ValueError: If a position below the surface is given as numbers.
    """
    _check_position(position, radius)
    along, across = _components(position, star)
    low = table.low
    high = low + (table.log_angle.shape[0] - 1) * table.step

    def gap(height: Array, u: Array, p: Array, scale: Array | float) -> Array:
        R = scale * table_angle(table, height)
        seen = p * jnp.cos(R) + u * jnp.sin(R) - radius
        return apparent_height(height, scale, radius) - seen

    # The solution is found on constants; the last step of Newton's method carries the derivative.
    constants = jax.lax.stop_gradient((along, across, density_scale))

    def linearised(height: Array) -> tuple[Array, Array]:
        return jax.jvp(lambda h: gap(h, *constants), (height,), (jnp.ones_like(height),))

    def improve(_: int, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        height, floor, ceiling = state
        value, rate = linearised(height)
        floor, ceiling = jnp.where(value > 0, floor, height), jnp.where(value > 0, height, ceiling)
        trial = height - value / jnp.where(rate > 0, rate, 1)
        sound = (rate > 0) & (trial >= floor) & (trial <= ceiling)
        return jnp.where(sound, trial, 0.5 * (floor + ceiling)), floor, ceiling

    start = jnp.clip(constants[1] - radius, low, high)
    found, _, _ = jax.lax.fori_loop(0, _STEPS, improve, (start, low, high))
    found = found - gap(found, along, across, density_scale) / linearised(found)[1]
    deficit = gap(low, along, across, density_scale)
    straight = jnp.where(along > 0, across, safe_norm(position)) - radius
    clear = (along <= 0) | (gap(high, along, across, density_scale) < 0)
    blocked = ~clear & (deficit > 0)
    height = jnp.where(clear, straight, jnp.where(blocked, low - deficit, found))
    angle = density_scale * table_angle(table, found)
    return Seen(jnp.where(clear | blocked, 0, angle), height)


def separation(a: Array, b: Array) -> Array:
    """Return the angle [rad] between two unit vectors ``(3,)``, exact for small angles.

    The gradient is zero, not NaN, where they are equal.
    """
    return jnp.arctan2(safe_norm(jnp.cross(a, b)), jnp.dot(a, b))


def _check_position(position: Array, radius: Array | float) -> None:
    if isinstance(position, Tracer) or isinstance(radius, Tracer):
        return
    distance = float(np.linalg.norm(position))
    if not distance >= radius:
        raise ValueError(
            f"position is {distance:.0f} m from the Earth's centre, inside its radius of "
            f"{radius:.0f} m; it must be given from the centre, not from the launch point"
        )
