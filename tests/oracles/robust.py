"""Robust and adaptive filters as loops, from the equations in their docstrings."""

from collections.abc import Callable

import numpy as np

from tests.oracles.kalman import Linear


def versoria_weight(e: np.ndarray, width: float, power: float) -> np.ndarray:
    """Return ``1 / (1 + tau |e|^p)^2``."""
    return 1 / (1 + width * np.abs(e) ** power) ** 2


def correntropy_weight(e: np.ndarray, bandwidth: float) -> np.ndarray:
    """Return ``exp(-e^2 / (2 sigma^2))``."""
    return np.exp(-(e**2) / (2 * bandwidth**2))


def reweighted(
    x: np.ndarray,
    P: np.ndarray,
    H: np.ndarray,
    R: np.ndarray,
    z: np.ndarray,
    valid: np.ndarray,
    weight: Callable[[np.ndarray], np.ndarray],
    iterations: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Update in information form; channels that are not valid are deleted from the measurement."""
    H, R, z = H[valid], R[np.ix_(valid, valid)], z[valid]
    L, prior = np.linalg.cholesky(R), np.linalg.inv(P)

    def update(noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        seen = H.T @ np.linalg.inv(noise)
        cov = np.linalg.inv(prior + seen @ H)
        return cov @ (prior @ x + seen @ z), cov

    mean, cov = update(R)
    for _ in range(iterations):
        w = np.maximum(weight(np.linalg.solve(L, z - H @ mean)), 1e-8)
        mean, cov = update(L @ np.diag(1 / w) @ L.T)
    return mean, cov


def adapted(
    model: Linear,
    z: np.ndarray,
    valid: np.ndarray,
    memory: float,
    bounds: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray]:
    """Run the filter that scales its process noise; return the means and the factors after each."""
    x, P, log_factor = model.x0, model.P0, 0.0
    means, factors = [], []
    for k in range(len(z)):
        x = model.Phi[k] @ x
        P = model.Phi[k] @ P @ model.Phi[k].T + np.exp(log_factor) * model.Q[k]
        if np.any(valid[k]):
            H, R = model.H[valid[k]], model.R[np.ix_(valid[k], valid[k])]
            S = H @ P @ H.T + R
            nu = z[k, valid[k]] - H @ x
            K = P @ H.T @ np.linalg.inv(S)
            x, P = x + K @ nu, P - K @ S @ K.T
            log_factor += np.mean(np.minimum(nu**2 / np.diag(S), 10) - 0.9970879) / memory
            log_factor = float(np.clip(log_factor, *np.log(bounds)))
        means.append(x)
        factors.append(np.exp(log_factor))
    return np.array(means), np.array(factors)
