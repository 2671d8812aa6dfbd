"""What one step of each method takes by itself, against the period of the inertial sensors."""

from typing import Any

import jax
import jax.numpy as jnp

from jaxnav.compiling import compiled
from jaxnav.estimation.banks.mixture import BankParams, mmae
from jaxnav.estimation.filters.kalman import ekf
from jaxnav.estimation.types import Filter, FilterParams
from jaxnav.navigation.models.sins_gnss import sins_gnss
from jaxnav.studies.arekf.config import ArekfConfig
from jaxnav.studies.arekf.methods import filters, params_of, shared_of
from jaxnav.studies.arekf.simulation import build_world, fly_run, timing_of
from jaxnav.studies.timing import Latency, step_latency

TIMED = ("ekf", "liekf", "se23-ekf", "versoria-ekf", "iae", "mmae")
"""Methods with a step of their own; ``arekf`` and ``oracle`` take that of ``ekf``."""
SAME_STEP = {"arekf": "ekf", "oracle": "ekf"}


def step_latencies(config: ArekfConfig) -> dict[str, Latency]:
    """Return the latency of a single compiled step of each method, prediction and update."""
    world = build_world(config)
    shared = shared_of(config, world, config.reported)
    flight = compiled(fly_run, static_argnames="timing")(
        jax.random.key(config.seed), world, timing=timing_of(config)
    )
    single = FilterParams(shared.believed, flight.start)

    def of(name: str) -> tuple[Filter, Any]:
        if name == "ekf":
            return ekf(sins_gnss()), single
        if name == "mmae":
            scales = jnp.asarray(config.factors)[:, None]
            members = jax.tree.map(lambda x: jnp.stack([x] * len(config.factors)), single)
            noise = members.model._replace(gyro_noise=scales * single.model.gyro_noise[None])
            return mmae(ekf(sins_gnss())), BankParams(members._replace(model=noise), ())
        return filters()[name], params_of(name, flight, shared, config.factors)

    timed = {name: step_latency(*of(name), flight.inputs, flight.fixes) for name in TIMED}
    return timed | {name: timed[other] for name, other in SAME_STEP.items()}
