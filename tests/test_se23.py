"""The group SE_2(3): axioms, exp and log from zero to pi, the adjoint, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import expm

from jaxnav.compiling import compiled
from jaxnav.numerics.lie import so3_left_jacobian, so3_left_jacobian_inverse, wrapped_angle
from jaxnav.numerics.se23 import (
    ExtendedPose,
    se23_adjoint,
    se23_exp,
    se23_inverse,
    se23_log,
    se23_multiply,
)
from tests.oracles import rotations
from tests.oracles.matrices import central_difference

SWITCH = 1e-2
"""Angle [rad] at which the kernels go over from a series to the closed form."""
ANGLES = np.array(
    [
        *(0.0, 1e-12, 1e-9, 1e-6, 1e-3, SWITCH * (1 - 1e-9), SWITCH * (1 + 1e-9)),
        *(0.1, 1.0, 2.0, 3.0, np.pi - 1e-3, np.pi - 1e-6),
    ]
)
exp, log = compiled(jax.vmap(se23_exp)), compiled(jax.vmap(se23_log))
multiply, inverse = compiled(jax.vmap(se23_multiply)), compiled(jax.vmap(se23_inverse))


def tangents(angles: np.ndarray = ANGLES, per_angle: int = 4) -> np.ndarray:
    """Coordinates ``(N, 9)``: every angle about random axes, vectors of the order of ten."""
    rng = np.random.default_rng(1)
    axes = rng.standard_normal((per_angle, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    phi = (np.asarray(angles)[:, None, None] * axes).reshape(-1, 3)
    return np.concatenate([phi, 10 * rng.standard_normal((len(phi), 6))], axis=1)


def hat(xi: np.ndarray) -> np.ndarray:
    """The matrix ``(5, 5)`` of the algebra."""
    X = np.zeros((5, 5))
    X[:3, :3] = rotations.skew(xi[:3])
    X[:3, 3], X[:3, 4] = xi[3:6], xi[6:]
    return X


def matrices(X: ExtendedPose) -> np.ndarray:
    """The elements as matrices ``(N, 5, 5)``."""
    M = np.tile(np.eye(5), (len(X.C), 1, 1))
    M[:, :3, :3], M[:, :3, 3], M[:, :3, 4] = X.C, X.v, X.p
    return M


def test_exp_is_the_matrix_exponential() -> None:
    xi = tangents()
    expected = np.array([expm(hat(x)) for x in xi])
    np.testing.assert_allclose(matrices(exp(xi)), expected, rtol=0, atol=5e-13)


def test_group_axioms() -> None:
    xi = tangents()
    X, Y, Z = (exp(np.roll(xi, shift, axis=0)) for shift in (0, 7, 19))
    product = multiply(X, Y)
    np.testing.assert_allclose(matrices(product), matrices(X) @ matrices(Y), rtol=0, atol=2e-14)
    left, right = multiply(product, Z), multiply(X, multiply(Y, Z))
    np.testing.assert_allclose(matrices(left), matrices(right), rtol=0, atol=5e-14)
    one = np.broadcast_to(np.eye(5), (len(xi), 5, 5))
    for pair in (multiply(X, inverse(X)), multiply(inverse(X), X)):
        np.testing.assert_allclose(matrices(pair), one, rtol=0, atol=2e-14)
    # Next to the switch 1 - cos(a) has lost all but eps / a^2, times an angle of a.
    np.testing.assert_allclose(matrices(exp(-xi)), matrices(inverse(X)), rtol=0, atol=5e-13)
    np.testing.assert_array_equal(matrices(exp(np.zeros((1, 9)))), one[:1])


def test_log_undoes_exp_from_zero_to_near_pi() -> None:
    xi = tangents()
    back = np.asarray(log(exp(xi)))
    np.testing.assert_allclose(back, xi, rtol=0, atol=2e-13)
    turned = np.linalg.norm(xi[:, :3], axis=1) > 0
    error = np.linalg.norm((back - xi)[turned, :3], axis=1)
    assert np.max(error / np.linalg.norm(xi[turned, :3], axis=1)) < 2e-15
    small = tangents(ANGLES[:4]) * 1e-9
    error = np.asarray(log(exp(small))) - small
    np.testing.assert_array_less(np.abs(error), 1e-22)


def test_adjoint_moves_an_exponential_to_the_other_side() -> None:
    xi = tangents()
    X = exp(np.roll(xi, 11, axis=0))
    Ad = np.asarray(compiled(jax.vmap(se23_adjoint))(X))
    through = exp((Ad @ xi[:, :, None])[..., 0])
    around = multiply(multiply(X, exp(xi)), inverse(X))
    np.testing.assert_allclose(matrices(through), matrices(around), rtol=0, atol=1e-12)
    # From its definition in the algebra, X hat(xi) inv(X), column by column.
    M = matrices(X)
    for k, axis in enumerate(np.eye(9)):
        turned = M @ hat(axis) @ np.linalg.inv(M)
        column = np.stack([turned[:, 2, 1], turned[:, 0, 2], turned[:, 1, 0]], axis=1)
        column = np.concatenate([column, turned[:, :3, 3], turned[:, :3, 4]], axis=1)
        np.testing.assert_allclose(Ad[:, :, k], column, rtol=0, atol=2e-14)


def test_left_jacobian_and_its_inverse() -> None:
    """Also beyond pi, up to where a full turn makes the Jacobian singular."""
    phi = tangents(np.append(ANGLES, [np.pi, 4.0, 6.0]))[:, :3]
    J = np.array([rotations.left_jacobian(p) for p in phi])
    both = compiled(jax.vmap(lambda p: (so3_left_jacobian(p), so3_left_jacobian_inverse(p))))
    own, inverse = map(np.asarray, both(phi))
    one = np.broadcast_to(np.eye(3), J.shape)
    np.testing.assert_allclose(own @ inverse, one, rtol=0, atol=3e-14)
    np.testing.assert_allclose(inverse, np.linalg.inv(J), rtol=0, atol=2e-12)
    narrow = both(phi.astype(np.float32))[1]
    assert narrow.dtype == jnp.float32
    kept = np.linalg.norm(phi, axis=1) < 5
    np.testing.assert_allclose(narrow[kept], inverse[kept], rtol=0, atol=2e-5)


def test_derivatives_are_right_and_finite_at_zero() -> None:
    xi = np.concatenate([np.zeros((1, 9)), tangents(ANGLES[:-2], per_angle=1)])

    def entries(x: jax.Array) -> jax.Array:
        X = se23_exp(x)
        return jnp.concatenate([X.C.reshape(-1), X.v, X.p])

    @compiled
    @jax.vmap
    def derivatives(x: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        of_inverse = jax.jacfwd(so3_left_jacobian_inverse)(x[:3])
        return jax.jacfwd(entries)(x), jax.jacrev(lambda x: se23_log(se23_exp(x)))(x), of_inverse

    of_exp, round_trip, of_inverse = map(np.asarray, derivatives(xi))
    one = np.broadcast_to(np.eye(9), round_trip.shape)
    np.testing.assert_allclose(round_trip, one, rtol=0, atol=1e-11)

    def numeric(x: np.ndarray) -> np.ndarray:
        X = expm(hat(x))[:3]
        return np.concatenate([X[:, :3].ravel(), X[:, 3], X[:, 4]])

    def inverse(phi: np.ndarray) -> np.ndarray:
        return np.linalg.inv(rotations.left_jacobian(phi))

    for x, dX, dJ in zip(xi, of_exp, of_inverse, strict=True):
        for k, axis in enumerate(np.eye(9)):
            expected = central_difference(numeric, x, axis, 1e-3)
            np.testing.assert_allclose(dX[:, k], expected, rtol=0, atol=1e-9)
        for k, axis in enumerate(np.eye(3)):
            expected = central_difference(inverse, x[:3], axis, 1e-3)
            np.testing.assert_allclose(dJ[..., k], expected, rtol=0, atol=1e-10)


def test_differences_of_angles_are_within_half_a_turn() -> None:
    """Row 23 of the hard inputs: a heading that goes through pi has a small innovation."""
    wrapped = compiled(jax.vmap(wrapped_angle))
    a, b = np.array([np.pi - 0.005, -np.pi + 0.005, 0.3, 7 * np.pi, np.pi, 1.0]), np.zeros(6)
    b[:2] = -a[:2]
    expected = [-0.01, 0.01, 0.3, -np.pi, -np.pi, 1.0]
    np.testing.assert_allclose(wrapped(a, b), expected, rtol=0, atol=5e-15)
    exact = np.random.default_rng(4).uniform(-3, 3, 50)
    np.testing.assert_array_equal(wrapped(exact, np.zeros(50)), exact)
    slope = compiled(jax.vmap(jax.grad(wrapped_angle, (0, 1))))(a, b)
    np.testing.assert_array_equal(slope, [np.ones(6), -np.ones(6)])
