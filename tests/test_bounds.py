"""The filter linearised at the truth: the Kalman filter where linear, the bound where not."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.estimation.bounds import linearised_at_truth
from jaxnav.estimation.filters.kalman import ekf, kf
from jaxnav.estimation.metrics import chi2_mean_bounds, nees
from jaxnav.estimation.run import run
from jaxnav.estimation.types import FilterParams, Gaussian, Model, Obs

STEPS, RUNS = 8, 200
ANCHORS = jnp.array([[0.0, 0.0], [300.0, 0.0], [0.0, 400.0]])
PHI = jnp.array([[1.0, 0.1], [-0.1, 0.9]])


class Step(NamedTuple):
    """The true states at the ends of the step."""

    before: Array
    after: Array


def truth(u: Step) -> tuple[Array, Array]:
    return u.before, u.after


def ranging(curved: bool) -> Model:
    """A planar state seen by its distances to three anchors, or by a matrix."""

    def distances(params: Array, x: Array, u: Step) -> Array:
        return jnp.sqrt(jnp.sum((x[None] - ANCHORS) ** 2, axis=1))

    def linear(params: Array, x: Array, u: Step) -> Array:
        return ANCHORS @ x / 300.0

    return Model(
        transition=lambda params, x, u: PHI @ x + jnp.array([3.0, 4.0]),
        process_noise=lambda params, x, u: 0.04 * jnp.eye(2),
        observe=distances if curved else linear,
        observation_noise=lambda params, x, u: params**2 * jnp.ones(3),
    )


def flown(model: Model, key: Array) -> tuple[Gaussian, Step, Obs]:
    """A prior, true states with the filter's own process noise, and observations."""
    start_key, noise_key, obs_key = jax.random.split(key, 3)
    prior = Gaussian(jnp.array([100.0, 80.0]), 4.0 * jnp.eye(2))
    x = prior.mean + 2.0 * jax.random.normal(start_key, (2,))
    white = 0.2 * jax.random.normal(noise_key, (STEPS, 2))
    states = [x]
    for k in range(STEPS):
        states.append(PHI @ states[-1] + jnp.array([3.0, 4.0]) + white[k])
    path = jnp.stack(states)
    inputs = Step(path[:-1], path[1:])
    z = jax.vmap(lambda u: model.observe(jnp.array(0.5), u.after, u))(inputs)
    z = z + 0.5 * jax.random.normal(obs_key, z.shape)
    valid = jnp.ones(z.shape, bool).at[3, 1].set(False).at[5].set(False)
    return prior, inputs, Obs(jnp.where(valid, z, jnp.nan), valid)


def test_a_linear_model_gives_the_kalman_filter(key: Array) -> None:
    model = ranging(curved=False)
    prior, inputs, obs = flown(model, key)
    params = FilterParams(jnp.array(0.5), prior)
    ours, info = run(linearised_at_truth(model, truth), params, inputs, obs).record
    plain, plain_info = run(kf(model), params, inputs, obs).record
    np.testing.assert_allclose(ours.mean, plain.mean, rtol=1e-12)
    np.testing.assert_allclose(ours.cov, plain.cov, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(info.log_likelihood, plain_info.log_likelihood, rtol=1e-10)


def test_an_estimate_at_the_truth_is_updated_as_the_ekf_does(key: Array) -> None:
    model = ranging(curved=True)
    prior, inputs, obs = flown(model, key)
    u = jax.tree.map(lambda leaf: leaf[0], inputs)
    params = FilterParams(jnp.array(0.5), Gaussian(u.before, prior.cov))
    one = Obs(obs.z[0], obs.valid[0])
    bound, plain = linearised_at_truth(model, truth), ekf(model)
    predicted = plain.predict(params, plain.init(params), u)._replace(x=u.after)
    ours, _ = bound.update(params, predicted, u, one)
    theirs, _ = plain.update(params, predicted, u, one)
    np.testing.assert_allclose(ours.x, theirs.x, rtol=1e-13)
    np.testing.assert_allclose(ours.P, theirs.P, rtol=1e-12)


def test_the_bound_is_consistent_where_the_observation_is_curved(key: Array) -> None:
    model = ranging(curved=True)

    def normalised(key: Array) -> Array:
        prior, inputs, obs = flown(model, key)
        params = FilterParams(jnp.array(0.5), prior)
        last = run(linearised_at_truth(model, truth), params, inputs, obs).record[0]
        return nees(last.mean[-1] - inputs.after[-1], last.cov[-1])

    mean = float(jnp.mean(jax.vmap(normalised)(jax.random.split(key, RUNS))))
    low, high = chi2_mean_bounds(2, RUNS)
    assert low < mean < high


def test_its_covariance_does_not_depend_on_the_data(key: Array) -> None:
    model = ranging(curved=True)
    prior, inputs, obs = flown(model, key)
    params = FilterParams(jnp.array(0.5), prior)
    bound = linearised_at_truth(model, truth)
    far = params._replace(initial=prior._replace(mean=prior.mean + 50.0))
    ours = run(bound, params, inputs, obs).record[0].cov
    np.testing.assert_array_equal(ours, run(bound, far, inputs, obs).record[0].cov)
    assert not np.array_equal(
        run(ekf(model), params, inputs, obs).record[0].cov,
        run(ekf(model), far, inputs, obs).record[0].cov,
    )
