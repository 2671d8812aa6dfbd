"""A wrapper of one's own: a fading memory, around any filter of the library.

jaxnav list --from examples/own_wrapper.py
jaxnav filter LOG --from examples/own_wrapper.py --filter "fading(ekf)"
python -m pytest --from examples/own_wrapper.py tests/test_contracts.py -k fading
"""

import math
from typing import Any, NamedTuple

from jax import Array

from jaxnav.estimation.filters.wrapping import parted, require_wrapper
from jaxnav.estimation.types import Filter, FilterParams, Info, Input, Obs


class Fading(NamedTuple):
    """Parameters: the factor on the predicted covariance, one or more."""

    factor: Array | float = 1.01


IDLE = {"fading": Fading(1.0)}


def fading(filter: Filter) -> Filter:
    """Return a filter that forgets: its predicted covariance grows by a factor in every step.

    References:
        Simon (2006), Optimal State Estimation, section 7.4.
    """

    def check(params: FilterParams) -> None:
        filter.check(require_wrapper(params, Fading(), {"factor": ("[1, inf)", 1.0, math.inf)}))

    def init(params: FilterParams) -> Any:
        return filter.init(parted(params, Fading())[1])

    def predict(params: FilterParams, state: Any, u: Input) -> Any:
        own, inner = parted(params, Fading())
        state = filter.predict(inner, state, u)
        known = filter.estimate(state)
        return filter.restart(state, known._replace(cov=own.factor * known.cov))

    def update(params: FilterParams, state: Any, u: Input, obs: Obs) -> tuple[Any, Info]:
        return filter.update(parted(params, Fading())[1], state, u, obs)

    build = filter.on
    return filter._replace(
        init=init,
        predict=predict,
        update=update,
        check=check,
        on=build and (lambda model: fading(build(model))),
    )
