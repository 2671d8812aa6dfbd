"""The penalty of the study's bank and its Sage-Husa filters, from supervised drives."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, float0

from jaxnav.compiling import compiled
from jaxnav.estimation.banks.mixture import BankParams, reweighed
from jaxnav.estimation.banks.rule import WeightRule
from jaxnav.estimation.banks.weights import Floor, Penalty, chain, fixed, floor, penalty
from jaxnav.estimation.filters.kalman import ekf
from jaxnav.estimation.filters.sage_husa import sage_husa
from jaxnav.estimation.montecarlo import RunOutput, monte_carlo
from jaxnav.estimation.run import run
from jaxnav.estimation.tune.transforms import POSITIVE, REAL, UNIT, between
from jaxnav.estimation.types import (
    Filter,
    FilterParams,
    Gaussian,
    Info,
    SureObs,
    replicate,
)
from jaxnav.navigation.earth import offset_between
from jaxnav.navigation.models.sins_gnss import sins_gnss
from jaxnav.studies.base import require_one_scenario
from jaxnav.studies.sage_husa.config import SCENARIOS, SageHusaConfig
from jaxnav.studies.sage_husa.methods import (
    BANKS,
    Shared,
    members_of,
    shared_of,
    taking_part,
)
from jaxnav.studies.sage_husa.simulation import (
    Run,
    World,
    build_world,
    clock_of,
    drive_run,
    informed,
)
from jaxnav.studies.tuned import Measure, Parameter, Problem, Values

RIVALS = {
    "hand-set": "proposed",
    "proposed-bayes-floor": "proposed-bayes-floor",
    "sage-husa": "sage-husa",
    "ekf": "ukf",
    "oracle": "oracle",
}
"""Methods that the optimum is compared with, and their names in the study."""
TRAINING_S = 1200.0
"""Length of a training drive [s]."""


def problem(config: SageHusaConfig) -> Problem:
    """Return the tuning of the penalty-weighted bank: weights, floor, forgetting factors.

    The rule is the paper's with a lower bound on the weights, of which the paper has none. The bank
    trains on drives of 1200 s by the RMSE of the position east and north, each drive with two
    spells of added noise of its own, and is judged on whole drives with the paper's spells, and on
    such with three others. All filters are extended ones, the rivals too: their RMSE is that of
    the study's unscented ones to 2e-6 (UKF, Sage-Husa and oracle on eight drives), at a fraction of
    the cost.

    Raises:
        ConfigError: If the scenario is "all".
    """
    require_one_scenario(config, SCENARIOS)
    training = config
    if config.duration_s > TRAINING_S:
        times = {"first_noise_s": (500.0, 600.0), "second_noise_s": (700.0, 800.0)}
        training = replace(config, duration_s=TRAINING_S, **times)
    world = build_world(config)
    return Problem(
        parameters=_parameters(config),
        draw=partial(_draw, training, build_world(training)),
        loss=partial(_rmse, training, True),
        hard=partial(_rmse, training, False),
        held_out={
            "spells of the paper": partial(_judge, config, world, world.added),
            "three spells, never seen": partial(_judge, config, world, three_spells(config.steps)),
        },
        measure=Measure("mean-square", "RMSE east and north, root mean of both", "m"),
        runs=8,
        validation_runs=8,
        steps=25,
        fresh=True,
    )


def _parameters(config: SageHusaConfig) -> dict[str, Parameter]:
    below = between(0.0, 1 / len(config.grid))
    return {
        "penalty_scale": Parameter(config.penalty_scale, POSITIVE, "scale of scale k^exponent"),
        "penalty_exponent": Parameter(
            config.penalty_exponent, REAL, "exponent of scale k^exponent"
        ),
        "normaliser": Parameter(0.0, REAL, "power of |2 pi S|^(-1/2); 1 is Bayes'"),
        "weight_floor": Parameter(config.weight_floor, below, "lower bound on a weight"),
        "forgetting": Parameter(
            jnp.array(config.forgetting), UNIT, "forgetting factors b of the members"
        ),
    }


def spells(key: Array, steps: int) -> Array:
    """Draw the standard deviation of the added noise ``(steps,) [m]``: two spells of 3 to 15 m.

    The first begins in the first third of the drive, the second half-way later; each lasts 10 to
    25 % of it.
    """
    at = jnp.arange(steps) / steps

    def one(earliest: Array, drawn: Array) -> Array:
        begin, length, level = drawn
        first = earliest + 0.2 * begin
        inside = (at >= first) & (at < first + 0.1 + 0.15 * length)
        return jnp.where(inside, 3 * 5**level, 0.0)

    drawn = jax.random.uniform(key, (2, 3))
    return jnp.max(jax.vmap(one)(jnp.array([0.05, 0.5]), drawn), axis=0)


def three_spells(steps: int) -> Array:
    """Return added noise ``(steps,) [m]`` of a kind that training never sees: 4, 12 and 7 m."""
    at = 20 * jnp.arange(steps) // steps
    return jnp.select(
        [(at >= 3) & (at < 6), (at >= 8) & (at < 10), (at >= 13) & (at < 18)], [4.0, 12.0, 7.0], 0.0
    )


@compiled(static_argnums=(0, 3))
def _draw(config: SageHusaConfig, world: World, key: Array, runs: int) -> Run:
    def one(key: Array) -> Run:
        noise_key, key = jax.random.split(key)
        spelt = world._replace(added=spells(noise_key, config.steps))
        return drive_run(key, spelt, clock_of(config))

    return jax.vmap(one)(jax.random.split(key, runs))


@cache
def _member(smooth: bool) -> Filter:
    """Return the Sage-Husa filter that a member is."""
    model = informed(sins_gnss())
    return sage_husa(ekf(model), current=True, smooth=smooth)


def _rule(smooth: bool) -> WeightRule:
    """Return the penalty with a lower bound on the weights."""
    return chain(penalty(), floor(smooth=smooth))


def _member_params(
    config: SageHusaConfig, members: Any, forgetting: Array, start: Gaussian
) -> FilterParams:
    size = len(config.grid)
    model, law = jax.tree.map(lambda leaf: leaf[:size], members)
    law = law._replace(forgetting=jnp.repeat(forgetting, len(config.q_scales)))
    own = FilterParams(model, replicate(start, size), law)
    # A function with a derivative of its own takes no NumPy arrays from a vmap inside a jit.
    return jax.tree.map(jnp.asarray, own)


def _rule_params(values: Values, smooth: bool) -> Any:
    rho = Penalty(
        values["penalty_scale"], values["penalty_exponent"], normaliser=values["normaliser"]
    )
    bound = values["weight_floor"]
    return (rho, Floor(bound) if smooth else bound)


class Watched(NamedTuple):
    """A member's run over a drive.

    Attributes:
        info: What its updates said, ``(T, ...)``.
        error: ``(T, 2) [m]`` of its position east and north.
    """

    info: Info
    error: Array


def _flown(smooth: bool, params: FilterParams, drive: Run) -> Watched:
    """Run a member over a drive."""
    member = _member(smooth)

    def record(state: Any, info: Info) -> tuple[Info, Array]:
        return info, member.estimate(state).mean.position

    info, position = run(member, params, drive.inputs, drive.fixes, record=record).record
    return Watched(info, jax.vmap(offset_between)(drive.truth.position, position)[:, :2])


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _watched(smooth: bool, params: FilterParams, drive: Run) -> Watched:
    """Run a member over a drive, with the derivative by its forgetting factor alone.

    Each member depends on its own factor and on no other parameter, so a single tangent beside its
    run is all that any gradient needs of it; reverse mode would store and undo the whole run.
    """
    return _flown(smooth, params, drive)


@_watched.defjvp
def _watched_jvp(smooth: bool, primals: Any, tangents: Any) -> tuple[Watched, Watched]:
    params, drive = primals

    def by_forgetting(forgetting: Array) -> Watched:
        own = params.own._replace(forgetting=forgetting)
        return _flown(smooth, params._replace(own=own), drive)

    at = params.own.forgetting
    whole, slope = jax.jvp(by_forgetting, (at,), (jnp.ones_like(at),))
    moved = tangents[0].own.forgetting
    return whole, jax.tree.map(lambda d: d if d.dtype == float0 else moved * d, slope)


def watch(config: SageHusaConfig, smooth: bool, values: Values, drives: Run) -> Watched:
    """Run all members over drives, leading axis ``runs``, as extended filters.

    No rule is needed, so that one run serves any number of them: see :func:`rule_rmse`. It has a
    derivative by ``values["forgetting"]`` alone.

    Returns:
        The members' runs, leading axes ``(runs, T, M)``.
    """
    members = members_of(config)

    def one(drive: Run) -> Watched:
        own = _member_params(config, members, values["forgetting"], drive.start)
        return jax.vmap(partial(_watched, smooth), (0, None), 1)(own, drive)

    return jax.vmap(one)(drives)


def rule_rmse(smooth: bool, values: Values, watched: Watched) -> Array:
    """Return the RMSE of the position [m] by a rule over members that have run.

    Root mean of east and north, over the drives.
    """
    prior = jnp.zeros(watched.error.shape[2])
    params = _rule_params(values, smooth)
    squares = jax.vmap(lambda one: _mean_square(_rule(smooth), params, prior, one))(watched)
    return jnp.sqrt(jnp.mean(squares))


def _mean_square(rule: WeightRule, params: Any, log_prior: Array, watched: Watched) -> Array:
    """Return the mean over a drive of the square of the position's error, east and north [m^2]."""
    steps = watched.error.shape[0]
    silent = SureObs(jnp.zeros((steps, 0)), jnp.zeros((steps, 0), bool))
    own = BankParams((), params, log_prior)
    segment = max(1, round(steps**0.5))
    weights = run(
        reweighed(rule), own, watched.info, silent, record=_weights, segment=segment
    ).record
    error = jnp.sum(jnp.exp(weights)[:, :, None] * watched.error, axis=1)
    return jnp.mean(error**2)


def _rmse(config: SageHusaConfig, smooth: bool, values: Values, drives: Run) -> Array:
    return rule_rmse(smooth, values, watch(config, smooth, values, drives))


def _weights(state: Any, log_weights: Array) -> Array:
    del state
    return log_weights


def _judge(
    config: SageHusaConfig, world: World, added: Array, values: Values, key: Array, runs: int
) -> dict[str, np.ndarray]:
    """Return the mean square of the position [m^2] of each run, by method."""
    shared = (shared_of(config, world._replace(added=added)), values)
    return monte_carlo(_comparison(config), key, runs, shared).rows


@cache
def _comparison(config: SageHusaConfig) -> Callable[[Array, Any], RunOutput]:
    """Return the run of tuned bank and rivals as a function of its key and what runs share."""
    chosen = np.array(taking_part(config, tuple(RIVALS.values())))
    bayesian = {name: BANKS.get(name, fixed()) for name in RIVALS.values()}

    def one(key: Array, arguments: tuple[Shared, Values]) -> RunOutput:
        shared, values = arguments
        drive = drive_run(key, shared.world, clock_of(config))
        model, law = jax.tree.map(lambda leaf: leaf[chosen], shared.members)
        others = FilterParams(model, replicate(drive.start, chosen.size), law)
        rivals = jax.vmap(partial(_flown, False), (0, None), 1)(others, drive)
        own = _member_params(config, shared.members, values["forgetting"], drive.start)
        rows = {}
        for name, smooth in (("tuned", True), ("tuned, hard rule", False)):
            tuned = jax.vmap(partial(_flown, smooth), (0, None), 1)(own, drive)
            prior = jnp.zeros(len(config.grid))
            rows[name] = _mean_square(_rule(smooth), _rule_params(values, smooth), prior, tuned)
        for name, known in RIVALS.items():
            prior = shared.log_priors[known][chosen]
            rows[name] = _mean_square(bayesian[known], shared.rules[known], prior, rivals)
        return RunOutput(rows)

    return one
