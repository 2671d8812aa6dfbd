"""Weight rules: how a bank's log-weights move over a step and with its data.

A rule is a small filter over the model index (:class:`~jaxnav.estimation.types.WeightRule`); rules
compose with :func:`chain`. All weights are log-weights and leave each rule normalised; ``-inf``
marks a member that takes no part and stays ``-inf``.

Rules with a hard decision have a smooth form for gradients, ``smooth=True``, whose temperature is a
parameter: :func:`floor`, :func:`windowed_reset`; :mod:`jaxnav.estimation.tune` lists them with
those of the filters. The others are smooth as they are: bounds at the machine epsilon keep a
logarithm finite and decide nothing.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.arguments import (
    FINITE,
    NOT_NEGATIVE,
    POSITIVE,
    described,
    require_number,
    require_switch,
)
from jaxnav.estimation.banks.log_weights import (
    active,
    from_peak,
    member_log_likelihood,
    normalise,
)
from jaxnav.estimation.banks.rule import WeightRule, require_rule
from jaxnav.estimation.checks import require_fields, require_transition_matrix
from jaxnav.estimation.types import Flag, Info


def _stateless(params: Any, log_weights: Array) -> tuple[()]:
    del params, log_weights
    return ()


def stay(params: Any, state: Any, log_weights: Array, k: Array) -> Array:
    """Leave log-weights ``(M,)`` as they are: the prediction of a rule that has none."""
    del params, state, k
    return log_weights


def _ignore_data(
    params: Any, state: Any, log_weights: Array, info: Info, k: Array
) -> tuple[Any, Array]:
    del params, info, k
    return state, log_weights


def fixed() -> WeightRule:
    """Return the rule that keeps the prior weights: one member alone, or a constant mixture."""
    return WeightRule(_stateless, stay, _ignore_data, partial(_check_none, "fixed"))


def _check_none(who: str, params: Any, count: int) -> None:
    del count
    if jax.tree.leaves(params):
        raise ValueError(f"the parameter of {who} is {described(params)}; it must be (), for none")


def bayes_step(log_weights: Array, info: Info) -> Array:
    """Return log-weights ``(M,)`` after Bayes' rule; kept if no likelihood is finite."""
    members = active(log_weights)
    likelihood = jnp.where(members, member_log_likelihood(info.log_likelihood), -jnp.inf)
    posterior = log_weights + from_peak(likelihood)
    vetoed = ~jnp.any(active(posterior))
    return normalise(jnp.where(vetoed, log_weights, posterior))


def bayes() -> WeightRule:
    """Return Bayes' rule: each weight is multiplied by its member's likelihood. No parameters.

    A step in which no member has a finite likelihood keeps the weights.

    References:
        Magill (1965); Si, Wang, Niu, Eqs. (14)-(15), with the weights in the log domain.
    """

    def update(
        params: Any, state: Any, log_weights: Array, info: Info, k: Array
    ) -> tuple[Any, Array]:
        del params, k
        return state, bayes_step(log_weights, info)

    return WeightRule(_stateless, stay, update, partial(_check_none, "bayes"))


class Penalty(NamedTuple):
    """Parameters of :func:`penalty`: ``rho(k) = least + scale k^exponent exp(-k / memory)``.

    The default is the increasing penalty of the paper, ``0.5 k^0.15``, without normaliser;
    ``Penalty(0.5, 0.0, normaliser=1.0)`` is Bayes' rule, a finite ``memory`` the decaying penalty.

    Attributes:
        scale: Zero or above.
        exponent: How fast it grows with the count of observations.
        memory: Observations over which it decays by ``e``; infinite, it does not.
        least: What it decays to.
        normaliser: Power ``gamma`` of ``|2 pi S|^(-1/2)``: zero as in the paper, one for Bayes.
    """

    scale: Array | float = 0.5
    exponent: Array | float = 0.15
    memory: Array | float = jnp.inf
    least: Array | float = 0.0
    normaliser: Array | float = 0.0


def penalty() -> WeightRule:
    """Return the penalty-weighted rule; parameters are :class:`Penalty`.

        log w <- log w - rho(k) nu' inv(S) nu - (gamma / 2) log |2 pi S|

    with ``k`` the count of observations from 1, so that a faster clock of the filter alone changes
    nothing; a faster receiver does. Without the normaliser the member with the largest ``S``, that
    is with the largest noise, is always ahead in the mean: each step's expectation is
    ``-rho tr(inv(S) S_true)``, which no true model maximises. With ``rho`` above 1/2 and the
    normaliser the weights are overconfident; ``gamma = 2 rho`` would temper both alike.

    References:
        Song et al. (2022), Sensors 22:5976, Eqs. (26)-(27), who leave the normaliser out as being
        without effect. The decaying penalty is that of their reference [29], whose numbers they do
        not give.
    """

    def init(params: Penalty, log_weights: Array) -> Array:
        del params
        return jnp.zeros((), log_weights.dtype)

    def update(
        params: Penalty, state: Array, log_weights: Array, info: Info, k: Array
    ) -> tuple[Array, Array]:
        del k
        heard = jnp.any(active(log_weights) & (info.flags & Flag.NO_OBSERVATION == 0))
        count = state + heard.astype(state.dtype)
        step = jnp.maximum(count, 1)
        grown = params.scale * step**params.exponent * jnp.exp(-step / params.memory)
        usable = jnp.isfinite(info.log_likelihood)
        normaliser = jnp.where(usable, info.log_likelihood, 0) + 0.5 * info.nis
        evidence = params.normaliser * normaliser - (params.least + grown) * info.nis
        judged = info._replace(log_likelihood=jnp.where(usable, evidence, -jnp.inf))
        return count, bayes_step(log_weights, judged)

    return WeightRule(init, stay, update, _check_penalty)


def _check_penalty(params: Penalty, count: int) -> None:
    del count
    domains = {
        "scale": NOT_NEGATIVE,
        "exponent": FINITE,
        "least": NOT_NEGATIVE,
        "normaliser": NOT_NEGATIVE,
        "memory": POSITIVE,
    }
    require_fields("the parameter of penalty", params, Penalty, domains)


class Floor(NamedTuple):
    """Parameters of the smooth :func:`floor`.

    Attributes:
        bound: In (0, 1/M).
        temperature: Width of the smooth maximum of the log-weights; with one, the bound is added to
            the weights.
    """

    bound: Array | float
    temperature: Array | float = 0.1


def floor(*, smooth: bool = False) -> WeightRule:
    """Return the lower bound on weights; the parameter is the bound, in (0, 1/M).

    Weights below the bound are raised to it and all are normalised again, so a model that was ruled
    out can come back within a few steps. With ``smooth=True`` the parameters are :class:`Floor` and
    the maximum is ``t log(w^(1/t) + bound^(1/t))`` of a temperature ``t``.

    References:
        Maybeck and Stevens (1991), IEEE Trans. AES 27(3).
    """
    require_switch("smooth", smooth)

    def update(
        params: Any, state: Any, log_weights: Array, info: Info, k: Array
    ) -> tuple[Any, Array]:
        del info, k
        members = active(log_weights)
        if smooth:
            t = params.temperature
            finite = jnp.where(members, log_weights, 0)
            raised = t * jnp.logaddexp(finite / t, jnp.log(params.bound) / t)
        else:
            raised = jnp.maximum(log_weights, jnp.log(params))
        return state, normalise(jnp.where(members, raised, -jnp.inf))

    def check(params: Any, count: int) -> None:
        domain = (f"(0, 1/{count})", 0, 1 / count) if count > 1 else ("(0, 1]", 0, 1)
        if smooth:
            domains = {"bound": domain, "temperature": POSITIVE}
            require_fields("the parameter of a smooth floor", params, Floor, domains)
        else:
            require_number("the floor of the weights", params, *domain)

    return WeightRule(_stateless, stay, update, check)


def forget() -> WeightRule:
    """Return exponential forgetting; the parameter in (0, 1] multiplies the log-weights each step.

    The weights before the data become ``w**forgetting``, normalised: evidence that is ``n`` steps
    old counts ``forgetting**n``.
    """

    def predict(params: Array, state: Any, log_weights: Array, k: Array) -> Array:
        del state, k
        members = active(log_weights)
        faded = params * jnp.where(members, log_weights, 0)
        return normalise(jnp.where(members, faded, -jnp.inf))

    def check(params: Any, count: int) -> None:
        del count
        require_number("the factor of forgetting", params, "(0, 1]", 0, 1)

    return WeightRule(_stateless, predict, _ignore_data, check)


def markov() -> WeightRule:
    """Return Markov switching between models; the parameter is the probability to switch per step.

    Before the data, ``w_i = (1 - p) w_i + p (1 - w_i) / (M - 1)``: the model index is a Markov
    chain that leaves its state with probability ``p`` for any other one. The members do not
    interact; the rule is the weight recursion of an interacting bank without its mixing step.
    """

    def predict(params: Array, state: Any, log_weights: Array, k: Array) -> Array:
        del state, k
        members = active(log_weights)
        others = jnp.maximum(jnp.sum(members) - 1, 1).astype(log_weights.dtype)
        stay = jnp.where(members, log_weights, 0) + jnp.log1p(-params)
        weight = jnp.where(members, jnp.exp(log_weights), 0)
        elsewhere = jnp.maximum(1 - weight, jnp.finfo(weight.dtype).eps)
        arrive = jnp.log(params) - jnp.log(others) + jnp.log(elsewhere)
        return normalise(jnp.where(members, jnp.logaddexp(stay, arrive), -jnp.inf))

    def check(params: Any, count: int) -> None:
        del count
        require_number("the probability to switch", params, "[0, 1]", 0, 1)

    return WeightRule(_stateless, predict, _ignore_data, check)


class Switched(NamedTuple):
    """A step of the chain over model indices, in log-probabilities.

    Attributes:
        log_weights: ``(M,)`` of the models after the step.
        origins: ``(M, M)``; ``origins[i, j]`` is that of having been in model ``i``, given that
            it is ``j`` now; a model that cannot be reached comes from itself.
    """

    log_weights: Array
    origins: Array


def switched(log_weights: Array, transition: Array) -> Switched:
    """Move log-weights ``(M,)`` over a step of a Markov chain.

    Args:
        log_weights: Before the step; members at ``-inf`` stay there, and what would go to them is
            shared out.
        transition: ``(M, M)``; ``transition[i, j]`` is the probability to go from ``i`` to ``j``.

    A model that no member can reach is ruled out and stays so: give one that the chain reaches
    later a small weight, not ``-inf``. If none can be reached the weights are kept.
    """
    members = active(log_weights)
    possible = (transition > 0) & members[:, None] & members[None, :]
    log_transition = jnp.log(jnp.where(possible, transition, 1))
    start = jnp.where(members, log_weights, 0)[:, None]
    joint = jnp.where(possible, start + log_transition, -jnp.inf)
    reached = jnp.any(possible, axis=0)
    total = jax.nn.logsumexp(jnp.where(reached[None], joint, 0), axis=0)
    itself = jnp.where(jnp.eye(members.shape[0], dtype=bool), 0.0, -jnp.inf).astype(joint.dtype)
    origins = jnp.where(reached[None], joint - total[None], itself)
    moved = normalise(jnp.where(reached, total, -jnp.inf))
    return Switched(jnp.where(jnp.any(reached), moved, log_weights), origins)


def switch() -> WeightRule:
    """Return Markov switching with any transition matrix ``(M, M)``, which is the parameter.

    Before the data, ``w_j = sum_i w_i Pi_ij``; rows of ``Pi`` sum to one. :func:`markov` is the
    case of equal probabilities to go elsewhere.

    References:
        Blom and Bar-Shalom (1988), IEEE Trans. Automatic Control 33(8).
    """

    def predict(params: Array, state: Any, log_weights: Array, k: Array) -> Array:
        del state, k
        return switched(log_weights, params).log_weights

    return WeightRule(_stateless, predict, _ignore_data, require_transition_matrix)


def chain(*rules: WeightRule) -> WeightRule:
    """Return the rules one after another; parameters and state are tuples, one entry a rule."""
    for i, rule in enumerate(rules):
        require_rule(f"rule {i} of a chain", rule)

    def init(params: tuple[Any, ...], log_weights: Array) -> tuple[Any, ...]:
        return tuple(rule.init(own, log_weights) for rule, own in zip(rules, params, strict=True))

    def predict(params: tuple, state: tuple, log_weights: Array, k: Array) -> Array:
        for rule, own, memory in zip(rules, params, state, strict=True):
            log_weights = rule.predict(own, memory, log_weights, k)
        return log_weights

    def update(
        params: tuple, state: tuple, log_weights: Array, info: Info, k: Array
    ) -> tuple[tuple, Array]:
        memories: list[Any] = []
        for rule, own, memory in zip(rules, params, state, strict=True):
            memory, log_weights = rule.update(own, memory, log_weights, info, k)
            memories.append(memory)
        return tuple(memories), log_weights

    def check(params: Any, count: int) -> None:
        if type(params) is not tuple or len(params) != len(rules):
            found = f"a tuple of {len(params)}" if type(params) is tuple else described(params)
            raise ValueError(
                f"the parameter of a chain is {found}; it must be a tuple of {len(rules)}, one "
                "entry for each rule, () for a rule without parameters"
            )
        for rule, own in zip(rules, params, strict=True):
            rule.check(own, count)

    return WeightRule(init, predict, update, check)
