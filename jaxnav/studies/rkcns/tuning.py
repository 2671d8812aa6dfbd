"""The tuning of the study: the noise of refraction that a filter believes, and its longest step."""

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.estimation.montecarlo import RunOutput, monte_carlo
from jaxnav.estimation.run import run
from jaxnav.estimation.tune.losses import rmse, step_means, weigh
from jaxnav.estimation.tune.transforms import POSITIVE
from jaxnav.estimation.types import FilterParams, Gaussian, Obs
from jaxnav.navigation.models.sins_rkcns import SinsRkcnsInput
from jaxnav.navigation.states import LAYOUT
from jaxnav.studies.base import require_one_scenario
from jaxnav.studies.rkcns.config import SCENARIOS, RkcnsConfig
from jaxnav.studies.rkcns.methods import Setup, Shared, filters, problem_of, setup_of, shared_of
from jaxnav.studies.rkcns.simulation import build_world, fly_run
from jaxnav.studies.tuned import Measure, Parameter, Problem, Values
from jaxnav.units import ARCSEC

METHOD = "modified-iterated-ckf"
RIVALS = {"hand-set": METHOD, "ckf": "ckf", "oracle": "oracle"}
"""Methods of the study that the optimum is compared with, by what they are called here."""
TEMPERATURE = 1.0
"""Of the smooth line search, in units of its functional: that of one squared standard deviation."""


class Flights(NamedTuple):
    """Simulated flights, leading axes of flights and steps.

    Attributes:
        start: What dead reckoning knows when the filters start, of each flight.
        inputs: Inputs of the filters.
        observations: Observations.
        position: True positions.
    """

    start: Gaussian
    inputs: SinsRkcnsInput
    observations: Obs
    position: Array


def problem(config: RkcnsConfig) -> Problem:
    """Return the tuning of the modified iterated filter: the noise it believes, its longest step.

    It trains by the RMSE of the position over whole flights, with a smooth line search: a gradient
    of eight flights takes 3.5 s on one core, forwards. The hand-set noise is the true one. Nothing
    varies within a flight that could be learned by heart: the errors of launch, sensors and, in
    "strong-nonlinearity", the lost position are drawn for each.

    Raises:
        ConfigError: If the scenario is "all".
        DataError: If the star table is missing or malformed.
    """
    require_one_scenario(config, SCENARIOS)
    setup = setup_of(config, (METHOD,))
    shared = shared_of(config, build_world(config))
    text = "standard deviation of a refraction angle that the filter believes [arcsec]"
    return Problem(
        parameters={
            "refraction_noise_arcsec": Parameter(config.refraction_noise, POSITIVE, text),
            "step": Parameter(shared.search.step, POSITIVE, "longest step of the line search"),
        },
        draw=partial(_draw, setup, shared),
        loss=partial(_rmse, setup, shared, TEMPERATURE),
        hard=partial(_rmse, setup, shared, 0.0),
        held_out={"flights of the study": partial(_judge, config, shared)},
        measure=Measure("mean-square", "position RMSE, norm over three axes", "m"),
        runs=8,
        steps=25,
        rate=0.1,
        fresh=True,
        mode="forward",
        notes=("The hand-set noise is that of the simulated angles.",),
    )


@compiled(static_argnums=(0, 3))
def _draw(setup: Setup, shared: Shared, key: Array, runs: int) -> Flights:
    def one(key: Array) -> Flights:
        flight = fly_run(key, shared.world, setup.timing)
        params, inputs, observations = problem_of(METHOD, flight, shared)
        return Flights(params.initial, inputs, observations, flight.truth.position)

    return jax.vmap(one)(jax.random.split(key, runs))


def _params(
    shared: Shared, temperature: Array | float, values: Values, start: Gaussian
) -> FilterParams:
    noise = values["refraction_noise_arcsec"] * ARCSEC
    search = shared.search._replace(step=values["step"], temperature=temperature)
    return FilterParams(shared.limb._replace(refraction_noise=noise), start, search)


def _position_error(estimate: Gaussian, position: Array) -> Gaussian:
    dr = LAYOUT.dr
    return Gaussian(estimate.mean.position - position, estimate.cov[dr, dr])


def _rmse(
    setup: Setup, shared: Shared, temperature: float, values: Values, flights: Flights
) -> Array:
    """Return the RMSE of the position over flights [m], the norm over three axes."""
    filter, terms = filters(setup)[METHOD], {"rmse": rmse(_position_error)}
    segment = max(1, round(flights.position.shape[1] ** 0.5))

    def one(flight: Flights) -> dict[str, Array]:
        params = _params(shared, temperature, values, flight.start)
        given = (params, flight.inputs, flight.observations, flight.position)
        return step_means(filter, terms, *given, segment=segment)

    return weigh(terms, jax.vmap(one)(flights), {"rmse": 1.0})


def _judge(
    config: RkcnsConfig, shared: Shared, values: Values, key: Array, runs: int
) -> dict[str, np.ndarray]:
    """Return the mean square of the position error [m^2] of each run, by method."""
    setup = setup_of(config, tuple(RIVALS.values()))
    return monte_carlo(_comparison(setup), key, runs, (shared, values)).rows


@cache
def _comparison(setup: Setup) -> Callable[[Array, Any], RunOutput]:
    """Return the run of the optimum and its rivals as a function of its key and what runs share."""
    chosen = filters(setup)

    def one(key: Array, arguments: tuple[Shared, Values]) -> RunOutput:
        shared, values = arguments
        flight = fly_run(key, shared.world, setup.timing)

        def score(method: str, params: FilterParams) -> Array:
            _, inputs, observations = problem_of(method, flight, shared)
            filter = chosen[method]
            seen = run(filter, params, inputs, observations, record=_position).record
            return jnp.mean(jnp.sum((seen - flight.truth.position) ** 2, axis=1))

        # One program for the three sets of values of the same filter.
        own = [_params(shared, soft, values, flight.start) for soft in (TEMPERATURE, 0.0)]
        own.append(problem_of(METHOD, flight, shared)[0])
        together = jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(x) for x in leaves]), *own)
        names = ("tuned", "tuned, hard rule", "hand-set")
        same = jax.vmap(partial(score, METHOD))(together)
        others = {
            name: score(method, problem_of(method, flight, shared)[0])
            for name, method in RIVALS.items()
            if method != METHOD
        }
        return RunOutput({**dict(zip(names, same, strict=True)), **others})

    return one


def _position(state: Any, info: Any) -> Array:
    del info
    return state.x.position
