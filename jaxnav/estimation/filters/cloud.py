"""Clouds of sigma points and their moments, as matrices and as roots.

Points are tangent vectors at a mean; those that lie opposite to each other are summed in pairs.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxnav.numerics.linalg import matmul, symmetrise
from jaxnav.numerics.roots import downdate
from jaxnav.numerics.sigma import SigmaRule


class Cloud(NamedTuple):
    """Sigma points as tangent vectors at a mean, their weighted mean being zero.

    Attributes:
        offsets: ``(2 n, d)`` of the points, each ``n`` before the one opposite to it.
        centre: ``(d,)`` of the centre.
    """

    offsets: Array
    centre: Array


class Halves(NamedTuple):
    """The :class:`Cloud` of a function at points that lie opposite to each other.

    Of points drawn about their mean the state has an odd half only, so half of the products of
    moments vanish.

    Attributes:
        odd: ``(n, d)`` half the difference of opposite points.
        even: ``(n, d)`` half their sum.
        centre: ``(d,)`` of the centre.
    """

    odd: Array
    even: Array
    centre: Array


def drawn(rule: SigmaRule, L: Array) -> Cloud:
    """Return the points ``+-spread L_j`` of a factor ``(n, n)`` about their centre."""
    offsets = rule.spread * L.T
    return Cloud(jnp.concatenate([offsets, -offsets]), jnp.zeros(L.shape[0], L.dtype))


def once(points: Array) -> Array:
    """Return points ``(2 n, d)`` as they are, the model's function computed once for each.

    Every sum over the points would compute it anew; see
    :func:`~jaxnav.numerics.linalg.computed_once`.
    """
    return points @ jnp.eye(points.shape[1], dtype=points.dtype)


def centred(rule: SigmaRule, differences: Array) -> tuple[Array, Cloud]:
    """Return the mean of points ``(2 n, d)`` given relative to the centre, and the cloud."""
    mean = rule.weight * jnp.sum(differences, axis=0)
    return mean, Cloud(differences - mean[None], -mean)


def halves_of(cloud: Cloud) -> Halves:
    """Return the halves ``(n, d)`` of a cloud ``(2 n, d)``."""
    one, other = jnp.split(cloud.offsets, 2)
    return Halves(0.5 * (one - other), 0.5 * (one + other), cloud.centre)


def second_moment(rule: SigmaRule, a: Cloud, b: Cloud) -> Array:
    """Return ``sum w_i a_i b_i'``."""
    centre = rule.centre * (a.centre[:, None] * b.centre[None])
    return rule.weight * (a.offsets.T @ b.offsets) + centre


Left = Callable[[Array, Array], Array]
"""What an update leaves of the covariance: ``(gain (m, n), predicted P) -> P``."""


def moments(rule: SigmaRule, seen: Cloud, cloud: Cloud, R: Array) -> tuple[Array, Array, Left]:
    """Return ``S``, the cross moment ``(m, n)`` and what is left, for points of any kind."""
    S = symmetrise(second_moment(rule, seen, seen)) + R
    return S, second_moment(rule, seen, cloud), lambda K, P: P - matmul(K.T, matmul(S, K))


def drawn_moments(
    rule: SigmaRule, seen: Cloud, cloud: Cloud, R: Array
) -> tuple[Array, Array, Left]:
    """Return the same for points drawn about the mean, in a form that stays semi-definite.

    The even halves are taken about their own average, which leaves of a large negative weight of
    the centre what does not cancel: with ``m`` the mean and ``v = 2 n w``,

        2 w sum (e_i - m)(e_i - m)' + c m m'
            = 2 w sum (e_i - m / v)(e_i - m / v)' + (c + v - 2 + 1 / v) m m'
    """
    halves, weight = halves_of(seen), 2 * rule.weight
    spread = jnp.split(cloud.offsets, 2)[0]
    even = halves.even - jnp.mean(halves.even, axis=0)[None]
    total = weight * even.shape[0]
    centre = rule.centre + total - 2 + 1 / total
    apart = centre * (halves.centre[:, None] * halves.centre[None])
    rest = symmetrise(weight * (even.T @ even) + apart) + R
    S = symmetrise(weight * (halves.odd.T @ halves.odd)) + rest

    def left(K: Array, P: Array) -> Array:
        del P
        kept = spread - matmul(halves.odd, K)
        return weight * (kept.T @ kept) + matmul(K.T, matmul(rest, K))

    return S, weight * (halves.odd.T @ spread), left


class CentreColumn(NamedTuple):
    """The centre's column ``(d, 1)``: what to add to a root, and what to take away again."""

    above: Array
    below: Array


def centre_column(rule: SigmaRule, centre: Array) -> CentreColumn:
    """Return the column of a root of the second moment that the centre ``(d,)`` gives."""
    weight = jnp.asarray(rule.centre, centre.dtype)
    size = jnp.abs(weight)
    # the root of a zero weight would have no derivative
    root = jnp.where(size > 0, jnp.sqrt(jnp.where(size > 0, size, 1)), 0)
    column = (root * centre)[:, None]
    return CentreColumn(jnp.where(weight > 0, column, 0), jnp.where(weight < 0, column, 0))


def without(rule: SigmaRule, L: Array, below: Array) -> tuple[Array, Array]:
    """Take the column of a negative centre from a root; return it and whether that was possible."""
    if not isinstance(rule.centre, Array) and rule.centre >= 0:
        return L, jnp.array(True)
    return downdate(L, below[:, 0])
