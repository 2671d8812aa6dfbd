"""Small-matrix kernels that XLA can fuse: no LAPACK call, no batched ``dot`` for small sizes.

A batched ``dot`` of 3x3 blocks and a LAPACK call per step each cost more than the arithmetic of a
whole Kalman step, so the sizes a navigation filter meets (three axes, up to six measurements) are
written out as multiply-adds over Python loops that unroll at trace time. Above that a rolled loop
takes a matrix column by column, looking back at the columns that are done: unrolled it would take
seconds to compile. Batched LAPACK calls also share their threads with whoever calls them.
"""

from itertools import accumulate
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.numerics.products import UNROLL_LIMIT, product

kernel = jax.jit
"""Has a function traced once for each shape, wherever and however often it is used: a filter is
traced through its transformations many times, and what is written out in multiply-adds is most of
it. The compiler takes the call apart again."""


def symmetrise(A: Array) -> Array:
    """Return the symmetric part ``(A + A') / 2`` of a matrix ``(n, n)``."""
    return 0.5 * (A + A.T)


def matmul(A: Array, B: Array) -> Array:
    """Return ``A @ B`` as a sum of outer products, unrolled over a small inner dimension.

    Args:
        A: Left factor ``(m, k)``.
        B: Right factor ``(k, n)`` or ``(k,)``.

    Returns:
        The product ``(m, n)`` or ``(m,)``.
    """
    if B.ndim == 1:
        return product(A, B[:, None])[:, 0]
    return product(A, B)


def rotated_diagonal(C: Array, variances: Array) -> Array:
    """Return ``C diag(variances) C'``, the covariance of independent errors seen in other axes."""
    return matmul(C * variances[None], C.T)


def computed_once(tree: Any) -> Any:
    """Return small arrays as they are, computed once wherever they are used after.

    XLA on CPUs fuses what is cheap to write into every loop that reads it, and computes it there
    anew for each element; an optimisation barrier does not stop it, an operand of a ``dot`` does.
    The product with the identity is exact, at n^2 multiply-adds for n numbers.
    """
    leaves, structure = jax.tree.flatten(tree)
    flat = jnp.concatenate([leaf.reshape(-1) for leaf in leaves])
    flat = jnp.eye(flat.shape[0], dtype=flat.dtype) @ flat
    ends = list(accumulate(leaf.size for leaf in leaves))
    pieces = [flat[end - leaf.size : end] for leaf, end in zip(leaves, ends, strict=True)]
    shaped = [piece.reshape(leaf.shape) for piece, leaf in zip(pieces, leaves, strict=True)]
    return jax.tree.unflatten(structure, shaped)


def safe_norm(x: Array) -> Array:
    """Return the Euclidean norm of ``(n,)`` with a zero gradient, not NaN, at the origin."""
    squared = jnp.sum(x * x)
    nonzero = squared > 0
    return jnp.where(nonzero, jnp.sqrt(jnp.where(nonzero, squared, 1)), 0)


def safe_sqrt(x: Array) -> Array:
    """Return the square root, with a zero derivative instead of an infinite one at zero."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1)), 0)


class Cholesky(NamedTuple):
    """Lower Cholesky factor ``L L' = S`` with the health of the factorisation.

    Attributes:
        factor: ``(m, m)`` lower factor; the identity where ``S`` is not positive definite.
        positive_definite: Whether every pivot was positive.
        reciprocal_pivot: Smallest ratio of a pivot to its diagonal entry: 1 for a diagonal matrix,
            about the machine epsilon when the factor has lost all its digits.
    """

    factor: Array
    positive_definite: Array
    reciprocal_pivot: Array


@kernel
def cholesky(S: Array) -> Cholesky:
    """Factor a symmetric matrix ``(m, m)``; a failed factorisation is reported, never NaN.

    Only the lower triangle is read. Where a pivot is not positive the factor is the identity, so a
    caller can select against it without poisoning gradients.
    """
    found = eliminated(S).factor
    sound = jnp.all(jnp.diag(found) > 0)
    factor = jnp.where(sound, found, jnp.eye(S.shape[0], dtype=S.dtype))
    ratio = jnp.min(jnp.diag(factor) ** 2 / jnp.where(sound, jnp.diag(S), 1))
    return Cholesky(factor, sound, jnp.where(sound, ratio, 0))


class Elimination(NamedTuple):
    """A symmetric matrix taken apart.

    Attributes:
        factor: ``(n, n)`` lower; columns whose pivot is not positive are zero.
        pivots: ``(n,)`` what was left on the diagonal when its column's turn came. A verdict: it
            has no derivative.
    """

    factor: Array
    pivots: Array


@jax.custom_jvp
def eliminated(S: Array) -> Elimination:
    """Take a symmetric matrix ``(n, n)`` apart column by column; only the lower half is read.

    The derivative is that of the columns with a positive pivot, the others staying zero, by two
    substitutions: ``dL = L Phi(inv(L) dS inv(L'))``, ``Phi`` the lower half with half the diagonal.
    """
    return _eliminated_unrolled(S) if S.shape[0] <= UNROLL_LIMIT else _eliminated_rolled(S)


@eliminated.defjvp
def _eliminated_jvp(
    primals: tuple[Array], tangents: tuple[Array]
) -> tuple[Elimination, Elimination]:
    (S,), (dS,) = primals, tangents
    done = eliminated(S)
    L, good = invertible(done.factor)
    half = jnp.tril(dS) - 0.5 * jnp.diag(jnp.diag(dS))
    inner = solve_lower(L, solve_lower(L, half + half.T).T)
    inner = jnp.tril(inner) - 0.5 * jnp.diag(jnp.diag(inner))
    return done, Elimination(L @ jnp.where(good[None], inner, 0), jnp.zeros_like(done.pivots))


def invertible(L: Array) -> tuple[Array, Array]:
    """Return a lower factor ``(n, n)`` with ones for its zero pivots, and which ``(n,)`` were not.

    One that is not finite gives the identity, so that a derivative that nobody asks for is finite.
    """
    good = jnp.diag(L) > 0
    whole = L + jnp.diag(jnp.where(good, 0, 1).astype(L.dtype))
    return jnp.where(jnp.all(jnp.isfinite(L)), whole, jnp.eye(L.shape[0], dtype=L.dtype)), good


@kernel
def _eliminated_unrolled(S: Array) -> Elimination:
    zero = jnp.zeros((), S.dtype)
    L: list[list[Array]] = []
    scales: list[Array] = []
    pivots: list[Array] = []
    for i in range(S.shape[0]):
        row: list[Array] = []
        for j in range(i):
            row.append((S[i, j] - _dot(row[:j], L[j][:j])) * scales[j])
        pivots.append(S[i, i] - _dot(row, row))
        scales.append(_over_root(pivots[i]))
        L.append([*row, safe_sqrt(pivots[i])])
    rows = [jnp.stack(row + [zero] * (S.shape[0] - len(row))) for row in L]
    return Elimination(jnp.stack(rows), jnp.stack(pivots))


@kernel
def _eliminated_rolled(S: Array) -> Elimination:
    index = jnp.arange(S.shape[0])

    def eliminate(L: Array, given: tuple[Array, Array]) -> tuple[Array, Array]:
        j, column = given
        left = column - L @ jax.lax.dynamic_index_in_dim(L, j, keepdims=False)
        pivot = jax.lax.dynamic_index_in_dim(left, j, keepdims=False)
        found = jnp.where(index >= j, left * _over_root(pivot), 0)
        return jax.lax.dynamic_update_index_in_dim(L, found, j, 1), pivot

    return Elimination(*jax.lax.scan(eliminate, jnp.zeros_like(S), (index, S.T)))


def _over_root(pivot: Array) -> Array:
    """Return one over the root of a positive pivot, zero for others."""
    good = pivot > 0
    return jnp.where(good, 1 / jnp.sqrt(jnp.where(good, pivot, 1)), 0)


def _dot(a: list[Array], b: list[Array]) -> Array | int:
    return sum((x * y for x, y in zip(a, b, strict=True)), 0)


@kernel
def solve_lower(L: Array, B: Array) -> Array:
    """Return ``inv(L) B`` by substitution; lower ``L`` ``(m, m)``, ``B`` ``(m, n)`` or ``(m,)``."""
    m = L.shape[0]
    if m > UNROLL_LIMIT:
        return _solve_rolled(jnp.tril(L), B, upper=False)
    rows: list[Array] = []
    for i in range(m):
        rows.append((B[i] - sum(L[i, j] * rows[j] for j in range(i))) / L[i, i])
    return jnp.stack(rows)


@kernel
def solve_lower_transposed(L: Array, B: Array) -> Array:
    """Return ``inv(L') B`` by back substitution; shapes as in :func:`solve_lower`."""
    m = L.shape[0]
    if m > UNROLL_LIMIT:
        return _solve_rolled(jnp.tril(L).T, B, upper=True)
    rows: dict[int, Array] = {}
    for i in reversed(range(m)):
        rows[i] = (B[i] - sum(L[j, i] * rows[j] for j in range(i + 1, m))) / L[i, i]
    return jnp.stack([rows[i] for i in range(m)])


def _solve_rolled(T: Array, B: Array, upper: bool) -> Array:
    """Return ``inv(T) B`` for a triangular ``T`` ``(m, m)``; its derivatives are solves too."""

    def substituted(T: Array, B: Array, upper: bool) -> Array:
        def solve(X: Array, given: tuple[Array, Array, Array, Array]) -> tuple[Array, None]:
            i, row, pivot, b = given
            return jax.lax.dynamic_update_index_in_dim(X, (b - row @ X) / pivot, i, 0), None

        rows = (jnp.arange(T.shape[0]), T, jnp.diag(T), B)
        return jax.lax.scan(solve, jnp.zeros_like(B), rows, reverse=upper)[0]

    return jax.lax.custom_linear_solve(
        lambda X: T @ X,
        B,
        solve=lambda _, B: substituted(T, B, upper),
        transpose_solve=lambda _, B: substituted(T.T, B, not upper),
    )


def log_det(L: Array) -> Array:
    """Return ``log|S|`` from the lower Cholesky factor ``L`` ``(m, m)`` of ``S``."""
    return 2 * jnp.sum(jnp.log(jnp.diag(L)))


def normalised_square(nu: Array, S: Array) -> Array:
    """Return ``nu' inv(S) nu`` of a vector ``(m,)`` and a covariance ``(m, m)``."""
    white = solve_lower(cholesky(S).factor, nu)
    return jnp.sum(white * white)


@jax.custom_jvp
def solve_positive(L: Array, S: Array, B: Array) -> Array:
    """Return ``inv(S) B`` from the lower Cholesky factor ``L`` of ``S``, all that the value reads.

    The derivative is that of ``inv(S) B`` and leaves the factorisation out: a fraction of the work.

    Args:
        L: ``(m, m)``.
        S: ``(m, m)`` symmetric.
        B: ``(m, n)`` or ``(m,)``.
    """
    del S
    # Without the barrier XLA solves again for each of the entries that use the solution.
    return jax.lax.optimization_barrier(solve_lower_transposed(L, solve_lower(L, B)))


@solve_positive.defjvp
def _solve_positive_jvp(
    primals: tuple[Array, Array, Array], tangents: tuple[Array, Array, Array]
) -> tuple[Array, Array]:
    (L, S, B), (_, dS, dB) = primals, tangents
    X = solve_positive(L, S, B)
    return X, solve_positive(L, S, dB - matmul(dS, X))
