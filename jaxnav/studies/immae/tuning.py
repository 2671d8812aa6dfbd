"""The process noise of the study as something to be found from data."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.filters.kalman import kf
from jaxnav.estimation.tune import negative_log_likelihood
from jaxnav.estimation.types import FilterParams, Gaussian, Obs
from jaxnav.navigation.models.sins_cns import LAYOUT, sins_cns_attitude
from jaxnav.studies.immae.config import ImmaeConfig
from jaxnav.studies.immae.simulation import build_world, fly_linear, noise_of, prior_sigma


def noise_loss(config: ImmaeConfig, key: Array, runs: int) -> Callable[[Array], Array]:
    """Simulate flights and return the loss of a factor on Q0: the likelihood of their innovations.

    The flights are those of the linear chain. The filter is the autonomous attitude part, which
    sees all that the star tracker tells of the noise, at a fraction of the cost.

    Args:
        config: The study's configuration; ``duration_s`` is the length of each flight.
        key: Random key of the flights.
        runs: Number of flights.

    Returns:
        ``(factor) -> `` mean negative log-likelihood per step [nats], differentiable.
    """
    period, imu_step = config.filter_period_s, config.imu_step
    world = build_world(config)
    simulate = jax.jit(jax.vmap(lambda key: fly_linear(key, world, period, imu_step).z))
    flights = simulate(jax.random.split(key, runs))
    sigma = prior_sigma(config)
    sigma = jnp.concatenate([sigma[LAYOUT.phi], sigma[LAYOUT.eps]])
    initial = Gaussian(jnp.zeros(6), jnp.diag(sigma**2))
    filter = kf(sins_cns_attitude(period, imu_step))
    valid = jnp.ones(flights.shape[1:], bool)
    segment = max(1, round(config.steps**0.5))

    def loss(factor: Array) -> Array:
        params = FilterParams(noise_of(config)._replace(noise_scale=factor), initial)
        per_run = jax.vmap(
            lambda z: negative_log_likelihood(
                filter, params, world.nominal, Obs(z, valid), segment=segment
            )
        )
        return jnp.mean(per_run(flights))

    return loss
