"""Small-matrix kernels that XLA can fuse: no LAPACK call, no batched ``dot`` for small sizes.

A batched ``dot`` of 3x3 blocks and a LAPACK call per step each cost more than the arithmetic of a
whole Kalman step, so the sizes a navigation filter meets (three axes, up to six measurements) are
written out as multiply-adds over Python loops that unroll at trace time. Above that a loop takes a
matrix apart column by column: batched LAPACK calls share the threads that they are called from, and
a large batch of them can stall for good (jax 0.10.2 on two cores).
"""

from collections.abc import Callable
from itertools import accumulate
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.numerics.products import UNROLL_LIMIT, product


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


def materialised(tree: Any) -> Any:
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


def cholesky(S: Array) -> Cholesky:
    """Factor a symmetric matrix ``(m, m)``; a failed factorisation is reported, never NaN.

    Only the lower triangle is read. Non-positive pivots are replaced by one before the root, so a
    caller can select against a failed factor without poisoning gradients.
    """
    m = S.shape[0]
    if m > UNROLL_LIMIT:
        return _rolled_cholesky(S)
    L: list[list[Array]] = []
    positive = jnp.array(True)
    ratio = jnp.ones((), S.dtype)
    for i in range(m):
        row: list[Array] = []
        for j in range(i):
            row.append((S[i, j] - _dot(row[:j], L[j][:j])) / L[j][j])
        pivot = S[i, i] - _dot(row, row)
        good = pivot > 0
        positive = positive & good
        ratio = jnp.minimum(ratio, jnp.where(good, pivot / jnp.where(good, S[i, i], 1), 0))
        row.append(jnp.sqrt(jnp.where(good, pivot, 1)))
        L.append(row)
    zero = jnp.zeros((), S.dtype)
    factor = jnp.stack([jnp.stack(row + [zero] * (m - len(row))) for row in L])
    return Cholesky(jnp.where(positive, factor, jnp.eye(m, dtype=S.dtype)), positive, ratio)


def _rolled_cholesky(S: Array) -> Cholesky:
    def eliminate(rest: Array) -> tuple[Array, tuple[Array, Array]]:
        pivot = rest[0, 0]
        column = rest[:, 0] / jnp.sqrt(jnp.where(pivot > 0, pivot, 1))
        return (rest - column[:, None] * column[None])[1:, 1:], (pivot, column)

    # A matrix that fails is taken apart again as the identity, whose derivative is finite.
    one = jnp.eye(S.shape[0], dtype=S.dtype)
    failed = ~jnp.all(jnp.stack(_by_columns(eliminate, jax.lax.stop_gradient(S))[0]) > 0)
    sound = jnp.where(failed, one, S)
    numbers, columns = _by_columns(eliminate, sound)
    ratio = jnp.min(jnp.stack(numbers) / jnp.diag(sound))
    return Cholesky(_lower(columns), ~failed, jnp.where(failed, 0, ratio))


def _dot(a: list[Array], b: list[Array]) -> Array | int:
    return sum((x * y for x, y in zip(a, b, strict=True)), 0)


def solve_lower(L: Array, B: Array) -> Array:
    """Return ``inv(L) B`` by substitution; lower ``L`` ``(m, m)``, ``B`` ``(m, n)`` or ``(m,)``."""
    m = L.shape[0]
    if m > UNROLL_LIMIT:
        return _rolled_solve(L, B)
    rows: list[Array] = []
    for i in range(m):
        rows.append((B[i] - sum(L[i, j] * rows[j] for j in range(i))) / L[i, i])
    return jnp.stack(rows)


def solve_lower_transposed(L: Array, B: Array) -> Array:
    """Return ``inv(L') B`` by back substitution; shapes as in :func:`solve_lower`."""
    m = L.shape[0]
    if m > UNROLL_LIMIT:
        return _rolled_solve(L.T[::-1, ::-1], B[::-1])[::-1]
    rows: dict[int, Array] = {}
    for i in reversed(range(m)):
        rows[i] = (B[i] - sum(L[j, i] * rows[j] for j in range(i + 1, m))) / L[i, i]
    return jnp.stack([rows[i] for i in range(m)])


def _rolled_solve(L: Array, B: Array) -> Array:
    m = L.shape[0]
    columns = jnp.stack([jnp.pad(L[j:, j], (0, j)) for j in range(m)])

    def eliminate(rest: Array, column: Array) -> tuple[Array, Array]:
        row = rest[0] / column[0]
        left = rest - (column[:, None] * row[None] if rest.ndim == 2 else column * row)
        return jnp.concatenate([left[1:], jnp.zeros_like(left[:1])]), row

    return jax.lax.scan(eliminate, B, columns)[1]


def log_det(L: Array) -> Array:
    """Return ``log|S|`` from the lower Cholesky factor ``L`` ``(m, m)`` of ``S``."""
    return 2 * jnp.sum(jnp.log(jnp.diag(L)))


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


def tria(A: Array) -> Array:
    """Return the lower-triangular ``L`` ``(n, n)`` with ``L L' = A A'`` for wide ``A`` ``(n, k)``.

    The diagonal is non-negative, which makes the factor unique for a full-rank ``A``. Uses QR,
    whose derivative exists when ``A`` has full row rank and ``k >= n``.
    """
    R = jnp.linalg.qr(A.T, mode="r")
    signs = jnp.where(jnp.diag(R) < 0, -1, 1).astype(A.dtype)
    return (R * signs[:, None]).T


class SemidefiniteRoot(NamedTuple):
    """Lower factor ``L L' = A`` of a positive semi-definite matrix, with its health.

    Attributes:
        factor: ``(n, n)`` lower; columns without a positive pivot are zero.
        semidefinite: Whether no pivot was negative by more than rounding.
    """

    factor: Array
    semidefinite: Array


def semidefinite_root(A: Array) -> SemidefiniteRoot:
    """Factor a positive semi-definite matrix ``(n, n)``; one that is not is reported.

    Columns whose pivot is not positive are zero, so covariances with states that carry no noise are
    factored; the gradient with respect to such a zero pivot is zero. The diagonal is raised by
    ``2 n`` rounding errors first: without that, a matrix that is singular to rounding loses its
    digits in the elimination (2e-3 relative at n = 15). A variance that is negative or not a number
    makes the factor NaN.
    """
    n = A.shape[0]
    diagonal = jnp.diag(A)
    sound = jnp.all(diagonal >= 0)
    # A zero variance beside a covariance has no negative pivot: its column would go unseen.
    null = diagonal == 0
    coupled = jnp.any((null[:, None] | null[None, :]) & (A != 0))
    rounding = 2 * n * jnp.finfo(A.dtype).eps

    def eliminate(rest: Array) -> tuple[Array, tuple[Array, Array]]:
        pivot = rest[0, 0]
        good = pivot > 0
        column = rest[:, 0] * jnp.where(good, 1 / jnp.sqrt(jnp.where(good, pivot, 1)), 0)
        return (rest - column[:, None] * column[None])[1:, 1:], (pivot, column)

    pivots, columns = _by_columns(eliminate, A + rounding * jnp.diag(diagonal))
    lowest = jnp.min(jnp.stack(pivots) / jnp.where(diagonal > 0, diagonal, 1))
    factor = jnp.where(sound, _lower(columns), jnp.nan)
    return SemidefiniteRoot(factor, sound & ~coupled & (lowest >= -8 * rounding))


def _by_columns(
    step: Callable[[Any], tuple[Any, tuple[Array, Array]]], rest: Any
) -> tuple[list[Array], list[Array]]:
    """Take a square matrix apart column by column, the pivot always in the corner.

    Reading the pivot there costs no gather. Beyond a few columns a loop is as fast as its unrolled
    form, and a fraction of the program to compile.

    Args:
        step: From what is left to what is left after a column, one row and column smaller, with a
            number about the pivot and the column from the pivot down.
        rest: What is left at the start; a pytree whose leaves are ``(n, n)`` or ``(n,)``.

    Returns:
        The numbers and the columns, of lengths n, n - 1, ..., 1.
    """
    n = jax.tree.leaves(rest)[0].shape[0]
    if n <= UNROLL_LIMIT:
        numbers, columns = [], []
        for _ in range(n):
            rest, (number, column) = step(rest)
            numbers.append(number)
            columns.append(column)
        return numbers, columns

    def padded(rest: Any, _: None) -> tuple[Any, tuple[Array, Array]]:
        rest, found = step(rest)
        return jax.tree.map(lambda leaf: jnp.pad(leaf, ((0, 1),) * leaf.ndim), rest), found

    numbers, columns = jax.lax.scan(padded, rest, None, length=n)[1]
    return list(numbers), [columns[j, : n - j] for j in range(n)]


def _lower(columns: list[Array]) -> Array:
    """Return the lower-triangular matrix of columns that start at the diagonal."""
    n = len(columns)
    zeros = [jnp.zeros(n - column.shape[0], column.dtype) for column in columns]
    return jnp.stack([jnp.concatenate(pair) for pair in zip(zeros, columns, strict=True)], axis=1)


def downdate(L: Array, v: Array) -> SemidefiniteRoot:
    """Return the lower factor of ``L L' - v v'``, by hyperbolic rotations in mixed form.

    Where the difference is not positive definite, ``L`` is returned as it is and reported.

    Args:
        L: Lower factor ``(n, n)`` with a non-negative diagonal.
        v: ``(n,)``.

    References:
        Bojanczyk, Brent, van Dooren, de Hoog (1987), SIAM J. Sci. Stat. Comput. 8(3).
    """

    def rotate(left: tuple[Array, Array]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        rest, tail = left
        pivot, lead = rest[0, 0], tail[0]
        # Relative to the pivot, so that the square of a small one cannot underflow.
        sine = jnp.where(pivot > 0, lead / jnp.where(pivot > 0, pivot, 1), 0)
        squared = (1 - sine) * (1 + sine)
        good = (squared > 0) & (pivot > 0)
        cosine, sine = jnp.sqrt(jnp.where(good, squared, 1)), jnp.where(good, sine, 0)
        column = (rest[1:, 0] - sine * tail[1:]) / cosine
        tail = cosine * tail[1:] - sine * column
        whole = jnp.concatenate([jnp.where(good, pivot * cosine, 0)[None], column])
        return (rest[1:, 1:], tail), (good | ((pivot == 0) & (lead == 0)), whole)

    done, columns = _by_columns(rotate, (L, v))
    sound = jnp.all(jnp.stack(done))
    return SemidefiniteRoot(jnp.where(sound, _lower(columns), L), sound)
