"""Bounds: what a filter that knew the truth would reach."""

from collections.abc import Callable
from typing import Any

from jaxnav.estimation.types import Filter, Input, Obs, Params


def oracle(filter: Filter, informed: Callable[[Params, Input], Params]) -> Filter:
    """Return the filter that is told the true parameters at every step.

    For a linear model with Gaussian noise it has the least mean square error of all estimators, so
    no adaptive filter can do better on average; the distance to it is what adaptation could gain.

    Args:
        filter: The filter to inform.
        informed: ``(params, u) -> params`` with the truth of the step, which the input carries.

    Returns:
        A filter with the same parameters and state.
    """

    def predict(params: Params, state: Any, u: Input) -> Any:
        return filter.predict(informed(params, u), state, u)

    def update(params: Params, state: Any, u: Input, obs: Obs) -> tuple[Any, Any]:
        return filter.update(informed(params, u), state, u, obs)

    return filter._replace(predict=predict, update=update)
