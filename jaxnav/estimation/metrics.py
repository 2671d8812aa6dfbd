"""Measures of a study: errors with their standard error, and statistics of consistency."""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.special import gammaincinv, stdtrit

from jaxnav.arguments import require_number
from jaxnav.numerics.linalg import cholesky, solve_lower

_PROBABILITY = ("(0, 1)", 0.0, 1.0)


class Measured(NamedTuple):
    """A value with its standard error over runs (NaN for a single run)."""

    value: float
    se: float


class Interval(NamedTuple):
    """A value with a two-sided confidence interval."""

    value: float
    low: float
    high: float


def rmse(mean_square: np.ndarray) -> Measured:
    """Return the root of the mean over runs of per-run mean squares ``(N,)``.

    The standard error follows from that of the mean square by the derivative of the root.
    """
    return root(float(np.mean(mean_square)), _se(mean_square))


def mean(values: np.ndarray) -> Measured:
    """Return the mean over runs of ``(N,)`` values."""
    return Measured(float(np.mean(values)), _se(values))


def root(mean_square: float, se: float) -> Measured:
    """Return the root of a mean square and its standard error, by the derivative of the root."""
    value = math.sqrt(mean_square)
    return Measured(value, se / (2 * value) if value > 0 else math.nan)


def rmse_ratio(
    numerator: np.ndarray, denominator: np.ndarray, confidence: float = 0.95
) -> Interval:
    """Return the ratio of two RMSE over the same runs, with the interval of the paired comparison.

    The runs share their random numbers, so the interval is that of the logarithm of the ratio from
    the paired deviations ``a_i / mean(a) - b_i / mean(b)``, with Student's t.

    Args:
        numerator: ``(N,)`` mean squares per run.
        denominator: ``(N,)`` mean squares of the same runs.
        confidence: Probability of the interval.
    """
    require_number("confidence", confidence, *_PROBABILITY)
    a, b = np.mean(numerator), np.mean(denominator)
    value = float(np.sqrt(a / b))
    if numerator.size < 2:
        return Interval(value, float("nan"), float("nan"))
    half = 0.5 * _se(numerator / a - denominator / b)
    width = float(stdtrit(numerator.size - 1, 0.5 + confidence / 2) * half)
    return Interval(value, value * float(np.exp(-width)), value * float(np.exp(width)))


def rmse_change(
    numerator: np.ndarray, denominator: np.ndarray, confidence: float = 0.95
) -> Interval:
    """Return the relative change between two RMSE over the same runs, :func:`rmse_ratio` less 1."""
    return Interval(*(bound - 1 for bound in rmse_ratio(numerator, denominator, confidence)))


def mean_interval(values: np.ndarray, confidence: float = 0.95) -> Interval:
    """Return the mean of ``(N,)`` values with the interval of Student's t."""
    require_number("confidence", confidence, *_PROBABILITY)
    value = float(np.mean(values))
    if values.size < 2:
        return Interval(value, float("nan"), float("nan"))
    width = float(stdtrit(values.size - 1, 0.5 + confidence / 2)) * _se(values)
    return Interval(value, value - width, value + width)


def _se(values: np.ndarray) -> float:
    if values.size < 2:
        return math.nan
    return float(np.std(values, ddof=1) / np.sqrt(values.size))


def trmse(mean_square: np.ndarray) -> np.ndarray:
    """Return the RMSE over runs at each time from the mean over runs of squares ``(T, ...)``."""
    return np.sqrt(mean_square)


def nees(error: Array, cov: Array) -> Array:
    """Return the normalised estimation error squared ``e' inv(P) e`` of ``(n,)`` and ``(n, n)``.

    Chi-square with ``n`` degrees of freedom for a consistent filter. The factor is taken of the
    correlation matrix, so that states of very different units do not spoil it; NaN if the
    covariance is not positive definite.
    """
    sigma = jnp.sqrt(jnp.diag(cov))
    root = cholesky(cov / (sigma[:, None] * sigma[None, :]))
    whitened = solve_lower(root.factor, error / sigma)
    return jnp.where(root.positive_definite, jnp.sum(whitened * whitened), jnp.nan)


def chi2_mean_bounds(degrees: int, runs: int, tail: float = 1e-6) -> tuple[float, float]:
    """Return two-sided bounds on the mean of ``runs`` independent chi-square variables.

    Args:
        degrees: Degrees of freedom of each: ``n`` for the NEES, ``m`` for the NIS.
        runs: How many are averaged.
        tail: Probability outside the bounds, both sides together.

    References:
        Bar-Shalom, Li, Kirubarajan (2001), section 5.4.
    """
    require_number("tail", tail, *_PROBABILITY)
    half = degrees * runs / 2
    low, high = 2 * gammaincinv(half, tail / 2), 2 * gammaincinv(half, 1 - tail / 2)
    return float(low) / runs, float(high) / runs
