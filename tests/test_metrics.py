"""Errors with their standard errors by simulation; consistency statistics by printed tables."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.compiling import compiled
from jaxnav.estimation.metrics import (
    chi2_mean_bounds,
    mean_interval,
    nees,
    rmse,
    rmse_ratio,
    trmse,
)

REPEATS = 400


def mean_squares(rng, runs, sigma, samples=8):
    """Return per-run mean squares ``(REPEATS, runs)`` of few correlated samples each."""
    common = rng.standard_normal((REPEATS, runs, 1))
    errors = sigma * (0.6 * common + 0.8 * rng.standard_normal((REPEATS, runs, samples)))
    return np.mean(errors**2, axis=2)


def test_standard_error_of_the_rmse_covers_the_truth():
    sigma = 0.3
    results = [rmse(row) for row in mean_squares(np.random.default_rng(1), 100, sigma)]
    inside = [abs(r.value - sigma) <= 1.96 * r.se for r in results]
    assert 0.9 <= np.mean(inside) <= 0.99
    spread = np.std([r.value for r in results], ddof=1)
    np.testing.assert_allclose(np.mean([r.se for r in results]), spread, rtol=5 / np.sqrt(800))


def test_interval_of_the_rmse_ratio_covers_the_truth_for_paired_runs():
    rng = np.random.default_rng(2)
    a = mean_squares(rng, 50, 0.3)
    b = 4 * a * rng.gamma(100, 0.01, a.shape)
    for confidence, least, most in ((0.95, 0.9, 0.99), (0.6, 0.52, 0.68)):
        results = [rmse_ratio(x, y, confidence) for x, y in zip(a, b, strict=True)]
        inside = [r.low <= 0.5 <= r.high for r in results]
        assert least <= np.mean(inside) <= most
        assert all(r.low < r.value < r.high for r in results)
    widths = np.array([r.high - r.low for r in results])
    unpaired = [rmse_ratio(x, np.roll(y, 1), 0.6) for x, y in zip(a, b, strict=True)]
    assert np.median(widths) < 0.5 * np.median([r.high - r.low for r in unpaired])


def test_interval_of_a_mean_of_few_values_covers_the_truth():
    values = 5 + 2 * np.random.default_rng(3).standard_normal((REPEATS, 4))
    results = [mean_interval(row) for row in values]
    assert 0.9 <= np.mean([r.low <= 5 <= r.high for r in results]) <= 0.99
    # Student's t with three degrees of freedom at 0.975.
    widths = [(r.high - r.value) / np.std(v, ddof=1) for r, v in zip(results, values, strict=True)]
    np.testing.assert_allclose(widths, 3.182446305284263 / 2, rtol=1e-12)
    np.testing.assert_allclose(
        [r.value - r.low for r in results], [r.high - r.value for r in results], rtol=1e-12
    )


def test_a_single_run_has_no_standard_error():
    one = np.array([4.0])
    assert rmse(one).value == 2
    assert rmse_ratio(one, np.array([16.0])).value == 0.5
    assert mean_interval(one).value == 4
    unknown = [rmse(one).se, *rmse_ratio(one, one)[1:], *mean_interval(one)[1:]]
    assert np.all(np.isnan(unknown))
    assert rmse(np.zeros(3)).value == 0
    assert np.isnan(rmse(np.zeros(3)).se)


def test_rmse_over_time_is_a_root():
    np.testing.assert_array_equal(trmse(np.array([[4.0, 9.0], [0.0, 1.0]])), [[2, 3], [0, 1]])


@pytest.mark.parametrize(
    ("runs", "degrees", "wide", "usual"),
    [
        (50, 4, (2.339, 6.271), (3.255, 4.821)),
        (100, 6, (4.456, 7.850), (5.340, 6.698)),
        (100, 9, (7.075, 11.230), (8.188, 9.850)),
        (100, 15, (12.472, 17.834), (13.946, 16.092)),
        (200, 15, (13.181, 16.972), (14.250, 15.769)),
        (1000, 15, (14.168, 15.863), (14.662, 15.341)),
    ],
)
def test_bounds_of_a_mean_chi_square_as_printed(runs, degrees, wide, usual):
    np.testing.assert_allclose(chi2_mean_bounds(degrees, runs), wide, rtol=0, atol=1e-3)
    np.testing.assert_allclose(chi2_mean_bounds(degrees, runs, 0.05), usual, rtol=0, atol=1e-3)


def test_nees_equals_numpy_whatever_the_units():
    rng = np.random.default_rng(4)

    @compiled
    def batched(cases):
        return [jax.vmap(nees)(error, cov) for error, cov in cases]

    cases, expected = [], []
    for n in (3, 15):
        A = rng.standard_normal((20, n, 2 * n))
        R = A @ A.transpose(0, 2, 1)
        e = rng.standard_normal((20, n))
        expected.append(np.einsum("ki,ki->k", e, np.linalg.solve(R, e[..., None])[..., 0]))
        units = 10.0 ** np.linspace(-8, 2, n)
        cov = units[:, None] * R * units[None, :]
        assert np.linalg.cond(cov).min() > 1e17
        cases += [(e, R), (e * units, cov)]
    results = batched(cases)
    for value, scaled, exact in zip(results[::2], results[1::2], expected, strict=True):
        np.testing.assert_allclose(value, exact, rtol=1e-11)
        np.testing.assert_allclose(scaled, exact, rtol=1e-11)


def test_nees_of_an_indefinite_covariance_is_nan():
    covariances = np.array(
        [np.diag([1.0, 1.0, 1.0]), np.diag([1.0, -1e-9, 1.0]), np.ones((3, 3)), np.zeros((3, 3))]
    )
    covariances[2, 0, 1] = covariances[2, 1, 0] = 2
    value = compiled(jax.vmap(nees, (None, 0)))(jnp.array([1.0, 2.0, 2.0]), covariances)
    np.testing.assert_array_equal(value, [9, np.nan, np.nan, np.nan])


def test_probabilities_in_percent_are_refused() -> None:
    for call in (
        lambda: mean_interval(np.ones(3), 95.0),
        lambda: rmse_ratio(np.ones(3), np.ones(3), 95.0),
    ):
        with pytest.raises(ValueError, match=r"^confidence is 95; it must be in \(0, 1\)$"):
            call()
    with pytest.raises(ValueError, match=r"^tail is 1; it must be in \(0, 1\)$"):
        chi2_mean_bounds(3, 10, tail=1.0)
