"""Allan variance of an inertial sensor at rest, with gaps, and the random walk read off its slope.

A rate is an angular rate [rad/s] or a specific force [m/s^2], each sample the mean over its
interval; its integral, the phase, is an angle or a velocity. ``u`` stands for rad or m/s.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.special import gammaincinv

from jaxnav.numerics.linalg import safe_sqrt

FLICKER = 2 * math.log(2) / math.pi
"""Allan variance of flicker noise of density ``1 / (2 pi f)``, at any cluster time."""
CHI2_MEDIAN = 0.454936423119572
"""Median of a chi-square variable of one degree of freedom."""
MEDIAN_TERMS = 100_000
"""Second differences of a size that a median is taken of, more or less."""


class AllanVariance(NamedTuple):
    """Allan variance at M cluster times.

    Attributes:
        tau: Cluster times ``(M,) [s]``.
        variance: ``(M,) [u^2/s^2]``, zero where there is no term.
        terms: Number of second differences averaged, ``(M,)``.
        share: Share of the second differences of a record without gaps that were averaged,
            ``(M,)``.
    """

    tau: Array
    variance: Array
    terms: Array
    share: Array

    @property
    def deviation(self) -> Array:
        """Allan deviation ``(M,) [u/s]``, whose derivative at zero is zero."""
        return safe_sqrt(self.variance)


def cluster_sizes(count: int, per_octave: int = 1, longest: float = 1 / 9) -> tuple[int, ...]:
    """Return cluster sizes in samples, evenly spaced in the logarithm from one sample on.

    Args:
        count: Number of samples of the record.
        per_octave: Sizes in an octave; the small ones, which round to the same, are fewer.
        longest: Longest cluster as a share of the record. With nine clusters the deviation of
            white noise is known to a quarter of its value; beyond, a few values decide.

    Returns:
        The sizes, strictly increasing.

    Raises:
        ValueError: If ``per_octave`` is below 1, ``longest`` is not in (0, 1/2], or the record has
            no cluster.
    """
    if per_octave < 1:
        raise ValueError(f"per_octave must be at least 1, got {per_octave}")
    if not 0 < longest <= 0.5:
        raise ValueError(f"longest must be in (0, 1/2], got {longest}")
    largest = math.floor(count * longest)
    if largest < 1:
        raise ValueError(f"count must be at least {math.ceil(1 / longest)}, got {count}")
    octaves = np.arange(math.floor(per_octave * math.log2(largest) + 1e-9) + 1) / per_octave
    return tuple(int(size) for size in np.unique(np.rint(2**octaves)) if size <= largest)


def allan_variance(
    rate: Array,
    step: float,
    sizes: tuple[int, ...],
    valid: Array | None = None,
    *,
    overlapping: bool = True,
) -> AllanVariance:
    """Return the Allan variance of a record, half the mean square change between clusters.

        sigma^2(m T) = < (theta_{k+2m} - 2 theta_{k+m} + theta_k)^2 > / (2 (m T)^2)

    with the phase ``theta``, at every k or, without overlap, at multiples of m. A second
    difference that spans a lost sample is left out; the value of a lost sample is never used.

    Args:
        rate: Samples ``(N,) [u/s]``.
        step: Sampling interval ``T`` [s].
        sizes: Cluster sizes m in samples, static, at most ``N / 2``.
        valid: Which samples are known ``(N,)``; by default all.
        overlapping: Whether all clusters are used, not only those side by side.

    Returns:
        The variance at each size.

    Raises:
        ValueError: If a size is not from 1 to ``N / 2``.

    References:
        Allan (1966), Proc. IEEE 54(2); Riley (2008), NIST SP 1065, Sec. 5.2.
    """
    sums, terms, whole = [], [], []
    strides = [1 if overlapping else m for m in sizes]
    for change, use in _changes(rate, sizes, valid, strides):
        whole.append(change.shape[0])
        if use is None:
            sums.append(jnp.sum(change**2))
            terms.append(jnp.asarray(change.shape[0]))
        else:
            sums.append(jnp.sum(jnp.where(use, change**2, 0)))
            terms.append(jnp.sum(use))
    used = jnp.stack(terms).astype(rate.dtype)
    return AllanVariance(
        tau=step * jnp.asarray(sizes, rate.dtype),
        variance=jnp.stack(sums) / (2 * jnp.maximum(used, 1)),
        terms=used,
        share=used / jnp.asarray(whole, rate.dtype),
    )


def median_variance(
    rate: Array, step: float, sizes: tuple[int, ...], valid: Array | None = None
) -> AllanVariance:
    """Return the Allan variance by the median of the squared changes, which a few do not move.

    As :func:`allan_variance`, of every k up to a hundred thousand of them, with the mean replaced
    by the median over that of a chi-square variable of one degree. For noises that are normal both
    estimate the same; this one scatters by two thirds more.

    Args:
        rate: Samples ``(N,) [u/s]``.
        step: Sampling interval ``T`` [s].
        sizes: Cluster sizes m in samples, static, at most ``N / 2``.
        valid: Which samples are known ``(N,)``; by default all.

    Returns:
        The variance at each size.

    Raises:
        ValueError: If a size is not from 1 to ``N / 2``.
    """
    variances, terms, whole = [], [], []
    for change, use in _changes(rate, sizes, valid, strides=[_thin(len(rate), m) for m in sizes]):
        square = change**2 if use is None else jnp.where(use, change**2, jnp.nan)
        middle = jnp.nanmedian(square)
        variances.append(jnp.where(jnp.isnan(middle), 0, middle) / (2 * CHI2_MEDIAN))
        whole.append(change.shape[0])
        terms.append(jnp.asarray(change.shape[0]) if use is None else jnp.sum(use))
    used = jnp.stack(terms).astype(rate.dtype)
    tau = step * jnp.asarray(sizes, rate.dtype)
    return AllanVariance(tau, jnp.stack(variances), used, used / jnp.asarray(whole, rate.dtype))


def _thin(count: int, size: int) -> int:
    return max(1, (count + 1 - 2 * size) // MEDIAN_TERMS)


def _changes(
    rate: Array, sizes: tuple[int, ...], valid: Array | None, strides: list[int]
) -> Iterator[tuple[Array, Array | None]]:
    """Yield, for each size, the second differences of the phase over m, and which are whole."""
    count = rate.shape[0]
    for size in sizes:
        if not 1 <= size <= count // 2:
            raise ValueError(f"sizes must be from 1 to {count // 2}, got {size}")
    phase = _phase(rate, valid)
    lost = None if valid is None else jnp.pad(jnp.cumsum(~valid), (1, 0))
    for m, stride in zip(sizes, strides, strict=True):
        begin, middle, end = (slice(j * m, count + 1 - (2 - j) * m, stride) for j in range(3))
        change = (phase[end] - phase[middle] - (phase[middle] - phase[begin])) / m
        yield change, None if lost is None else lost[end] == lost[begin]


def _phase(rate: Array, valid: Array | None) -> Array:
    """Return the sums ``(N + 1,)`` of the deviations from the mean, in units of the step.

    A constant does not change a second difference but costs the sums their digits. One sample is
    taken off before the mean is formed, so that a constant record leaves exact zeros.
    """
    if valid is None:
        moved = rate - rate[0]
        return jnp.pad(jnp.cumsum(moved - jnp.mean(moved)), (1, 0))
    safe = jnp.where(valid, rate, 0)
    moved = jnp.where(valid, safe - safe[jnp.argmax(valid)], 0)
    mean = jnp.sum(moved) / jnp.maximum(jnp.sum(valid), 1).astype(rate.dtype)
    return jnp.pad(jnp.cumsum(jnp.where(valid, moved - mean, 0)), (1, 0))


def slope_rule(measured: AllanVariance, sharpness: float | None = None) -> Array:
    """Return the random walk coefficient from where the deviation falls with slope -1/2.

    At each cluster time but the first and the last the slope of ``log sigma`` against ``log tau``
    is that between its neighbours, and ``N = sigma sqrt(tau)``. The rule takes the N whose slope
    is closest to -1/2, or the mean of all with the weights ``exp(-sharpness (slope + 1/2)^2)``.

    Args:
        measured: Allan variance at three or more cluster times.
        sharpness: ``None`` for the closest slope alone; a positive number for the weighted mean,
            which has a derivative.

    Returns:
        ``N`` ``() [u/sqrt(s)]``, zero if no three neighbours are positive.

    Raises:
        ValueError: If there are fewer than three cluster times.

    References:
        Yang et al. (2025), PeerJ Computer Science 11:e3040, Eqs. (18)-(22). The text speaks of
        the variance with slope -1/2; that is the slope of the deviation. It chooses a segment by
        eye and reads N at one second; the choice here is by rule, and N is read where the slope is
        right, on the same line. The weighted mean is an addition.
    """
    if len(measured.tau) < 3:
        raise ValueError(f"at least 3 cluster times are needed, got {len(measured.tau)}")
    positive = measured.variance > 0
    log_sigma = 0.5 * jnp.log(jnp.where(positive, measured.variance, 1))
    log_tau = jnp.log(measured.tau)
    slope = (log_sigma[2:] - log_sigma[:-2]) / (log_tau[2:] - log_tau[:-2])
    usable = positive[2:] & positive[1:-1] & positive[:-2]
    miss = jnp.where(usable, (slope + 0.5) ** 2, 0)
    N = jnp.where(usable, jnp.exp(log_sigma + 0.5 * log_tau)[1:-1], 0)
    if sharpness is None:
        return N[jnp.argmin(jnp.where(usable, miss, jnp.inf))]
    return jnp.sum(N * jax.nn.softmax(-sharpness * miss, where=usable))


def deviation_interval(
    measured: AllanVariance, freedom: Array, confidence: float = 0.95
) -> tuple[np.ndarray, np.ndarray]:
    """Return the interval of confidence of the Allan deviation, on the host.

    ``freedom * variance / true variance`` is taken as chi-square with ``freedom`` degrees.

    Args:
        measured: The Allan variance.
        freedom: Equivalent degrees of freedom ``(M,)``, of
            :func:`~jaxnav.navigation.sensors.noise_fit.degrees_of_freedom`.
        confidence: Probability of the interval.

    Returns:
        Lower and upper ends, ``(M,) [u/s]`` each; from zero to infinity where nothing is known.

    References:
        Riley (2008), NIST SP 1065, Sec. 5.3.
    """
    low, high = chi_square_ends(np.asarray(freedom, float), confidence)
    sigma = np.asarray(measured.deviation)
    known = (np.asarray(measured.terms) > 0) & np.isfinite(high)
    above = np.where(known, sigma * np.sqrt(np.where(known, high, 1)), np.inf)
    return np.where(known, sigma * np.sqrt(low), 0), above


def chi_square_ends(freedom: np.ndarray, confidence: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the factors on an estimated variance that bound the true one, on the host.

    Args:
        freedom: Degrees of freedom, any shape; from zero to infinity where not positive.
        confidence: Probability between the two.

    Raises:
        ValueError: If the confidence is not between 0 and 1.
    """
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must be between 0 and 1, got {confidence}")
    some = freedom > 0
    half = np.where(some, freedom, 1) / 2
    tail = (1 - confidence) / 2
    low = np.where(some, half / gammaincinv(half, 1 - tail), 0)
    # A quantile below the smallest float is zero: there is no upper end.
    quantile = np.where(some, gammaincinv(half, tail), 0)
    high = np.where(quantile > 0, half / np.where(quantile > 0, quantile, 1), np.inf)
    return low, high
