"""A model whose noise is handed to it, for filters that estimate noise or reweigh their data."""

from typing import NamedTuple

from jax import Array

from jaxnav.estimation.models import adapted
from jaxnav.estimation.types import FilterParams, Input, Model, Params, Point


class GivenNoise(NamedTuple):
    """Parameters of a model under :func:`with_given_noise`.

    Attributes:
        own: The model's own parameters.
        process: Factor on its process noise.
        observation: ``(m, m)`` covariance, or its diagonal ``(m,)``, in place of its own.
    """

    own: Params
    process: Array | float
    observation: Array | float


def with_given_noise(model: Model) -> Model:
    """Return the model with parameters :class:`GivenNoise`; all else is as it was."""

    def process_noise(params: GivenNoise, x: Point, u: Input) -> Array:
        return params.process * model.process_noise(params.own, x, u)

    return adapted(model, lambda params: params.own)._replace(
        process_noise=process_noise,
        observation_noise=lambda params, x, u: params.observation,
    )


def given(params: FilterParams, process: Array | float, observation: Array | float) -> FilterParams:
    """Return a filter's parameters with the noise handed to its model."""
    return params._replace(model=GivenNoise(params.model, process, observation))


def require_additive(model: Model, who: str) -> None:
    """Raise ``ValueError`` if the model has ``noisy``, which a filter uses in place of a given R.

    Args:
        model: The model.
        who: What cannot do with it, for the message.
    """
    if model.noisy is not None:
        raise ValueError(f"the model has noise that does not add; {who} needs one that does")
