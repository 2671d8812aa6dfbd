"""The tuning of the study: random walks N per axis and the Versoria kernel, on flights."""

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.estimation.filters.robust import Versoria
from jaxnav.estimation.montecarlo import RunOutput, monte_carlo
from jaxnav.estimation.run import run
from jaxnav.estimation.tune.losses import likelihood, rmse, step_means, weigh
from jaxnav.estimation.tune.transforms import POSITIVE
from jaxnav.estimation.types import FilterParams, Gaussian, Obs
from jaxnav.navigation.models.sins_gnss import SinsGnssInput
from jaxnav.navigation.states import LAYOUT, SinsLevel
from jaxnav.numerics.lie import so3_local
from jaxnav.studies.arekf.config import DRIFTING, SCENARIOS, ArekfConfig
from jaxnav.studies.arekf.methods import Shared, filters, shared_of
from jaxnav.studies.arekf.simulation import Run, Timing, World, build_world, fly_run, timing_of
from jaxnav.studies.base import require_one_scenario
from jaxnav.studies.tuned import HeldOut, Measure, Parameter, Problem, Values
from jaxnav.units import DEG, DEG_PER_SQRT_HOUR, HOUR

RIVALS = ("hand-set", "ekf", "arekf", "robust arekf", "oracle")


class Flights(NamedTuple):
    """Simulated flights.

    Attributes:
        start: What is known at launch, of each flight.
        inputs: Inputs of the filters, leading axes of flights and steps; so have the others.
        fixes: Observations.
        truth: True states.
    """

    start: Gaussian
    inputs: SinsGnssInput
    fixes: Obs
    truth: SinsLevel


def problem(config: ArekfConfig) -> Problem:
    """Return the tuning of the Versoria filter: its random walks by axis, its width and power.

    It starts from what the filters were given, too small by ``config.reported`` in the scenarios of
    drift, and from the study's kernel, and is fitted over whole flights. Where the noise drifts the
    loss is the likelihood of the innovations, which knows each axis better than the attitude does;
    elsewhere, where outliers would spoil it, the RMSE of the attitude. A gradient of eight flights
    of 120 s takes 2 s on one core, forwards; backwards it takes minutes to compile. Nothing varies
    within a flight that could be learned by heart but for the receiver: in "outliers" each training
    flight has a share and a size of outliers of its own. Its values are also judged on a receiver
    without outliers there.

    Raises:
        ConfigError: If the scenario is "all".
    """
    require_one_scenario(config, SCENARIOS)
    world = build_world(config)
    factor = config.reported if config.scenario in DRIFTING else 1.0
    shared = shared_of(config, world, factor)
    return Problem(
        parameters=_parameters(shared),
        draw=partial(_draw, timing_of(config)._replace(steps_per_record=1), world),
        loss=partial(_loss, config, shared),
        hard=None,
        held_out=_held_out(config, shared),
        measure=Measure("mean-square", "attitude RMSE, norm over three axes", "deg", DEG),
        runs=8,
        steps=40,
        rate=0.3,
        fresh=True,
        mode="forward",
        notes=(
            "hand-set is the study's versoria-ekf; robust arekf has its kernel, arekf's noise.",
        ),
    )


def _parameters(shared: Shared) -> dict[str, Parameter]:
    given, kernel = shared.believed, shared.kernel
    arw, vrw = given.gyro_noise / DEG_PER_SQRT_HOUR, given.accel_noise * HOUR**0.5
    return {
        "arw_deg_sqrt_h": Parameter(arw, POSITIVE, "angle random walk N, by axis [deg/sqrt(h)]"),
        "vrw_m_s_sqrt_h": Parameter(vrw, POSITIVE, "velocity random walk N, by axis [m/s/sqrt(h)]"),
        "width": Parameter(kernel.width, POSITIVE, "width tau of the Versoria weights"),
        "power": Parameter(kernel.power, POSITIVE, "power p of the Versoria weights"),
    }


def spoiled(key: Array, world: World) -> World:
    """Return a world whose outliers are drawn: up to twice as many, up to three times the size."""
    often, large = jax.random.uniform(key, (2,))
    fixes = world.fixes
    return world._replace(
        fixes=fixes._replace(
            outlier_share=2 * often * fixes.outlier_share,
            outlier_scale=3 ** (2 * large - 1) * fixes.outlier_scale,
        )
    )


@compiled(static_argnums=(0, 3))
def _draw(timing: Timing, world: World, key: Array, runs: int) -> Flights:
    def one(key: Array) -> Flights:
        world_key, key = jax.random.split(key)
        flight = fly_run(key, spoiled(world_key, world), timing)
        return Flights(flight.start, flight.inputs, flight.fixes, flight.truth)

    return jax.vmap(one)(jax.random.split(key, runs))


def _params(shared: Shared, values: Values, start: Gaussian) -> FilterParams:
    noise = shared.believed._replace(
        gyro_noise=values["arw_deg_sqrt_h"] * DEG_PER_SQRT_HOUR,
        accel_noise=values["vrw_m_s_sqrt_h"] / HOUR**0.5,
    )
    return FilterParams(noise, start, Versoria(values["width"], values["power"]))


def _attitude_error(estimate: Gaussian, truth: SinsLevel) -> Gaussian:
    phi = LAYOUT.phi
    return Gaussian(so3_local(truth.dcm, estimate.mean.dcm), estimate.cov[phi, phi])


def _counted(steps: int, period: Array, settle: Array) -> Array:
    """Return the weight ``(steps,)`` of each step in a mean: none before the filter has settled."""
    late = (period * jnp.arange(1, steps + 1, dtype=period.dtype) > settle).astype(period.dtype)
    return late / jnp.mean(late)


def _loss(config: ArekfConfig, shared: Shared, values: Values, flights: Flights) -> Array:
    """Return the loss over flights: nats per step, or the RMSE of the attitude [deg]."""

    def error(estimate: Gaussian, now: tuple[SinsLevel, Array]) -> Gaussian:
        truth, weight = now
        e, P = _attitude_error(estimate, truth)
        return Gaussian(jnp.sqrt(weight) * e, P)

    drifting = config.scenario in DRIFTING
    terms = {"loss": likelihood() if drifting else rmse(error)}
    weight = _counted(config.steps, flights.inputs.dt[0, 0], shared.settle)

    def one(flight: Flights) -> dict[str, Array]:
        return step_means(
            filters()["versoria-ekf"],
            terms,
            _params(shared, values, flight.start),
            flight.inputs,
            flight.fixes,
            (flight.truth, weight),
        )

    return weigh(terms, jax.vmap(one)(flights), {"loss": 1.0 if drifting else 1 / DEG})


def _held_out(config: ArekfConfig, shared: Shared) -> dict[str, HeldOut]:
    timing = timing_of(config)
    found: dict[str, HeldOut] = {"flights of the study": partial(_judge, timing, shared)}
    if config.scenario == "outliers":
        clean = shared.world.fixes._replace(outlier_share=jnp.array(0.0))
        world = shared.world._replace(fixes=clean)
        found["receiver without outliers"] = partial(_judge, timing, shared._replace(world=world))
    return found


def _judge(
    timing: Timing, shared: Shared, values: Values, key: Array, runs: int
) -> dict[str, np.ndarray]:
    """Return the mean square of the attitude error [rad^2] of each run, by method."""
    return monte_carlo(_comparison(timing), key, runs, (shared, values)).rows


@cache
def _comparison(timing: Timing) -> Callable[[Array, Any], RunOutput]:
    """Return the run of the optimum and its rivals as a function of its key and what runs share."""
    filter = filters()["versoria-ekf"]

    def dcm(state: Any, info: Any) -> Array:
        del info
        return filter.estimate(state).mean.dcm

    def one(key: Array, arguments: tuple[Shared, Values]) -> RunOutput:
        shared, _ = arguments
        flight = fly_run(key, shared.world, timing)
        together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *_methods(flight, *arguments))

        def score(method: tuple[Array, Array, Versoria]) -> Array:
            gyro, accel, kernel = method
            noise = shared.believed._replace(gyro_noise=gyro, accel_noise=accel)
            params = FilterParams(noise, flight.start, kernel)
            every = timing.steps_per_record
            seen = run(filter, params, flight.inputs, flight.fixes, record=dcm, every=every).record
            error = jax.vmap(so3_local)(flight.truth.dcm, seen)
            period = jnp.array(every * timing.clock.step)
            weight = _counted(seen.shape[0], period, shared.settle)
            return jnp.mean(weight * jnp.sum(error**2, axis=1))

        scores = jax.vmap(score)(together)
        return RunOutput(dict(zip(("tuned", *RIVALS), scores, strict=True)))

    return one


def _methods(flight: Run, shared: Shared, values: Values) -> list[tuple[Array, Array, Versoria]]:
    """Return noise and kernel of the optimum and its rivals, each of them a Versoria filter.

    One of no width is the plain filter.
    """
    tuned = _params(shared, values, flight.start)
    given, true, kernel = shared.believed, shared.world.noise, shared.kernel
    plain = kernel._replace(width=jnp.zeros_like(kernel.width))
    walks = {"given": given, "true": true}
    own = {name: (noise.gyro_noise, noise.accel_noise) for name, noise in walks.items()}
    return [
        (tuned.model.gyro_noise, tuned.model.accel_noise, tuned.own),
        (*own["given"], kernel),
        (*own["given"], plain),
        (*flight.identified, plain),
        (*flight.identified, kernel),
        (*own["true"], plain),
    ]
