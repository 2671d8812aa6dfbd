"""Random test matrices and derivatives by finite differences."""

from collections.abc import Callable

import numpy as np


def random_spd(rng: np.random.Generator, count: int, size: int) -> np.ndarray:
    A = rng.standard_normal((count, size, size))
    return A @ A.transpose(0, 2, 1) + 0.1 * np.eye(size)


def central_difference(
    f: Callable[[np.ndarray], np.ndarray], x: np.ndarray, dx: np.ndarray, h: float
) -> np.ndarray:
    """Return the derivative of ``f`` at ``x`` along ``dx``, of fourth order in ``h``."""
    near = f(x + h * dx) - f(x - h * dx)
    far = f(x + 2 * h * dx) - f(x - 2 * h * dx)
    return (8 * near - far) / (12 * h)
