"""Noise coefficients from Allan variances: generalised least squares that cannot go below zero.

Work is in units of the sampling interval: with ``tau = m T`` the Allan variance is linear in four
numbers that are not negative,

    sigma^2(m) = 3 q / m^2 + n / m + (2 ln 2 / pi) b + k m / 3
    q = Q^2 / T^2,  n = N^2 / T,  b = B^2,  k = K^2 T

and the covariance of the estimates at two sizes is a quadratic form in the same four, whose kernel
depends on the sizes and the length of the record alone.
"""

from itertools import combinations_with_replacement
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.navigation.sensors.allan import FLICKER, AllanVariance, chi_square_ends
from jaxnav.navigation.sensors.imu import NoiseModel
from jaxnav.numerics.linalg import cholesky, safe_sqrt, solve_lower, solve_lower_transposed

ITERATIONS = 10
"""Times the weights are formed anew from the fitted noise."""
RIDGE = 1e-4
"""Added share of each variance. Variances at dense sizes are nearly dependent, and the fit would
lean on differences of them that no real sensor honours."""
_SUBSETS = np.array([[s >> i & 1 for i in range(4)] for s in range(16)], bool)
_DENSE, _GROWTH, _REACH = 16, 0.05, 16


class NoiseFit(NamedTuple):
    """Fitted noise with its uncertainty.

    Attributes:
        noise: The coefficients, ``()`` each.
        squared: ``Q^2, N^2, B^2, K^2`` ``(4,)``, in the squares of the units of ``noise``.
        covariance: Of ``squared`` ``(4, 4)``, all four free; infinite where the record cannot tell
            them apart.
        freedom: Degrees of freedom ``(4,)`` of each squared coefficient, were it the only noise.
        background: What the other noises add to each squared coefficient ``(4,)``:
            ``squared + background`` scatters like a chi-square variable of ``freedom`` degrees.
        misfit: ``()`` Sum of the squared residuals of the Allan variances, whitened.
        misfit_freedom: ``()`` Its expectation if the four noises explain the record.
    """

    noise: NoiseModel
    squared: Array
    covariance: Array
    freedom: Array
    background: Array
    misfit: Array
    misfit_freedom: Array


class _Problem(NamedTuple):
    """Scaled data: design ``(M, 4)``, variances ``(M,)``, kernel ``(4, 4, M, M)``."""

    design: Array
    variance: Array
    kernel: Array
    usable: Array


class _Normal(NamedTuple):
    """Whitened least squares, its columns of unit length."""

    root: Array
    columns: Array
    data: Array
    lengths: Array


def model_variance(noise: NoiseModel, tau: Array) -> Array:
    """Return the Allan variance ``(M,) [u^2/s^2]`` of a noise at cluster times ``(M,) [s]``.

        sigma^2(tau) = 3 Q^2 / tau^2 + N^2 / tau + (2 ln 2 / pi) B^2 + K^2 tau / 3

    References:
        IEEE Std 952-1997 (R2008), Annex C, of two-sided densities.
    """
    Q, N, B, K = noise
    return 3 * (Q / tau) ** 2 + N**2 / tau + FLICKER * B**2 + K**2 * tau / 3


def covariance_kernel(sizes: tuple[int, ...], count: int) -> np.ndarray:
    """Return how the covariance of overlapping Allan variances follows from the noise.

        Cov(v_a, v_b) = sum_ij theta_i theta_j kernel[i, j, a, b],  theta = (q, n, b, k)

    The second differences ``d_a, d_b`` of the phase at two sizes are stationary and Gaussian, so
    ``Cov(d_a^2, d_b^2) = 2 c_ab^2``, and the sum runs over all pairs the record holds:

        kernel = 1 / (2 n_a n_b m_a^2 m_b^2) sum_u pairs(u) c_i(u) c_j(u)

    with ``c_i`` the covariance of ``d_a, d_b`` whose centres are u samples apart: the second
    differences at both sizes of the generalised covariance of the phase, which is a unit pulse,
    ``-|u| / 2``, ``u^2 ln|u| / (2 pi)`` and ``|u|^3 / 12``. This is exact at the ends of the
    record, where formulas for the degrees of freedom are approximate. The sum takes every lag near
    the kinks of ``c_i`` and, by trapezoids, geometrically fewer away from them; flicker noise,
    whose covariance falls as ``u^-2``, is cut at sixteen clusters (1e-4 of the sum).

    Args:
        sizes: Cluster sizes m in samples, increasing.
        count: Number of samples of the record.

    Returns:
        ``(4, 4, M, M)``, symmetric in the first and in the last two.

    References:
        Greenhall and Riley (2003), Proc. PTTI 35, the same sum for equal sizes.
    """
    kernel = np.zeros((4, 4, len(sizes), len(sizes)))
    for a, b in combinations_with_replacement(range(len(sizes)), 2):
        short, long = sizes[a], sizes[b]
        lags, weights = _lags(short, long, count)
        c = _curvature(lags + long, short) - 2 * _curvature(lags, short)
        c += _curvature(lags - long, short)
        pairs = (count + 1 - 2 * short) * (count + 1 - 2 * long)
        sums = (weights * c) @ c.T / (2 * pairs * (short * long) ** 2)
        kernel[:, :, a, b] = kernel[:, :, b, a] = sums
    return kernel


def _lags(short: int, long: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return lags from zero up and how many pairs of second differences each stands for."""
    largest = _REACH * long
    growing = np.geomspace(_DENSE, largest, 1 + int(np.log(largest / _DENSE) / _GROWTH + 1))
    offsets = np.concatenate([np.arange(_DENSE), np.rint(growing)])
    kinks = np.array([0, short, long - short, long, long + short])[:, None]
    lags = np.unique(np.abs(np.concatenate([kinks - offsets, kinks + offsets])))
    pairs = count + 1 - 2 * long - np.maximum(0, lags - (long - short))
    gaps = np.diff(lags, prepend=lags[0], append=lags[-1])
    # Twice the trapezoids: the lags below zero count the same.
    return lags, (gaps[1:] + gaps[:-1]) * np.maximum(pairs, 0)


def _curvature(lag: np.ndarray, m: int) -> np.ndarray:
    """Return ``R(u + m) - 2 R(u) + R(u - m)`` ``(4, ...)`` of the phase covariances."""
    u = np.abs(lag)
    near = u < m
    pulse = 1.0 * (u == m) - 2.0 * (u == 0)
    white = -np.where(near, m - u, 0)
    walk = np.where(near, m**3 / 6 + m * u**2 / 2 - u**3 / 6, u * m**2 / 2)
    # Away from the kink the direct difference loses its digits.
    far = u > 2 * m
    ratio = m / np.where(far, u, 2 * m)
    rest = (1 + ratio) ** 2 * np.log1p(ratio) + (1 - ratio) ** 2 * np.log1p(-ratio)
    direct = _square_log(u + m) - 2 * _square_log(u) + _square_log(u - m)
    flicker = np.where(far, u**2 * rest + 2 * m**2 * np.log(np.where(far, u, 1)), direct)
    return np.stack([pulse, white, flicker / (2 * np.pi), walk])


def _square_log(u: np.ndarray) -> np.ndarray:
    return u**2 * np.log(np.where(u == 0, 1, np.abs(u)))


def degrees_of_freedom(
    noise: NoiseModel, step: float, sizes: tuple[int, ...], count: int, share: Array | None = None
) -> Array:
    """Return the equivalent degrees of freedom of overlapping Allan variances, ``2 v^2 / Var(v)``.

    Args:
        noise: The noise, ``()`` each.
        step: Sampling interval [s].
        sizes: Cluster sizes in samples, increasing.
        count: Number of samples of the record.
        share: Share of the terms that gaps left, ``(M,)``; the degrees shrink with it.

    Returns:
        ``(M,)``, zero where the noise is zero.
    """
    theta = _unitless(jnp.stack([jnp.asarray(part) ** 2 for part in noise]), step)
    kernel = jnp.asarray(np.einsum("ijaa->ija", covariance_kernel(sizes, count)), theta.dtype)
    mean = jnp.asarray(_design(sizes), theta.dtype) @ theta
    variance = jnp.einsum("i,j,ija->a", theta, theta, kernel)
    degrees = 2 * mean**2 / jnp.where(variance > 0, variance, 1)
    return degrees if share is None else degrees * share


def fit_noise(
    measured: AllanVariance,
    step: float,
    sizes: tuple[int, ...],
    count: int,
    *,
    iterations: int = ITERATIONS,
) -> NoiseFit:
    """Return the four noise coefficients that explain overlapping Allan variances best.

    Generalised least squares with the full covariance of the variances, under the condition that no
    squared coefficient is negative. The covariance is that of the fitted noise, formed anew a
    fixed number of times: weights from the measured variances would favour those that came out
    small. Each fit is exact: the best of the sixteen sets of coefficients that are not zero.

    With gaps, the covariance grows as the share of terms at each size shrinks, which for lost
    samples that are scattered overstates it. The sensor must be at rest, and its samples must be
    means over their intervals; a filter's roll-off at the shortest clusters is not in the model.

    Args:
        measured: The variances at ``sizes``; those without a term are ignored.
        step: Sampling interval [s].
        sizes: Cluster sizes in samples, static, four or more, increasing.
        count: Number of samples of the record, lost ones included.
        iterations: How many times the weights are formed.

    Returns:
        The coefficients, zero where the data ask for no such noise, with their uncertainty.

    Raises:
        ValueError: If there are fewer than four sizes.

    References:
        IEEE Std 952-1997 (R2008), Annex C, which fits unweighted and without the condition;
        Lawson and Hanson (1974), Solving Least Squares Problems, Ch. 23.
    """
    if len(sizes) < 4:
        raise ValueError(f"at least 4 cluster sizes are needed, got {len(sizes)}")
    problem, scale = _problem(measured, sizes, count)

    def reweight(covariance: Array, _: None) -> tuple[Array, tuple[_Normal, Array]]:
        normal = _whiten(problem, covariance)
        theta = _nonnegative(normal)
        return _covariance(problem, theta), (normal, theta)

    history = jax.lax.scan(reweight, _start(problem), None, length=iterations)[1]
    normal, theta = jax.tree.map(lambda each: each[-1], history)
    covariance, freedom, background = _uncertainty(problem, normal, theta)
    unit = scale * _unitless(jnp.ones(4, theta.dtype), 1 / step)
    residual = normal.data - normal.columns @ (normal.lengths * theta)
    squared = theta * unit
    return NoiseFit(
        noise=NoiseModel(*safe_sqrt(squared)),
        squared=squared,
        covariance=covariance * unit[:, None] * unit[None],
        freedom=freedom,
        background=background * unit,
        misfit=jnp.sum(residual**2),
        misfit_freedom=(jnp.sum(problem.usable) - jnp.sum(theta > 0)).astype(theta.dtype),
    )


def coefficient_interval(fit: NoiseFit, confidence: float = 0.95) -> tuple[NoiseModel, NoiseModel]:
    """Return the intervals of confidence of the coefficients, on the host.

    A squared coefficient together with its background scatters like a chi-square variable. So a
    noise that stands alone gets the skew interval of a variance, and one that drowns in the
    others, or is zero, an interval that starts at zero.

    Args:
        fit: The fit, of one axis or with leading axes.
        confidence: Probability of each interval.

    Returns:
        Lower and upper ends; from zero to infinity where the record cannot tell the noises apart.
    """
    low, high = chi_square_ends(np.asarray(fit.freedom, float), confidence)
    background = np.asarray(fit.background, float)
    total = np.asarray(fit.squared, float) + background
    lower = np.sqrt(np.maximum(total * low - background, 0))
    known = np.isfinite(high)
    above = np.where(known, total * np.where(known, high, 1) - background, np.inf)
    upper = np.sqrt(np.maximum(above, 0))
    return NoiseModel(*np.moveaxis(lower, -1, 0)), NoiseModel(*np.moveaxis(upper, -1, 0))


def _design(sizes: tuple[int, ...]) -> np.ndarray:
    m = np.asarray(sizes, float)
    return np.stack([3 / m**2, 1 / m, np.full_like(m, FLICKER), m / 3], axis=1)


def _unitless(squared: Array, step: float) -> Array:
    """Return ``q, n, b, k`` of ``Q^2, N^2, B^2, K^2``; with ``1 / step``, the way back."""
    return squared * jnp.asarray([step**-2, 1 / step, 1, step], squared.dtype)


def _problem(measured: AllanVariance, sizes: tuple[int, ...], count: int) -> tuple[_Problem, Array]:
    """Return the data of order one and their scale; sizes without a term become empty rows."""
    dtype = measured.variance.dtype
    usable = measured.terms > 0
    v = jnp.where(usable, measured.variance, 0)
    # The fit is homogeneous in the scale, which therefore has no derivative of its own.
    largest = jax.lax.stop_gradient(jnp.max(v))
    scale = jnp.where(largest > 0, largest, 1)
    both = usable[:, None] & usable[None]
    inflate = jnp.where(usable, 1 / jnp.sqrt(jnp.where(usable, measured.share, 1)), 0)
    kernel = jnp.asarray(covariance_kernel(sizes, count), dtype)
    kernel = kernel * (jnp.where(both, inflate[:, None] * inflate[None], 0))[None, None]
    design = jnp.where(usable[:, None], jnp.asarray(_design(sizes), dtype), 0)
    return _Problem(design, v / scale, kernel, usable), scale


def _start(problem: _Problem) -> Array:
    """Return a first covariance ``(M, M)``, as if each variance were that of white noise alone."""
    white = problem.design[:, 1]
    ratio = problem.variance / jnp.where(problem.usable, white, 1)
    return problem.kernel[1, 1] * ratio[:, None] * ratio[None]


def _covariance(problem: _Problem, theta: Array) -> Array:
    return jnp.einsum("i,j,ijab->ab", theta, theta, problem.kernel)


def _whiten(problem: _Problem, covariance: Array) -> _Normal:
    ridge = jnp.where(problem.usable, RIDGE * jnp.diag(covariance), 1)
    root = cholesky(covariance + jnp.diag(ridge)).factor
    both = jnp.concatenate([problem.design, problem.variance[:, None]], axis=1)
    both = solve_lower(root, both)
    lengths = safe_sqrt(jnp.sum(both[:, :4] ** 2, axis=0))
    lengths = jnp.where(lengths > 0, lengths, 1)
    return _Normal(root, both[:, :4] / lengths[None], both[:, 4], lengths)


def _nonnegative(normal: _Normal) -> Array:
    """Return the least squares solution ``(4,)`` with no negative entry, the best of all sets."""
    gram, right = normal.columns.T @ normal.columns, normal.data @ normal.columns

    def solve(free: Array) -> tuple[Array, Array]:
        both = free[:, None] & free[None]
        part = cholesky(jnp.where(both, gram, jnp.eye(4, dtype=gram.dtype)))
        half = solve_lower(part.factor, jnp.where(free, right, 0))
        found = solve_lower_transposed(part.factor, half)
        feasible = jnp.all(found >= 0) & part.positive_definite
        return found, jnp.where(feasible, -jnp.sum(half**2), jnp.inf)

    found, cost = jax.vmap(solve)(jnp.asarray(_SUBSETS))
    return found[jnp.argmin(cost)] / normal.lengths


def _uncertainty(problem: _Problem, normal: _Normal, theta: Array) -> tuple[Array, Array, Array]:
    """Return the covariance, and degrees of freedom and background of each coefficient.

    Row i of the estimator, applied to the covariance with and without noise i, gives the variance
    ``c theta_i^2`` of its own and ``a`` of the others; a chi-square variable with ``2 / c`` degrees
    about ``theta_i + sqrt(a / c)`` has both.
    """
    gram = cholesky(normal.columns.T @ normal.columns)
    whitened = solve_lower(gram.factor, normal.columns.T)
    estimator = solve_lower_transposed(gram.factor, whitened) / normal.lengths[:, None]
    estimator = solve_lower_transposed(normal.root, estimator.T).T
    others = jnp.where(jnp.eye(4, dtype=bool), 0, theta[None])
    own = jnp.einsum("ia,ib,iiab->i", estimator, estimator, problem.kernel)
    rest = jnp.einsum("ia,ib,ij,ik,jkab->i", estimator, estimator, others, others, problem.kernel)
    told_apart = gram.positive_definite & (own > 0)
    safe = jnp.where(told_apart, own, 1)
    inverse = solve_lower_transposed(
        gram.factor, solve_lower(gram.factor, jnp.eye(4, dtype=theta.dtype))
    )
    covariance = inverse / (normal.lengths[:, None] * normal.lengths[None])
    return (
        jnp.where(gram.positive_definite, covariance, jnp.inf),
        jnp.where(told_apart, 2 / safe, 0),
        jnp.where(told_apart, safe_sqrt(jnp.where(told_apart, rest, 0) / safe), 0),
    )
