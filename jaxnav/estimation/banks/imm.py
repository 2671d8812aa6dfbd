"""The interacting multiple model filter: a bank whose members start each step from a mixture."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.arguments import require_number, require_whole
from jaxnav.estimation.banks.log_weights import active
from jaxnav.estimation.banks.mixture import (
    BankParams,
    BankState,
    bank,
    likeliest,
    require_bank_params,
)
from jaxnav.estimation.banks.weights import bayes, switched
from jaxnav.estimation.checks import require_log_prior, require_members, require_transition_matrix
from jaxnav.estimation.types import Filter, Gaussian, Info, Input, Obs, accept


def imm(filter: Filter) -> Filter:
    """Return the interacting multiple model filter, with parameters :class:`BankParams`.

    The rule's parameter is the transition matrix ``Pi`` ``(M, M)``, rows summing to one
    (:func:`imm_params` checks it). A step mixes the members' estimates, predicts and updates each,
    and weighs them by Bayes' rule:

        mu_ij = w_i Pi_ij / c_j,   c_j = sum_i w_i Pi_ij
        x0_j = sum_i mu_ij x_i,    P0_j = sum_i mu_ij (P_i + (x_i - x0_j)(x_i - x0_j)')

    all in log-weights; on a manifold the sums are taken in the tangent space at the likeliest
    member, as in :func:`~jaxnav.estimation.banks.mixture.moment_match`. The identity as ``Pi``
    gives :func:`~jaxnav.estimation.banks.mixture.mmae`; one model gives the filter.

    Raises:
        ValueError: In a run, if ``Pi`` has not the size of the bank.

    References:
        Blom and Bar-Shalom (1988), IEEE Trans. Automatic Control 33(8); Bar-Shalom, Li, Kirubarajan
        (2001), section 11.6.6.
    """
    base = bank(filter, bayes())

    def weighed(params: BankParams) -> BankParams:
        return params._replace(rule=())

    def check(params: BankParams) -> None:
        count = require_bank_params(filter, params)
        require_transition_matrix(params.rule, count)
        require_log_prior(params.log_prior, count)

    def init(params: BankParams) -> BankState:
        return base.init(weighed(params))

    def predict(params: BankParams, state: BankState, u: Input) -> BankState:
        log_weights, origins = switched(state.log_weights, params.rule)
        mixed = mix(origins, state.log_weights, jax.vmap(filter.estimate)(state.members), filter)
        members = jax.vmap(filter.restart)(state.members, mixed)
        moved = state._replace(members=members, log_weights=log_weights)
        return base.predict(weighed(params), moved, u)

    def update(params: BankParams, state: BankState, u: Input, obs: Obs) -> tuple[BankState, Info]:
        return base.update(weighed(params), state, u, obs)

    return base._replace(init=init, predict=predict, update=update, check=check)


def imm_params(members: Any, transition: Array, log_prior: Any = None) -> BankParams:
    """Return the parameters of :func:`imm` after a check of the transition matrix.

    Args:
        members: The filter's parameters with a leading model axis ``M`` on every leaf.
        transition: ``(M, M)`` probabilities to go from row to column.
        log_prior: As in :class:`BankParams`.

    Raises:
        ValueError: If the members have no common model axis, or the matrix has another size, a
            negative entry, or a row that does not sum to one.
    """
    count = require_members(accept, members)
    require_transition_matrix(transition, count)
    require_log_prior(log_prior, count)
    return BankParams(members, transition, log_prior)


def uniform_switching(count: int, probability: Array | float) -> Array:
    """Return the transition matrix ``(count, count)`` of equal probabilities to go elsewhere.

    Args:
        count: Number of models.
        probability: To leave a model in a step, in [0, 1].

    Raises:
        ValueError: If a concrete probability is outside its domain.
    """
    count = require_whole("count", count, 1)
    require_number("the probability to leave a model", probability, "[0, 1]", 0, 1)
    away = probability / max(count - 1, 1)
    stay = 1 - probability if count > 1 else 1.0
    return jnp.where(jnp.eye(count, dtype=bool), stay, away)


def mix(origins: Array, log_weights: Array, members: Gaussian, filter: Filter) -> Gaussian:
    """Return the mixed estimate that each member starts from, with a leading axis ``M``.

    A member that takes no part starts from the reference, with no covariance: nothing asks for it.

    Args:
        origins: ``(M, M)`` log-probabilities of the members' pasts, columns summing to one.
        log_weights: ``(M,)`` before the step.
        members: Their estimates, leading axis ``M``.
        filter: The members' filter, for its manifold.
    """
    used = active(log_weights)
    reference = likeliest(log_weights, members.mean)
    offsets = jax.vmap(filter.local, in_axes=(None, 0))(reference, members.mean)
    offsets = jnp.where(used[:, None], offsets, 0)
    covs = jnp.where(used[:, None, None], members.cov, 0)
    share = jnp.exp(origins).T
    mean = share @ offsets
    spread = offsets[None] - mean[:, None]
    within = (share @ covs.reshape(used.shape[0], -1)).reshape(covs.shape)
    between = jnp.swapaxes(share[..., None] * spread, 1, 2) @ spread
    means = jax.vmap(filter.retract, in_axes=(None, 0))(reference, mean)
    return Gaussian(means, within + between)
