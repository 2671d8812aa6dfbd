"""What wrappers of filters share: the filter inside, its parameters, and noise handed to its model.

A wrapper takes a filter and gives a filter, so that they nest: ``sage_husa(versoria(ekf(model)))``.
Its parameters are ``own=(its own, the inner filter's own)``. One that hands noise over builds the
inner filter anew on a model whose noise is a parameter, by ``filter.on``.
"""

import warnings
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeVar

from jax import Array

from jaxnav.arguments import Domain, described
from jaxnav.estimation.checks import require_own, require_single
from jaxnav.estimation.models import adapted
from jaxnav.estimation.types import Filter, FilterParams, Input, Model, Params, Point

Own = TypeVar("Own")
Builder = Callable[[Model], Filter]
"""A filter of a model, such as :func:`~jaxnav.estimation.filters.kalman.ekf`."""


class Wrapped(NamedTuple):
    """A single filter inside a wrapper: with its model, and how it is built of another.

    Attributes:
        model: What it filters.
        on: ``(model) -> Filter``.
    """

    model: Model
    on: Builder


def wrapped(filter: Filter | Builder, model: Model | None, who: str) -> Wrapped:
    """Return the single filter that a wrapper is to go around.

    Args:
        filter: The filter; or, as it used to be, what builds one of a model.
        model: The model, in the form as it used to be.
        who: Name of the wrapper, for messages.

    Raises:
        ValueError: If it is no filter, or a bank.
    """
    if isinstance(filter, Filter):
        if model is not None:
            raise ValueError(f"{who} takes a filter, which knows its model: {who}(ekf(model))")
        if filter.on is None or filter.model is None:
            raise ValueError(
                f"{who} hands noise to the model of a single filter, and a bank has one for each "
                f"member; wrap these: bank({who}(filter), rule)"
            )
        return Wrapped(filter.model, filter.on)
    if model is None or not callable(filter):
        raise ValueError(f"filter is {described(filter)}; {who} takes a filter, as ekf(model)")
    warnings.warn(
        f"{who}(build, model) is {who}(build(model)) now, and goes with the next version",
        DeprecationWarning,
        stacklevel=3,
    )
    return Wrapped(model, filter)


def parted(params: FilterParams, default: Own) -> tuple[Own, FilterParams]:
    """Return a wrapper's own parameters, and those of the filter inside.

    Args:
        params: Parameters of the wrapper, as :func:`require_wrapper` has them.
        default: What ``()`` stands for.
    """
    given: Any = params.own
    if isinstance(given, type(default)):
        return given, params._replace(own=())
    mine, inner = given or ((), ())
    return mine or default, params._replace(own=inner)


def require_wrapper(params: Any, default: Any, domains: Mapping[str, Domain]) -> FilterParams:
    """Return the parameters of the filter inside a wrapper.

    Args:
        params: Parameters of the wrapper.
        default: Its own, as built.
        domains: As for :func:`~jaxnav.estimation.checks.require_fields`.

    Raises:
        ValueError: If they are not a wrapper's.
    """
    require_single(params)
    own = params.own
    if type(own) is tuple and len(own) == 2:
        own = own[0]
    require_own(own, type(default), domains)
    return parted(params, default)[1]


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


def with_noise(
    params: FilterParams, process: Array | float, observation: Array | float
) -> FilterParams:
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
