"""What studies of attitude share: axes, the measures of a method, when a run is lost."""

from typing import Any

import numpy as np

from jaxnav.estimation.metrics import rmse
from jaxnav.units import ARCSEC

AXES = ("yaw", "pitch", "roll")
DIVERGED_SIGMAS = 5.0
"""A method diverged in a run whose final attitude error exceeds this many star-tracker sigmas."""


def attitude_measures(
    mean_square: np.ndarray, nees: np.ndarray, final_error: np.ndarray, star_noise: float
) -> dict[str, Any]:
    """Return the entry of one method in ``summary.json``.

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
