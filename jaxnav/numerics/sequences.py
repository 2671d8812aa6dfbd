"""Points of low discrepancy that spread a few parameters evenly over a box."""

import numpy as np


def van_der_corput(count: int, base: int = 2, start: int = 1) -> np.ndarray:
    """Return the radical inverses ``(count,)`` in [0, 1) of ``start, start + 1, ...``.

    The digits of the index are mirrored at the radix point: ``sum_k d_k base^k`` becomes
    ``sum_k d_k base^(-k-1)``. Numerator and denominator are integers, so that each value is the
    rational number correctly rounded; the sums of ``scipy.stats.qmc.Halton`` err by one unit in
    the last place in any base but 2.

    Args:
        count: Number of points.
        base: Base of the digits; any integer from 2.
        start: First index; 0 would give the point 0.

    Returns:
        The points, all inside (0, 1) for a ``start`` from 1.

    Raises:
        ValueError: If ``count`` is below 1, ``base`` below 2 or ``start`` below 0.
    """
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}")
    if base < 2:
        raise ValueError(f"base must be at least 2, got {base}")
    if start < 0:
        raise ValueError(f"start must be at least 0, got {start}")
    index = np.arange(start, start + count, dtype=np.int64)
    numerator, denominator = np.zeros_like(index), 1
    while index.any():
        index, digit = np.divmod(index, base)
        numerator, denominator = numerator * base + digit, denominator * base
    return numerator / denominator


def hammersley(count: int, dims: int, regular: int = 0) -> np.ndarray:
    """Return the Hammersley points ``(count, dims)``, all inside (0, 1).

    Point ``j = 1 .. count`` has ``(j - 1/2) / count`` on one coordinate and on the others, in their
    order, the radical inverses of ``j`` in the bases 2, 3, 5, ...

    Args:
        count: Number of points.
        dims: Number of coordinates.
        regular: Which coordinate is the regular grid.

    Returns:
        The points.

    Raises:
        ValueError: If ``count`` or ``dims`` is below 1, or ``regular`` is not a coordinate.

    References:
        Hammersley (1960), Ann. N.Y. Acad. Sci. 86; Zhao, Chen, He, Ge (2018), IEEE/CAA JAS 5(6),
        Sec. V. The original has ``j / count``, which puts the last point on the border.
    """
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}")
    if dims < 1:
        raise ValueError(f"dims must be at least 1, got {dims}")
    if not 0 <= regular < dims:
        raise ValueError(f"regular must be from 0 to {dims - 1}, got {regular}")
    columns = [van_der_corput(count, base) for base in _first_primes(dims - 1)]
    columns.insert(regular, (np.arange(count) + 0.5) / count)
    return np.stack(columns, axis=1)


def _first_primes(count: int) -> list[int]:
    """Return the first primes."""
    primes: list[int] = []
    candidate = 2
    while len(primes) < count:
        if all(candidate % prime for prime in primes):
            primes.append(candidate)
        candidate += 1
    return primes


def log_grid(points: np.ndarray, low: float | np.ndarray, high: float | np.ndarray) -> np.ndarray:
    """Return ``low^(1-u) high^u`` of points ``u`` in (0, 1): even in the logarithm.

    Args:
        points: Points ``(..., dims)``.
        low: Value at ``u = 0``, positive, ``()`` or ``(dims,)``.
        high: Value at ``u = 1``, positive, ``()`` or ``(dims,)``.

    Returns:
        The values, shaped like ``points``.

    Raises:
        ValueError: If a bound is not positive.
    """
    if np.any(np.asarray(low) <= 0) or np.any(np.asarray(high) <= 0):
        raise ValueError(f"low and high must be positive, got {low} and {high}")
    return np.power(low, 1 - points) * np.power(high, points)


def star_discrepancy(points: np.ndarray) -> float:
    """Return the L2-star discrepancy of points ``(count, dims)`` in the unit cube.

    The root mean square, over all boxes with a corner at the origin, of the share of the points in
    the box less its volume.

    References:
        Warnock (1972), Computational investigations of low-discrepancy point sets.
    """
    # scipy.stats takes a second to import, which nobody but the caller should pay.
    from scipy.stats import qmc

    return float(qmc.discrepancy(points, method="L2-star"))
