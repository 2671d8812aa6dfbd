"""Low-discrepancy points: exact radical inverses, the Hammersley set, its discrepancy."""

import numpy as np
import pytest
from scipy.stats import qmc

from jaxnav.numerics.sequences import hammersley, log_grid, star_discrepancy, van_der_corput


def test_first_radical_inverses_are_exact():
    binary = [1 / 2, 1 / 4, 3 / 4, 1 / 8, 5 / 8, 3 / 8, 7 / 8, 1 / 16, 9 / 16, 5 / 16]
    ternary = [1 / 3, 2 / 3, 1 / 9, 4 / 9, 7 / 9, 2 / 9, 5 / 9, 8 / 9, 1 / 27, 10 / 27]
    np.testing.assert_array_equal(van_der_corput(10), binary)
    np.testing.assert_array_equal(van_der_corput(10, base=3), ternary)
    np.testing.assert_array_equal(van_der_corput(4, base=10, start=8), [0.8, 0.9, 0.01, 0.11])
    np.testing.assert_array_equal(van_der_corput(3, start=0), [0, 1 / 2, 1 / 4])
    np.testing.assert_array_equal(van_der_corput(5, start=6), binary[5:])


def test_the_ten_points_of_the_study():
    inverse = [1 / 2, 1 / 4, 3 / 4, 1 / 8, 5 / 8, 3 / 8, 7 / 8, 1 / 16, 9 / 16, 5 / 16]
    regular = [0.05, 0.15, 0.25, 0.35, 0.45, 0.55, 0.65, 0.75, 0.85, 0.95]
    points = hammersley(10, 2)
    np.testing.assert_array_equal(points, np.stack([regular, inverse], axis=1))
    np.testing.assert_array_equal(hammersley(10, 2, regular=1), points[:, ::-1])


def test_every_coordinate_is_regular_or_a_halton_sequence():
    count, dims = 500, 8
    sequence = qmc.Halton(dims - 1, scramble=False)
    halton = sequence.fast_forward(1).random(count)
    for regular in range(dims):
        points = hammersley(count, dims, regular)
        assert points.shape == (count, dims)
        assert 0 < points.min() < points.max() < 1
        np.testing.assert_array_equal(points[:, regular], np.arange(0.5, count) / count)
        np.testing.assert_allclose(np.delete(points, regular, axis=1), halton, rtol=0, atol=3e-16)
    np.testing.assert_array_equal(hammersley(3, 1), [[1 / 6], [1 / 2], [5 / 6]])


def test_log_grid_is_symmetric_about_one():
    u = np.linspace(0, 1, 101)
    scale = log_grid(u, 0.25, 4.0)
    np.testing.assert_allclose(scale[[0, 25, 50, 75, 100]], [0.25, 0.5, 1, 2, 4], rtol=1e-15)
    np.testing.assert_allclose(scale * scale[::-1], 1, rtol=1e-15)
    np.testing.assert_allclose(np.diff(np.log(scale)), np.log(16) / 100, rtol=1e-12)
    columns = log_grid(np.full((2, 2), 0.5), np.array([1.0, 4.0]), np.array([4.0, 9.0]))
    np.testing.assert_allclose(columns, [[2, 6], [2, 6]], rtol=1e-15)


def test_discrepancy_is_warnocks_and_far_below_that_of_uniform_points():
    rng = np.random.default_rng(1)
    count = 250
    u = rng.random((count, 2))
    larger = np.maximum(u[:, None], u[None])
    warnock = (
        3.0**-2
        - 2 / count * np.prod((1 - u**2) / 2, axis=1).sum()
        + np.prod(1 - larger, axis=2).sum() / count**2
    )
    np.testing.assert_allclose(star_discrepancy(u), np.sqrt(warnock), rtol=1e-12)
    uniform = np.mean([star_discrepancy(rng.random((count, 2))) for _ in range(50)])
    # E D^2 = (2^-2 - 3^-2) / count for uniform points; the mean of D is a little below the root.
    expected = np.sqrt((1 / 4 - 1 / 9) / count)
    assert 0.8 * expected < uniform < 1.05 * expected
    assert star_discrepancy(hammersley(count, 2)) < uniform / 5


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: van_der_corput(0), "count must be at least 1, got 0"),
        (lambda: van_der_corput(5, base=1), "base must be at least 2, got 1"),
        (lambda: van_der_corput(5, start=-1), "start must be at least 0, got -1"),
        (lambda: hammersley(0, 2), "count must be at least 1, got 0"),
        (lambda: hammersley(5, 0), "dims must be at least 1, got 0"),
        (lambda: hammersley(5, 2, regular=2), "regular must be from 0 to 1, got 2"),
        (lambda: hammersley(5, 2, regular=-1), "regular must be from 0 to 1, got -1"),
        (lambda: log_grid(np.array([0.5]), 0.0, 4.0), "low and high must be positive, got 0.0"),
        (lambda: log_grid(np.array([0.5]), 1.0, -4.0), "got 1.0 and -4.0"),
    ],
)
def test_bad_input_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
