"""What studies of attitude share: axes, the measures of a method, when a run is lost."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from jaxnav.estimation.metrics import rmse, trmse
from jaxnav.estimation.montecarlo import Campaign
from jaxnav.units import ARCSEC

AXES = ("yaw", "pitch", "roll")
DIVERGED_SIGMAS = 5.0
"""A method diverged in a run whose final attitude error exceeds this many star-tracker sigmas."""


def attitude_measures(
    rows: Any, methods: Sequence[str], star_noise: float
) -> dict[str, dict[str, Any]]:
    """Return the entries of the methods in ``summary.json``.

    Args:
        rows: ``mean_square``, ``nees`` and ``final_error`` with axes of runs and methods.
        methods: Names along the axis of methods.
        star_noise: Standard deviation of the star tracker [rad].
    """
    return {
        name: _measures(rows.mean_square[:, i], rows.nees[:, i], rows.final_error[:, i], star_noise)
        for i, name in enumerate(methods)
    }


def _measures(
    mean_square: np.ndarray, nees: np.ndarray, final_error: np.ndarray, star_noise: float
) -> dict[str, Any]:
    """Return the entry of one method.

    Args:
        mean_square: ``(runs, 3) [rad^2]`` of the errors of yaw, pitch, roll.
        nees: ``(runs,)`` time averages of the attitude's NEES.
        final_error: ``(runs,) [rad]`` norm of the attitude error at the end.
        star_noise: Standard deviation of the star tracker [rad].
    """
    lost = ~np.all(np.isfinite(mean_square), axis=-1)
    lost |= ~(final_error <= DIVERGED_SIGMAS * star_noise)
    axes = {
        axis: {**rmse(mean_square[:, j] / ARCSEC**2)._asdict(), "unit": "arcsec"}
        for j, axis in enumerate(AXES)
    }
    mean = rmse(mean_square.mean(axis=-1) / ARCSEC**2)
    return {
        "rmse": axes,
        "rmse_all": {**mean._asdict(), "unit": "arcsec"},
        "anees": float(nees.mean()),
        "anees_dof": 3,
        "diverged": int(lost.sum()),
    }


def attitude_arrays(
    campaign: Campaign, period: float, methods: Sequence[str], banks: Sequence[str]
) -> tuple[dict[str, Any], dict[str, tuple[str, ...]]]:
    """Return the arrays of a study of attitude and the names of their axes.

    Args:
        campaign: Rows with ``mean_square`` and ``nees``, curves with ``square`` and ``weights``,
            traces with ``error``, ``sigma`` and ``weights``.
        period: Filter period [s].
        methods: Names along the axis of methods.
        banks: Names along the axis of banks.
    """
    curve, first = campaign.mean_curve, jax.tree.map(lambda leaf: leaf[0], campaign.traces)
    steps = curve["square"].shape[0]
    arrays = {
        "time": period * np.arange(1, steps + 1),
        "trmse": trmse(curve["square"]) / ARCSEC,
        "mean_weights": curve["weights"],
        "run_0_error": first["error"] / ARCSEC,
        "run_0_sigma": first["sigma"] / ARCSEC,
        "run_0_weights": first["weights"],
        "mean_square": campaign.rows.mean_square / ARCSEC**2,
        "nees": campaign.rows.nees,
        "estimator": np.array(methods),
        "axis": np.array(AXES),
        "bank": np.array(banks),
    }
    dims = {
        "time": ("time",),
        "trmse": ("time", "estimator", "axis"),
        "mean_weights": ("time", "bank", "model"),
        "run_0_error": ("time", "estimator", "axis"),
        "run_0_sigma": ("time", "estimator", "component"),
        "run_0_weights": ("time", "bank", "model"),
        "mean_square": ("run", "estimator", "axis"),
        "nees": ("run", "estimator"),
    }
    return arrays, dims
