"""Clark's (1987) trend and cycle of the real GDP of the United States, by Kim and Nelson (1999).

Kim and Nelson, State-Space Models with Regime Switching, MIT Press, chapter 3: their program
UC_UNI.OPT with GDP4795.PRN. Data, parameters, log-likelihood and filtered states as printed by it
are those of ``uc_uni`` in statsmodels 0.15.0 (tsa/statespace/tests/results, C. Fulton, BSD
licence).
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.estimation.filters.kalman import kf
from jaxnav.estimation.filters.square_root import square_root_kf
from jaxnav.estimation.run import run
from jaxnav.estimation.types import Filter, FilterParams, Gaussian, Model, observed
from tests.published.vectors import numbers

CLARK = numbers("statsmodels_uc_uni.json")
START = int(CLARK["start"])
HALF_UNIT = 0.5e-6
"""All of it is printed to six decimals."""


def transition(p: Array, x: Array, u: Array) -> Array:
    """Trend, cycle, the cycle before, drift."""
    return jnp.stack([x[0] + x[3], p[3] * x[1] + p[4] * x[2], x[1], x[3]])


MODEL = Model(
    transition=transition,
    process_noise=lambda p, x, u: jnp.diag(jnp.zeros(4).at[jnp.array([0, 1, 3])].set(p[:3] ** 2)),
    observe=lambda p, x, u: x[:1] + x[1:2],
    observation_noise=lambda p, x, u: jnp.zeros(1),
)


def results(build: Callable[[Model], Filter], parameters: Array) -> tuple[Array, Array]:
    """The log-likelihood and the three states of the observations from the given start on."""
    z = jnp.log(jnp.asarray(CLARK["gdp"]))[:, None]
    params = FilterParams(parameters, Gaussian(jnp.zeros(4), 100 * jnp.eye(4)))
    estimate, info = run(build(MODEL), params, jnp.zeros((len(z), 0)), observed(z)).record
    states = estimate.mean[START:, jnp.array([0, 1, 3])]
    return jnp.sum(info.log_likelihood[START:]), states


def test_results_agree_to_the_digits_of_the_parameters() -> None:
    """What half a unit of the last place of each parameter may change, to first order."""
    parameters = jnp.asarray(CLARK["parameters"])
    value, slope = compiled(lambda p: (results(kf, p), jax.jacfwd(results, 1)(kf, p)))(parameters)
    for one, derivative, name in zip(value, slope, ("log_likelihood", "states"), strict=True):
        room = HALF_UNIT * (1 + np.abs(derivative).sum(axis=-1))
        np.testing.assert_array_less(np.abs(one - CLARK[name]), room)


@pytest.mark.parametrize("build", [kf, square_root_kf])
def test_the_log_likelihood_is_that_printed(build: Callable[[Model], Filter]) -> None:
    """With one more digit of the drift's deviation, which is printed 0.000184."""
    parameters = jnp.asarray(CLARK["parameters"]).at[2].set(0.0001837)
    value, _ = compiled(lambda p: results(build, p))(parameters)
    assert f"{value:.6f}" == "578.520887"
