"""Star camera that looks past the limb: which stars it sees, and refracted by how much.

A star at the limb is seen bent by the angle R. As heights, the atmosphere gives that at which a
ray is bent by R, the geometry that at which it must have passed to reach the vehicle; their
difference is the observation, which is zero. R, and with it its noise, is in both, inside a
logarithm: taken for noise that adds, it leaves a bias of ``H (sigma / R)^2 / 2`` on every height.
As angles, the observation is R itself, by the angle under which the star is seen from a position;
its noise adds, but it is exponential in the position.

References:
    Shi, Chen, Wang (2023), Eqs. (32)-(42). The observation (39) is printed as additive noise on a
    height; the noise here is on the angle, where it arises, and the geometry is exact.
"""

from enum import IntEnum
from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.models import Channel
from jaxnav.estimation.types import Input, NonAdditive, Params, Point
from jaxnav.navigation.atmosphere import RefractionTable
from jaxnav.navigation.earth import MEAN_RADIUS
from jaxnav.navigation.limb import (
    HeightModel,
    model_height,
    ray_height,
    seen_refraction,
    separation,
)

RayForm = Literal["height", "angle"]


class Camera(NamedTuple):
    """A star camera.

    Attributes:
        boresight: Unit vector ``(3,)`` in inertial axes.
        half_angle: Of the cone it sees [rad]; pi for all round.
        magnitude_limit: Faintest magnitude it sees.
    """

    boresight: Array
    half_angle: Array | float
    magnitude_limit: Array | float


class Sight(IntEnum):
    """How a camera sees a star."""

    OUT_OF_VIEW = 0
    """Outside the cone, or too faint."""
    OCCULTED = 1
    """Behind the Earth."""
    REFRACTED = 2
    """Through the atmosphere."""
    CLEAR = 3
    """Above the atmosphere."""


class View(NamedTuple):
    """How a camera sees each star.

    Attributes:
        kind: A :class:`Sight` ``(N,)``, 32-bit integers.
        tangent_height: Of the ray ``(N,) [m]``; see
            :func:`~jaxnav.navigation.atmosphere.seen_refraction` for those that are not refracted.
        angle: Refraction angle ``(N,) [rad]``, zero for those.
        direction: Unit vectors ``(N, 3)`` of the apparent directions.
    """

    kind: Array
    tangent_height: Array
    angle: Array
    direction: Array


def view(
    table: RefractionTable,
    position: Array,
    stars: Array,
    magnitudes: Array,
    camera: Camera,
    density_scale: Array | float = 1.0,
    radius: Array | float = MEAN_RADIUS,
) -> View:
    """Return how a camera above the atmosphere sees a catalogue of stars.

    A star that is both outside the camera's cone and occulted counts as out of view; the cone holds
    the apparent directions.

    Args:
        table: Angles of the standard atmosphere; its range is that of the refracted rays.
        position: Of the camera, ``(3,) [m]`` from the Earth's centre.
        stars: Unit vectors ``(N, 3)`` of the true directions.
        magnitudes: ``(N,)``.
        camera: The camera.
        density_scale: Factor on the density of the atmosphere.
        radius: Radius of the Earth [m], as of the table.

    Raises:
        ValueError: If the catalogue's shapes do not agree.
    """
    if stars.ndim != 2 or stars.shape[1] != 3 or magnitudes.shape != stars.shape[:1]:
        raise ValueError(
            f"stars must be (N, 3) with magnitudes (N,), got {stars.shape} and {magnitudes.shape}"
        )

    def one(star: Array) -> tuple[Array, Array, Array]:
        seen = seen_refraction(table, position, star, density_scale, radius)
        return seen.angle, seen.tangent_height, raised(position, star, seen.angle)

    angle, height, direction = jax.vmap(one)(stars)
    off_axis = jax.vmap(separation, in_axes=(0, None))(direction, camera.boresight)
    visible = (off_axis <= camera.half_angle) & (magnitudes <= camera.magnitude_limit)
    kind = jnp.where(
        ~visible,
        int(Sight.OUT_OF_VIEW),
        jnp.where(
            height < table.low,
            int(Sight.OCCULTED),
            jnp.where(angle > 0, int(Sight.REFRACTED), int(Sight.CLEAR)),
        ),
    )
    return View(kind.astype(jnp.int32), height, angle, direction)


def raised(position: Array, star: Array, angle: Array) -> Array:
    """Return the direction ``(3,)`` of a star turned by an angle away from the Earth's centre.

    The turn is in the plane of star and position; a star at the zenith or the nadir has none and
    stays.

    Args:
        position: Of the observer, ``(3,) [m]`` from the Earth's centre.
        star: Unit vector ``(3,)`` of the true direction.
        angle: [rad].
    """
    upward = _unit(position - jnp.dot(position, star) * star)
    return jnp.cos(angle) * star + jnp.sin(angle) * upward


def _unit(x: Array) -> Array:
    squared = jnp.sum(x * x)
    nonzero = squared > 0
    return jnp.where(nonzero, x / jnp.sqrt(jnp.where(nonzero, squared, 1)), 0)


def pick(
    view: View,
    position: Array,
    stars: Array,
    magnitudes: Array,
    low: Array | float,
    high: Array | float,
    count: int,
) -> tuple[Array, Array]:
    """Return refracted stars of a band of tangent heights, spread around the limb.

    The first is the brightest in the band. Each of the following is the one whose azimuth about the
    vertical is farthest from all chosen so far; of equals the first of the catalogue.

    Args:
        view: Of the catalogue.
        position: Of the camera, ``(3,) [m]`` from the Earth's centre.
        stars: Unit vectors ``(N, 3)`` of the true directions.
        magnitudes: ``(N,)``.
        low: Lower end of the band [m].
        high: Upper end [m].
        count: Number of stars wanted.

    Returns:
        Indices ``(count,)`` into the catalogue and a mask ``(count,)``, false where the band holds
        no further star; the index there is valid but means nothing.

    Raises:
        ValueError: If ``count`` is below one.
    """
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}")
    in_band = (view.tangent_height >= low) & (view.tangent_height <= high)
    eligible = (view.kind == int(Sight.REFRACTED)) & in_band
    vertical = _unit(position)
    level = stars - jnp.sum(stars * vertical[None], axis=1)[:, None] * vertical[None]
    azimuths = jax.vmap(_unit)(level)

    def choose(state: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], tuple]:
        cost, left = state
        index = jnp.argmin(jnp.where(left, cost, jnp.inf))
        # The cosine falls with the angle, so the nearest chosen star has the largest.
        cosine = jnp.sum(azimuths * azimuths[index][None], axis=1)
        return (jnp.maximum(cost, cosine), left.at[index].set(False)), (index, left[index])

    brightest = jnp.argmin(jnp.where(eligible, magnitudes, jnp.inf))
    cosine = jnp.sum(azimuths * azimuths[brightest][None], axis=1)
    state = (cosine, eligible.at[brightest].set(False))
    _, (indices, mask) = jax.lax.scan(choose, state, None, length=count - 1)
    return (
        jnp.concatenate([brightest[None], indices]),
        jnp.concatenate([eligible[brightest][None], mask]),
    )


def measure(key: Array, angle: Array, noise: Array | float) -> Array:
    """Return measured refraction angles, which may be negative where they are small.

    Args:
        key: Random key.
        angle: True angle [rad], any shape.
        noise: Standard deviation of the white error [rad].
    """
    return angle + noise * jax.random.normal(key, angle.shape, angle.dtype)


def limb_stars(stars: int, radius: float, form: RayForm = "height") -> Channel:
    """Return the channel ``(stars,)`` of stars at the limb, for states in launch-inertial axes.

    It reads ``atmosphere``, ``refraction_noise`` [rad] and ``density_sigma``, one relative error of
    the atmosphere for all stars of an epoch, of its parameters, and ``star`` ``(stars, 3)``,
    ``angle`` ``(stars,)`` and ``density`` of the inputs. In ``noisy`` the noise of angles and
    density enters where it arises, ``(stars + 1,)``, in ``noise`` to first order.

    Args:
        stars: Number of stars.
        radius: Distance from the Earth's centre to the launch point, and to sea level [m].
        form: How refraction is observed, as differences of heights, whose values are zero, or as
            angles.

    Raises:
        ValueError: If ``form`` is neither; in a run, if the input has another number of stars.
    """
    if form not in _RAYS:
        raise ValueError(f"ray is {form!r}; it must be one of {', '.join(_RAYS)}")
    rays = _RAYS[form]

    def disturbed(params: Params, x: Point, v: Array, u: Input) -> Array:
        centred = x.position + jnp.array([0.0, 1.0, 0.0], v.dtype) * radius
        if u.star.shape != (stars, 3) or u.angle.shape != (stars,):
            raise ValueError(
                f"the input has stars {u.star.shape} and angles {u.angle.shape}; the model is made "
                f"for {stars}"
            )
        scale = u.density * (1 + v[-1])
        one = partial(rays, params.atmosphere, radius, centred, scale)
        return jax.vmap(one)(_Ray(u.star, u.angle, v[:-1]))

    def sources(params: Params, x: Point, u: Input) -> Array:
        del x
        angles = jnp.broadcast_to(params.refraction_noise**2, u.angle.shape)
        return jnp.concatenate([angles, params.density_sigma[None] ** 2])

    def noise(params: Params, x: Point, u: Input) -> Array:
        variances = sources(params, x, u)
        G = jax.jacfwd(lambda v: disturbed(params, x, v, u))(jnp.zeros_like(variances))
        return (G * variances[None]) @ G.T

    def observe(params: Params, x: Point, u: Input) -> Array:
        return disturbed(params, x, jnp.zeros(stars + 1, x.position.dtype), u)

    return Channel(stars, observe, noise, noisy=NonAdditive(disturbed, sources))


class _Ray(NamedTuple):
    """A star's direction ``(3,)``, its refraction angle as measured and the noise of that [rad]."""

    star: Array
    measured: Array
    noise: Array


def _height_difference(
    atmosphere: HeightModel, radius: float, position: Array, density: Array, ray: _Ray
) -> Array:
    """Return the height of a ray by the atmosphere less that by the geometry [m]."""
    angle = ray.measured - ray.noise
    by_atmosphere = model_height(atmosphere, angle / density)
    return by_atmosphere - ray_height(position, ray.star, angle, radius)


def _angle(
    atmosphere: RefractionTable, radius: float, position: Array, density: Array, ray: _Ray
) -> Array:
    """Return the angle that is measured [rad]."""
    return seen_refraction(atmosphere, position, ray.star, density, radius).angle + ray.noise


_RAYS = {"height": _height_difference, "angle": _angle}
