"""What a weight rule is: how a bank moves the weights of its members."""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

from jax import Array

from jaxnav.arguments import described
from jaxnav.estimation.types import Info, Params, accept


class WeightPredict(Protocol):
    """Moves log-weights ``(M,)`` over a step, before its data: forgetting, switching."""

    def __call__(self, params: Params, state: Any, log_weights: Array, k: Array) -> Array:
        """Return normalised log-weights; ``k`` counts steps from 1."""
        ...


class WeightUpdate(Protocol):
    """Moves log-weights ``(M,)`` with the members' :class:`Info` of the step."""

    def __call__(
        self, params: Params, state: Any, log_weights: Array, info: Info, k: Array
    ) -> tuple[Any, Array]:
        """Return the rule's state and normalised log-weights."""
        ...


class WeightRule(NamedTuple):
    """How a bank weighs its members: itself a small filter over the model index.

    A weight of ``-inf`` marks a member that takes no part; no rule revives it.

    Attributes:
        init: ``(params, log_weights) -> state``.
        predict: See :class:`WeightPredict`; what it returns weighs the predictive likelihood.
        update: See :class:`WeightUpdate`.
        check: ``(params, M)`` raises ``ValueError``, as :attr:`Filter.check` does.
    """

    init: Callable[[Params, Array], Any]
    predict: WeightPredict
    update: WeightUpdate
    check: Callable[[Params, int], None] = accept


def require_rule(name: str, rule: Any) -> None:
    """Raise ``ValueError`` unless it is a weight rule, and not what builds one."""
    if not isinstance(rule, WeightRule):
        raise ValueError(
            f"{name} is {described(rule)}; it must be a WeightRule, as jaxnav.bayes() or "
            "jaxnav.chain(jaxnav.bayes(), jaxnav.floor()) make it"
        )
