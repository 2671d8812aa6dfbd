"""Smooth forms of hard decisions: they tend to the hard ones, and have the gradients these lack."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.estimation.banks.reset import WindowedReset, windowed_reset
from jaxnav.estimation.banks.weights import Floor, floor
from jaxnav.estimation.filters.adaptive import Adaptation, moved_log_factor, softly_clamped
from jaxnav.estimation.filters.line_search import Search, step_length
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
    gap = compiled(apart)(falling)
    assert np.all(np.diff(gap) < 0)
    assert gap[-1] < 1e-6
    np.testing.assert_allclose(np.exp(raised(True, Floor(BOUND, 1.0))).sum(), 1, rtol=1e-12)


def test_the_smooth_floor_keeps_out_who_takes_no_part() -> None:
    away = WEIGHTS.at[1].set(-jnp.inf)
    value, slope = compiled(
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
    gradient = compiled(jax.grad(weight))(jnp.asarray(point))
    program = compiled(weight)
    expected = [
        central_difference(program, point, e, h)
        for e, h in zip(np.eye(2), (1e-6, 1e-4), strict=True)
    ]
    np.testing.assert_allclose(gradient, expected, rtol=1e-6)
    assert np.min(np.abs(gradient)) > 1e-3
    silent = jax.grad(lambda bound: raised(False, bound)[3] - raised(False, bound)[0])
    assert silent(jnp.array(4e-4)) == 0


def reset(own: WindowedReset, smooth: bool) -> tuple[Array, Array]:
    """Both sets of weights after a step in which the second prefers another model."""
    zero, whole = jnp.zeros(4), jnp.zeros(4, jnp.int32)
    window, seen = WEIGHTS[::-1], jnp.array([-3.0, -2.0, -0.5, -1.0])
    info = Info(zero[:, None], jnp.ones((4, 1, 1)), seen, zero, whole, whole, whole > 0, whole > 0)
    rule = windowed_reset(smooth=smooth)
    return rule.update(own, window, WEIGHTS, info, jnp.array(8, jnp.int32))


def test_the_threshold_of_the_smooth_reset_tends_to_the_hard_one() -> None:
    """The leader, at 0.9, meets it or not; what is replaced then is the smooth rule's share."""
    one = lambda threshold, t: reset(WindowedReset(8.5, threshold, t), True)  # noqa: E731
    over = jax.vmap(jax.vmap(one, (None, 0)), (0, None))
    falling = jnp.array([0.3, 0.1, 0.03, 0.01, 0.003])
    window, found = compiled(over)(jnp.array([0.95, 0.85]), falling)
    w = np.exp(WEIGHTS) / np.exp(WEIGHTS).sum()
    share = (1 - np.exp(window[1, 0]) @ np.exp(WEIGHTS)) / 8.5
    hard = np.stack([w, (1 - share) * w + share / 4])
    gap = np.max(np.abs(np.exp(found) - hard[:, None]), axis=2)
    assert np.all(np.diff(gap, axis=1) < 0)
    assert np.all(gap[:, 0] > 0.01)
    assert np.all(gap[:, -1] < 1e-8)


def test_the_gradient_of_the_smooth_reset() -> None:
    """By threshold, width and period, where the hard one keeps its weights but for a jump."""

    def weight(params: Array, smooth: bool) -> Array:
        return reset(WindowedReset(params[2], params[0], params[1]), smooth)[1][0]

    point = np.array([0.93, 0.05, 8.5])
    both = compiled(lambda params: jnp.stack([weight(params, smooth) for smooth in (True, False)]))
    soft, hard = compiled(jax.jacrev(both))(jnp.asarray(point))
    expected = [
        central_difference(both, point, e, h)[0]
        for e, h in zip(np.eye(3), (1e-3, 1e-4, 1e-2), strict=True)
    ]
    np.testing.assert_allclose(soft, expected, rtol=1e-6)
    assert np.all(np.abs(soft) > 1e-3)
    np.testing.assert_array_equal(hard, 0)


BENDS = jnp.array([0.5, 0.9, 1.2, 2.2])
"""Curvatures of a functional that falls with slope -1: they accept trials 1, 2, 2 and 3."""


def stepped(params: Array) -> Array:
    """Step lengths for a longest step, the share that suffices and a temperature."""
    search = Search(step=params[0], sufficient=params[1], temperature=params[2])

    def of(bend: Array) -> Array:
        return step_length(lambda a: a * (bend * a - 1), jnp.array(-1.0), search, 4)

    return jax.vmap(of)(BENDS)


def test_the_smooth_line_search() -> None:
    """Its temperatures share one program with the hard search, whose is zero."""
    falling = jnp.array([3.0, 0.3, 0.03, 0.01, 0.001, 0.0])
    settings = jnp.stack([jnp.ones(6), jnp.full(6, 0.3), falling], axis=1)
    value, slope = compiled(jax.vmap(lambda a: (stepped(a), jax.jacrev(stepped)(a))))(settings)
    np.testing.assert_array_equal(value[-1], [1.0, 0.5, 0.5, 0.25])
    gap = np.max(np.abs(value[:-1] - value[-1:]), axis=1)
    assert np.all(np.diff(gap) < 0)
    assert gap[-1] < 1e-12
    program = compiled(stepped)
    expected = [central_difference(program, np.asarray(settings[1]), e, 1e-3) for e in np.eye(3)]
    np.testing.assert_allclose(slope[1].T, expected, rtol=1e-6)
    assert np.min(np.abs(slope[1])) > 1e-3
    np.testing.assert_array_equal(slope[-1][:, 1:], 0)


def test_the_smooth_clamp() -> None:
    """Of a noise estimate: its limit, its gradient by both bounds and width, values far out."""
    x = jnp.array([0.4, 0.9, 1.1, 1.6, 1.9, 2.3, 4.0])

    def clamped(params: Array) -> Array:
        return softly_clamped(x, params[0], params[1], params[2])

    settings = jnp.stack([jnp.ones(5), jnp.full(5, 2.0), TEMPERATURES], axis=1)
    value, slope = compiled(jax.vmap(lambda a: (clamped(a), jax.jacrev(clamped)(a))))(settings)
    gap = np.max(np.abs(value - jnp.clip(x, 1, 2)[None]), axis=1)
    assert np.all(np.diff(gap) < 0)
    assert gap[-1] < 1e-6
    program = compiled(clamped)
    expected = [central_difference(program, np.asarray(settings[1]), e, 1e-3) for e in np.eye(3)]
    np.testing.assert_allclose(slope[1].T, expected, rtol=1e-6, atol=1e-9)
    assert np.min(np.abs(slope[1])) > 1e-5
    far = softly_clamped(jnp.float32([-1e8, 1e8]), *map(jnp.float32, (0.1, 100, 0.02)))
    np.testing.assert_allclose(far, [0.1, 100], rtol=3e-7)


def moved(own: Adaptation, innovation: Array, smooth: bool, log_factor: float = 0.0) -> Array:
    """The log-factor of an adaptive filter after an innovation of unit covariance, or none."""
    zero, whole = jnp.zeros(()), jnp.zeros((), jnp.int32)
    info = Info(innovation, jnp.eye(1), zero, zero, whole, whole, whole > 0, whole > 0)
    obs = Obs(innovation, jnp.isfinite(innovation))
    return moved_log_factor(own, jnp.array(log_factor), info, obs, smooth=smooth)


def test_the_smooth_bounds_of_the_adaptive_filter() -> None:
    """Small, bounded by the largest ratio, and beyond the largest factor."""

    def pairs(temperature: Array, memory: Array, innovation: Array) -> Array:
        own = Adaptation(memory, 0.5, 2.0, temperature)
        return jnp.stack([moved(own, innovation[None], smooth) for smooth in (True, False)])

    over = jax.vmap(jax.vmap(pairs, (None, 0, 0)), (0, None, None))
    cases = jnp.array([20.0, 20.0, 5.0]), jnp.array([0.9, 8.0, 8.0])
    found = compiled(over)(TEMPERATURES, *cases)
    gap = np.max(np.abs(found[:, :, 0] - found[:, :, 1]), axis=1)
    assert np.all(np.diff(gap) < 0)
    assert gap[-1] < 1e-9

    def factor(params: Array, smooth: bool) -> Array:
        return moved(Adaptation(*params), jnp.array([3.6]), smooth)

    point = np.array([5.0, 0.5, 2.0, 0.3])
    program = compiled(lambda params: factor(params, True))
    gradient = compiled(jax.grad(lambda params: factor(params, True)))(jnp.asarray(point))
    expected = [central_difference(program, point, e, 1e-3) for e in np.eye(4)]
    np.testing.assert_allclose(gradient, expected, rtol=1e-6)
    assert np.min(np.abs(gradient)) > 1e-4
    silent = jax.grad(lambda params: factor(params, False))(jnp.asarray(point))
    np.testing.assert_array_equal(silent[jnp.array([0, 1, 3])], 0)
    kept = moved(Adaptation(5.0, 0.5, 2.0, 0.3), jnp.array([jnp.nan]), True, 0.69)
    assert kept == 0.69
