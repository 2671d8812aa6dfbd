"""The methods of the study: weight rules over one set of members, and one run of them."""

from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.compiling import host
from jaxnav.estimation.banks.mixture import BankParams, PanelState, panel
from jaxnav.estimation.banks.rule import WeightRule
from jaxnav.estimation.banks.weights import Penalty, bayes, chain, fixed, floor, penalty
from jaxnav.estimation.filters.sage_husa import SageHusa, sage_husa
from jaxnav.estimation.filters.sigma_point import ukf
from jaxnav.estimation.metrics import nees
from jaxnav.estimation.montecarlo import RunOutput
from jaxnav.estimation.run import run
from jaxnav.estimation.types import Filter, FilterParams, Gaussian, replicate
from jaxnav.navigation.earth import displaced, offset_between
from jaxnav.navigation.models.sins_gnss import sins_gnss
from jaxnav.navigation.sense import Clock
from jaxnav.navigation.states import LAYOUT
from jaxnav.studies.sage_husa.config import WINDOWS_S, SageHusaConfig
from jaxnav.studies.sage_husa.simulation import (
    DriveParams,
    Run,
    World,
    clock_of,
    drive_run,
    informed,
    noise_of,
    within,
)

AXES = ("east", "north")
BANKS: dict[str, WeightRule] = {
    "exponential-decay": penalty(),
    "proposed": penalty(),
    "unnormalised-floor": chain(penalty(), floor()),
    "proposed-bayes": bayes(),
    "proposed-bayes-floor": chain(bayes(), floor()),
}
"""Weight rules over the Sage-Husa filters of the grid."""
ORACLES = ("oracle-r", "oracle")
"""The filter that is told the true R, and the one that is told the true Q as well."""
HORIZONTAL = slice(LAYOUT.dr.start, LAYOUT.dr.start + 2)


def single(config: SageHusaConfig, forgetting: float) -> str:
    """Return the name of the single Sage-Husa filter with a forgetting factor."""
    chosen = forgetting == config.single_forgetting
    return "sage-husa" if chosen else f"sage-husa-{forgetting:g}"


def constant(forgetting: float) -> str:
    """Return the name of that of Experiment 1, whose ``d`` is constant and whose R starts wrong."""
    return f"constant-{forgetting:g}"


def methods_of(config: SageHusaConfig) -> tuple[str, ...]:
    """Return the names of the estimators, in the order of their axis."""
    singles = (single(config, b) for b in config.forgetting)
    of_experiment_1 = (constant(b) for b in config.forgetting)
    return ("ukf", *singles, "mmae", *BANKS, *ORACLES, *of_experiment_1)


class Setup(NamedTuple):
    """What fixes the shape of a run: the static part of a configuration.

    Attributes:
        clock: Rates.
        methods: Names of the estimators.
        size: Members of the bank; they come first.
    """

    clock: Clock
    methods: tuple[str, ...]
    size: int


class Shared(NamedTuple):
    """What all runs share: the world, the members, and who takes part in what.

    Attributes:
        world: The world.
        members: Parameters of the members without what is known at the start, leading axis ``M``.
        rules: Parameters of the weight rules by name.
        log_priors: ``(M,)`` log-weights at the start by name.
        spans: ``(intervals, 2) [s]`` of Table 4, then those of Experiment 1.
    """

    world: World
    members: tuple[DriveParams, SageHusa]
    rules: dict[str, Any]
    log_priors: dict[str, Array]
    spans: Array


class Row(NamedTuple):
    """Statistics of one run; the leading axis of each is that of the methods.

    Attributes:
        mean_square: ``(methods, intervals, 2) [m^2]`` of the errors east and north.
        nees: ``(methods, intervals)`` mean NEES of the horizontal position.
        final_square: ``(methods,) [m^2]`` squared horizontal error at the end.
    """

    mean_square: Array
    nees: Array
    final_square: Array


def setup_of(config: SageHusaConfig) -> Setup:
    """Return the static part of a configuration."""
    return Setup(clock_of(config), methods_of(config), len(config.grid))


class _Member(NamedTuple):
    """One member of the panel, and the methods that it takes part in."""

    vrw: float
    q_scale: float
    r_scale: float
    knows: float
    law: SageHusa
    methods: tuple[str, ...]


def _members(config: SageHusaConfig) -> list[_Member]:
    """Return the members: Sage-Husa filters of the grid, fixed ones, those of Experiment 1.

    A fixed filter is a Sage-Husa filter that starts with infinitely many samples of its R.
    """
    believed, law = config.vrw_believed, SageHusa(prior_count=config.prior_count)
    law = law._replace(low=config.clamp[0], high=config.clamp[1])
    still = law._replace(forgetting=1.0, prior_count=np.inf)
    members = [
        _Member(
            believed,
            q,
            1.0,
            0.0,
            law._replace(forgetting=b),
            (*BANKS, single(config, b)) if q == 1 else tuple(BANKS),
        )
        for b, q in config.grid
    ]
    for r in config.r_scales:
        methods = ("mmae", "ukf") if r == 1 else ("mmae",)
        members.append(_Member(believed, 1.0, r, 0.0, still, methods))
    for vrw, name in zip((believed, config.true_vrw), ORACLES, strict=True):
        members.append(_Member(vrw, 1.0, 1.0, 1.0, still, (name,)))
    for b in config.forgetting:
        own = law._replace(forgetting=b, prior_count=np.inf)
        members.append(_Member(believed, 1.0, config.start_r, 0.0, own, (constant(b),)))
    return members


def shared_of(config: SageHusaConfig, world: World) -> Shared:
    """Return what all runs share."""
    listed = _members(config)
    names = methods_of(config)
    decaying = Penalty(
        config.penalty_scale - config.decay_least,
        0.0,
        config.decay_steps,
        config.decay_least,
    )
    growing = Penalty(config.penalty_scale, config.penalty_exponent)
    bound = host.array(config.weight_floor)
    rules: dict[str, Any] = dict.fromkeys(names, ()) | {
        "exponential-decay": _arrays(decaying),
        "proposed": _arrays(growing),
        "unnormalised-floor": (_arrays(Penalty(0.5, 0.0)), bound),
        "proposed-bayes-floor": ((), bound),
    }
    log_priors = {
        name: host.where(host.array([name in member.methods for member in listed]), 0.0, -host.inf)
        for name in names
    }
    return Shared(
        world,
        members_of(config),
        rules,
        log_priors,
        host.array([*config.intervals_s, *WINDOWS_S]),
    )


def taking_part(config: SageHusaConfig, names: tuple[str, ...]) -> list[int]:
    """Return the indices of the members that take part in any of some methods."""
    listed = enumerate(_members(config))
    return [i for i, member in listed if any(name in member.methods for name in names)]


def members_of(config: SageHusaConfig) -> tuple[DriveParams, SageHusa]:
    """Return the parameters of all members, leading axis ``M``; those of the grid come first."""
    rows = [(_params_of(config, member), _arrays(member.law)) for member in _members(config)]
    return _stacked(rows)


def _params_of(config: SageHusaConfig, member: _Member) -> DriveParams:
    """Return the model's parameters of a member; in Experiment 1 all of R starts wrong."""
    noise = noise_of(config, member.vrw)
    horizontal = host.array([1.0, 1.0, 0.0])
    wrong = any(name == constant(b) for b in config.forgetting for name in member.methods)
    grown = host.sqrt(member.r_scale)
    position = grown if wrong else 1 + (grown - 1) * horizontal
    own = noise._replace(
        accel_noise=noise.accel_noise * host.sqrt(member.q_scale),
        position_noise=noise.position_noise * position,
        velocity_noise=noise.velocity_noise * (grown if wrong else 1.0),
    )
    return DriveParams(own, host.array(member.knows))


def _arrays(numbers: Any) -> Any:
    return jax.tree.map(host.asarray, numbers)


def _stacked(trees: list[Any]) -> Any:
    return jax.tree.map(lambda *leaves: host.stack(leaves), *trees)


@cache
def member_of() -> Filter:
    """Return the filter that all members are."""
    return sage_husa(ukf(informed(sins_gnss())), current=True)


@cache
def filter_of(methods: tuple[str, ...]) -> Filter:
    """Return the panel of all methods."""
    bayesian = {"mmae": bayes()} | BANKS
    return panel(member_of(), {name: bayesian.get(name, fixed()) for name in methods})


@cache
def run_one(setup: Setup) -> Any:
    """Return the run of all methods as a function of its key and :class:`Shared`."""
    filter = filter_of(setup.methods)

    def run_methods(key: Array, shared: Shared) -> RunOutput:
        now = drive_run(key, shared.world, setup.clock)
        params = params_of(now.start, shared)

        def record(state: PanelState, info: Any) -> Any:
            del info
            logs = jnp.stack([state.log_weights[name] for name in setup.methods])
            position, cov = horizontal(logs, jax.vmap(member_of().estimate)(state.members))
            weights = jnp.stack([jnp.exp(state.log_weights[name]) for name in BANKS])
            variance = jnp.diagonal(state.members.noise, axis1=1, axis2=2)[: setup.size, 3:5]
            return position, cov, weights[:, : setup.size], variance

        found = run(filter, params, now.inputs, now.fixes, record=record).record
        return judge(now, found, shared, setup)

    return run_methods


def horizontal(log_weights: Array, members: Gaussian) -> Gaussian:
    """Return horizontal positions of mixtures, all from the first member's.

    What the panel's estimate says of them, at a tenth of its cost: that matches the moments of all
    15 states, method by method.

    Args:
        log_weights: ``(methods, M)``.
        members: The members' estimates, leading axis ``M``; errors in position are additive.

    Returns:
        ``(methods, 3)`` geodetic positions, and ``(methods, 2, 2) [m^2]``.
    """
    first = members.mean.position[0]
    offset = jax.vmap(offset_between, in_axes=(None, 0))(first, members.mean.position)
    cov = members.cov[:, HORIZONTAL, HORIZONTAL]
    second = cov + offset[:, :2, None] * offset[:, None, :2]
    w = jnp.exp(log_weights)
    count = w.shape[1]
    mean = w @ offset
    spread = (w @ second.reshape(count, 4)).reshape(-1, 2, 2)
    cov = spread - mean[:, :2, None] * mean[:, None, :2]
    return Gaussian(jax.vmap(displaced, in_axes=(None, 0))(first, mean), cov)


def params_of(start: Gaussian, shared: Shared) -> BankParams:
    """Return the parameters of the panel in a run."""
    model, law = shared.members
    count = model.own.gyro_noise.shape[0]
    members = FilterParams(model, replicate(start, count), law)
    return BankParams(members, shared.rules, shared.log_priors)


def judge(now: Run, found: tuple[Array, ...], shared: Shared, setup: Setup) -> RunOutput:
    """Compare estimates with the truth.

    Args:
        now: The run.
        found: Positions ``(T, methods, 3)`` and their horizontal covariances, weights of the banks
            ``(T, banks, members)`` and variances in the units of R ``(T, members, 2)``.
        shared: What all runs share.
        setup: The static part.
    """
    position, cov, weights, variance = found
    offset = jax.vmap(jax.vmap(offset_between, in_axes=(None, 0)))(now.truth.position, position)
    error = offset[:, :, :2]
    squares = error**2
    consistency = jax.vmap(jax.vmap(nees))(error, cov)
    time = setup.clock.step * jnp.arange(1, squares.shape[0] + 1, dtype=squares.dtype)
    inside = jax.vmap(lambda span: within(time, span))(shared.spans).astype(squares.dtype)
    share = inside / jnp.maximum(jnp.sum(inside, axis=1), 1)[:, None]
    row = Row(
        mean_square=jnp.einsum("it,tma->mia", share, squares),
        nees=jnp.einsum("it,tm->mi", share, consistency),
        final_square=jnp.sum(squares[-1], axis=1),
    )
    curve = {"square": squares, "weights": weights, "variance": variance}
    trace = {"error": error, "weights": weights, "variance": variance}
    trace["sigma"] = jnp.sqrt(jnp.diagonal(cov, axis1=2, axis2=3))
    return RunOutput(row, curve, trace)
