"""Small-matrix kernels against NumPy, and their behaviour where a factorisation fails."""

import jax
import jax.numpy as jnp
import numpy as np
from oracles.matrices import central_difference, random_spd

from jaxnav.numerics import linalg

SIZES = range(1, 9)
COUNT = 20


@jax.jit
def kernels(batches):
    def one(S, B):
        root = linalg.cholesky(S)
        L = root.factor
        return {
            "health": root[1:],
            "factor": L,
            "lower": linalg.solve_lower(L, B),
            "lower_vector": linalg.solve_lower(L, B[:, 0]),
            "upper": linalg.solve_lower_transposed(L, B),
            "upper_vector": linalg.solve_lower_transposed(L, B[:, 0]),
            "log_det": linalg.log_det(L),
            "matmul": linalg.matmul(S, B),
            "matmul_vector": linalg.matmul(S, B[:, 0]),
            "root": linalg.semidefinite_root(S),
            "tria": linalg.tria(jnp.concatenate([L, B], axis=1)),
        }

    return [jax.vmap(one)(S, B) for S, B in batches]


def test_kernels_equal_numpy_for_every_size():
    rng = np.random.default_rng(1)
    batches = [(random_spd(rng, COUNT, m), rng.standard_normal((COUNT, m, 4))) for m in SIZES]
    for (S, B), out in zip(batches, kernels(batches), strict=True):
        L = np.linalg.cholesky(S)
        T = L.transpose(0, 2, 1)
        expected = {
            "factor": L,
            "lower": np.linalg.solve(L, B),
            "upper": np.linalg.solve(T, B),
            "log_det": np.linalg.slogdet(S)[1],
            "matmul": S @ B,
            "root": L,
            "tria": np.linalg.cholesky(S + B @ B.transpose(0, 2, 1)),
        }
        for name in ("lower", "upper", "matmul"):
            expected[f"{name}_vector"] = expected[name][..., 0]
        for name, value in expected.items():
            np.testing.assert_allclose(out[name], value, rtol=1e-11, atol=1e-11, err_msg=name)
        assert np.all(out["health"][0])
        pivots = np.diagonal(L, axis1=1, axis2=2) ** 2 / np.diagonal(S, axis1=1, axis2=2)
        np.testing.assert_allclose(out["health"][1], pivots.min(axis=1), rtol=1e-10)
        np.testing.assert_array_equal(out["factor"], np.tril(out["factor"]))
        np.testing.assert_array_equal(out["tria"], np.tril(out["tria"]))


def test_matmul_beyond_the_unrolled_sizes():
    rng = np.random.default_rng(2)
    for inner in (0, 1, linalg.UNROLL_LIMIT, linalg.UNROLL_LIMIT + 1):
        A, B = rng.standard_normal((3, inner)), rng.standard_normal((inner, 2))
        a, b = jnp.asarray(A), jnp.asarray(B)
        np.testing.assert_allclose(linalg.matmul(a, b), A @ B, atol=1e-14)
        np.testing.assert_allclose(linalg.matmul(a, b[:, 0]), A @ B[:, 0], atol=1e-14)


def test_float32_stays_float32():
    rng = np.random.default_rng(3)
    batches = [
        (random_spd(rng, 2, m).astype(np.float32), np.ones((2, m, 4), np.float32)) for m in (3, 7)
    ]
    for out in kernels(batches):
        dtypes = {leaf.dtype.name for leaf in jax.tree.leaves(out)}
        assert dtypes == {"float32", "bool"}
        assert linalg.safe_norm(out["lower_vector"][0]).dtype == jnp.float32


def test_cholesky_reads_the_lower_triangle_of_a_small_matrix():
    S = jnp.array([[4.0, np.nan], [2.0, 5.0]])
    np.testing.assert_array_equal(linalg.cholesky(S).factor, [[2.0, 0.0], [1.0, 2.0]])


def indefinite(m):
    """Return not positive definite matrices ``(5, m, m)``, one of them semi-definite."""
    rng = np.random.default_rng(m)
    S = random_spd(rng, 5, m)
    S[0, -1, -1] = -1
    S[1, 0, 0] = -1e-8
    S[2] = 0
    S[3] = -S[3]
    S[4] = np.diag([1.0] + [0.0] * (m - 1))
    return S


def test_factor_of_an_indefinite_matrix_is_reported_and_finite():
    batches = [indefinite(m) for m in (2, 3, 6, 7)]

    @jax.jit
    def factor_and_gradient(batches):
        def total(S):
            root = linalg.cholesky(S)
            return jnp.sum(root.factor) + root.reciprocal_pivot + linalg.log_det(root.factor)

        return [(jax.vmap(linalg.cholesky)(S), jax.vmap(jax.grad(total))(S)) for S in batches]

    for root, gradient in factor_and_gradient(batches):
        assert not np.any(root.positive_definite)
        np.testing.assert_array_equal(root.reciprocal_pivot, 0)
        assert np.all(np.isfinite(root.factor))
        assert np.all(np.isfinite(gradient))
        assert np.all(np.diagonal(root.factor, axis1=1, axis2=2) > 0)


def test_a_matrix_of_nan_is_reported():
    for m in (3, 7):
        S = jnp.eye(m).at[1, 0].set(jnp.nan).at[0, 1].set(jnp.nan)
        root = linalg.cholesky(S)
        assert not root.positive_definite
        assert root.reciprocal_pivot == 0


def test_reciprocal_pivot_tells_how_many_digits_are_left():
    for m in (1, 3, 6, 8):
        diagonal = linalg.cholesky(jnp.diag(10.0 ** jnp.linspace(-12, 12, m)))
        assert diagonal.positive_definite
        np.testing.assert_allclose(diagonal.reciprocal_pivot, 1, rtol=1e-15)
    # The innovation covariance of Dyer and McReynolds: its second pivot is about 8 d^2 / 3.
    for d, tolerance in ((1e-3, 1e-2), (1e-5, 1e-2), (1e-7, 0.2)):
        H = np.array([[1.0, 1.0, 1.0], [1.0, 1.0, 1.0 + d]])
        root = linalg.cholesky(jnp.asarray(H @ H.T + d * d * np.eye(2)))
        np.testing.assert_allclose(root.reciprocal_pivot, 8 / 9 * d * d, rtol=tolerance)


def test_derivatives_of_cholesky_equal_finite_differences():
    rng = np.random.default_rng(4)
    S = [random_spd(rng, 5, m) + np.eye(m) for m in SIZES]
    E = [e + e.transpose(0, 2, 1) for e in (rng.standard_normal(s.shape) for s in S)]
    W = [rng.standard_normal(s.shape) for s in S]

    @jax.jit
    def both_modes(S, E, W):
        def one(s, e, w):
            def factor(x):
                return linalg.cholesky(x).factor

            return jax.jvp(factor, (s,), (e,))[1], jnp.sum(jax.vjp(factor, s)[1](w)[0] * e)

        return [jax.vmap(one)(*args) for args in zip(S, E, W, strict=True)]

    for s, e, w, (forward, reverse) in zip(S, E, W, both_modes(S, E, W), strict=True):
        numeric = central_difference(np.linalg.cholesky, s, e, 1e-3)
        np.testing.assert_allclose(forward, numeric, rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(reverse, np.sum(w * forward, axis=(1, 2)), rtol=1e-11)


def test_root_of_a_singular_matrix():
    rng = np.random.default_rng(5)
    low_rank = rng.standard_normal((200, 6, 3))
    A = low_rank @ low_rank.transpose(0, 2, 1)
    A[:20, :2] = 0
    A[:20, :, :2] = 0
    A[20] = 0
    A[21] = np.diag([1.0, 0.0, 4.0, 0.0, 0.0, 9.0])
    A[22] = 1.0

    @jax.jit
    def root_and_gradient(A):
        def total(a):
            return jnp.sum(linalg.semidefinite_root(a))

        return jax.vmap(linalg.semidefinite_root)(A), jax.vmap(jax.grad(total))(A[:23])

    L, gradient = map(np.asarray, root_and_gradient(A))
    np.testing.assert_array_equal(L, np.tril(L))
    np.testing.assert_allclose(L @ L.transpose(0, 2, 1), A, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(L[21], np.sqrt(A[21]))
    np.testing.assert_array_equal(L[22], np.eye(1, 6).T @ np.ones((1, 6)))
    assert np.all(np.isfinite(gradient[20:]))


def test_gradient_of_safe_norm_at_zero_and_beyond():
    value, gradient = jax.value_and_grad(linalg.safe_norm)(jnp.zeros(3))
    assert value == 0
    np.testing.assert_array_equal(gradient, 0)
    np.testing.assert_array_equal(jax.jacfwd(linalg.safe_norm)(jnp.zeros(3)), 0)
    value, gradient = jax.value_and_grad(linalg.safe_norm)(jnp.array([3.0, 0.0, -4.0]))
    assert value == 5
    np.testing.assert_allclose(gradient, [0.6, 0, -0.8], rtol=1e-15)


def test_symmetrise():
    A = np.random.default_rng(6).standard_normal((4, 4))
    S = linalg.symmetrise(jnp.asarray(A))
    np.testing.assert_array_equal(S, S.T)
    np.testing.assert_array_equal(S, (A + A.T) / 2)


def test_a_poisoned_member_leaves_the_batch_bitwise_unchanged():
    rng = np.random.default_rng(7)
    healthy = [(random_spd(rng, 64, m), rng.standard_normal((64, m, 4))) for m in SIZES]
    reference = kernels(healthy)
    for poison in (np.nan, -1.0, np.inf):
        poisoned = [(S.copy(), B) for S, B in healthy]
        for S, _ in poisoned:
            S[17] = poison
        others = np.arange(64) != 17
        same = jax.tree.map(
            lambda a, b, keep=others: np.array_equal(a[keep], b[keep]),
            reference,
            kernels(poisoned),
        )
        assert all(jax.tree.leaves(same))
