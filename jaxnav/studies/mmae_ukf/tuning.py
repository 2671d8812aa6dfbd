"""The tuning of the study: the noise of the bank's models and the rule of their sigma points."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.estimation.banks.mixture import BankParams, bank, panel
from jaxnav.estimation.banks.reset import WindowedReset, windowed_reset
from jaxnav.estimation.banks.rule import WeightRule
from jaxnav.estimation.banks.weights import bayes, chain
from jaxnav.estimation.filters.sigma_point import ukf
from jaxnav.estimation.montecarlo import RunOutput, monte_carlo
from jaxnav.estimation.run import run
from jaxnav.estimation.tune.losses import rmse, step_means, weigh
from jaxnav.estimation.tune.transforms import POSITIVE, above
from jaxnav.estimation.types import Filter, FilterParams, Gaussian, SureObs, replicate
from jaxnav.navigation.models.sins_total import SinsTotalInput
from jaxnav.navigation.states import LAYOUT, SinsTotal
from jaxnav.numerics.lie import so3_local
from jaxnav.numerics.sigma import unscented
from jaxnav.studies.base import require_one_scenario
from jaxnav.studies.mmae_ukf.config import SCENARIOS, STATES, MmaeUkfConfig
from jaxnav.studies.mmae_ukf.methods import (
    UKF_RULES,
    Setup,
    Shared,
    attitude_of,
    informed,
    model_factors,
    model_of,
    setup_of,
    shared_of,
    started,
)
from jaxnav.studies.mmae_ukf.simulation import World, build_world, fly, noise_of, prior_sigma
from jaxnav.studies.tuned import Measure, Parameter, Problem, Values
from jaxnav.units import ARCSEC

TRAINING_S = 30.0
"""Length of the training flights [s], of a shorter study its own."""
LEVEL = 2.5
"""Largest factor on the nominal deviations in training, and one over the smallest."""
TUNED: dict[str, WeightRule] = {
    "tuned": chain(bayes(), windowed_reset(smooth=True)),
    "tuned, hard rule": chain(bayes(), windowed_reset()),
}
RIVALS = {"hand-set": "immae-ukf", "mmae-ukf": "mmae-ukf", "ukf": "ukf", "oracle": "oracle"}
"""Methods of the study that the optimum is compared with, by what they are called here."""


class Flights(NamedTuple):
    """Simulated flights, leading axes of flights and steps.

    Attributes:
        start: The state that the filters start from, of each flight.
        inputs: Inputs of the filters.
        z: Observations.
        dcm: True attitudes.
    """

    start: SinsTotal
    inputs: SinsTotalInput
    z: Array
    dcm: Array


def problem(config: MmaeUkfConfig) -> Problem:
    """Return the tuning of IMMAE-UKF: the noise of its models, alpha and kappa of its points.

    It trains on the first :data:`TRAINING_S` of a flight, each flight with three spans and levels
    of noise of its own, by the RMSE of the attitude where the study scores it: a gradient of four
    such flights takes 5.6 s on one core, and one of whole flights would take ten times that. It is
    judged on flights of the length and the noise of the study.

    Raises:
        ConfigError: If the scenario is "all".
    """
    require_one_scenario(config, SCENARIOS)
    short = _shortened(config)
    setup = setup_of(config)
    filter = ukf(model_of(setup))
    return Problem(
        parameters=_parameters(config),
        draw=partial(_draw, setup_of(short), build_world(short)),
        loss=partial(_rmse, short, bank(filter, TUNED["tuned"])),
        hard=partial(_rmse, short, bank(filter, TUNED["tuned, hard rule"])),
        held_out={
            "flights of the study": partial(
                _judge, config, setup, shared_of(config, build_world(config))
            )
        },
        measure=Measure(
            "mean-square", "attitude RMSE, root mean over three axes", "arcsec", ARCSEC
        ),
        runs=4,
        steps=20,
        rate=0.2,
        fresh=True,
        notes=(
            "The attitude does not depend on wga; on alpha and kappa only where errors are large.",
        ),
    )


def _shortened(config: MmaeUkfConfig) -> MmaeUkfConfig:
    return replace(config, duration_s=min(config.duration_s, TRAINING_S))


def _parameters(config: MmaeUkfConfig) -> dict[str, Parameter]:
    wgt, wga = jnp.array(model_factors(config)).T
    return {
        "wgt": Parameter(wgt, POSITIVE, "factors on the gyro's deviation wgt0 of the models"),
        "wga": Parameter(wga, POSITIVE, "factors on the accelerometer's wga0 of the models"),
        "alpha": Parameter(abs(config.alpha), POSITIVE, "spread of the sigma points"),
        "kappa": Parameter(config.kappa, above(-STATES), "secondary spread"),
    }


def levels(key: Array, steps: int) -> Array:
    """Draw the true factor on the noise variances ``(steps,)`` of a flight: three levels.

    The deviation's factor is between 1 / :data:`LEVEL` and :data:`LEVEL`, evenly in its logarithm;
    it changes somewhere in the first and in the second half.
    """
    change_key, level_key = jax.random.split(key)
    at = jnp.arange(steps) / steps
    change = 0.5 * jax.random.uniform(change_key, (2,)) + jnp.array([0.0, 0.5])
    level = jax.random.uniform(level_key, (3,), minval=-1.0)
    span = jnp.sum(at[:, None] >= change[None], axis=1)
    return LEVEL ** (2 * level[span])


@compiled(static_argnums=(0, 3))
def _draw(setup: Setup, world: World, key: Array, runs: int) -> Flights:
    every = round(setup.period / setup.imu_step)

    def one(key: Array) -> Flights:
        level_key, key = jax.random.split(key)
        scale = levels(level_key, world.step_scale.shape[0])
        flown = world._replace(step_scale=scale, sample_scale=jnp.repeat(scale, every))
        flight = fly(key, flown, setup.period, setup.imu_step, setup.star)
        return Flights(flight.start, flight.inputs, flight.z, flight.truth.dcm)

    return jax.vmap(one)(jax.random.split(key, runs))


def _members(config: MmaeUkfConfig, sigma: Array, values: Values, start: SinsTotal) -> FilterParams:
    """Return the members at tuned values, ``sigma`` ``(15,)`` being those of P0."""
    noise = noise_of(config)
    count = values["wgt"].shape[0]
    rule = unscented(STATES, values["alpha"], config.beta, values["kappa"])
    alike = FilterParams(noise, Gaussian(start, jnp.diag(sigma**2)), rule)
    members = replicate(alike, count)
    model = members.model._replace(
        gyro_noise=values["wgt"][:, None] * noise.gyro_noise[None],
        accel_noise=values["wga"][:, None] * noise.accel_noise[None],
    )
    return members._replace(model=model)


def _reset(config: MmaeUkfConfig) -> WindowedReset:
    period = config.reset_period_s / config.filter_period_s
    return WindowedReset(jnp.array(period), jnp.array(config.reset_threshold))


def _attitude_error(estimate: Gaussian, truth: tuple[Array, Array]) -> Gaussian:
    dcm, counted = truth
    phi = LAYOUT.phi
    return Gaussian(
        counted * so3_local(dcm, estimate.mean.dcm),
        estimate.cov[phi, phi],
    )


def _rmse(config: MmaeUkfConfig, filter: Filter, values: Values, flights: Flights) -> Array:
    """Return the RMSE of the attitude over flights [arcsec], root mean over three axes."""
    sigma = prior_sigma(config)
    terms = {"rmse": rmse(_attitude_error)}
    steps = flights.z.shape[1]
    late = (jnp.arange(steps) >= config.scored_from).astype(flights.z.dtype)
    counted = jnp.sqrt(late / jnp.mean(late))

    def one(flight: Flights) -> dict[str, Array]:
        params = BankParams(_members(config, sigma, values, flight.start), ((), _reset(config)))
        observations = SureObs(flight.z, jnp.ones(flight.z.shape, bool))
        truth = (flight.dcm, counted)
        segment = max(1, round(steps**0.5))
        return step_means(
            filter, terms, params, flight.inputs, observations, truth, segment=segment
        )

    return weigh(terms, jax.vmap(one)(flights), {"rmse": 1 / (ARCSEC * 3**0.5)})


def _judge(
    config: MmaeUkfConfig, setup: Setup, shared: Shared, values: Values, key: Array, runs: int
) -> dict[str, np.ndarray]:
    """Return the mean square of the attitude error [rad^2] of each run, by method."""
    anywhere = jax.tree.map(lambda leaf: leaf[0], shared.ukf.members.filter.initial.mean)
    members = _members(config, shared.world.prior_sigma, values, anywhere)
    own = BankParams(members, dict.fromkeys(TUNED, ((), _reset(config))))
    return monte_carlo(_comparison(setup), key, runs, (shared.world, own, shared.ukf)).rows


@cache
def _comparison(setup: Setup) -> Callable[[Array, Any], RunOutput]:
    """Return the run of tuned bank and rivals as a function of its key and what runs share."""
    model = model_of(setup)
    single = ukf(model, alpha=setup.alpha, beta=setup.beta, kappa=setup.kappa)
    banks = panel(ukf(model), TUNED), panel(informed(single), UKF_RULES)

    def one(key: Array, arguments: tuple[World, BankParams, BankParams]) -> RunOutput:
        world, own, others = arguments
        flight = fly(key, world, setup.period, setup.imu_step, setup.star)
        count = own.members.sigma.spread.shape[0]
        initial = own.members.initial._replace(mean=replicate(flight.start, count))
        params = own._replace(members=own.members._replace(initial=initial))
        observations = SureObs(flight.z, jnp.ones(flight.z.shape, bool))

        def scores(filter: Filter, params: BankParams) -> dict[str, Array]:
            seen = run(filter, params, flight.inputs, observations, record=_attitudes).record
            return {name: score(dcm) for name, dcm in seen.items()}

        def score(dcm: Array) -> Array:
            error = jax.vmap(so3_local)(flight.truth.dcm, dcm)
            return jnp.mean(error[setup.scored_from :] ** 2)

        tuned, study = scores(banks[0], params), scores(banks[1], started(others, flight.start))
        return RunOutput(tuned | {name: study[method] for name, method in RIVALS.items()})

    return one


def _attitudes(state: Any, info: Any) -> dict[str, Array]:
    del info
    names = tuple(state.log_weights)
    mixed = attitude_of(jnp.stack([state.log_weights[name] for name in names]), state.members)
    return dict(zip(names, mixed.mean, strict=True))
