"""The methods of the study, and one run of all of them side by side.

The single filter, the oracle and the four banks watch the same members: five models, the single
filter's and the informed one. Each method is a weight rule over them, so the comparison costs seven
filters rather than twenty-two.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.compiling import host
from jaxnav.estimation.banks.mixture import BankParams, PanelState, moment_match, panel
from jaxnav.estimation.banks.reset import WindowedReset, windowed_reset
from jaxnav.estimation.banks.rule import WeightRule
from jaxnav.estimation.banks.weights import bayes, chain, fixed, floor, markov
from jaxnav.estimation.bounds import oracle
from jaxnav.estimation.filters.kalman import kf
from jaxnav.estimation.metrics import nees
from jaxnav.estimation.montecarlo import RunOutput
from jaxnav.estimation.run import run
from jaxnav.estimation.types import (
    Filter,
    FilterParams,
    Gaussian,
    Model,
    SureObs,
    replicate,
)
from jaxnav.navigation.models.sins_cns import SinsCnsInput, SinsCnsParams, sins_cns
from jaxnav.navigation.states import LAYOUT
from jaxnav.numerics.lie import so3_left_jacobian
from jaxnav.studies.immae.config import ImmaeConfig
from jaxnav.studies.immae.simulation import World, fly_linear, fly_sins, noise_of, prior_sigma

RULES: dict[str, WeightRule] = {
    "kf": fixed(),
    "mmae": bayes(),
    "immae": chain(bayes(), windowed_reset()),
    "floor": chain(bayes(), floor()),
    "markov": chain(markov(), bayes()),
    "oracle": fixed(),
}
METHODS = tuple(RULES)
BANKS = ("mmae", "immae", "floor", "markov")


class Member(NamedTuple):
    """Parameters of one member: those of its filter, and whether it is told the true noise."""

    model: SinsCnsParams
    initial: Gaussian
    informed: Array


class Shared(NamedTuple):
    """What all runs of a scenario share: the world and the parameters of the panel."""

    world: World
    params: BankParams


class Row(NamedTuple):
    """Statistics of one run; the leading axis of each is that of :data:`METHODS`.

    Attributes:
        mean_square: ``(methods, 3) [rad^2]`` of the errors of yaw, pitch, roll over the flight.
        nees: ``(methods,)`` time average of the attitude's NEES (three degrees of freedom).
        final_error: ``(methods,) [rad]`` norm of the attitude error at the end.
        crossing: Step, counted from 1, at which the MMAE first prefers the second model to the
            first in or after the middle third; the number of steps if never.
        returned: Whether the MMAE then prefers the first model again at the end.
    """

    mean_square: Array
    nees: Array
    final_error: Array
    crossing: Array
    returned: Array


def members_filter(
    period: float, imu_step: float, model: Callable[[float, float], Model] = sins_cns
) -> Filter:
    """Return the Kalman filter of the error model, informed where its member is told."""

    def informed(member: Member, u: SinsCnsInput) -> FilterParams:
        scale = jnp.where(member.informed, u.true_scale, member.model.noise_scale)
        return FilterParams(member.model._replace(noise_scale=scale), member.initial)

    return oracle(kf(model(period, imu_step)), informed)


def panel_params(config: ImmaeConfig) -> BankParams:
    """Return the parameters of the panel: models, single filter and informed filter."""
    theta = host.array([*config.theta, config.single_theta, 1.0])
    count = theta.shape[0]
    initial = Gaussian(host.zeros(15), host.diag(prior_sigma(config) ** 2))
    same = replicate(FilterParams(noise_of(config), initial), count)
    members = Member(
        model=same.model._replace(noise_scale=theta),
        initial=same.initial,
        informed=host.arange(count) == count - 1,
    )
    period = config.reset_period_s / config.filter_period_s
    rules: dict[str, Any] = {
        "kf": (),
        "mmae": (),
        "immae": ((), WindowedReset(host.array(period), host.array(config.reset_threshold))),
        "floor": ((), host.array(config.weight_floor)),
        "markov": (host.array(config.switching), ()),
        "oracle": (),
    }
    models = len(config.theta)
    bank = host.where(host.arange(count) < models, 0.0, -host.inf)
    alone = {
        "kf": host.where(host.arange(count) == models, 0.0, -host.inf),
        "oracle": host.where(host.arange(count) == models + 1, 0.0, -host.inf),
    }
    return BankParams(members, rules, {name: alone.get(name, bank) for name in METHODS})


def _record(state: PanelState, info: Any) -> tuple[Gaussian, Array]:
    """Keep the attitude of every method ``(methods, 3)`` and the banks' weights."""
    del info
    phi = LAYOUT.phi
    attitude = Gaussian(state.members.x[:, phi], state.members.P[:, phi, phi])
    log_weights = jnp.stack([state.log_weights[name] for name in METHODS])
    weights = jnp.exp(jnp.stack([state.log_weights[name] for name in BANKS]))
    return jax.vmap(moment_match, in_axes=(0, None))(log_weights, attitude), weights


@cache
def run_one(chain_name: str, period: float, imu_step: float, models: int) -> Any:
    """Return the run of all methods as a function of its key and :class:`Shared`.

    Args:
        chain_name: "sins" or "linear".
        period: Filter period [s].
        imu_step: Interval of the inertial samples [s].
        models: Number of models in the banks.
    """
    simulate_run = {"sins": fly_sins, "linear": fly_linear}[chain_name]
    comparison = panel(members_filter(period, imu_step), RULES)

    def run_methods(key: Array, shared: Shared) -> RunOutput:
        world, params = shared
        flight = simulate_run(key, world, period, imu_step)
        # One mask for all runs: the covariances may then be shared between them.
        observations = SureObs(flight.z, jnp.ones(world.dcm.shape[:2], bool))
        trace = run(comparison, params, flight.inputs, observations, record=_record)
        attitude, weights = trace.record
        rotation, error = attitude_errors(attitude.mean, flight.error[:, LAYOUT.phi], world)
        consistency = jax.vmap(jax.vmap(nees))(rotation, attitude.cov)
        weights = weights[:, :, :models]
        row = _row(error, consistency, weights)
        sigma = jnp.sqrt(jnp.diagonal(attitude.cov, axis1=-2, axis2=-1))
        curve = {"square": error**2, "weights": weights}
        kept = {"error": error, "weights": weights, "sigma": sigma}
        return RunOutput(row, curve, kept)

    return run_methods


def attitude_errors(estimated: Array, true: Array, world: World) -> tuple[Array, Array]:
    """Return what is left of the attitude error after correction.

    Args:
        estimated: ``(K, methods, 3) [rad]`` misalignment by each method.
        true: ``(K, 3) [rad]`` the true one.
        world: What all runs share.

    Returns:
        The rotation that is left and its errors of yaw, pitch, roll, both ``(K, methods, 3)``.
    """
    rotation = jax.vmap(_residual_rotation)(estimated, true)
    return rotation, jnp.einsum("kij,kmj->kmi", world.euler_map, rotation)[
        ..., jnp.array([1, 0, 2])
    ]


def _residual_rotation(estimated: Array, true: Array) -> Array:
    """Return the rotation ``(methods, 3)`` left after correcting ``true`` by what was estimated.

    ``log(exp(-a) exp(a + d)) = J_r(a) d`` to first order in the small ``d``; ``a`` is the large
    misalignment of an open-loop solution.
    """
    jacobian = so3_left_jacobian(-true)
    return jnp.einsum("ij,mj->mi", jacobian, true[None] - estimated)


def _row(error: Array, consistency: Array, weights: Array) -> Row:
    """Condense the histories ``(K, methods, ...)`` of one run."""
    steps, models = weights.shape[0], weights.shape[2]
    mmae = weights[:, BANKS.index("mmae")]
    second = min(1, models - 1)
    prefers = (mmae[:, second] > mmae[:, 0]) & (jnp.arange(steps) >= steps // 3)
    return Row(
        mean_square=jnp.mean(error**2, axis=0),
        nees=jnp.mean(consistency, axis=0),
        final_error=jnp.sqrt(jnp.sum(error[-1] ** 2, axis=-1)),
        crossing=jnp.where(jnp.any(prefers), jnp.argmax(prefers) + 1, steps),
        returned=jnp.any(prefers) & (mmae[-1, 0] >= mmae[-1, second]),
    )
