"""Small-matrix kernels against NumPy, and their behaviour where a factorisation fails."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from oracles.matrices import central_difference, random_spd

from jaxnav.compiling import compiled
from jaxnav.numerics import linalg, roots

SIZES = range(1, 9)
COUNT = 64


@compiled
def kernels(batches):
    def one(S, L, B):
        return {
            "cholesky": linalg.cholesky(S),
            "lower": linalg.solve_lower(L, B),
            "upper": linalg.solve_lower_transposed(L, B),
            "log_det": linalg.log_det(L),
            "matmul": linalg.matmul(S, B),
            "root": roots.semidefinite_root(S[:3, :3]).factor,
            "tria": roots.tria(jnp.concatenate([L, B], axis=1)),
        }

    return [jax.vmap(one)(*batch) for batch in batches]


def random_batches(rng):
    """Return for every size ``S`` (COUNT, m, m), its factor and ``B`` (COUNT, m, 4)."""
    batches = []
    for m in SIZES:
        S = random_spd(rng, COUNT, m)
        batches.append((S, np.linalg.cholesky(S), rng.standard_normal((COUNT, m, 4))))
    return batches


def test_kernels_equal_numpy_for_every_size():
    batches = random_batches(np.random.default_rng(1))
    for (S, L, B), out in zip(batches, kernels(batches), strict=True):
        expected = {
            "lower": np.linalg.solve(L, B),
            "upper": np.linalg.solve(L.transpose(0, 2, 1), B),
            "log_det": np.linalg.slogdet(S)[1],
            "matmul": S @ B,
            "root": L[:, :3, :3],
            "tria": np.linalg.cholesky(S + B @ B.transpose(0, 2, 1)),
        }
        for name, value in expected.items():
            np.testing.assert_allclose(out[name], value, rtol=1e-11, atol=1e-11, err_msg=name)
        np.testing.assert_array_equal(out["tria"], np.tril(out["tria"]))
        factor, positive_definite, ratio = out["cholesky"]
        np.testing.assert_allclose(factor, L, rtol=1e-12, atol=1e-12)
        np.testing.assert_array_equal(factor, np.tril(factor))
        assert np.all(positive_definite)
        pivots = np.diagonal(L, axis1=1, axis2=2) ** 2 / np.diagonal(S, axis1=1, axis2=2)
        np.testing.assert_allclose(ratio, pivots.min(axis=1), rtol=1e-11)


def test_vectors_and_the_sizes_around_the_limit():
    rng = np.random.default_rng(2)
    inner = (0, 1, linalg.UNROLL_LIMIT, linalg.UNROLL_LIMIT + 1)
    pairs = [(rng.standard_normal((3, k)), rng.standard_normal((k, 2))) for k in inner]
    factors = [np.tril(rng.standard_normal((m, m))) + 3 * np.eye(m) for m in (1, 3, 7)]

    @compiled
    def calculated(pairs, factors):
        products = [(linalg.matmul(A, B), linalg.matmul(A, B[:, 0])) for A, B in pairs]
        solves = [
            [f(L, jnp.arange(1.0, L.shape[0] + 1)) for L in factors]
            for f in (linalg.solve_lower, linalg.solve_lower_transposed)
        ]
        return products, *solves

    products, lower, upper = calculated(pairs, factors)
    for (A, B), (matrix, vector) in zip(pairs, products, strict=True):
        np.testing.assert_allclose(matrix, A @ B, rtol=0, atol=1e-14)
        np.testing.assert_allclose(vector, A @ B[:, 0], rtol=0, atol=1e-14)
    for L, y, x in zip(factors, lower, upper, strict=True):
        b = np.arange(1.0, L.shape[0] + 1)
        np.testing.assert_allclose(L @ y, b, rtol=0, atol=1e-13)
        np.testing.assert_allclose(L.T @ x, b, rtol=0, atol=1e-13)


def test_float32_stays_float32():
    square, wide = (jnp.zeros((1, 7, k), jnp.float32) for k in (7, 4))
    small = (square[:, :3, :3], square[:, :3, :3], wide[:, :3])
    shapes = jax.eval_shape(kernels, [small, (square, square, wide)])
    leaves = jax.tree.leaves((shapes, jax.eval_shape(linalg.safe_norm, wide[0, :, 0])))
    assert {leaf.dtype.name for leaf in leaves} == {"float32", "bool"}


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
    batches = [indefinite(m) for m in (3, 7)]

    @compiled
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


def test_a_matrix_with_nan_is_reported_and_its_factor_finite():
    S = [jnp.eye(m).at[1, 0].set(jnp.nan).at[0, 1].set(jnp.nan) for m in (3, 7)]
    for root in compiled(lambda S: [linalg.cholesky(s) for s in S])(S):
        assert not root.positive_definite
        assert root.reciprocal_pivot == 0
        assert np.all(np.isfinite(root.factor))


def test_reciprocal_pivot_tells_how_many_digits_are_left():
    diagonals = [jnp.diag(10.0 ** jnp.linspace(-12, 12, m)) for m in (1, 3, 6, 8)]
    d = np.array([1e-3, 1e-5, 1e-7])
    H = np.ones((3, 2, 3))
    H[:, 1, 2] += d
    dyer_mcreynolds = H @ H.transpose(0, 2, 1) + (d * d)[:, None, None] * np.eye(2)

    @compiled
    def factor(diagonals, innovation_cov):
        return [linalg.cholesky(S) for S in diagonals], jax.vmap(linalg.cholesky)(innovation_cov)

    diagonal, ill_conditioned = factor(diagonals, dyer_mcreynolds)
    for root in diagonal:
        assert root.positive_definite
        np.testing.assert_allclose(root.reciprocal_pivot, 1, rtol=1e-15)
    # By hand: S = [[3 + d2, 3 + d], [., 3 + 2 d + 2 d2]], |S| = 8 d2 + ..., ratio |S| / (S11 S22).
    np.testing.assert_allclose(ill_conditioned.reciprocal_pivot / d**2, 8 / 9, rtol=0.05)
    assert np.all(ill_conditioned.reciprocal_pivot[2] < 1e-13)


def test_derivatives_of_cholesky_equal_finite_differences():
    rng = np.random.default_rng(4)
    S = [random_spd(rng, 5, m) + np.eye(m) for m in (1, 3, 6, 7)]
    E = [e + e.transpose(0, 2, 1) for e in (rng.standard_normal(s.shape) for s in S)]
    W = [rng.standard_normal(s.shape) for s in S]

    @compiled
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
    block = random_spd(rng, 3, 3)
    A = np.zeros((7, 6, 6))
    A[1] = np.diag([1.0, 0.0, 4.0, 0.0, 0.0, 9.0])
    A[2] = 1.0
    A[3, :3, :3] = block[0]
    A[4, 3:, 3:] = block[1]
    A[5, ::2, ::2] = block[2]
    A[6] = random_spd(rng, 1, 6)

    @compiled
    def root_and_gradient(A):
        def total(a):
            return jnp.sum(roots.semidefinite_root(a).factor)

        return jax.vmap(roots.semidefinite_root)(A), jax.vmap(jax.grad(total))(A)

    root, gradient = root_and_gradient(A)
    assert np.all(root.semidefinite)
    L = np.asarray(root.factor)
    np.testing.assert_array_equal(L, np.tril(L))
    np.testing.assert_allclose(L @ L.transpose(0, 2, 1), A, rtol=0, atol=1e-13)
    np.testing.assert_allclose(L[1], np.sqrt(A[1]), rtol=1e-14)
    np.testing.assert_allclose(L[6], np.linalg.cholesky(A[6]), rtol=0, atol=1e-13)
    assert np.all(np.isfinite(gradient))


def test_root_of_a_matrix_that_is_singular_to_rounding():
    rng = np.random.default_rng(6)
    axes = np.linalg.qr(rng.standard_normal((50_000, 3, 3)))[0]
    A = (axes * np.array([1.0, 1.0, 0.0])) @ axes.transpose(0, 2, 1)
    root = compiled(jax.vmap(roots.semidefinite_root))(A)
    assert np.all(root.semidefinite)
    L = np.asarray(root.factor)
    np.testing.assert_allclose(L @ L.transpose(0, 2, 1), A, rtol=0, atol=1e-13)


ROOT_SIZES = (1, 3, 15)


def test_root_tells_semidefinite_from_indefinite():
    """In any units: all of any rank pass, and none with an eigenvalue of -1e-3 of the largest."""
    rng = np.random.default_rng(8)
    batches = []
    for n in (3, 15):
        axes = np.linalg.qr(rng.standard_normal((200, n, n)))[0]
        ranks = rng.integers(1, n + 1, (200, 1))
        values = rng.uniform(0.1, 1, (200, n)) * (np.arange(n) < ranks)
        negative = np.where(np.arange(n) == n - 1, -1e-3, values)
        units = 10.0 ** rng.integers(-6, 7, (200, n, 1))
        for eigenvalues in (values, negative):
            A = (axes * eigenvalues[:, None]) @ axes.mT
            batches.append(0.5 * (A + A.mT) * units * units.mT)
    judged = compiled(lambda A: [jax.vmap(roots.semidefinite_root)(a) for a in A])(batches)
    for on_cone, beyond in (judged[:2], judged[2:]):
        assert np.all(on_cone.semidefinite)
        assert not np.any(beyond.semidefinite)


def test_root_of_a_negative_or_missing_variance_is_not_a_number():
    A = np.stack([np.eye(3)] * 4)
    A[1, 1, 1], A[2, 2, 2], A[3, 0, 1], A[3, 1, 0] = -1e-12, np.nan, np.nan, np.nan
    root = compiled(jax.vmap(roots.semidefinite_root))(A)
    np.testing.assert_array_equal(root.semidefinite, [True, False, False, False])
    assert np.all(np.isnan(root.factor[1:3]))


@compiled
def downdates(pairs):
    return [jax.vmap(roots.downdate)(*pair) for pair in pairs]


def random_downdates(rng, length):
    """Return factors ``(COUNT, n, n)`` and vectors ``L u`` with ``|u| = length``, for each size."""
    pairs = []
    for n in ROOT_SIZES:
        L = np.linalg.cholesky(random_spd(rng, COUNT, n))
        u = rng.standard_normal((COUNT, n, 1))
        pairs.append((L, (L @ u)[..., 0] * length / np.linalg.norm(u, axis=1)))
    return pairs


def test_downdate_is_the_factor_of_the_difference():
    pairs = random_downdates(np.random.default_rng(9), 0.8)
    for (L, v), (factor, sound) in zip(pairs, downdates(pairs), strict=True):
        assert np.all(sound)
        expected = np.linalg.cholesky(L @ L.mT - v[:, :, None] * v[:, None])
        scale = np.abs(expected).max(axis=(1, 2), keepdims=True)
        np.testing.assert_allclose(factor / scale, expected / scale, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(factor, np.tril(factor))


def test_downdate_of_too_much_is_reported_and_of_nothing_is_the_identity():
    pairs = random_downdates(np.random.default_rng(10), 1.01)
    nothing = [(L, np.zeros_like(v)) for L, v in pairs]
    unknown = [(L, np.full_like(v, np.nan)) for L, v in pairs]
    cases = ((pairs, False), (nothing, True), (unknown, False))
    for given, sound in cases:
        for (L, _), out in zip(given, downdates(given), strict=True):
            np.testing.assert_array_equal(out.semidefinite, sound)
            np.testing.assert_array_equal(out.factor, L)


def test_downdate_of_a_singular_factor():
    """A state without variance allows nothing to be taken from it, and is no obstacle."""
    L = np.linalg.cholesky(random_spd(np.random.default_rng(11), COUNT, 3))
    L[:, 1] = 0
    v = L[:, :, 0] * 0.5
    touched = v.copy()
    touched[:, 1] = 1e-3
    (factor, sound), (kept, refused) = downdates([(L, v), (L, touched)])
    assert np.all(sound)
    assert not np.any(refused)
    np.testing.assert_allclose(
        factor @ factor.mT, L @ L.mT - v[:, :, None] * v[:, None], atol=1e-13
    )
    np.testing.assert_array_equal(kept, L)


def test_derivatives_of_downdate():
    """By central differences in both modes; at ``v = 0`` and where it fails they are finite."""
    rng = np.random.default_rng(12)
    L, v = (jnp.asarray(part[:4]) for part in random_downdates(rng, 0.6)[1])
    weight = jnp.asarray(rng.standard_normal((3, 3)))

    @compiled
    def total(L, v):
        return jnp.sum(weight * roots.downdate(L, v).factor)

    check_grads(jax.vmap(total), (L, v), order=1, modes=["fwd", "rev"], rtol=1e-7, atol=1e-7)
    by_both = compiled(jax.vmap(jax.grad(total, argnums=(0, 1))))
    of_L, of_v = by_both(L, 0 * v)
    np.testing.assert_allclose(of_L, jnp.tril(weight)[None] + 0 * L, atol=1e-15)
    np.testing.assert_allclose(of_v, 0, atol=1e-15)
    assert all(np.all(np.isfinite(g)) for g in by_both(L, 9 * v))


AD_SIZES = (1, 3, 6, 7, 15, 18)


def roots_of(n):
    """Return what factors arrays of ``n`` rows, with arguments and a plain form in NumPy."""
    rng = np.random.default_rng(n)
    S = random_spd(rng, 1, n)[0] + np.eye(n)
    L, wide = np.linalg.cholesky(S), rng.standard_normal((n, n + 9))
    seen, root = rng.standard_normal((2, n)), np.linalg.cholesky(random_spd(rng, 1, 2)[0])
    v = L @ np.full(n, 0.5 / np.sqrt(n))

    def square(A):
        return np.linalg.cholesky(A @ A.T)

    def updated(root, seen, L):
        return square(np.block([[root, seen], [np.zeros((n, 2)), L]]))

    def symmetric(A):
        return np.linalg.cholesky(np.tril(A) + np.tril(A, -1).T)

    return {
        "cholesky": (lambda A: linalg.cholesky(A).factor, symmetric, (S,)),
        "semidefinite_root": (lambda A: roots.semidefinite_root(A).factor, symmetric, (S,)),
        "tria": (roots.tria, square, (wide,)),
        "tria_beside": (roots.tria_beside, lambda L, A: square(np.hstack([L, A])), (L, wide)),
        "tria_of_update": (roots.tria_of_update, updated, (root, seen, L)),
        "downdate": (
            lambda L, v: roots.downdate(L, v).factor,
            lambda L, v: np.linalg.cholesky(L @ L.T - np.outer(v, v)),
            (L, v),
        ),
    }


@pytest.mark.parametrize("n", AD_SIZES)
def test_derivatives_of_all_factors_in_both_modes(n):
    """Forward against central differences of NumPy, reverse against forward."""
    rng = np.random.default_rng(100 + n)
    cases = roots_of(n)
    directions = {
        name: tuple(
            np.tril(rng.standard_normal(a.shape))
            if a.ndim == 2 and a.shape[0] == a.shape[1]
            else rng.standard_normal(a.shape)
            for a in args
        )
        for name, (_, _, args) in cases.items()
    }
    weights = {
        name: rng.standard_normal(plain(*args).shape) for name, (_, plain, args) in cases.items()
    }

    @compiled
    def both(directions, weights):
        out = {}
        for name, (function, _, args) in cases.items():
            value, forward = jax.jvp(function, args, directions[name])
            pulled = jax.vjp(function, *args)[1](weights[name])
            pairs = zip(pulled, directions[name], strict=True)
            out[name] = value, forward, sum(jnp.sum(a * b) for a, b in pairs)
        return out

    for name, (value, forward, reverse) in both(directions, weights).items():
        _, plain, args = cases[name]
        np.testing.assert_allclose(value, plain(*args), rtol=0, atol=1e-12, err_msg=name)
        h = 1e-4
        ahead, behind = (
            plain(*(a + sign * h * d for a, d in zip(args, directions[name], strict=True)))
            for sign in (1, -1)
        )
        numeric = (ahead - behind) / (2 * h)
        scale = 1 + np.abs(numeric).max()
        np.testing.assert_allclose(forward / scale, numeric / scale, atol=1e-6, err_msg=name)
        expected = np.sum(weights[name] * forward)
        np.testing.assert_allclose(reverse, expected, rtol=1e-10, atol=1e-10, err_msg=name)


def test_arrays_with_zero_rows_and_columns_have_finite_factors_and_derivatives():
    """A state without variance and noise, a perfect channel, a root of lower rank."""
    for n in (3, 15):
        root, seen, L = (jnp.asarray(a) for a in roots_of(n)["tria_of_update"][2])
        flat, perfect = L.at[:, 1].set(0).at[1].set(0), root.at[:, 0].set(0)
        calls = (
            (roots.tria, (jnp.concatenate([flat, flat], axis=1),)),
            (roots.tria_beside, (flat, flat)),
            (roots.tria_of_update, (perfect, seen, flat)),
            (roots.tria_of_update, (0 * root, 0 * seen, 0 * L)),
        )

        @compiled
        def values_and_gradients(arguments, calls=calls):
            return [
                (f(*a), jax.grad(lambda a, f=f: jnp.sum(f(*a)))(a))
                for (f, _), a in zip(calls, arguments, strict=True)
            ]

        arrays = (
            np.hstack([flat, flat]),
            np.hstack([flat, flat]),
            np.asarray(roots.update_array(perfect, seen, flat)),
            np.zeros((n + 2, n + 2)),
        )
        found = values_and_gradients([a for _, a in calls])
        for (factor, gradient), A in zip(found, arrays, strict=True):
            np.testing.assert_allclose(factor @ factor.T, A @ A.T, rtol=0, atol=1e-12)
            np.testing.assert_array_equal(factor, np.tril(factor))
            assert all(np.all(np.isfinite(g)) for g in jax.tree.leaves(gradient))


def test_roots_in_float32_stay_there_and_do_not_underflow():
    """In units of 1e-21 the squares are below the smallest number."""
    cases = roots_of(15)
    for name in ("tria", "tria_beside", "tria_of_update"):
        function, plain, args = cases[name]
        small = [jnp.asarray(1e-21 * a, jnp.float32) for a in args]
        factor = compiled(function)(*small)
        assert factor.dtype == jnp.float32
        expected = plain(*args)
        error = np.abs(np.asarray(factor, float) * 1e21 - expected).max()
        assert error < 1e-5 * np.abs(expected).max(), name


def test_no_factor_is_a_call_into_a_library():
    cases = roots_of(15)
    for name, (function, _, args) in cases.items():
        batch = [jnp.stack([jnp.asarray(a)] * 4) for a in args]
        text = jax.jit(jax.vmap(function)).lower(*batch).compile().as_text()
        assert text is not None
        assert "custom-call" not in text, name
        assert "custom_call_target" not in text, name


def test_gradient_of_safe_norm_at_zero_and_beyond():
    x = jnp.array([[0.0, 0.0, 0.0], [3.0, 0.0, -4.0]])
    value, reverse = compiled(jax.vmap(jax.value_and_grad(linalg.safe_norm)))(x)
    forward = compiled(jax.vmap(jax.jacfwd(linalg.safe_norm)))(x)
    np.testing.assert_array_equal(value, [0, 5])
    for gradient in (forward, reverse):
        np.testing.assert_allclose(gradient, [[0, 0, 0], [0.6, 0, -0.8]], rtol=4e-16)


def test_symmetrise():
    A = np.random.default_rng(6).standard_normal((4, 4))
    S = linalg.symmetrise(jnp.asarray(A))
    np.testing.assert_array_equal(S, S.T)
    np.testing.assert_array_equal(S, (A + A.T) / 2)


def test_a_poisoned_member_leaves_the_batch_bitwise_unchanged():
    healthy = random_batches(np.random.default_rng(7))
    reference = kernels(healthy)
    others = np.arange(COUNT) != 17
    for poison in (np.nan, -1.0, np.inf):
        poisoned = [tuple(part.copy() for part in batch) for batch in healthy]
        for S, L, _ in poisoned:
            S[17] = L[17] = poison
        same = jax.tree.map(
            lambda a, b: np.array_equal(a[others], b[others]), reference, kernels(poisoned)
        )
        assert all(jax.tree.leaves(same))
