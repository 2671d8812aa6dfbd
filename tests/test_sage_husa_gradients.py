"""Gradients through Sage-Husa filters and their banks, and the process noise adapted with them."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.estimation.banks.mixture import BankParams, bank
from jaxnav.estimation.banks.weights import Penalty, penalty
from jaxnav.estimation.filters.adaptive import Adaptation, innovation_adaptive
from jaxnav.estimation.filters.kalman import kf
from jaxnav.estimation.filters.sage_husa import SageHusa, sage_husa
from jaxnav.estimation.run import run
from jaxnav.estimation.tune.losses import negative_log_likelihood
from jaxnav.estimation.types import Filter, FilterParams, Gaussian, Model, Obs, replicate
from tests.oracles.matrices import central_difference

SCALAR = Model(
    transition=lambda p, x, u: 0.9 * x,
    process_noise=lambda p, x, u: p * jnp.ones((1, 1)),
    observe=lambda p, x, u: x,
    observation_noise=lambda p, x, u: u * jnp.ones(1),
)
"""The parameter is the variance Q, the input that of R: a small program is enough."""
STEPS = 50
START = FilterParams(jnp.array(1.0), Gaussian(jnp.zeros(1), jnp.eye(1)))
"""Of the scalar model."""


def graded_data() -> tuple[Array, Obs]:
    """Grades and data for the scalar model, some of them missing."""
    rng = np.random.default_rng(31)
    z, valid = 2.5 * rng.normal(size=(STEPS, 1)), rng.uniform(size=(STEPS, 1)) > 0.2
    return jnp.array(rng.uniform(1, 2, STEPS)), Obs(jnp.array(z), jnp.array(valid))


def check_gradient(loss: Callable[[Array], Array], points: list[np.ndarray]) -> None:
    """Compare with central differences, by those parameters that are finite."""
    both = compiled(jax.value_and_grad(loss))
    for point in points:
        axes = np.eye(len(point))[np.isfinite(point)]
        expected = [
            central_difference(lambda t: np.asarray(both(t)[0]), point, e, 1e-4) for e in axes
        ]
        gradient = np.asarray(both(point)[1])[np.isfinite(point)]
        np.testing.assert_allclose(gradient, expected, rtol=1e-6, atol=1e-9)
        assert abs(gradient[0]) > 1e-3


def test_gradient_of_the_likelihood_by_forgetting() -> None:
    """Of the residual form, by process noise and prior count too, which may be infinite."""
    filter, (grade, obs) = sage_husa(kf(SCALAR), channels=1, form="residual"), graded_data()

    def loss(theta: Array) -> Array:
        own, q = SageHusa(theta[0], theta[1]), jnp.exp(theta[2])
        params = START._replace(model=q, own=own)
        return negative_log_likelihood(filter, params, grade, obs)

    check_gradient(loss, [np.array([0.9, 4.0, 0.1]), np.array([0.95, np.inf, 0.1])])


def test_gradient_of_a_banks_likelihood_by_averaging_and_penalty() -> None:
    """Two members of the smooth form that differ in process noise and forgetting."""
    filter = bank(sage_husa(kf(SCALAR), channels=1, smooth=True), penalty())
    grade, obs = graded_data()

    def loss(theta: Array) -> Array:
        shared = (jnp.broadcast_to(theta[i], (2,)) for i in range(2, 6))
        alike = replicate(START, 2)
        inner = alike._replace(model=jnp.array([0.3, 3.0]), own=SageHusa(theta[:2], *shared))
        rule = Penalty(*(theta[i] for i in range(6, 11)))
        return negative_log_likelihood(filter, BankParams(inner, rule), grade, obs)

    rest = [0.4, 2.5, 0.1, 0.3, 0.2, 40.0, 0.05, 0.4]
    points = [np.array([0.9, 0.97, count, *rest]) for count in (5.0, np.inf)]
    check_gradient(loss, points)


def test_process_noise_is_adapted_as_by_the_filter_that_does_only_that() -> None:
    grade, obs = graded_data()
    process = Adaptation(jnp.array(4.0), jnp.array(0.1), jnp.array(50.0))

    def adapted(filter: Filter, own: Any, factor: Callable[[Any], Array]) -> tuple[Array, Array]:
        def kept(state: Any, info: Any) -> tuple[Array, Array]:
            return factor(state), filter.estimate(state).mean

        return run(filter, START._replace(own=own), grade, obs, record=kept).record

    inner = innovation_adaptive(kf(SCALAR))
    both = adapted(
        sage_husa(inner, channels=1),
        (SageHusa(1.0, jnp.inf), process),
        lambda state: state.inner.log_factor,
    )
    alone = adapted(inner, process, lambda state: state.log_factor)
    for found, expected in zip(both, alone, strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    assert np.ptp(alone[0]) > 0.5


def test_gradient_of_the_smooth_clamp_at_and_beyond_the_bounds() -> None:
    """By one datum of a state that is known, half of its square being told."""
    low, high, width = 1.0, 2.0, 0.1
    filter = sage_husa(kf(SCALAR), channels=1, smooth=True)
    own = SageHusa(0.5, jnp.inf, low, high, width)
    prior = Gaussian(jnp.zeros(1), jnp.zeros((1, 1)))
    params = FilterParams(jnp.array(0.0), prior, own=own)

    def variance(z: Array) -> Array:
        obs = Obs(z[None], jnp.array([True]))
        return filter.update(params, filter.init(params), jnp.array(1.0), obs)[0].noise[0, 0]

    told = np.array([0.6, 0.9, low, 1.5, high, 2.2, 3.0])
    z = np.sqrt(2 * told - 1)
    value, gradient = compiled(jax.vmap(jax.value_and_grad(variance)))(z)
    above, below = (1 / (1 + np.exp(-(told - bound) / width)) for bound in (low, high))
    np.testing.assert_allclose(gradient, (above - below) * z, rtol=1e-9)
    assert np.all(gradient > 1e-5)
    assert np.all((value > low) & (value < high) & (np.diff(value, prepend=0) > 0))
