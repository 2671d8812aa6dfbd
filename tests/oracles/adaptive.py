"""The Sage-Husa filter as a loop over steps, channels that did not arrive being deleted."""

from typing import NamedTuple

import numpy as np

from tests.oracles.kalman import Linear


class Averaging(NamedTuple):
    """Forgetting ``b``, samples that the start counts for, and bounds of the "clamped" form."""

    forgetting: float
    prior_count: float
    low: float
    high: float


class NoiseHistory(NamedTuple):
    """After each step: mean, covariance, the noise ``N``; and what the update said.

    ``told`` (T, m) marks the channels that moved the noise, ``indefinite`` (T,) the updates that
    used a noise that is not positive definite.
    """

    mean: np.ndarray
    cov: np.ndarray
    noise: np.ndarray
    log_likelihood: np.ndarray
    told: np.ndarray
    indefinite: np.ndarray


def positive(A: np.ndarray) -> bool:
    """Return whether a symmetric matrix, which may be empty, is positive definite."""
    return bool(np.all(np.linalg.eigvalsh(A) > 0))


def share(own: Averaging, count: np.ndarray) -> np.ndarray:
    """Return ``d`` as a weight among all samples: one over the sum of ``b^i`` up to the count."""
    n = count + own.prior_count
    if own.forgetting == 1:
        return 1 / (n + 1)
    return (1 - own.forgetting) / (1 - own.forgetting ** (n + 1))


def sage_husa(
    model: Linear,
    grade: np.ndarray,
    z: np.ndarray,
    valid: np.ndarray,
    own: Averaging,
    form: str,
    current: bool,
) -> NoiseHistory:
    """Run the filter with the model's noise times ``grade`` (T,)."""
    m = len(model.H)
    x, P, N, count = model.x0, model.P0, np.eye(m), np.zeros(m)
    rows = []
    for k in range(len(z)):
        x, P = model.Phi[k] @ x, model.Phi[k] @ P @ model.Phi[k].T + model.Q[k]
        v = valid[k]
        H, nominal, seen = model.H[v], grade[k] * model.R[np.ix_(v, v)], z[k, v]
        prior, told = (x, P), np.zeros(m, bool)
        x, P, row = corrected(*prior, H, scaled(nominal, N, v), seen)
        lost = not positive(N[np.ix_(v, v)])
        if np.any(v) and np.isfinite(row) and positive(nominal):
            told = v
            sample = sampled(form, prior, (x, P), H, np.linalg.cholesky(nominal), seen)
            N = averaged(N, sample, v, share(own, count[v]))
            if form == "clamped":
                clipped = np.clip(np.diag(N), own.low, own.high)
                N = np.diag(np.where(v, clipped, np.diag(N)))
            count = count + v
        if current:
            x, P, row = corrected(*prior, H, scaled(nominal, N, v), seen)
            lost = not positive(N[np.ix_(v, v)])
        rows.append((x, P, N, row, told, lost and form == "printed"))
    return NoiseHistory(*(np.array(column) for column in zip(*rows, strict=True)))


def scaled(nominal: np.ndarray, N: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return ``L N L'`` of the channels that arrived."""
    if not positive(nominal):
        return nominal
    L = np.linalg.cholesky(nominal)
    return L @ N[np.ix_(v, v)] @ L.T


def corrected(
    x: np.ndarray, P: np.ndarray, H: np.ndarray, R: np.ndarray, z: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return mean, covariance and log-likelihood; an update that is impossible is skipped."""
    S = H @ P @ H.T + R
    if not positive(S):
        return x, P, -np.inf
    nu, K = z - H @ x, P @ H.T @ np.linalg.inv(S)
    quadratic = nu @ np.linalg.solve(S, nu)
    likelihood = -0.5 * (quadratic + np.linalg.slogdet(2 * np.pi * S)[1])
    return x + K @ nu, P - K @ S @ K.T, float(likelihood)


def sampled(
    form: str,
    prior: tuple[np.ndarray, np.ndarray],
    after: tuple[np.ndarray, np.ndarray],
    H: np.ndarray,
    L: np.ndarray,
    z: np.ndarray,
) -> np.ndarray:
    """Return what a step tells of ``N``: by the residual after the update, or the innovation."""
    (x, P), sign = (after, 1) if form == "residual" else (prior, -1)
    e = np.linalg.solve(L, z - H @ x)
    spread = np.linalg.solve(L, np.linalg.solve(L, H @ P @ H.T).T)
    return np.outer(e, e) + sign * spread


def averaged(N: np.ndarray, sample: np.ndarray, v: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Return ``N`` with the sample in its channels, each at its own pace."""
    kept, used = np.ones(len(N)), np.zeros(len(N))
    kept[v], used[v] = np.sqrt(1 - d), np.sqrt(d)
    wide = np.zeros_like(N)
    wide[np.ix_(v, v)] = sample
    return N * np.outer(kept, kept) + wide * np.outer(used, used)
