"""Where parameters live: smooth maps between their domains and the real line."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.arguments import described, require_leaves
from jaxnav.numerics.linalg import cholesky


class Transform(NamedTuple):
    """A smooth one-to-one map between real numbers and a parameter's domain.

    Attributes:
        constrain: From real numbers ``(d,)`` or ``()`` to the domain.
        unconstrain: Back; not finite outside the domain.
        domain: What is accepted, to follow "it must be".
    """

    constrain: Callable[[Array], Array]
    unconstrain: Callable[[Array], Array]
    domain: str


def _itself(x: Array) -> Array:
    return x


def _logit(p: Array) -> Array:
    return jnp.log(p) - jnp.log1p(-p)


REAL = Transform(_itself, _itself, "finite")
"""Any real number, as it is."""
FIXED = Transform(_itself, _itself, "finite")
"""A parameter that stays where it is: it has no coordinate."""
POSITIVE = Transform(jnp.exp, jnp.log, "positive and finite")
"""Positive parameters, by their logarithm."""
UNIT = Transform(jax.nn.sigmoid, _logit, "between 0 and 1")
"""Parameters between 0 and 1, by their log-odds."""


def above(low: float) -> Transform:
    """Return the domain above ``low``, by the logarithm of the distance."""
    return Transform(
        lambda u: low + jnp.exp(u), lambda p: jnp.log(p - low), f"above {low:g} and finite"
    )


def between(low: float, high: float) -> Transform:
    """Return the domain between two bounds, by the log-odds of the position.

    Raises:
        ValueError: If the bounds are not finite and in order.
    """
    if not -np.inf < low < high < np.inf:
        raise ValueError(f"the bounds are {low:g} and {high:g}; they must be finite and in order")
    return Transform(
        lambda u: low + (high - low) * jax.nn.sigmoid(u),
        lambda p: _logit((p - low) / (high - low)),
        f"between {low:g} and {high:g}",
    )


def _factor(u: Array) -> Array:
    n = round((np.sqrt(8 * u.size + 1) - 1) / 2)
    L = jnp.zeros((n, n), u.dtype).at[np.tril_indices(n)].set(u)
    diagonal = jnp.diag(L)
    return L + jnp.diag(jnp.exp(diagonal) - diagonal)


def _covariance(u: Array) -> Array:
    L = _factor(u)
    return L @ L.T


def _log_cholesky(P: Array) -> Array:
    root = cholesky(P)
    diagonal = jnp.diag(root.factor)
    L = root.factor + jnp.diag(jnp.log(diagonal) - diagonal)
    symmetric = jnp.all(jnp.abs(P - P.T) <= 1e-9 * jnp.max(jnp.abs(P)))
    return jnp.where(root.positive_definite & symmetric, L[np.tril_indices(P.shape[0])], jnp.nan)


COVARIANCE = Transform(_covariance, _log_cholesky, "symmetric and positive definite")
"""Covariances ``(n, n)``, by their Cholesky factor with the logarithm of its diagonal.

References:
    Pinheiro and Bates (1996), Statistics and Computing 6(3): the log-Cholesky parametrisation.
"""


def _weights(u: Array) -> Array:
    return jax.nn.softmax(jnp.append(u, jnp.zeros((), u.dtype)))


def _log_ratios(w: Array) -> Array:
    ratios = jnp.log(w[:-1]) - jnp.log(w[-1])
    return jnp.where(jnp.abs(jnp.sum(w) - 1) < 1e-9, ratios, jnp.nan)


SIMPLEX = Transform(_weights, _log_ratios, "positive with the sum 1")
"""Weights ``(M,)`` with the sum 1, by log-ratios to the last one."""


class Coordinates(NamedTuple):
    """The free parameters of a pytree as one vector of real numbers.

    Attributes:
        start: ``(d,)``.
        constrain: ``(d,) -> params``.
        labels: ``d`` names, such as ``theta[1]``.
        values: ``(d,) -> (d,)`` the parameter's value behind each coordinate; the coordinate itself
            where, as for a covariance, no one value stands behind it.
    """

    start: Array
    constrain: Callable[[Array], Any]
    labels: tuple[str, ...]
    values: Callable[[Array], Array]


def coordinates(params: Any, transform: Any = POSITIVE) -> Coordinates:
    """Return the real coordinates of parameters.

    Args:
        params: Pytree of parameters.
        transform: One :class:`Transform` for all leaves, or a pytree of them like ``params``.

    Raises:
        ValueError: If a value is outside its domain, or every parameter is fixed.
    """
    require_leaves("start", params)
    leaves, structure = jax.tree.flatten_with_path(params)
    names = [jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in leaves]
    values = [jnp.asarray(leaf, float) for _, leaf in leaves]
    if isinstance(transform, Transform):
        transforms = [transform] * len(values)
    else:
        transforms = _for_each(structure, transform)
    pieces = [
        _real(name, value, own) for name, value, own in zip(names, values, transforms, strict=True)
    ]
    sizes = [piece.size for piece in pieces]
    if not sum(sizes):
        raise ValueError("every parameter is fixed; a fit needs one that is not")
    ends = np.cumsum(sizes)[:-1]

    def bounded(point: Array) -> list[Array]:
        return [
            value if own is FIXED else own.constrain(part.reshape(piece.shape))
            for part, piece, value, own in zip(
                jnp.split(point, ends), pieces, values, transforms, strict=True
            )
        ]

    def behind(point: Array) -> Array:
        parts = zip(jnp.split(point, ends), bounded(point), strict=True)
        return jnp.concatenate(
            [v.reshape(-1) if v.size == u.size else u for u, v in parts if u.size]
        )

    start = jnp.concatenate([piece.reshape(-1) for piece in pieces])
    return Coordinates(
        start,
        lambda point: jax.tree.unflatten(structure, bounded(point)),
        _labels(names, pieces),
        behind,
    )


def _for_each(structure: Any, transform: Any) -> list[Transform]:
    """Return the transforms of a pytree in the order of the parameters."""
    try:
        found = structure.flatten_up_to(transform)
    except (KeyError, TypeError, ValueError):
        found = [transform]
    if not found or not all(isinstance(each, Transform) for each in found):
        raise ValueError(
            f"transform is {described(transform)}; it must be one Transform, or a tree of them "
            "like start"
        )
    return found


def _real(name: str, value: Array, transform: Transform) -> Array:
    if transform is FIXED:
        return jnp.zeros((0,), value.dtype)
    real = transform.unconstrain(value)
    if not bool(jnp.all(jnp.isfinite(real))):
        shown = value.tolist()
        raise ValueError(f"{name or 'the parameter'} is {shown}; it must be {transform.domain}")
    return real


def _labels(names: list[str], pieces: list[Array]) -> tuple[str, ...]:
    return tuple(
        name if piece.ndim == 0 else f"{name}[{i}]"
        for name, piece in zip(names, pieces, strict=True)
        for i in range(piece.size)
    )
