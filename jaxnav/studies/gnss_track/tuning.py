"""The noise of the track's model as something to be found from a part of it."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.filters.kalman import kf
from jaxnav.estimation.tune.losses import negative_log_likelihood
from jaxnav.studies.gnss_track.config import GnssTrackConfig
from jaxnav.studies.gnss_track.study import MODEL, TrackData, filter_params


def density_loss(config: GnssTrackConfig, data: TrackData, part: slice) -> Callable[[Array], Array]:
    """Return the loss of a single filter's density on a part of the track.

    Args:
        config: The study's configuration.
        data: The track.
        part: Steps to use, such as ``slice(0, 1000)``; the filter starts at its first fix.

    Returns:
        ``(density [m^2/s^3]) -> `` mean negative log-likelihood per step [nats], differentiable.
    """
    inputs, observations = jax.tree.map(lambda leaf: leaf[part], (data.inputs, data.observations))
    start = jnp.concatenate([observations.z[0], jnp.zeros(2)])
    filter = kf(MODEL)

    def loss(density: Array) -> Array:
        params = filter_params(density, config, data)
        initial = params.initial._replace(mean=start)
        return negative_log_likelihood(
            filter, params._replace(initial=initial), inputs, observations
        )

    return loss
