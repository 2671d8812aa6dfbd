"""What a linear observation takes off a covariance and adds to a mean, with derivatives at hand.

With ``B = H P``, ``S = H P H' + R`` and the transposed gain ``K = inv(S) B``, the optimum of the
gain makes the derivative of the covariance one of two products, and none of a solution:

    d (B' inv(S) B) = W' K + K' W,   W = dB - dS K / 2

The functions are given what has been solved already, and leave its derivative out, which is part
of their own. What they are given is all that a backward pass needs of the forward one, and little:
it is named :data:`KEPT`, for a policy of ``jax.checkpoint`` that keeps it.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.ad_checkpoint import checkpoint_name

from jaxnav.numerics.linalg import Cholesky, kernel, log_det, matmul, solve_lower, solve_positive

KEPT = "solved"
"""Name of what is better kept for a backward pass than computed again."""


class Solved(NamedTuple):
    """An innovation and its covariance, solved.

    Attributes:
        root: The factor of ``S`` ``(m, m)``.
        inverse: ``inv(S)`` ``(m, m)``, for derivatives.
        weighed: ``inv(S) nu`` ``(m,)``, for derivatives.
    """

    root: Cholesky
    inverse: Array
    weighed: Array


@kernel
def solved(S: Array, root: Cholesky, nu: Array) -> Solved:
    """Return what the derivatives need; a program that takes none does not compute it."""
    inverse = solve_positive(root.factor, S, jnp.eye(S.shape[0], dtype=S.dtype))
    weighed = solve_positive(root.factor, S, nu)
    sound = checkpoint_name(root.positive_definite, KEPT)
    return Solved(
        root._replace(positive_definite=sound),
        checkpoint_name(inverse, KEPT),
        checkpoint_name(weighed, KEPT),
    )


@jax.custom_jvp
def explained(S: Array, B: Array, K: Array) -> Array:
    """Return the covariance ``B' inv(S) B`` that an observation explains.

    Args:
        S: ``(m, m)`` symmetric.
        B: ``(m, n)``.
        K: ``inv(S) B``; all that the value reads, beside ``B``.

    Returns:
        ``(n, n)``.
    """
    del S
    return matmul(K.T, B)


@explained.defjvp
def _explained_jvp(
    primals: tuple[Array, Array, Array], tangents: tuple[Array, Array, Array]
) -> tuple[Array, Array]:
    (S, B, K), (dS, dB, _) = primals, tangents
    half = matmul((dB - 0.5 * matmul(dS, K)).T, K)
    return explained(S, B, K), half + half.T


@jax.custom_jvp
def corrected(S: Array, B: Array, nu: Array, K: Array, y: Array) -> Array:
    """Return the correction ``B' inv(S) nu`` of a mean.

    Args:
        S: ``(m, m)`` symmetric.
        B: ``(m, n)``.
        nu: ``(m,)``.
        K: ``inv(S) B``; all that the value reads, beside ``nu``.
        y: ``inv(S) nu``, for the derivative.

    Returns:
        ``(n,)``.
    """
    del S, B, y
    return matmul(K.T, nu)


@corrected.defjvp
def _corrected_jvp(
    primals: tuple[Array, Array, Array, Array, Array],
    tangents: tuple[Array, Array, Array, Array, Array],
) -> tuple[Array, Array]:
    (S, B, nu, K, y), (dS, dB, dnu, _, _) = primals, tangents
    moved = matmul(dB.T, y) + matmul(K.T, dnu - matmul(dS, y))
    return corrected(S, B, nu, K, y), moved


@jax.custom_jvp
def squared(S: Array, nu: Array, L: Array, y: Array) -> Array:
    """Return ``nu' inv(S) nu``.

    Args:
        S: ``(m, m)`` symmetric.
        nu: ``(m,)``.
        L: Lower factor of ``S``, all that the value reads, beside ``nu``.
        y: ``inv(S) nu``, for the derivative.
    """
    del S, y
    white = solve_lower(L, nu)
    return jnp.sum(white * white)


@squared.defjvp
def _squared_jvp(
    primals: tuple[Array, Array, Array, Array], tangents: tuple[Array, Array, Array, Array]
) -> tuple[Array, Array]:
    (S, nu, L, y), (dS, dnu, _, _) = primals, tangents
    return squared(S, nu, L, y), jnp.sum(y * (2 * dnu - matmul(dS, y)))


@jax.custom_jvp
def log_volume(S: Array, L: Array, inverse: Array) -> Array:
    """Return ``log|S|``.

    Args:
        S: ``(m, m)`` symmetric.
        L: Its lower factor, all that the value reads.
        inverse: ``inv(S)``, for the derivative.
    """
    del S, inverse
    return log_det(L)


@log_volume.defjvp
def _log_volume_jvp(
    primals: tuple[Array, Array, Array], tangents: tuple[Array, Array, Array]
) -> tuple[Array, Array]:
    return log_volume(*primals), jnp.sum(primals[2] * tangents[0])
