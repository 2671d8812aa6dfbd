"""How the single filters settle after an initial attitude error of a few to many degrees."""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.compiling import host
from jaxnav.estimation.filters.kalman import ekf
from jaxnav.estimation.filters.sigma_point import ukf
from jaxnav.estimation.montecarlo import RunOutput, monte_carlo
from jaxnav.estimation.run import run
from jaxnav.estimation.types import Filter, FilterParams, Gaussian, SureObs
from jaxnav.navigation.models.sins_total import StarForm
from jaxnav.navigation.states import LAYOUT
from jaxnav.numerics.lie import so3_local
from jaxnav.studies.mmae_ukf.config import MmaeUkfConfig
from jaxnav.studies.mmae_ukf.methods import Setup, model_of, setup_of, steps_outside
from jaxnav.studies.mmae_ukf.simulation import World, build_world, fly
from jaxnav.units import DEG

ANGLES_DEG = (5.0, 10.0, 15.0, 20.0, 25.0, 30.0)
FORMS: tuple[StarForm, ...] = ("euler", "rotation-vector")
FILTERS = ("ekf", "ukf")
LENGTH_S = 10.0
"""Length of the flights; what has not settled by then counts as not settled."""


def settling_times(config: MmaeUkfConfig) -> np.ndarray:
    """Return when the attitude error came within the band for good [s].

    Args:
        config: The configuration of "large-misalignment".

    Returns:
        ``(forms, angles, filters, runs)``; where it did not, the length of the flight:
        :data:`LENGTH_S`, or the configuration's if that is shorter.
    """
    steps = min(config.steps, max(1, round(LENGTH_S / config.filter_period_s)))
    world = build_world(config)
    short = world._replace(
        trajectory=_cut(world.trajectory, steps * config.samples_per_step),
        epochs=jax.tree.map(lambda leaf: leaf[:steps], world.epochs),
        sample_scale=world.sample_scale[: steps * config.samples_per_step],
        step_scale=world.step_scale[:steps],
    )
    key = jax.random.key(config.seed)
    times = np.empty((len(FORMS), len(ANGLES_DEG), len(FILTERS), config.runs))
    for i, form in enumerate(FORMS):
        one = _run_one(setup_of(config)._replace(star=form))
        for j, angle in enumerate(ANGLES_DEG):
            sigma = short.prior_sigma.copy()
            sigma[LAYOUT.phi] = angle * DEG / 3**0.5
            turned = short._replace(prior_sigma=sigma, misalignment=host.array(angle * DEG))
            settled = monte_carlo(one, key, config.runs, turned).rows
            times[i, j] = config.filter_period_s * settled.T
    return times


def _cut(trajectory: Any, samples: int) -> Any:
    """Return the first intervals of a trajectory."""
    return trajectory._replace(
        time=trajectory.time[: samples + 1],
        state=jax.tree.map(lambda leaf: leaf[: samples + 1], trajectory.state),
        dtheta=trajectory.dtheta[:samples],
        dvel=trajectory.dvel[:samples],
    )


@cache
def _run_one(setup: Setup) -> Any:
    """Return one run of both filters: the steps after which each stays within the band."""
    model = model_of(setup)
    filters = {
        "ekf": ekf(model),
        "ukf": ukf(model, alpha=setup.alpha, beta=setup.beta, kappa=setup.kappa),
    }

    def settled(key: Array, world: World) -> RunOutput:
        flight = fly(key, world, setup.period, setup.imu_step, setup.star)
        initial = Gaussian(flight.start, jnp.diag(world.prior_sigma**2))
        observations = SureObs(flight.z, jnp.ones(flight.z.shape, bool))

        def last_outside(filter: Filter) -> Array:
            params = FilterParams(world.noise, initial)
            record = run(
                filter, params, flight.inputs, observations, record=lambda state, info: state.x.dcm
            ).record
            phi = jax.vmap(so3_local)(flight.truth.dcm, record)
            return steps_outside(jnp.sqrt(jnp.sum(phi**2, axis=-1)), world)

        return RunOutput(jnp.stack([last_outside(filters[name]) for name in FILTERS]))

    return settled
