"""States that a filter of a drive may carry besides its own, and how well each is known before."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.carried import (
    CarriedParams,
    GaussMarkov,
    Law,
    constant,
    gauss_markov,
    with_carried,
)
from jaxnav.estimation.types import FilterParams
from jaxnav.navigation.models.vehicle import CARRIED, VehicleParams
from jaxnav.units import DEG


class Carry(NamedTuple):
    """A state that may be carried.

    Attributes:
        law: How it moves.
        sigma: Its standard deviation at the start, each entry, in SI.
        unit: What it is told in.
        scale: That unit in SI.
        params: ``()``, or the parameters of its law.
    """

    law: Law
    sigma: float
    unit: str
    scale: float = 1.0
    params: tuple[float, ...] = ()


CARRIES = {
    "lever-arm": Carry(constant(3), 0.5, "m"),
    "mounting": Carry(constant(3), 3 * DEG, "deg", DEG),
    "time-offset": Carry(constant(1), 0.05, "s"),
    "gyro-scale": Carry(constant(3), 5e-3, "ppm", 1e-6),
    "accel-scale": Carry(constant(3), 5e-3, "ppm", 1e-6),
    "position-error": Carry(gauss_markov(3), 1.0, "m", params=(1.0, 60.0)),
}
"""By the name on the command line; the states of the model have an underscore."""
assert {name.replace("-", "_") for name in CARRIES} == set(CARRIED)


def laws(names: Sequence[str]) -> dict[str, Law]:
    """Return the laws of states by their names in the model."""
    return {_state(name): CARRIES[name].law for name in names}


def carried(params: FilterParams, names: Sequence[str]) -> FilterParams:
    """Return the parameters of a filter whose model carries states.

    Lever arm and mounting start from the parameters that they take the place of, the others from
    zero.

    Args:
        params: Of a filter of the plain model.
        names: The states; with none the parameters are as they were.
    """
    if not names:
        return params
    model: VehicleParams = params.model
    start = {"lever_arm": model.inner.lever_arm, "mounting": model.mounting}
    spread, own = {}, {}
    for name in names:
        one, state = CARRIES[name], _state(name)
        zero = jnp.zeros(one.law.size)
        variance = jnp.full(one.law.size, one.sigma**2)
        spread[state] = (jnp.asarray(start.get(state, zero)), variance)
        own[state] = GaussMarkov(*map(jnp.array, one.params)) if one.params else ()
    return params._replace(
        model=CarriedParams(model, own), initial=with_carried(params.initial, spread)
    )


def summary(names: Sequence[str], values: dict[str, Array], sigma: Array) -> dict[str, Any]:
    """Return what was found of the states at the end, by name, in the unit of each.

    Args:
        names: The states.
        values: Their last estimates by their names in the model.
        sigma: Their standard deviations, in the order of these names.
    """
    found, first = {}, 0
    for name in sorted(names, key=_state):
        one = CARRIES[name]
        last = first + one.law.size
        found[name] = {
            "value": [float(x) / one.scale for x in values[_state(name)]],
            "sigma": [float(x) / one.scale for x in sigma[first:last]],
            "unit": one.unit,
        }
        first = last
    return found


def _state(name: str) -> str:
    return name.replace("-", "_")
