"""The table of all filters and banks, over any model with a factor on each noise."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.banks.imm import imm, uniform_switching
from jaxnav.estimation.banks.mixture import BankParams, bank, immae, mmae
from jaxnav.estimation.banks.reset import WindowedReset
from jaxnav.estimation.banks.weights import Penalty, bayes, chain, floor, forget, markov, penalty
from jaxnav.estimation.bounds import oracle
from jaxnav.estimation.filters.kalman import ekf, kf
from jaxnav.estimation.filters.sage_husa import SageHusa
from jaxnav.estimation.filters.square_root import square_root_kf
from jaxnav.estimation.register import FILTER, WRAPPER, by_kind, entries
from jaxnav.estimation.types import Filter, FilterParams, Model, replicate

THETA = (0.2, 1.0, 8.0)
"""Factors on the process noise of a bank's members."""
LINEAR = ("kf", "square_root_kf")
"""Filters that want a linear model."""
SWITCHING = uniform_switching(3, 0.05)


class Noise(NamedTuple):
    """Parameters of a model: factors on Q and R."""

    q: Array
    r: Array


class Case(NamedTuple):
    """A filter with its parameters, and the same made of members that are all alike."""

    filter: Filter
    params: Any
    alike: Any


def noise_adaptation(forgetting: float, prior_count: float) -> SageHusa:
    """How a filter that estimates its measurement noise does so; 1 and infinity: not at all."""
    numbers = forgetting, prior_count, 0.1, 100.0, 0.02
    return SageHusa(*(jnp.array(number, float) for number in numbers))


def _plain(name: str, base: FilterParams) -> FilterParams:
    """Parameters of one filter that leave its noise and its data as they are."""
    idle = entries()[name].idle if name in entries() else ()
    return base._replace(own=jax.tree.map(lambda leaf: jnp.array(leaf, float), idle))


def _members(base: FilterParams, *theta: float) -> FilterParams:
    """Members of a bank that differ in the process noise."""
    alike = replicate(base, len(theta))
    return alike._replace(model=alike.model._replace(q=jnp.array(theta)))


def _singles(model: Model, bent: Model) -> dict[str, Filter]:
    """Return all that is registered, wrappers around the extended filter."""
    known = by_kind()
    single = {
        name: entry.make(model if name in LINEAR else bent) for name, entry in known[FILTER].items()
    }
    wrapped = {name: entry.make(ekf(bent)) for name, entry in known[WRAPPER].items()}
    return {**single, "oracle": oracle(kf(model), lambda params, u: params), **wrapped}


def _banks(model: Model, singles: dict[str, Filter]) -> dict[str, tuple[Filter, Any]]:
    base = singles["kf"]
    reset = WindowedReset(jnp.array(5.0), jnp.array(0.9), jnp.array(0.05))
    return {
        "mmae": (mmae(base), ()),
        "mmae of square roots": (mmae(square_root_kf(model)), ()),
        "immae": (immae(base), ((), reset)),
        "immae, smooth": (immae(base, smooth=True), ((), reset)),
        "floor": (bank(base, chain(bayes(), floor())), ((), jnp.array(1e-3))),
        "forget": (bank(base, chain(forget(), bayes())), (jnp.array(0.95), ())),
        "markov": (bank(base, chain(markov(), bayes())), (jnp.array(0.05), ())),
        "penalty": (bank(base, penalty()), Penalty(*map(jnp.array, (0.5, 0.15, 9.0, 0.1, 1.0)))),
        "imm": (imm(base), SWITCHING),
        "mmae of ukf": (mmae(singles["ukf"]), ()),
        "immae of ckf": (immae(singles["ckf"]), ((), reset)),
        "mmae of iterated_ckf": (mmae(singles["iterated_ckf"]), ()),
    }


def cases(
    model: Model, base: FilterParams, channels: int, bent: Model | None = None
) -> dict[str, Case]:
    """Return every filter and bank by name.

    Args:
        model: A linear model with parameters :class:`Noise`.
        base: Parameters of one filter of it, with factors of one.
        channels: Of its observation.
        bent: The model of the filters that need no linear one, if that is another.
    """
    named = (("all", channels),)
    singles = _singles(model, (bent or model)._replace(channels=named))
    table = {
        name: Case(made, _plain(name, base), _plain(name, base)) for name, made in singles.items()
    }
    moving = base._replace(own=noise_adaptation(0.9, 5.0))
    table["sage_husa"] = table["sage_husa"]._replace(params=moving)
    alike = _members(base, 1.0, 1.0, 1.0)
    for name, (made, rule) in _banks(model, singles).items():
        members = BankParams(_members(base, *THETA), rule)
        table[name] = Case(made, members, BankParams(alike, rule))
    one = BankParams(_members(base, 1.0), ())
    table["bank of one"] = Case(mmae(singles["kf"]), one, one)
    return table
