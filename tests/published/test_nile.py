"""The flow of the Nile at Aswan, 1871 to 1970, as a random walk observed with noise.

The flows (Cobb 1978, Biometrika 65(2)) are in the public domain. What others published of the
variances 15099 and 1469.1:

* Durbin and Koopman (2012), Time Series Analysis by State Space Methods, page 40: moments and tests
  of the standardised innovations, as quoted by the tests of statsmodels 0.15.0
  (``test_diagnostics_nile_durbinkoopman``).
* Fulton (2017), Estimating time series models by state space methods in Python: Statsmodels,
  sections 3 and 4 (github.com/ChadFulton/fulton_statsmodels_2017): log-likelihoods, and the first
  and the last filtered level with its variance, from a prior of variance 1e6.
* KFAS (Helske): the least diffuse negative log-likelihood that its ``fitSSM`` finds, 632.5456, in
  the output of an example (rstudio-pubs 182968).

With the flows 21 to 40 and 61 to 80 missing the book has figures only. Those means and variances
were computed with statsmodels 0.15.0, by ``MLEModel`` with an approximately diffuse prior of
variance 1e6.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.estimation.filters.kalman import kf
from jaxnav.estimation.run import run
from jaxnav.estimation.types import FilterParams, Gaussian, Model, observed
from tests.published.vectors import assert_as_printed, numbers

NILE = numbers("statsmodels_nile.json")
VARIANCES = (15099.0, 1469.1)
WALK = Model(
    transition=lambda p, x, u: x,
    process_noise=lambda p, x, u: p[1:, None],
    observe=lambda p, x, u: x,
    observation_noise=lambda p, x, u: p[:1],
)
FILTER = kf(WALK)


def filtered(
    flow: np.ndarray, mean: float, variance: float, variances: tuple[float, float] = VARIANCES
) -> Any:
    """The record of a run whose first prediction has the given mean and variance."""
    start = Gaussian(jnp.array([mean]), jnp.array([[variance - variances[1]]]))
    params = FilterParams(jnp.array(variances), start)
    inputs = jnp.zeros((len(flow), 0))
    return run(FILTER, params, inputs, observed(jnp.asarray(flow)[:, None])).record


@pytest.mark.parametrize(
    ("variances", "printed"),
    [
        (VARIANCES, "-632.537695048"),
        ((10000.0, 1.0), "-687.5456216"),
        ((15108.31, 1463.55), "-632.537685587"),
    ],
)
def test_log_likelihood_by_fulton(variances: tuple[float, float], printed: str) -> None:
    _, info = filtered(NILE["flow"], 0.0, 1e6, variances)
    assert_as_printed(np.sum(info.log_likelihood[1:], keepdims=True), [printed])


def test_levels_by_fulton() -> None:
    estimate, _ = filtered(NILE["flow"], 0.0, 1e6)
    ends = np.array([0, -1])
    assert_as_printed(estimate.mean[ends, 0], ["1103.34065938", "798.37029261"])
    assert_as_printed(estimate.cov[ends, 0, 0], ["14874.41126432", "4032.15794181"])


def test_innovations_by_durbin_and_koopman() -> None:
    """Skewness, excess kurtosis, normality, heteroscedasticity, autocorrelation up to lag nine."""
    flow = NILE["flow"]
    # Of a diffuse level the first flow leaves its own mean and variance.
    _, info = filtered(flow[1:], flow[0], VARIANCES[0] + VARIANCES[1])
    e = np.asarray(info.innovation[:, 0] / np.sqrt(info.innovation_cov[:, 0, 0]))
    n, c = len(e), e - e.mean()
    spread = np.mean(c**2)
    skewness, kurtosis = np.mean(c**3) / spread**1.5, np.mean(c**4) / spread**2 - 3
    normality = n * (skewness**2 / 6 + kurtosis**2 / 24)
    third = n // 3
    heteroscedasticity = np.sum(e[-third:] ** 2) / np.sum(e[:third] ** 2)
    lags = np.arange(1, 10)
    correlation = np.array([c[lag:] @ c[:-lag] for lag in lags]) / (c @ c)
    autocorrelation = n * (n + 2) * np.sum(correlation**2 / (n - lags))
    found = [skewness, kurtosis, normality, heteroscedasticity, autocorrelation]
    assert_as_printed(np.array(found), ["-0.03", "0.09", "0.05", "0.61", "8.84"])
    # By KFAS, at variances so near the best that the likelihood is the same to these digits.
    assert_as_printed(np.sum(info.log_likelihood, keepdims=True), ["-632.5456"])


def test_gaps_by_statsmodels() -> None:
    flow = NILE["flow"].copy()
    for first, last in NILE["gaps"].astype(int):
        flow[first - 1 : last] = np.nan
    estimate, info = filtered(flow, 0.0, 1e6)
    np.testing.assert_allclose(estimate.mean[:, 0], NILE["filtered_means"], rtol=1e-11)
    np.testing.assert_allclose(estimate.cov[:, 0, 0], NILE["filtered_variances"], rtol=1e-11)
    likelihood = np.sum(info.log_likelihood[1:])
    np.testing.assert_allclose(likelihood, NILE["log_likelihood"], rtol=0, atol=1e-9)
