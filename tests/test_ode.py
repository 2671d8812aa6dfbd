"""The Runge-Kutta step: order and exactness."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.compiling import compiled
from jaxnav.numerics.ode import rk4


def test_order_four_on_a_pytree_with_a_known_solution():
    def derivative(t, state):
        y = state["logistic"]
        return {"logistic": y * (1 - y), "lorentz": -2 * t * state["lorentz"] ** 2}

    @compiled
    def integrated(step, steps):
        def body(k, state):
            return rk4(derivative, k * step, state, step)

        start = {"logistic": jnp.array([0.1, 0.6]), "lorentz": jnp.ones(())}
        return jax.lax.fori_loop(0, steps, body, start)

    end = 2.0
    exact = {
        "logistic": 1 / (1 + np.array([9.0, 2 / 3]) * np.exp(-end)),
        "lorentz": 1 / (1 + end * end),
    }
    errors = {name: [] for name in exact}
    for steps in (40, 80, 160):
        state = integrated(end / steps, steps)
        for name, value in exact.items():
            errors[name].append(np.abs(state[name] - value))
    for name, (coarse, fine, finest) in errors.items():
        assert np.all(finest < 1e-8)
        np.testing.assert_allclose(coarse / fine, 16, rtol=0.1, err_msg=name)
        np.testing.assert_allclose(fine / finest, 16, rtol=0.05, err_msg=name)


def test_a_cubic_in_time_is_integrated_exactly():
    def advance(t, y):
        return rk4(lambda t, y: 4 * t**3 + jnp.zeros_like(y), t, y, 2.0)

    np.testing.assert_allclose(compiled(advance)(1.0, np.zeros(2)), 3.0**4 - 1, rtol=1e-15)


def test_gradient_by_the_step():
    def decayed(step):
        return rk4(lambda t, y: -y, jnp.zeros(()), jnp.ones(()), step)

    h = 0.3
    np.testing.assert_allclose(
        compiled(jax.grad(decayed))(h), -1 + h - h**2 / 2 + h**3 / 6, rtol=1e-14
    )
