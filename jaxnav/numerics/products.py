"""Products of small matrices as one operation, whose derivatives are such products again.

Written out in multiply-adds a product fuses with what is around it, which a ``dot`` does not. The
derivative of the written-out form, however, is a sum over one axis for each factor's row or column:
loops of their own, and most of the time of a backward pass. As an operation of its own the product
is transposed into products, which fuse as well.
"""

from typing import Any

import jax.numpy as jnp
from jax import Array, lax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

UNROLL_LIMIT = 6
"""Largest size that is written out; above it a product is a ``dot`` and a factorisation a loop."""


def product(A: Array, B: Array) -> Array:
    """Return ``A @ B`` of matrices, written out over a small inner dimension.

    Args:
        A: ``(..., m, k)``; leading axes, as many as those of ``B``, are the same or one.
        B: ``(..., k, n)``.

    Returns:
        ``(..., m, n)``.
    """
    if not 0 < A.shape[-1] <= UNROLL_LIMIT:
        return A @ B
    dtype = jnp.result_type(A, B)
    return _product_p.bind(A.astype(dtype), B.astype(dtype))


def _written_out(A: Array, B: Array) -> Array:
    axis = A.ndim - 1
    terms = [
        lax.slice_in_dim(A, j, j + 1, axis=axis) * lax.slice_in_dim(B, j, j + 1, axis=axis - 1)
        for j in range(A.shape[-1])
    ]
    return sum(terms[1:], terms[0])


def _shape(A: Any, B: Any) -> ShapedArray:
    lead = jnp.broadcast_shapes(A.shape[:-2], B.shape[:-2])
    return ShapedArray((*lead, A.shape[-2], B.shape[-1]), A.dtype)


def _left_transposed(ct: Array, A: Any, B: Array) -> Array:
    return _summed_like(product(ct, jnp.swapaxes(B, -1, -2)), A.aval.shape)


def _right_transposed(ct: Array, A: Array, B: Any) -> Array:
    return _summed_like(product(jnp.swapaxes(A, -1, -2), ct), B.aval.shape)


def _summed_like(ct: Array, shape: tuple[int, ...]) -> Array:
    """Return a cotangent summed over the leading axes along which a factor was repeated."""
    repeated = [i for i, size in enumerate(shape) if size != ct.shape[i]]
    return jnp.sum(ct, axis=repeated, keepdims=True) if repeated else ct


def _batched(
    factors: tuple[Array, Array], axes: tuple[int | None, int | None]
) -> tuple[Array, int]:
    """Put the new axis first; a factor without it has one entry there, and is not repeated."""
    A, B = (
        factor[None] if axis is None else jnp.moveaxis(factor, axis, 0)
        for factor, axis in zip(factors, axes, strict=True)
    )
    return _product_p.bind(A, B), 0


_product_p = Primitive("small_product")
_product_p.def_impl(_written_out)
_product_p.def_abstract_eval(_shape)
mlir.register_lowering(_product_p, mlir.lower_fun(_written_out, multiple_results=False))
ad.defbilinear(_product_p, _left_transposed, _right_transposed)
batching.primitive_batchers[_product_p] = _batched
