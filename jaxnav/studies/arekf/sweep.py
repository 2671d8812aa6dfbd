"""One EKF whose measurement noise is mis-set by factors: the paper's first experiment."""

from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.banks.mixture import BankParams, panel
from jaxnav.estimation.banks.weights import fixed
from jaxnav.estimation.filters.kalman import ekf
from jaxnav.estimation.montecarlo import Campaign, RunOutput, monte_carlo
from jaxnav.estimation.run import run
from jaxnav.estimation.types import FilterParams, replicate
from jaxnav.navigation.models.sins_gnss import sins_gnss
from jaxnav.studies.arekf.config import ArekfConfig
from jaxnav.studies.arekf.methods import (
    Setup,
    Shared,
    judge_all,
    record_estimate,
    setup_of,
    shared_of,
)
from jaxnav.studies.arekf.simulation import Run, build_world, fly_run


def labels_of(config: ArekfConfig) -> tuple[str, ...]:
    """Return the names of the filters by the factor on what they believe."""
    return tuple(f"ekf-{factor:g}" for factor in config.r_factors)


def run_sweep(config: ArekfConfig, **options: Any) -> Campaign:
    """Run the Monte Carlo; options are those of ``monte_carlo``."""
    shared = shared_of(config, build_world(config), 1.0)
    one = _run_one(setup_of(config), config.r_factors)
    key = jax.random.key(config.seed)
    return monte_carlo(one, key, config.runs, shared, **options)


@cache
def _run_one(setup: Setup, factors: tuple[float, ...]) -> Any:
    """Return the run of all filters as a function of its key and :class:`Shared`."""
    names = tuple(f"{factor:g}" for factor in factors)
    filter = panel(ekf(sins_gnss()), {name: fixed() for name in names})

    def run_filters(key: Array, shared: Shared) -> RunOutput:
        flight = fly_run(key, shared.world, setup.timing)
        estimates = run(
            filter,
            _params(names, factors, flight, shared),
            flight.inputs,
            flight.fixes,
            record=partial(record_estimate, filter),
            every=setup.timing.steps_per_record,
        ).record
        in_order = {name: estimates[name] for name in names}
        return judge_all(flight, in_order, shared, setup)

    return run_filters


def _params(
    names: tuple[str, ...], factors: tuple[float, ...], flight: Run, shared: Shared
) -> BankParams:
    members = replicate(FilterParams(shared.believed, flight.start), len(names))
    believed = members.model
    factor = jnp.asarray(factors, believed.position_noise.dtype)[:, None]
    noise = believed._replace(
        velocity_noise=factor * believed.velocity_noise,
        position_noise=factor * believed.position_noise,
    )
    index = jnp.arange(len(names))
    priors = {name: jnp.where(index == i, 0.0, -jnp.inf) for i, name in enumerate(names)}
    return BankParams(members._replace(model=noise), dict.fromkeys(names, ()), priors)
