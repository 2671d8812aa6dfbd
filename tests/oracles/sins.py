"""The SINS/CNS error model as dense matrices, Eqs. (21) and (22) of Si, Wang, Niu."""

import numpy as np

GM = 3.986004418e14


def gravity(r: np.ndarray, radius: float) -> np.ndarray:
    centre = r + np.array([0.0, radius, 0.0])
    return -GM * centre / np.linalg.norm(centre) ** 3


def dynamics(C: np.ndarray, minus_force_skew: np.ndarray, F_a: np.ndarray) -> np.ndarray:
    zero, one = np.zeros((3, 3)), np.eye(3)
    return np.block(
        [
            [zero, zero, zero, C, zero],
            [minus_force_skew, zero, F_a, zero, C],
            [zero, one, zero, zero, zero],
            [zero, zero, zero, zero, zero],
            [zero, zero, zero, zero, zero],
        ]
    )


def noise_input(C: np.ndarray) -> np.ndarray:
    zero = np.zeros((3, 3))
    return np.block([[C, zero], [zero, C], [zero, zero], [zero, zero], [zero, zero]])
