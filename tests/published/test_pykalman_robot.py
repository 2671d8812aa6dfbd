"""The robot of pykalman 0.11.2: five states, two channels, offsets that change in time.

Numbers of ``pykalman/datasets/data/robot.mat`` in the package on PyPI (BSD licence): data that P.
Abbeel made for CS287, Berkeley, in 2011, completed in 2012 with a Kalman filter in MATLAB, whose
filtered means and covariances these are. The first hundred of five hundred observations.

The file has no observation at its first time, so its prior is the state at t0 here.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.estimation.filters.kalman import kf
from jaxnav.estimation.filters.sigma_point import ckf, square_root_ukf, ukf
from jaxnav.estimation.filters.square_root import square_root_kf
from jaxnav.estimation.run import run
from jaxnav.estimation.types import Filter, FilterParams, Gaussian, Model, observed
from tests.published.vectors import numbers

ROBOT = {name: jnp.asarray(value) for name, value in numbers("pykalman_robot.json").items()}
MODEL = Model(
    transition=lambda p, x, u: ROBOT["transition"] @ x + u,
    process_noise=lambda p, x, u: ROBOT["process_noise"],
    observe=lambda p, x, u: ROBOT["observation"] @ x + ROBOT["observation_offset"],
    observation_noise=lambda p, x, u: ROBOT["observation_noise"],
)


@pytest.mark.parametrize("build", [kf, square_root_kf, ukf, square_root_ukf, ckf])
def test_estimates_are_those_in_the_file(build: Callable[[Model], Filter]) -> None:
    prior = Gaussian(ROBOT["initial_mean"], ROBOT["initial_covariance"])
    trace = run(
        build(MODEL),
        FilterParams((), prior),
        ROBOT["transition_offsets"],
        observed(ROBOT["observations"]),
    )
    estimate, info = trace.record
    np.testing.assert_array_equal(info.flags, 0)
    np.testing.assert_allclose(estimate.mean, ROBOT["filtered_means"], rtol=0, atol=1e-9)
    for step in (1, 100):
        stored = ROBOT[f"filtered_covariance_{step}"]
        np.testing.assert_allclose(estimate.cov[step - 1], stored, rtol=0, atol=1e-9)
