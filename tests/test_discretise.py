"""Continuous systems over a step, against closed forms and the exponential of Van Loan's matrix."""

import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import jaxnav as jn


def van_loan(F: np.ndarray, density: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    n = len(F)
    whole = scipy.linalg.expm(np.block([[-F, density], [np.zeros((n, n)), F.T]]) * dt)
    Phi = whole[n:, n:].T
    return Phi, Phi @ whole[:n, n:]


def test_closed_forms() -> None:
    """Constant acceleration, to the last digits at any step, and a Gauss-Markov process."""
    F = np.diag([1.0, 1.0], 1)
    for dt in (1e-6, 0.01, 1.0, 60.0):
        Phi, Q = jn.discretise(F, np.array([[0.0], [0.0], [1.0]]), np.array([3.0]), dt)
        np.testing.assert_allclose(Phi, [[1, dt, dt**2 / 2], [0, 1, dt], [0, 0, 1]], rtol=1e-13)
        expected = [
            [dt**5 / 20, dt**4 / 8, dt**3 / 6],
            [dt**4 / 8, dt**3 / 3, dt**2 / 2],
            [dt**3 / 6, dt**2 / 2, dt],
        ]
        np.testing.assert_allclose(Q, 3 * np.array(expected), rtol=1e-12)
        time, sigma = 5.0, 0.3
        Phi, Q = jn.discretise(jnp.array([[-1 / time]]), None, np.array([2 * sigma**2 / time]), dt)
        np.testing.assert_allclose(Phi[0, 0], np.exp(-dt / time), rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(Q[0, 0], -(sigma**2) * np.expm1(-2 * dt / time), rtol=1e-12)


def test_random_systems_equal_van_loan() -> None:
    rng = np.random.default_rng(0)
    for n, dt in ((2, 0.3), (6, 0.05), (15, 1.0)):
        F, root = rng.normal(size=(n, n)) / n**0.5, rng.normal(size=(n, 3))
        density = root @ np.diag([1.0, 0.2, 4.0]) @ root.T
        expected = van_loan(F, density, dt)
        ours = jn.discretise(F, root, np.array([1.0, 0.2, 4.0]), dt)
        whole = jn.discretise(F, None, density, dt)
        for mine, same, theirs in zip(ours, whole, expected, strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=1e-10, atol=1e-12)
            np.testing.assert_allclose(same, theirs, rtol=1e-10, atol=1e-12)


def test_whole_numbers_are_numbers_too() -> None:
    Phi, Q = jn.discretise(np.array([[0, 1], [0, 0]]), np.array([[0], [1]]), np.array([2]), 3)
    np.testing.assert_allclose(Phi, [[1, 3], [0, 1]], rtol=1e-13)
    np.testing.assert_allclose(Q, [[18, 9], [9, 6]], rtol=1e-13)
    flags = np.array([[False, True], [False, False]])
    assert jn.discretise(flags, None, np.ones(2), 0.5).Phi[0, 1] == 0.5
    narrow = jn.discretise(jnp.eye(2, dtype=jnp.float32), None, jnp.ones(2, jnp.float32), 0.1)
    assert narrow.Phi.dtype == narrow.Q.dtype == jnp.float32


def test_structure_is_kept_and_what_decays_fast_is_right() -> None:
    """Blocks of zeros stay exact; a stiff state ends at its stationary variance; Q is one."""
    F = np.diag([1.0, 0.0, 0.0, 0.0], 1) + np.diag([0.0, 0.0, 0.0, -200.0, 0.0])
    Phi, Q = map(np.asarray, jn.discretise(F, None, np.array([0.0, 1.0, 0.0, 2.0, 0.5]), 1.0))
    assert np.all(Phi[2:, :2] == 0)
    assert np.all(Q[2:, :2] == 0)
    assert Phi[2, 2] == 1
    np.testing.assert_allclose(Q[3, 3], 2.0 / 400.0, rtol=1e-12)
    np.testing.assert_array_equal(Q, Q.T)
    assert np.linalg.eigvalsh(Q).min() > -1e-16
    lost = jn.discretise(np.array([[-5000.0]]), None, np.ones(1), 1.0)
    assert np.isnan(lost.Phi).all()
    assert np.isnan(lost.Q).all()


def test_derivatives_in_both_modes() -> None:
    F = jnp.array([[-0.5, 1.0], [0.0, -0.1]])

    def entries(dt: Any) -> jax.Array:
        Phi, Q = jn.discretise(F, None, jnp.array([1.0, 2.0]), dt)
        return jnp.concatenate([Phi.ravel(), Q.ravel()])

    Phi, Q = jn.discretise(F, None, jnp.array([1.0, 2.0]), 0.7)
    by_dt = jnp.concatenate(
        [(F @ Phi).ravel(), (F @ Q + Q @ F.T + jnp.diag(jnp.array([1.0, 2.0]))).ravel()]
    )
    for differentiated in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(differentiated(entries)(0.7), by_dt, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((np.ones((2, 3)), None, np.ones(2), 1.0), "F is (2, 3); it must be square, (n, n)"),
        ((np.ones(3), None, np.ones(2), 1.0), "F is (3,); it must be square, (n, n)"),
        ((np.eye(2), None, np.ones(2), np.array([0.1, 0.2])), "dt is (2,); it must be one number"),
        ((1j * np.eye(2), None, np.ones(2), 1.0), "F is complex; it must be of real numbers"),
        ((np.eye(2), None, np.ones(2), -0.1), "dt is -0.1; it must not be negative"),
        ((np.eye(2), None, -np.ones(2), 0.1), "a variance of Qc is -1; it must not be negative"),
        ((np.eye(2), np.ones((3, 1)), np.ones(1), 1.0), "it must be (2, k)"),
        ((np.eye(2), np.ones((2, 1)), np.ones(2), 1.0), "it must be (1, 1) or (1,)"),
        (
            (np.eye(2), None, np.array([[1.0, 0.5], [0.0, 1.0]]), 0.1),
            "Qc and its transpose differ by 0.5; it must be",
        ),
    ],
)
def test_shapes_that_do_not_fit_are_refused(arguments: Any, sentence: str) -> None:
    with pytest.raises(ValueError, match=re.escape(sentence)):
        jn.discretise(*arguments)
