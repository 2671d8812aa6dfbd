"""What a step of each method costs on its own, since the paper names the price of its bank."""

import time
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.banks.imm import imm
from jaxnav.estimation.banks.mixture import BankParams, immae, mmae
from jaxnav.estimation.filters.kalman import ekf
from jaxnav.estimation.filters.sigma_point import ukf
from jaxnav.estimation.run import run
from jaxnav.estimation.types import Filter, Obs
from jaxnav.studies.mmae_ukf.config import MmaeUkfConfig
from jaxnav.studies.mmae_ukf.methods import (
    BANKS,
    Setup,
    Shared,
    informed,
    model_of,
    setup_of,
    shared_of,
    started,
)
from jaxnav.studies.mmae_ukf.simulation import Run, build_world, fly

RUNS = 16
STEPS = 200
REPEATS = 3


@cache
def alone(setup: Setup) -> dict[str, Filter]:
    """Return every method as a filter of its own, but for the oracle, which is a UKF."""
    model = model_of(setup)
    single = informed(ekf(model))
    unscented = informed(ukf(model, alpha=setup.alpha, beta=setup.beta, kappa=setup.kappa))
    return {
        "ekf": single,
        "ukf": unscented,
        "mmae-ekf": mmae(single),
        "mmae-ukf": mmae(unscented),
        "immae-ukf": immae(unscented),
        "imm-ukf": imm(unscented),
    }


def step_costs(config: MmaeUkfConfig) -> dict[str, float]:
    """Time each method over 16 runs at once on one device, compilation apart.

    Returns:
        Microseconds per filter step and run, the best of three.
    """
    world, setup = build_world(config), setup_of(config)
    shared = shared_of(config, world)
    keys = jax.random.split(jax.random.key(config.seed), RUNS)
    simulate = jax.jit(
        jax.vmap(lambda key: fly(key, world, setup.period, setup.imu_step, setup.star))
    )
    flights = simulate(keys)
    steps = min(STEPS, config.steps)
    flights = flights._replace(
        inputs=jax.tree.map(lambda leaf: leaf[:, :steps], flights.inputs), z=flights.z[:, :steps]
    )
    costs = {
        name: _timed(filter, _params(name, shared, config.models), flights)
        for name, filter in alone(setup).items()
    }
    return {**costs, "oracle": costs["ukf"]}


def _params(name: str, shared: Shared, models: int) -> Any:
    """Return the parameters of one method by itself."""
    family = {"ekf": shared.ekf, "mmae-ekf": shared.ekf, "imm-ukf": shared.imm}
    whole = family.get(name, shared.ukf)
    if name not in BANKS:
        return jax.tree.map(lambda leaf: leaf[models], whole.members)
    members = jax.tree.map(lambda leaf: leaf[:models], whole.members)
    return BankParams(members, whole.rule if name == "imm-ukf" else whole.rule[name])


def _timed(filter: Filter, params: Any, flights: Run) -> float:
    """Return the time per step and run [us]."""

    def one(flight: Run) -> Array:
        observations = Obs(flight.z, jnp.ones(flight.z.shape, bool))
        final = run(
            filter,
            started(params, flight.start),
            flight.inputs,
            observations,
            record=lambda state, info: info.log_likelihood,
        )
        return final.record

    compiled = jax.jit(jax.vmap(one)).lower(flights).compile()
    best = float("inf")
    for _ in range(REPEATS):
        begin = time.perf_counter()
        jax.block_until_ready(compiled(flights))
        best = min(best, time.perf_counter() - begin)
    return 1e6 * best / (flights.z.shape[0] * flights.z.shape[1])
