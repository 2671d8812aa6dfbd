"""Numerical integration of ordinary differential equations."""

from collections.abc import Callable
from typing import TypeVar

import jax
from jax import Array

S = TypeVar("S")


def rk4(derivative: Callable[[Array, S], S], time: Array, state: S, step: float | Array) -> S:
    """Advance ``state`` by one classical Runge-Kutta step of fourth order.

    Args:
        derivative: ``(t, state) -> d(state)/dt``, a pytree like ``state``.
        time: Start of the step [s].
        state: Pytree of arrays.
        step: Length of the step [s].

    Returns:
        The state at ``time + step``; the local error is of order ``step**5``.
    """

    def along(slope: S, weight: float | Array) -> S:
        return jax.tree.map(lambda x, k: x + weight * k, state, slope)

    k1 = derivative(time, state)
    k2 = derivative(time + 0.5 * step, along(k1, 0.5 * step))
    k3 = derivative(time + 0.5 * step, along(k2, 0.5 * step))
    k4 = derivative(time + step, along(k3, step))
    mean = jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4)
    return along(mean, step)
