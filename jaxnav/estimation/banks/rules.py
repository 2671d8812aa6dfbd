"""The weight rules by name, for listing."""

from collections.abc import Callable

from jaxnav.estimation.banks.reset import windowed_reset
from jaxnav.estimation.banks.weights import (
    bayes,
    chain,
    fixed,
    floor,
    forget,
    markov,
    penalty,
    switch,
)
from jaxnav.estimation.types import WeightRule

RULES: dict[str, Callable[..., WeightRule]] = {
    rule.__name__: rule
    for rule in (fixed, bayes, penalty, floor, forget, markov, switch, windowed_reset, chain)
}
