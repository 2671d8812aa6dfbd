"""Sigma-point rules: where the points lie and what they weigh, nothing else."""

from typing import NamedTuple

import numpy as np
from jax import Array
from jax.core import Tracer


class SigmaRule(NamedTuple):
    """A symmetric rule of ``2 n`` points ``x +- spread L_j`` and a centre, with ``P = L L'``.

    The mean weights of the points and of the centre sum to one, so that of the centre follows. The
    entries are numbers, or scalar arrays where the rule is to differ between the members of a bank
    or to be tuned.

    Attributes:
        spread: Distance of the points in columns of the root.
        weight: Weight of each of the ``2 n`` points, for means and for covariances.
        centre: Weight of the centre for covariances; it may be negative.
    """

    spread: Array | float
    weight: Array | float
    centre: Array | float


def unscented(
    n: int,
    alpha: Array | float = 1.0,
    beta: Array | float = 2.0,
    kappa: Array | float = 0.0,
) -> SigmaRule:
    """Return the scaled unscented rule for ``n`` states.

        lambda = alpha^2 (n + kappa) - n,   spread = sqrt(n + lambda),
        weight = 1 / (2 (n + lambda)),      centre = lambda / (n + lambda) + 1 - alpha^2 + beta

    Args:
        n: Number of states.
        alpha: Spread of the points; a number, ``()``, or ``(M,)`` for the members of a bank.
        beta: Likewise; 2 is best for a Gaussian prior.
        kappa: Likewise; secondary spread.

    Raises:
        ValueError: If ``n + lambda`` is a number and not positive: there is then no real spread and
            the weights have no meaning.

    References:
        Wan and van der Merwe (2000), The unscented Kalman filter for nonlinear estimation; Zhao et
        al. (2018), Eqs. (13)-(22), where ``w_i`` is printed ``1 (2 (n + lambda))``.
    """
    total = alpha**2 * (n + kappa)
    if not isinstance(total, Tracer) and not np.all(np.asarray(total) > 0):
        raise ValueError(
            f"alpha = {alpha}, kappa = {kappa} give n + lambda = alpha^2 (n + kappa) = {total} for "
            f"n = {n} states; it must be positive: alpha not zero and kappa above {-n}"
        )
    return SigmaRule(total**0.5, 1 / (2 * total), (total - n) / total + 1 - alpha**2 + beta)


def cubature(n: int) -> SigmaRule:
    """Return the third-degree spherical-radial rule for ``n`` states: no centre, equal weights.

    References:
        Arasaratnam and Haykin (2009), IEEE Trans. Automatic Control 54(6).
    """
    return SigmaRule(n**0.5, 1 / (2 * n), 0.0)
