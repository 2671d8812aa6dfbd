"""Smooth forms of hard decisions: they tend to the hard ones, and have the gradients these lack."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.estimation.banks.weights import Floor, floor
from jaxnav.estimation.filters.adaptive import Adaptation, moved_log_factor
from jaxnav.estimation.types import Info, Obs
from tests.oracles.matrices import central_difference

TEMPERATURES = jnp.array([1.0, 0.3, 0.1, 0.03, 0.01])
WEIGHTS = jnp.log(jnp.array([0.9, 0.0895, 0.01, 0.0005]))
BOUND = 0.002


def raised(smooth: bool, params: Any, log_weights: Array = WEIGHTS) -> Array:
    """The weights after the floor."""
    info: Any = None
    step = jnp.ones((), jnp.int32)
    return floor(smooth=smooth).update(params, (), log_weights, info, step)[1]


def test_the_smooth_floor_tends_to_the_hard_one() -> None:
    hard = raised(False, jnp.array(BOUND))
    falling = jnp.array([1.0, 0.6, 0.4, 0.2, 0.1])
    apart = jax.vmap(lambda t: jnp.max(jnp.abs(raised(True, Floor(BOUND, t)) - hard)))
    gap = jax.jit(apart)(falling)
    assert np.all(np.diff(gap) < 0)
    assert gap[-1] < 1e-6
    np.testing.assert_allclose(np.exp(raised(True, Floor(BOUND, 1.0))).sum(), 1, rtol=1e-12)


def test_the_smooth_floor_keeps_out_who_takes_no_part() -> None:
    away = WEIGHTS.at[1].set(-jnp.inf)
    value, slope = jax.jit(
        jax.value_and_grad(lambda bound: raised(True, Floor(bound), away)[3], argnums=0)
    )(jnp.array(BOUND))
    assert np.isfinite(value)
    assert np.isfinite(slope)
    assert raised(True, Floor(BOUND), away)[1] == -jnp.inf


def test_the_gradient_of_the_smooth_floor() -> None:
    """A weight above the bound learns of it from afar, where the hard rule is silent."""

    def weight(params: Array) -> Array:
        return raised(True, Floor(params[0], params[1]))[3]

    point = np.array([4e-4, 0.5])
    gradient = jax.jit(jax.grad(weight))(jnp.asarray(point))
    compiled = jax.jit(weight)
    expected = [
        central_difference(compiled, point, e, h)
        for e, h in zip(np.eye(2), (1e-6, 1e-4), strict=True)
    ]
    np.testing.assert_allclose(gradient, expected, rtol=1e-6)
    silent = jax.grad(lambda bound: raised(False, bound)[3] - raised(False, bound)[0])
    assert silent(jnp.array(4e-4)) == 0


def moved(own: Adaptation, innovation: Array, smooth: bool) -> Array:
    """The log-factor of an adaptive filter after an innovation of unit covariance."""
    zero, whole = jnp.zeros(()), jnp.zeros((), jnp.int32)
    info = Info(innovation, jnp.eye(1), zero, zero, whole, whole)
    obs = Obs(innovation, jnp.ones(1, bool))
    return moved_log_factor(own, jnp.zeros(()), info, obs, smooth=smooth)


def test_the_smooth_bounds_of_the_adaptive_filter() -> None:
    """Small, bounded by the largest ratio, and beyond the largest factor."""

    def pairs(temperature: Array, memory: Array, innovation: Array) -> Array:
        own = Adaptation(memory, 0.5, 2.0, temperature)
        return jnp.stack([moved(own, innovation[None], smooth) for smooth in (True, False)])

    over = jax.vmap(jax.vmap(pairs, (None, 0, 0)), (0, None, None))
    cases = jnp.array([20.0, 20.0, 5.0]), jnp.array([0.9, 8.0, 8.0])
    found = jax.jit(over)(TEMPERATURES, *cases)
    gap = np.max(np.abs(found[:, :, 0] - found[:, :, 1]), axis=1)
    assert np.all(np.diff(gap) < 0)
    assert gap[-1] < 1e-9

    def factor(params: Array, smooth: bool) -> Array:
        own = Adaptation(params[0], 0.5, params[1], jnp.array(0.3))
        return moved(own, jnp.array([3.6]), smooth)

    point = np.array([5.0, 2.0])
    compiled = jax.jit(lambda params: factor(params, True))
    gradient = jax.jit(jax.grad(lambda params: factor(params, True)))(jnp.asarray(point))
    expected = [central_difference(compiled, point, e, 1e-4) for e in np.eye(2)]
    np.testing.assert_allclose(gradient, expected, rtol=1e-6)
    assert abs(gradient[0]) > 0
    assert jax.grad(lambda params: factor(params, False))(jnp.asarray(point))[0] == 0
