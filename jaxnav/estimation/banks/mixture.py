"""Banks: the same filter over several parameter sets, weighed by a rule; a bank is again a filter.

The members never interact, so several weight rules can watch one set of members: :func:`panel`
compares rules at the price of one bank.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.arguments import described
from jaxnav.estimation.banks.log_weights import active, member_log_likelihood, normalise
from jaxnav.estimation.banks.reset import windowed_reset
from jaxnav.estimation.banks.rule import WeightRule, require_rule
from jaxnav.estimation.banks.weights import bayes, chain
from jaxnav.estimation.checks import require_filter, require_log_prior, require_members
from jaxnav.estimation.types import (
    Filter,
    Flag,
    Gaussian,
    Info,
    Input,
    Obs,
    add,
    flags_of,
    subtract,
)
from jaxnav.numerics.linalg import cholesky, solve_lower, symmetrise


class BankParams(NamedTuple):
    """Parameters of a bank.

    Attributes:
        members: The filter's parameters with a leading model axis ``M`` on every leaf.
        rule: Parameters of the weight rule; for a :func:`panel`, a mapping by rule name.
        log_prior: ``(M,)`` log-weights at t0, normalised or not; ``-inf`` leaves a member out;
            ``None`` is uniform. For a :func:`panel`, a mapping by rule name, or ``None``.
    """

    members: Any
    rule: Any
    log_prior: Any = None


class BankState(NamedTuple):
    """Members' states (leading axis ``M``), the rule's memory, log-weights and the step count."""

    members: Any
    rule: Any
    log_weights: Any
    step: Array


class PanelState(NamedTuple):
    """The state of a panel: as :class:`BankState`, rule and log-weights being mappings by name."""

    members: Any
    rule: dict[str, Any]
    log_weights: dict[str, Array]
    step: Array


def panel(filter: Filter, rules: Mapping[str, WeightRule]) -> Filter:
    """Return several banks over one set of members, one for each weight rule.

    Parameters are :class:`BankParams` with mappings; ``update`` gives a mapping of
    :class:`Info` and ``estimate`` one of :class:`Gaussian`, by rule name. With ``fixed`` weights on
    one member, a single filter takes part in the comparison at no further cost.
    """
    require_filter(filter)
    if not isinstance(rules, Mapping) or not rules:
        raise ValueError(
            f"rules is {described(rules)}; it must be a mapping of names to one rule or more"
        )
    for name, rule in rules.items():
        require_rule(f"rule {name!r}" if name else "rule", rule)
    names = tuple(rules)
    estimate_members = jax.vmap(filter.estimate)

    def check(params: BankParams) -> None:
        count = require_bank_params(filter, params)
        for given in ("rule", "log_prior"):
            value = getattr(params, given)
            if value is None and given == "log_prior":
                continue
            if not isinstance(value, Mapping) or set(value) != set(names):
                found = ", ".join(value) if isinstance(value, Mapping) else described(value)
                raise ValueError(
                    f"{given} of a panel is {found}; it must be a mapping with {', '.join(names)}"
                )
        for name in names:
            rules[name].check(params.rule[name], count)
            require_log_prior(params.log_prior and params.log_prior[name], count)

    def init(params: BankParams) -> PanelState:
        check(params)
        members = jax.vmap(filter.init)(params.members)
        count = jax.tree.leaves(params.members)[0].shape[0]
        dtype = jax.tree.leaves(members)[0].dtype
        priors = {name: _log_prior(params.log_prior, name, count, dtype) for name in names}
        memories = {name: rules[name].init(params.rule[name], priors[name]) for name in names}
        return PanelState(members, memories, priors, jnp.zeros((), jnp.int32))

    def predict(params: BankParams, state: PanelState, u: Input) -> PanelState:
        step = state.step + 1
        members = jax.vmap(filter.predict, in_axes=(0, 0, None))(params.members, state.members, u)
        log_weights = {
            name: rules[name].predict(
                params.rule[name], state.rule[name], state.log_weights[name], step
            )
            for name in names
        }
        return PanelState(members, state.rule, log_weights, step)

    def update(
        params: BankParams, state: PanelState, u: Input, obs: Obs
    ) -> tuple[PanelState, dict[str, Info]]:
        members, info = jax.vmap(filter.update, in_axes=(0, 0, None, None))(
            params.members, state.members, u, obs
        )
        moved = {
            name: rules[name].update(
                params.rule[name], state.rule[name], state.log_weights[name], info, state.step
            )
            for name in names
        }
        infos = _by_name(names, jax.vmap(mixture_info, (0, None))(_stacked(names, state), info))
        memories = {name: memory for name, (memory, _) in moved.items()}
        log_weights = {name: weights for name, (_, weights) in moved.items()}
        return PanelState(members, memories, log_weights, state.step), infos

    def estimate(state: PanelState) -> dict[str, Gaussian]:
        members = estimate_members(state.members)

        def mixed(log_weights: Array) -> Gaussian:
            return moment_match(log_weights, members, filter.retract, filter.local)

        return _by_name(names, jax.vmap(mixed)(_stacked(names, state)))

    def restart(state: PanelState, estimate: Gaussian) -> PanelState:
        members = jax.vmap(filter.restart, in_axes=(0, None))(state.members, estimate)
        return state._replace(members=members)

    local, model = filter.local, filter.model
    return Filter(init, predict, update, estimate, restart, filter.retract, local, check, model)


# What the rules of a panel have in common is done for all of them at once: one body to compile.


def _stacked(names: tuple[str, ...], state: PanelState) -> Array:
    """Return the log-weights ``(rules, M)`` of a panel in the order of the names."""
    return jnp.stack([state.log_weights[name] for name in names])


def _by_name(names: tuple[str, ...], results: Any) -> dict[str, Any]:
    """Return results with a leading axis of rules as a mapping by their names."""
    return {name: jax.tree.map(lambda leaf, i=i: leaf[i], results) for i, name in enumerate(names)}


def bank(filter: Filter, rule: WeightRule) -> Filter:
    """Return the bank of ``filter`` under one weight rule, with parameters :class:`BankParams`.

    The estimate is the moment-matched mixture: the members' covariances and the spread of their
    means, weighted. The info's log-likelihood is that of the predictive mixture. A member whose
    update fails, or whose likelihood is not a number, is ruled out and leaves the others as they
    are.

    References:
        Si, Wang, Niu, Eqs. (4)-(18). Zhao et al. (2018), Eqs. (5) and (30), leave the members'
        covariances out; that covariance tends to zero when one weight tends to one.
    """
    single = panel(filter, {"": rule})

    def widen(params: BankParams) -> BankParams:
        prior = None if params.log_prior is None else {"": params.log_prior}
        return BankParams(params.members, {"": params.rule}, prior)

    def wide_state(state: BankState) -> PanelState:
        return PanelState(state.members, {"": state.rule}, {"": state.log_weights}, state.step)

    def narrow(state: PanelState) -> BankState:
        return BankState(state.members, state.rule[""], state.log_weights[""], state.step)

    def check(params: BankParams) -> None:
        count = require_bank_params(filter, params)
        rule.check(params.rule, count)
        require_log_prior(params.log_prior, count)

    def init(params: BankParams) -> BankState:
        return narrow(single.init(widen(params)))

    def predict(params: BankParams, state: BankState, u: Input) -> BankState:
        return narrow(single.predict(widen(params), wide_state(state), u))

    def update(params: BankParams, state: BankState, u: Input, obs: Obs) -> tuple[BankState, Info]:
        moved, infos = single.update(widen(params), wide_state(state), u, obs)
        return narrow(moved), infos[""]

    def estimate(state: BankState) -> Gaussian:
        return single.estimate(wide_state(state))[""]

    def restart(state: BankState, estimate: Gaussian) -> BankState:
        return narrow(single.restart(wide_state(state), estimate))

    local, model = filter.local, filter.model
    return Filter(init, predict, update, estimate, restart, filter.retract, local, check, model)


def require_bank_params(filter: Filter, params: Any) -> int:
    """Raise ``ValueError`` unless parameters are those of a bank; return the number of members."""
    if not isinstance(params, BankParams):
        raise ValueError(
            f"params is {described(params)}; a bank takes BankParams(members, rule), its members' "
            "parameters with a leading model axis, as jaxnav.replicate(params, count) gives"
        )
    return require_members(filter.check, params.members)


def reweighed(rule: WeightRule) -> Filter:
    """Return a bank whose members have already run: its input is their :class:`Info` of the step.

    The members of a bank never interact, so another rule, or the same with other parameters, needs
    no filter to run again. Its parameters are :class:`BankParams` without members, its estimate is
    the log-weights ``(M,)``; observations are not used.
    """

    def init(params: BankParams) -> BankState:
        prior = normalise(params.log_prior)
        return BankState((), rule.init(params.rule, prior), prior, jnp.zeros((), jnp.int32))

    def predict(params: BankParams, state: BankState, u: Info) -> BankState:
        del u
        step = state.step + 1
        moved = rule.predict(params.rule, state.rule, state.log_weights, step)
        return state._replace(log_weights=moved, step=step)

    def update(params: BankParams, state: BankState, u: Info, obs: Obs) -> tuple[BankState, Array]:
        del obs
        memory, moved = rule.update(params.rule, state.rule, state.log_weights, u, state.step)
        return state._replace(rule=memory, log_weights=moved), moved

    def restart(state: BankState, estimate: Any) -> BankState:
        return state._replace(log_weights=estimate)

    return Filter(init, predict, update, lambda state: state.log_weights, restart)


def mmae(filter: Filter) -> Filter:
    """Return multiple-model adaptive estimation: a bank under Bayes' rule (rule parameters ``()``).

    References:
        Magill (1965), IEEE Trans. Automatic Control 10(4).
    """
    return bank(filter, bayes())


def immae(filter: Filter, *, smooth: bool = False) -> Filter:
    """Return improved MMAE: Bayes' rule with a windowed reset.

    The rule's parameters are ``((), WindowedReset(...))``; ``smooth`` is that of the reset.

    References:
        Si, Wang, Niu, Eqs. (5)-(18) and step (5); see
        :func:`~jaxnav.estimation.banks.weights.windowed_reset` for what the paper leaves open.
    """
    return bank(filter, chain(bayes(), windowed_reset(smooth=smooth)))


def _log_prior(log_prior: Any, name: str, count: int, dtype: Any) -> Array:
    given = None if log_prior is None else log_prior[name]
    if given is None:
        return normalise(jnp.zeros((count,), dtype))
    return normalise(jnp.asarray(given, dtype))


def moment_match(
    log_weights: Array,
    members: Gaussian,
    retract: Callable[[Any, Array], Any] = add,
    local: Callable[[Any, Any], Array] = subtract,
) -> Gaussian:
    """Return the Gaussian with the mean and covariance of a mixture.

        x = sum w_i x_i,   P = sum w_i (P_i + (x_i - x)(x_i - x)')

    On a manifold the sums are taken in the tangent space at the likeliest member, into which the
    covariances are taken as they are: right to first order in the spread of the means.

    Args:
        log_weights: ``(M,)`` normalised; members at ``-inf`` have no effect, even if not finite.
        members: Means with a leading axis ``M`` and covariances ``(M, n, n)``.
        retract: That of the mean's manifold; the default is a vector space.
        local: Likewise.
    """
    if retract is add and local is subtract:
        return _moment_match(log_weights, members)
    reference = likeliest(log_weights, members.mean)
    offsets = jax.vmap(local, in_axes=(None, 0))(reference, members.mean)
    mixed = _moment_match(log_weights, Gaussian(offsets, members.cov))
    return Gaussian(retract(reference, mixed.mean), mixed.cov)


def likeliest(log_weights: Array, means: Any) -> Any:
    """Return the mean, out of those with a leading axis ``M``, of the largest weight.

    It needs no smooth form: a mixture's moments about one point or another are the same to first
    order in the spread.
    """
    best = jnp.argmax(log_weights)
    return jax.tree.map(lambda leaf: leaf[best], means)


def _moment_match(log_weights: Array, members: Gaussian) -> Gaussian:
    """Match moments in a vector space: means ``(M, n)``."""
    used = active(log_weights)
    w = jnp.where(used, jnp.exp(log_weights), 0)
    means = jnp.where(used[:, None], members.mean, 0)
    covs = jnp.where(used[:, None, None], members.cov, 0)
    mean = w @ means
    spread = jnp.where(used[:, None], means - mean[None], 0)
    within = (w @ covs.reshape(w.shape[0], -1)).reshape(covs.shape[1:])
    return Gaussian(mean, within + (w[:, None] * spread).T @ spread)


def mixture_info(log_weights: Array, info: Info) -> Info:
    """Return the info of a bank from its predictive log-weights ``(M,)`` and its members' info.

    The log-likelihood is the mixture's, ``log sum w_i N(nu_i; 0, S_i)``; innovation, its covariance
    and the NIS are those of the moment-matched prediction of the members that did not fail. If all
    failed the log-likelihood is ``-inf`` and :attr:`Flag.ALL_MODELS_VETOED` is raised.
    """
    weighed = jnp.any(active(log_weights)) & ~jnp.any(jnp.isnan(log_weights))
    joint = log_weights + member_log_likelihood(info.log_likelihood)
    vetoed = ~jnp.any(active(joint))
    evidence = jax.nn.logsumexp(jnp.where(vetoed, 0, joint))
    heard = normalise(jnp.where(active(joint) | vetoed, log_weights, -jnp.inf))
    innovation, S = moment_match(heard, Gaussian(info.innovation, info.innovation_cov))
    root = cholesky(symmetrise(S))
    whitened = solve_lower(root.factor, innovation)
    used = active(log_weights)
    raised = flags_of({Flag.ALL_MODELS_VETOED: vetoed & weighed, Flag.NO_WEIGHTS: ~weighed})
    bits = jnp.where(used, info.flags, 0)
    return Info(
        innovation=innovation,
        innovation_cov=S,
        log_likelihood=jnp.where(weighed & ~vetoed, evidence, -jnp.inf),
        nis=jnp.where(root.positive_definite, jnp.sum(whitened * whitened), 0),
        iterations=jnp.max(jnp.where(used, info.iterations, 0)),
        flags=jax.lax.reduce(bits, jnp.zeros((), jnp.int32), jax.lax.bitwise_or, (0,)) | raised,
        used=jnp.any(info.used & used[:, None], axis=0),
        refused=jnp.any(info.refused & used[:, None], axis=0),
    )
