"""Small products and the conditioning of a Gaussian against NumPy and plain differentiation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxnav.estimation.filters.kalman import kf
from jaxnav.estimation.tune.losses import negative_log_likelihood
from jaxnav.estimation.types import FilterParams, Gaussian, Model, Obs
from jaxnav.numerics.conditioning import corrected, explained, log_volume, solved, squared
from jaxnav.numerics.linalg import cholesky, matmul, solve_positive
from jaxnav.numerics.products import UNROLL_LIMIT, product

RNG = np.random.default_rng(3)
LEADS = (((), ()), ((4,), (4,)), ((4,), (1,)), ((1, 5), (4, 1)))


@pytest.mark.parametrize("lead", LEADS)
@pytest.mark.parametrize("inner", [1, 3, UNROLL_LIMIT + 1])
def test_product_and_its_derivatives(lead: tuple[tuple, tuple], inner: int) -> None:
    A, B = RNG.normal(size=(*lead[0], 2, inner)), RNG.normal(size=(*lead[1], inner, 5))
    np.testing.assert_allclose(jax.jit(product)(A, B), A @ B, rtol=1e-14, atol=1e-14)
    check_grads(product, (A, B), order=2, modes=["fwd", "rev"])


@pytest.mark.parametrize("axes", [(0, None), (None, 1), (2, 0), (None, None)])
def test_product_under_vmap(axes: tuple[int | None, int | None]) -> None:
    """Of a gradient and inside one; a factor that is not mapped stays as it is."""
    factors = RNG.normal(size=(2, 3)), RNG.normal(size=(3, 4))
    A, B = (
        jnp.asarray(factor if axis is None else np.stack([factor, 2 * factor, -factor], axis))
        for factor, axis in zip(factors, axes, strict=True)
    )

    def both(A: jax.Array, B: jax.Array) -> tuple[jax.Array, jax.Array]:
        return matmul(A, B), jax.grad(lambda A: jnp.sum(jnp.sin(matmul(A, B))))(A)

    def plain(A: jax.Array, B: jax.Array) -> tuple[jax.Array, jax.Array]:
        return A @ B, jax.grad(lambda A: jnp.sum(jnp.sin(A @ B)))(A)

    if axes == (None, None):
        mapped, expected = both(A, B), plain(A, B)
    else:
        mapped, expected = jax.vmap(both, axes)(A, B), jax.vmap(plain, axes)(A, B)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13), mapped, expected)


def conditioned(theta: jax.Array) -> tuple[jax.Array, ...]:
    """All four functions, of a covariance, a noise and an innovation that depend on ``theta``."""
    root = jnp.eye(4) + 0.3 * jnp.outer(jnp.arange(4.0), theta[:4])
    P, R = root @ root.T, jnp.diag(jnp.exp(theta[:2]))
    B, nu = P[:2], theta[2:4] ** 2
    S = B[:, :2] + R
    known = solved(S, cholesky(S), nu)
    K = solve_positive(known.root.factor, S, B)
    return (
        explained(S, B, K),
        corrected(S, B, nu, K, known.weighed),
        squared(S, nu, known.root.factor, known.weighed),
        log_volume(S, known.root.factor, known.inverse),
    )


def inverted(theta: jax.Array) -> tuple[jax.Array, ...]:
    """The same by the inverse, differentiated as it stands."""
    root = jnp.eye(4) + 0.3 * jnp.outer(jnp.arange(4.0), theta[:4])
    P, R = root @ root.T, jnp.diag(jnp.exp(theta[:2]))
    B, nu = P[:2], theta[2:4] ** 2
    S = B[:, :2] + R
    inverse = jnp.linalg.inv(S)
    return (
        B.T @ inverse @ B,
        B.T @ inverse @ nu,
        nu @ inverse @ nu,
        jnp.log(jnp.linalg.det(S)),
    )


def test_conditioning_equals_the_inverse_in_value_and_both_modes() -> None:
    theta = jnp.array([0.3, -0.2, 0.5, 0.7])
    for taken in (lambda f: f, jax.jacfwd, jax.jacrev, lambda f: jax.jacfwd(jax.jacrev(f))):
        own, expected = jax.jit(taken(conditioned))(theta), jax.jit(taken(inverted))(theta)
        for a, b in zip(own, expected, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11)


def test_a_backward_pass_factors_nothing_again() -> None:
    """What is kept of a step suffices: its loop has no square root, the forward loop has."""
    model = Model(
        transition=lambda p, x, u: x,
        process_noise=lambda p, x, u: jnp.exp(p) * jnp.eye(3),
        observe=lambda p, x, u: x,
        observation_noise=lambda p, x, u: jnp.ones(3),
    )
    observations = Obs(jnp.ones((5, 3)), jnp.ones((5, 3), bool))

    def loss(p: jax.Array) -> jax.Array:
        params = FilterParams(p, Gaussian(jnp.zeros(3), jnp.eye(3)))
        return negative_log_likelihood(kf(model), params, jnp.zeros(5), observations)

    text = jax.jit(jax.grad(loss)).lower(0.1).compile().as_text()
    assert text is not None
    loops = [part for part in text.split("\n\n") if " sqrt(" in part]
    assert loops
    assert not any("transpose(jvp" in line for line in text.splitlines() if " sqrt(" in line)
