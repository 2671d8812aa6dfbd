"""Kalman filter and multiple-model banks as loops over steps and models."""

from typing import NamedTuple

import numpy as np


class Linear(NamedTuple):
    """A linear model: ``Phi`` and ``Q`` (T, n, n) per step, and constant ``H, R, x0, P0``."""

    Phi: np.ndarray
    Q: np.ndarray
    H: np.ndarray
    R: np.ndarray
    x0: np.ndarray
    P0: np.ndarray


class History(NamedTuple):
    """Means (T, n), covariances (T, n, n) and log-likelihoods (T,)."""

    mean: np.ndarray
    cov: np.ndarray
    log_likelihood: np.ndarray


def kalman(model: Linear, z: np.ndarray, valid: np.ndarray) -> History:
    """Run the Kalman filter; channels that are not valid are deleted from the measurement."""
    x, P = model.x0, model.P0
    means, covs, likelihoods = [], [], []
    for k in range(len(z)):
        x, P, likelihood = kalman_step(model, k, x, P, z[k], valid[k])
        likelihoods.append(likelihood)
        means.append(x)
        covs.append(P)
    return History(np.array(means), np.array(covs), np.array(likelihoods))


def kalman_step(
    model: Linear, k: int, x: np.ndarray, P: np.ndarray, z: np.ndarray, valid: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Predict and update over step ``k``; return mean, covariance and log-likelihood."""
    x = model.Phi[k] @ x
    P = model.Phi[k] @ P @ model.Phi[k].T + model.Q[k]
    H, R = model.H[valid], model.R[np.ix_(valid, valid)]
    S = H @ P @ H.T + R
    nu = z[valid] - H @ x
    K = P @ H.T @ np.linalg.inv(S)
    A = np.eye(len(x)) - K @ H
    quadratic = nu @ np.linalg.solve(S, nu)
    likelihood = -0.5 * (quadratic + np.linalg.slogdet(2 * np.pi * S)[1])
    return x + K @ nu, A @ P @ A.T + K @ R @ K.T, float(likelihood)


def interacting(
    models: list[Linear], transition: np.ndarray, z: np.ndarray, valid: np.ndarray
) -> History:
    """Run the interacting multiple model filter of Bar-Shalom, Li, Kirubarajan, section 11.6.6.

    From equal probabilities; the log-likelihood is that of the mixture of predictions.
    """
    members = range(len(models))
    mu = np.ones(len(models)) / len(models)
    x, P = [m.x0 for m in models], [m.P0 for m in models]
    means, covs, likelihoods = [], [], []
    for k in range(len(z)):
        c = np.array([sum(transition[i, j] * mu[i] for i in members) for j in members])
        x0, P0 = [], []
        for j in members:
            share = [transition[i, j] * mu[i] / c[j] for i in members]
            mixed = sum(share[i] * x[i] for i in members)
            x0.append(mixed)
            P0.append(
                sum(share[i] * (P[i] + np.outer(x[i] - mixed, x[i] - mixed)) for i in members)
            )
        steps = [kalman_step(models[j], k, x0[j], P0[j], z[k], valid[k]) for j in members]
        x, P, rows = (list(part) for part in zip(*steps, strict=True))
        joint = np.exp(rows) * c
        likelihoods.append(np.log(joint.sum()))
        mu = joint / joint.sum()
        mean = sum(mu[j] * x[j] for j in members)
        covs.append(sum(mu[j] * (P[j] + np.outer(x[j] - mean, x[j] - mean)) for j in members))
        means.append(mean)
    return History(np.array(means), np.array(covs), np.array(likelihoods))


def mixture(histories: list[History], weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the means and covariances of the mixtures with weights (T, M)."""
    means, covs = [], []
    for k, w in enumerate(weights):
        x = sum(w[i] * h.mean[k] for i, h in enumerate(histories))
        P = sum(
            w[i] * (h.cov[k] + np.outer(h.mean[k] - x, h.mean[k] - x))
            for i, h in enumerate(histories)
        )
        means.append(x)
        covs.append(P)
    return np.array(means), np.array(covs)


def bayes_weights(log_likelihood: np.ndarray) -> np.ndarray:
    """Return the weights (T, M) of Bayes' rule from log-likelihoods (T, M), from equal ones."""
    total = np.cumsum(log_likelihood, axis=0)
    w = np.exp(total - total.max(axis=1, keepdims=True))
    return w / w.sum(axis=1, keepdims=True)


def immae_weights(log_likelihood: np.ndarray, period: int, threshold: float) -> np.ndarray:
    """Return the weights (T, M) of IMMAE: Bayes, reset when the window prefers another model."""
    count = log_likelihood.shape[1]
    w, window, out = np.ones(count) / count, np.ones(count) / count, []
    for k, row in enumerate(log_likelihood, start=1):
        likelihood = np.exp(row - row.max())
        w = w * likelihood / np.sum(w * likelihood)
        window = window * likelihood / np.sum(window * likelihood)
        if k % period == 0:
            if w.max() > threshold and w.argmax() != window.argmax():
                w = np.ones(count) / count
            window = np.ones(count) / count
        out.append(w)
    return np.array(out)


def markov_weights(log_likelihood: np.ndarray, switching: float) -> np.ndarray:
    """Return the weights (T, M) of a model index that switches with a probability per step."""
    count = log_likelihood.shape[1]
    transition = np.full((count, count), switching / (count - 1))
    np.fill_diagonal(transition, 1 - switching)
    w, out = np.ones(count) / count, []
    for row in log_likelihood:
        w = (w @ transition) * np.exp(row - row.max())
        w = w / w.sum()
        out.append(w)
    return np.array(out)


def floor_weights(log_likelihood: np.ndarray, bound: float) -> np.ndarray:
    """Return the weights (T, M) of Bayes' rule with a lower bound."""
    count = log_likelihood.shape[1]
    w, out = np.ones(count) / count, []
    for row in log_likelihood:
        w = w * np.exp(row - row.max())
        w = np.maximum(w / w.sum(), bound)
        w = w / w.sum()
        out.append(w)
    return np.array(out)
