"""The tuning of the study: its noise from innovations, its bank from supervised flights."""

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.estimation.banks.log_weights import active
from jaxnav.estimation.banks.mixture import BankParams, bank, panel
from jaxnav.estimation.banks.reset import WindowedReset, windowed_reset
from jaxnav.estimation.banks.rule import WeightRule
from jaxnav.estimation.banks.weights import bayes, chain, markov
from jaxnav.estimation.filters.kalman import kf
from jaxnav.estimation.montecarlo import RunOutput, monte_carlo
from jaxnav.estimation.run import run
from jaxnav.estimation.tune.losses import negative_log_likelihood, rmse, step_means, weigh
from jaxnav.estimation.tune.transforms import POSITIVE, UNIT, above
from jaxnav.estimation.types import Filter, FilterParams, Gaussian, SureObs, replicate
from jaxnav.navigation.models.sins_cns import SinsCnsInput, sins_cns_attitude
from jaxnav.navigation.states import ATTITUDE_LAYOUT, LAYOUT
from jaxnav.studies.base import require_one_scenario
from jaxnav.studies.immae.config import SCENARIOS, ImmaeConfig
from jaxnav.studies.immae.methods import (
    RULES,
    Member,
    attitude_errors,
    members_filter,
    panel_params,
)
from jaxnav.studies.immae.simulation import (
    World,
    build_world,
    fly_linear,
    fly_sins,
    noise_of,
    prior_sigma,
)
from jaxnav.studies.tuned import Measure, Parameter, Problem, Values
from jaxnav.units import ARCSEC


def noise_loss(config: ImmaeConfig, key: Array, runs: int) -> Callable[[Array], Array]:
    """Simulate flights and return the loss of a factor on Q0: the likelihood of their innovations.

    The flights are those of the linear chain. The filter is the autonomous attitude part, which
    sees all that the star tracker tells of the noise, at a fraction of the cost.

    Args:
        config: The study's configuration; ``duration_s`` is the length of each flight.
        key: Random key of the flights.
        runs: Number of flights.

    Returns:
        ``(factor) -> `` mean negative log-likelihood per step [nats], differentiable.
    """
    period, imu_step = config.filter_period_s, config.imu_step
    world = build_world(config)
    simulate = compiled(jax.vmap(lambda key: fly_linear(key, world, period, imu_step).z))
    flights = simulate(jax.random.split(key, runs))
    sigma = prior_sigma(config)
    sigma = jnp.concatenate([sigma[LAYOUT.phi], sigma[LAYOUT.eps]])
    initial = Gaussian(jnp.zeros(6), jnp.diag(sigma**2))
    filter = kf(sins_cns_attitude(period, imu_step))
    valid = jnp.ones(flights.shape[1:], bool)
    segment = max(1, round(config.steps**0.5))

    def loss(factor: Array) -> Array:
        params = FilterParams(noise_of(config)._replace(noise_scale=factor), initial)
        per_run = jax.vmap(
            lambda z: negative_log_likelihood(
                filter, params, world.nominal, SureObs(z, valid), segment=segment
            )
        )
        return jnp.mean(per_run(flights))

    return loss


class Flights(NamedTuple):
    """Simulated flights of the linear chain.

    Attributes:
        inputs: Inputs of the error model, those of all flights.
        z: ``(runs, K, 3) [rad]`` observations.
        phi: ``(runs, K, 3) [rad]`` true misalignment.
    """

    inputs: SinsCnsInput
    z: Array
    phi: Array


def burst(key: Array, steps: int) -> Array:
    """Draw a true factor on Q0 ``(steps,)``: one, and in one span of the flight more.

    The span begins between a tenth and half of the flight and lasts a tenth to four tenths of it;
    the factor is between 5 and 20, evenly in its logarithm.
    """
    begin, length, level = jax.random.uniform(key, (3,))
    at = jnp.arange(steps) / steps
    first = 0.1 + 0.4 * begin
    inside = (at >= first) & (at < first + 0.1 + 0.3 * length)
    return jnp.where(inside, 5 * 4**level, 1.0)


def two_bursts(steps: int) -> Array:
    """Return a factor on Q0 ``(steps,)`` of a kind that training never sees: 5 and then 20."""
    at = 20 * jnp.arange(steps) // steps
    return jnp.where((at >= 3) & (at < 7), 5.0, jnp.where((at >= 12) & (at < 15), 20.0, 1.0))


def problem(config: ImmaeConfig) -> Problem:
    """Return the tuning of the study's bank: its models, and how they switch and are reset.

    The bank has Markov switching before Bayes' rule and the paper's windowed reset after it. It
    trains on flights of the linear chain, each with a burst of noise of its own, by the RMSE of the
    attitude; it is judged on flights of ``config.chain`` with the noise of the scenario, and on
    such with two bursts. Everything runs on the autonomous attitude part of the error model, whose
    attitude and weights are those of all 15 states.

    Raises:
        ConfigError: If the scenario is "all".
    """
    require_one_scenario(config, SCENARIOS)
    world = build_world(config)
    return Problem(
        parameters=_parameters(config),
        draw=partial(_draw, config, world),
        loss=partial(_rmse, config, True),
        hard=partial(_rmse, config, False),
        held_out={
            f"{config.scenario} of the paper": partial(_judge, config, world, world.step_scale),
            "two bursts, never seen": partial(_judge, config, world, two_bursts(config.steps)),
        },
        measure=Measure(
            "mean-square", "attitude RMSE, root mean over three axes", "arcsec", ARCSEC
        ),
        fresh=True,
        notes=(
            "Q0 and theta together have one factor too many: their product is what is learned.",
        ),
    )


def _parameters(config: ImmaeConfig) -> dict[str, Parameter]:
    period = config.filter_period_s
    return {
        "q0": Parameter(jnp.ones(3), POSITIVE, "factor on the gyro's entries of Q0, by axis"),
        "theta": Parameter(jnp.array(config.theta), POSITIVE, "factors on Q0 of the models"),
        "switching": Parameter(config.switching, UNIT, "probability to switch, per step"),
        "reset_period_s": Parameter(
            config.reset_period_s, above(0.999 * period), "period of the reset [s]"
        ),
        "reset_threshold": Parameter(config.reset_threshold, UNIT, "weight that allows a reset"),
    }


@compiled(static_argnums=(0, 3))
def _draw(config: ImmaeConfig, world: World, key: Array, runs: int) -> Flights:
    def one(key: Array) -> tuple[Array, Array]:
        noise_key, key = jax.random.split(key)
        flown = world._replace(step_scale=burst(noise_key, config.steps))
        flight = fly_linear(key, flown, config.filter_period_s, config.imu_step)
        return flight.z, flight.error[:, LAYOUT.phi]

    return Flights(world.nominal, *jax.vmap(one)(jax.random.split(key, runs)))


def _bank(config: ImmaeConfig, smooth: bool) -> Filter:
    members = members_filter(config.filter_period_s, config.imu_step, sins_cns_attitude)
    return bank(members, chain(markov(), bayes(), windowed_reset(smooth=smooth)))


def _bank_params(config: ImmaeConfig, values: Values) -> BankParams:
    period = values["reset_period_s"] / config.filter_period_s
    reset = WindowedReset(period, values["reset_threshold"])
    members = attitude_members(config, values["theta"], jnp.sqrt(values["q0"]))
    return BankParams(members, (values["switching"], (), reset))


def attitude_members(config: ImmaeConfig, theta: Array, gyro: Array | float = 1.0) -> Member:
    """Return members of the attitude part with factors ``theta`` ``(M,)`` on Q0, none informed.

    Args:
        config: The configuration.
        theta: Factors on Q0.
        gyro: Factors ``(3,)`` on the standard deviations of the gyro.
    """
    noise = noise_of(config)
    noise = noise._replace(gyro_noise=gyro * noise.gyro_noise)
    sigma = prior_sigma(config)
    sigma = jnp.concatenate([sigma[LAYOUT.phi], sigma[LAYOUT.eps]])
    same = replicate(
        Member(noise, Gaussian(jnp.zeros(6), jnp.diag(sigma**2)), jnp.array(False)), theta.shape[0]
    )
    return same._replace(model=same.model._replace(noise_scale=theta))


def _attitude_error(estimate: Gaussian, phi: Array) -> Gaussian:
    part = ATTITUDE_LAYOUT.phi
    return Gaussian(estimate.mean[part] - phi, estimate.cov[part, part])


def _rmse(config: ImmaeConfig, smooth: bool, values: Values, flights: Flights) -> Array:
    """Return the RMSE of the attitude over flights [arcsec], root mean over three axes."""
    filter, params = _bank(config, smooth), _bank_params(config, values)
    terms = {"rmse": rmse(_attitude_error)}
    valid = jnp.ones(flights.z.shape[1:], bool)
    segment = max(1, round(config.steps**0.5))

    def one(z: Array, phi: Array) -> dict[str, Array]:
        observations = SureObs(z, valid)
        return step_means(filter, terms, params, flights.inputs, observations, phi, segment=segment)

    means = jax.vmap(one)(flights.z, flights.phi)
    return weigh(terms, means, {"rmse": 1 / (ARCSEC * 3**0.5)})


PANEL: dict[str, WeightRule] = {
    "hand-set": chain(markov(), bayes(), windowed_reset()),
    "immae": RULES["immae"],
    "markov": RULES["markov"],
    "oracle": RULES["oracle"],
}


def _rivals(config: ImmaeConfig) -> BankParams:
    """Return the parameters of the panel that the optimum is compared with."""
    whole = panel_params(config)
    models = len(config.theta)
    members = attitude_members(config, jnp.array([*config.theta, 1.0]))
    members = members._replace(informed=jnp.arange(models + 1) == models)
    rules = {name: whole.rule[name] for name in ("immae", "markov", "oracle")}
    reset = whole.rule["immae"][1]
    rules["hand-set"] = (whole.rule["markov"][0], (), reset)
    priors = {name: jnp.where(members.informed, -jnp.inf, 0.0) for name in PANEL}
    priors["oracle"] = jnp.where(members.informed, 0.0, -jnp.inf)
    return BankParams(members, rules, priors)


def _judge(
    config: ImmaeConfig, world: World, scale: Array, values: Values, key: Array, runs: int
) -> dict[str, np.ndarray]:
    """Return the mean square of the attitude error [rad^2] of each run, by method."""
    flown = world._replace(
        step_scale=scale,
        sample_scale=jnp.repeat(scale, config.samples_per_step),
        nominal=world.nominal._replace(true_scale=scale),
    )
    shared = (flown, _bank_params(config, values), _rivals(config))
    return monte_carlo(_comparison(config), key, runs, shared).rows


@cache
def _comparison(config: ImmaeConfig) -> Callable[[Array, Any], RunOutput]:
    """Return the run of tuned bank and rivals as a function of its key and what runs share."""
    fly = {"sins": fly_sins, "linear": fly_linear}[config.chain]
    tuned = [_bank(config, smooth) for smooth in (True, False)]
    members = members_filter(config.filter_period_s, config.imu_step, sins_cns_attitude)
    rivals = panel(members, PANEL)

    def attitude(state: Any, info: Any) -> Array:
        del info
        weights = state.log_weights
        rows = [weights[name] for name in PANEL] if isinstance(weights, dict) else [weights]
        stacked = jnp.stack(rows)
        used = jnp.where(active(stacked), jnp.exp(stacked), 0)
        return used @ state.members.x[:, ATTITUDE_LAYOUT.phi]

    def one(key: Array, shared: tuple[World, BankParams, BankParams]) -> RunOutput:
        world, own, others = shared
        flight = fly(key, world, config.filter_period_s, config.imu_step)
        observations = SureObs(flight.z, jnp.ones(world.dcm.shape[:2], bool))
        traces = [
            run(filter, params, flight.inputs, observations, record=attitude).record
            for filter, params in ((tuned[0], own), (tuned[1], own), (rivals, others))
        ]
        estimates = jnp.concatenate(traces, axis=1)
        _, error = attitude_errors(estimates, flight.error[:, LAYOUT.phi], world)
        scores = jnp.mean(error**2, axis=(0, 2))
        return RunOutput(dict(zip(("tuned", "tuned, hard rule", *PANEL), scores, strict=True)))

    return one
