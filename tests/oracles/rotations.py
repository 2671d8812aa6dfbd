"""Rotations by power series and by elementary rotations."""

import numpy as np


def skew(v: np.ndarray) -> np.ndarray:
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def series(phi: np.ndarray, first: int) -> np.ndarray:
    """Return the sum over k of ``[phi]x^k / (k + first)!``: exp for 0, left Jacobian for 1."""
    term = np.eye(3)
    for k in range(1, first + 1):
        term = term / k
    total = term
    for k in range(1, 60):
        term = term @ skew(phi) / (k + first)
        total = total + term
    return total


def exp(phi: np.ndarray) -> np.ndarray:
    return series(phi, 0)


def left_jacobian(phi: np.ndarray) -> np.ndarray:
    return series(phi, 1)


def dcm(pitch: float, yaw: float, roll: float) -> np.ndarray:
    """Return ``Rz(pitch) Ry(yaw) Rx(roll)``."""
    z, y, x = np.eye(3)[::-1]
    return exp(pitch * z) @ exp(yaw * y) @ exp(roll * x)


def euler(C: np.ndarray) -> np.ndarray:
    """Return pitch, yaw, roll of :func:`dcm`."""
    return np.array(
        [np.arctan2(C[1, 0], C[0, 0]), np.arcsin(-C[2, 0]), np.arctan2(C[2, 1], C[2, 2])]
    )
