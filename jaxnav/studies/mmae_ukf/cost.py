"""What a step of each method costs on its own, since the paper names the price of its bank."""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp

from jaxnav.compiling import compiled
from jaxnav.estimation.banks.imm import imm
from jaxnav.estimation.banks.mixture import BankParams, immae, mmae
from jaxnav.estimation.filters.kalman import ekf
from jaxnav.estimation.filters.sigma_point import ukf
from jaxnav.estimation.types import Filter, SureObs
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
from jaxnav.studies.mmae_ukf.simulation import build_world, fly
from jaxnav.studies.timing import RUNS, microseconds_per_step


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
    """Return the time of each method by itself [us per filter step and run]."""
    world, setup = build_world(config), setup_of(config)
    shared = shared_of(config, world)
    keys = jax.random.split(jax.random.key(config.seed), RUNS)
    flights = compiled(
        jax.vmap(lambda key: fly(key, world, setup.period, setup.imu_step, setup.star))
    )(keys)
    observations = SureObs(flights.z, jnp.ones(flights.z.shape, bool))

    def timed(name: str, filter: Filter) -> float:
        own = _params(name, shared, config.models)
        params = jax.vmap(lambda start: started(own, start))(flights.start)
        return microseconds_per_step(filter, params, flights.inputs, observations)

    costs = {name: timed(name, filter) for name, filter in alone(setup).items()}
    return {**costs, "oracle": costs["ukf"]}


def _params(name: str, shared: Shared, models: int) -> Any:
    """Return the parameters of one method by itself."""
    family = {"ekf": shared.ekf, "mmae-ekf": shared.ekf, "imm-ukf": shared.imm}
    whole = family.get(name, shared.ukf)
    if name not in BANKS:
        return jax.tree.map(lambda leaf: leaf[models], whole.members)
    members = jax.tree.map(lambda leaf: leaf[:models], whole.members)
    return BankParams(members, whole.rule if name == "imm-ukf" else whole.rule[name])
