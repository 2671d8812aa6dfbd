"""Bounds of consistency, held to printed tables of the chi-square distribution.

* NIST/SEMATECH e-Handbook of Statistical Methods, section 1.3.6.7.4, critical values to three
  decimals.
* Bar-Shalom, Li and Kirubarajan (2001), Estimation with Applications to Tracking and Navigation,
  section 5.4.2: fifty runs with two states, so that the mean of the NEES is bounded by 74.22 / 50
  and 129.56 / 50, printed 1.5 and 2.6.
"""

import numpy as np
import pytest

from jaxnav.estimation.metrics import chi2_mean_bounds
from jaxnav.navigation.sensors.allan import chi_square_ends
from tests.published.vectors import assert_as_printed

# Degrees of freedom, probability outside both bounds, lower and upper critical value.
TABLE = [
    (2, 0.05, "0.051", "7.378"),
    (4, 0.05, "0.484", "11.143"),
    (9, 0.05, "2.700", "19.023"),
    (15, 0.02, "5.229", "30.578"),
    (15, 0.05, "6.262", "27.488"),
    (50, 0.002, "24.674", "86.661"),
    (50, 0.02, "29.707", "76.154"),
    (50, 0.05, "32.357", "71.420"),
    (50, 0.1, "34.764", "67.505"),
    (100, 0.002, "61.918", "149.449"),
    (100, 0.02, "70.065", "135.807"),
    (100, 0.05, "74.222", "129.561"),
    (100, 0.1, "77.929", "124.342"),
]


@pytest.mark.parametrize(("freedom", "tail", "low", "high"), TABLE)
def test_bounds_by_nist(freedom: int, tail: float, low: str, high: str) -> None:
    """However the degrees are made up of those of a run and of the number of runs."""
    for runs in (1, 2, 5, 10, 50):
        if freedom % runs == 0:
            bounds = np.array(chi2_mean_bounds(freedom // runs, runs, tail))
            assert_as_printed(runs * bounds, [low, high])
    factors = np.array(chi_square_ends(np.array(float(freedom)), 1 - tail))
    assert_as_printed(freedom / factors[::-1], [low, high])


def test_bounds_by_bar_shalom() -> None:
    bounds = np.array(chi2_mean_bounds(2, 50, 0.05))
    assert_as_printed(50 * bounds, ["74.22", "129.56"])
    assert_as_printed(bounds, ["1.5", "2.6"])
