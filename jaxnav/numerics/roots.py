"""Triangular roots of covariances: of a matrix, of a wide array, and after a downdate.

Roots of arrays are found by orthogonal transformations from the right, which never form a product
of the array with itself; neither do their derivatives. All are written for arrays of a few tens of
rows, without LAPACK, as loops over rows: unrolling them gains a tenth of a filter's time and costs
seconds of compiling.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.numerics.linalg import UNROLL_LIMIT, eliminated, invertible, kernel, solve_lower


class SemidefiniteRoot(NamedTuple):
    """Lower factor ``L L' = A`` of a positive semi-definite matrix, with its health.

    Attributes:
        factor: ``(n, n)`` lower; columns without a positive pivot are zero.
        semidefinite: Whether no pivot was negative by more than rounding.
    """

    factor: Array
    semidefinite: Array


@kernel
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
    done = eliminated(A + rounding * jnp.diag(diagonal))
    lowest = jnp.min(done.pivots / jnp.where(diagonal > 0, diagonal, 1))
    factor = jnp.where(sound, done.factor, jnp.nan)
    return SemidefiniteRoot(factor, sound & ~coupled & (lowest >= -8 * rounding))


@jax.custom_jvp
def tria(A: Array) -> Array:
    """Return the lower-triangular ``L`` ``(n, n)`` with ``L L' = A A'`` for ``A`` ``(n, k)``.

    The diagonal is non-negative, which makes the factor unique for a full-rank ``A``. The
    derivative exists for full row rank; else it is finite, that of a vanished pivot being zero.

    References:
        Bjorck (1967), BIT 7(1): reflections of ``[0, A]`` are the modified Gram-Schmidt method.
    """
    return _reflected(jnp.zeros((A.shape[0], A.shape[0]), A.dtype), A)


@tria.defjvp
def _tria_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    L = tria(primals[0])
    return L, _tangent(L, primals[0], tangents[0])


@jax.custom_jvp
def tria_beside(L: Array, A: Array) -> Array:
    """Return ``tria([L, A])`` for a triangle, at the cost of ``A``'s columns alone.

    Args:
        L: Lower ``(n, n)`` with a non-negative diagonal.
        A: ``(n, k)``.
    """
    return _reflected(L, A)


@tria_beside.defjvp
def _tria_beside_jvp(
    primals: tuple[Array, Array], tangents: tuple[Array, Array]
) -> tuple[Array, Array]:
    L = tria_beside(*primals)
    array, moved = (jnp.concatenate(parts, axis=1) for parts in (primals, tangents))
    return L, _tangent(L, array, moved)


@jax.custom_jvp
def tria_of_update(root: Array, seen: Array, L: Array) -> Array:
    """Return ``tria([root, seen; 0, L])`` ``(m + n, m + n)``, the array of an update.

    Each channel turns against the columns of ``L`` from the last to the first, which keeps ``L`` a
    triangle; all turns of a channel are a few sums over columns.

    Args:
        root: Lower ``(m, m)`` root of the noise; a column with a zero pivot is zero.
        seen: ``(m, n)`` columns of a root of the predicted observation's covariance.
        L: Lower ``(n, n)`` with a non-negative diagonal, the same columns for the state.

    References:
        Carlson (1973), AIAA Journal 11(9), whose scalar update this is, as an array.
    """
    m, n = seen.shape
    if m > UNROLL_LIMIT:
        zero = jnp.zeros((n, m), L.dtype)
        triangle = jnp.block([[root, jnp.zeros((m, n), L.dtype)], [zero, jnp.zeros_like(L)]])
        return _reflected(triangle, jnp.concatenate([seen, L]))
    units = _largest(jnp.concatenate([root, seen], axis=1))
    columns, left = _turned(root / units[:, None], seen / units[:, None], L)
    units = jnp.concatenate([units, jnp.ones(n, L.dtype)])
    zero = jnp.zeros((m, n), L.dtype)
    return jnp.concatenate([columns * units[:, None], jnp.concatenate([zero, left])], axis=1)


@tria_of_update.defjvp
def _tria_of_update_jvp(
    primals: tuple[Array, Array, Array], tangents: tuple[Array, Array, Array]
) -> tuple[Array, Array]:
    L = tria_of_update(*primals)
    return L, _tangent(L, update_array(*primals), update_array(*tangents))


def update_array(root: Array, seen: Array, L: Array) -> Array:
    """Return ``[root, seen; 0, L]`` ``(m + n, m + n)``, see :func:`tria_of_update`."""
    zero = jnp.zeros((L.shape[0], root.shape[0]), L.dtype)
    return jnp.block([[root, seen], [zero, L]])


@kernel
def _turned(root: Array, seen: Array, L: Array) -> tuple[Array, Array]:
    """Return the first columns ``(m + n, m)`` of the update's triangle, and what is left of ``L``.

    With ``t`` the pivot and ``f`` the row of a channel, ``s_j^2 = t^2 + f_j^2 + ... + f_n^2``. The
    channel's column is ``c_j = (t c + f_j a_j + ... + f_n a_n) / s_j`` after the turn against
    column ``a_j``, which becomes ``(s_{j+1} a_j - f_j c_{j+1}) / s_j``.
    """
    m, n = seen.shape
    later = jnp.tril(jnp.ones((n, n), L.dtype))
    array = jnp.concatenate([seen, L])
    columns = []
    for i in range(m):
        f, t = array[0], root[i, i]
        lead = jnp.concatenate([root[i:, i], jnp.zeros(n, L.dtype)])
        sums = t * lead[:, None] + (array * f[None]) @ later
        size = jnp.sqrt(sums[0])
        safe = jnp.where(size > 0, size, 1)
        column = sums / safe[None]
        columns.append(jnp.concatenate([jnp.zeros(i, L.dtype), column[:, 0]]))
        before = jnp.concatenate([size[1:], t[None]])
        turned = before[None] * array - f[None] * jnp.concatenate(
            [column[:, 1:], lead[:, None]], axis=1
        )
        array = jnp.where(size[None] > 0, turned / safe[None], array)[1:]
    return jnp.stack(columns, axis=1), array


@kernel
def _reflected(L: Array, A: Array) -> Array:
    """Return ``tria([L, A])`` by Householder reflections, one for each row.

    A reflection takes ``[p, a]``, ``p`` the pivot in ``L``, to ``[|(p, a)|, 0]``; it reaches one
    column of ``L``.
    """
    n = L.shape[0]
    # In units of the largest entry of each row, so that squares do not underflow in float32.
    units = _largest(jnp.concatenate([L, A], axis=1))
    L, A = L / units[:, None], A / units[:, None]
    index = jnp.arange(n)

    def reflect(A: Array, given: tuple[Array, Array]) -> tuple[Array, Array]:
        i, column = given
        row = jax.lax.dynamic_index_in_dim(A, i, keepdims=False)
        pivot = jax.lax.dynamic_index_in_dim(column, i, keepdims=False)
        along = A @ row
        squared = jax.lax.dynamic_index_in_dim(along, i, keepdims=False)
        size = jnp.sqrt(pivot * pivot + squared)
        safe = jnp.where(size > 0, size, 1)
        turned = jnp.where(index >= i, (pivot * column + along) / safe, 0)
        weight = (pivot + size) / jnp.where(squared > 0, squared, 1)
        return A - ((weight * along - column) / safe)[:, None] * row[None], turned

    return jax.lax.scan(reflect, A, (index, L.T))[1].T * units[:, None]


def _largest(A: Array) -> Array:
    """Return the largest size in each row of ``A`` ``(n, k)``, one for a row of zeros."""
    largest = jnp.max(jnp.abs(A), axis=1)
    return jnp.where(largest > 0, largest, 1)


@kernel
def _tangent(L: Array, A: Array, dA: Array) -> Array:
    """Return the derivative of ``L = tria(A)`` along ``dA`` ``(n, k)``.

    With ``A = L Q'`` and ``X = inv(L) dA Q``, the upper half of ``X`` is what turns ``Q`` alone, so
    that ``dL = L (lower half of X + (strictly upper half of X)')``.
    """
    L, good = invertible(L)
    X = solve_lower(L, dA) @ solve_lower(L, A).T
    X = jnp.where(good[:, None] & good[None], X, 0)
    return L @ (jnp.tril(X) + jnp.triu(X, 1).T)


@kernel
def downdate(L: Array, v: Array) -> SemidefiniteRoot:
    """Return the lower factor of ``L L' - v v'``, by hyperbolic rotations in mixed form.

    Where the difference is not positive definite, ``L`` is returned as it is and reported.

    Args:
        L: Lower factor ``(n, n)`` with a non-negative diagonal.
        v: ``(n,)``.

    References:
        Bojanczyk, Brent, van Dooren, de Hoog (1987), SIAM J. Sci. Stat. Comput. 8(3).
    """
    index = jnp.arange(L.shape[0])

    def rotate(v: Array, given: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        j, column = given
        pivot, lead = (jax.lax.dynamic_index_in_dim(x, j, keepdims=False) for x in (column, v))
        # Relative to the pivot, so that the square of a small one cannot underflow.
        sine = jnp.where(pivot > 0, lead / jnp.where(pivot > 0, pivot, 1), 0)
        squared = (1 - sine) * (1 + sine)
        good = (squared > 0) & (pivot > 0)
        cosine, sine = jnp.sqrt(jnp.where(good, squared, 1)), jnp.where(good, sine, 0)
        below = (column - sine * v) / cosine
        done = jnp.where(index > j, below, jnp.where((index == j) & good, pivot * cosine, 0))
        return cosine * v - sine * below, (good | ((pivot == 0) & (lead == 0)), done)

    rotated = jax.lax.scan(rotate, v, (index, L.T))[1]
    sound = jnp.all(rotated[0])
    return SemidefiniteRoot(jnp.where(sound, rotated[1].T, L), sound)
