"""The group SE_2(3) of extended poses: a rotation with two vectors that it turns.

An element is ``X = [C v p; 0 1 0; 0 0 1]``; its logarithm ``xi = (phi, nu, rho)`` has nine
coordinates in that order.

References:
    Barrau and Bonnabel (2017), IEEE Trans. Automatic Control 62(4), section IV.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxnav.numerics.lie import (
    skew,
    so3_exp,
    so3_left_jacobian,
    so3_left_jacobian_inverse,
    so3_log,
)
from jaxnav.numerics.linalg import matmul


class ExtendedPose(NamedTuple):
    """An element of SE_2(3): rotation ``C`` ``(3, 3)``, vectors ``v`` and ``p`` ``(3,)``."""

    C: Array
    v: Array
    p: Array


def se23_exp(xi: Array) -> ExtendedPose:
    """Return the element of ``xi`` ``(9,)``: ``exp(phi)``, ``J nu``, ``J rho`` with J of phi."""
    J = so3_left_jacobian(xi[:3])
    return ExtendedPose(so3_exp(xi[:3]), matmul(J, xi[3:6]), matmul(J, xi[6:]))


def se23_log(X: ExtendedPose) -> Array:
    """Return ``xi`` ``(9,)`` of an element; inverse of :func:`se23_exp` below half a turn."""
    phi = so3_log(X.C)
    inverse = so3_left_jacobian_inverse(phi)
    return jnp.concatenate([phi, matmul(inverse, X.v), matmul(inverse, X.p)])


def se23_multiply(X: ExtendedPose, Y: ExtendedPose) -> ExtendedPose:
    """Return the product ``X Y``."""
    return ExtendedPose(matmul(X.C, Y.C), matmul(X.C, Y.v) + X.v, matmul(X.C, Y.p) + X.p)


def se23_inverse(X: ExtendedPose) -> ExtendedPose:
    """Return the inverse of an element."""
    back = X.C.T
    return ExtendedPose(back, -matmul(back, X.v), -matmul(back, X.p))


def se23_adjoint(X: ExtendedPose) -> Array:
    """Return ``Ad`` ``(9, 9)`` with ``X exp(xi) inv(X) = exp(Ad xi)``."""
    zero = jnp.zeros_like(X.C)
    return jnp.block(
        [
            [X.C, zero, zero],
            [matmul(skew(X.v), X.C), X.C, zero],
            [matmul(skew(X.p), X.C), zero, X.C],
        ]
    )
