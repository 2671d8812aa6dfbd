"""The methods of the study, and one run of them side by side."""

from collections.abc import Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.compiling import host
from jaxnav.estimation.bounds import linearised_at_truth
from jaxnav.estimation.filters.iterated import iterated_ckf, modified_iterated_ckf
from jaxnav.estimation.filters.line_search import Search
from jaxnav.estimation.filters.sigma_point import ckf
from jaxnav.estimation.metrics import nees
from jaxnav.estimation.montecarlo import RunOutput
from jaxnav.estimation.run import run
from jaxnav.estimation.types import Filter, FilterParams, Gaussian, Obs, SureObs
from jaxnav.navigation.atmosphere import RefractionTable
from jaxnav.navigation.earth import MEAN_RADIUS
from jaxnav.navigation.limb import HeightModel, exponential_model, fitted_model
from jaxnav.navigation.models.sins_rkcns import SinsRkcnsParams, sins_rkcns
from jaxnav.navigation.models.sins_total import sins_total
from jaxnav.navigation.states import LAYOUT, SinsTotal, local_total
from jaxnav.numerics.lie import euler_from_dcm, wrapped_angle
from jaxnav.studies.rkcns.config import RkcnsConfig
from jaxnav.studies.rkcns.simulation import (
    Run,
    Timing,
    World,
    fly_run,
    noise_of,
    slots_of,
    timing_of,
)
from jaxnav.units import ARCSEC

METHODS = (
    "conventional",
    "ckf",
    "iterated-ckf",
    "modified-iterated-ckf",
    "oracle",
)
FIT_SIGMAS = 5.0
"""How far beyond the band of stars the model of the atmosphere is fitted, in noise of an angle."""
LEAST_ANGLE = 0.3
"""Smallest angle that it is fitted to, as a share of that at the top of the band."""


class Setup(NamedTuple):
    """What fixes the shape of a run: the static part of a configuration."""

    timing: Timing
    iterations: int
    trials: int
    methods: tuple[str, ...]
    printed: bool
    slots: int


class Shared(NamedTuple):
    """What all runs share: the world, and the parameters of the filters less where they start.

    Attributes:
        world: The world.
        limb: Parameters of the model that observes heights.
        exact: Parameters of that which observes angles, with the true atmosphere.
        search: Numbers of the iterated filters.
    """

    world: World
    limb: SinsRkcnsParams
    exact: SinsRkcnsParams
    search: Search


class Row(NamedTuple):
    """Statistics of one run; the leading axis of each is that of the methods.

    Attributes:
        mean_square: ``(methods, 6) [m^2, rad^2]`` of the errors of position x, y, z and of yaw,
            pitch, roll over the flight.
        early: ``(methods,) [m^2]`` mean square of the position error over the first ten steps.
        bias_square: ``(methods, 3) [m^2/s^4]`` of the accelerometer bias at the end.
        nees: ``(methods,)`` time average of the NEES of the whole state.
        final_nees: ``(methods,)`` NEES at the end, which is independent from run to run.
        final_error: ``(methods,) [rad]`` norm of the attitude error at the end.
    """

    mean_square: Array
    early: Array
    bias_square: Array
    nees: Array
    final_nees: Array
    final_error: Array


EARLY_STEPS = 10


def setup_of(
    config: RkcnsConfig, methods: Sequence[str] = METHODS, *, printed: bool = False
) -> Setup:
    """Return the static part of a configuration, for some of the methods.

    Args:
        config: The configuration.
        methods: Which to run.
        printed: Iterate as the paper prints it.
    """
    return Setup(
        timing_of(config),
        config.iterations,
        config.trials,
        tuple(methods),
        printed,
        slots_of(config),
    )


def shared_of(config: RkcnsConfig, world: World) -> Shared:
    """Return what all runs share."""
    noise = noise_of(config)
    limb = SinsRkcnsParams(
        gyro_noise=noise.gyro_noise,
        accel_noise=noise.accel_noise,
        star_noise=noise.star_noise,
        refraction_noise=world.refraction_noise,
        density_sigma=world.density_error,
        disturbance=host.array(0.0),
        atmosphere=believed_atmosphere(config, world.atmosphere),
    )
    exact = limb._replace(atmosphere=world.atmosphere, density_sigma=host.array(0.0))
    return Shared(world, limb, exact, Search(spread=host.array(config.spread)))


def believed_atmosphere(config: RkcnsConfig, table: RefractionTable) -> HeightModel:
    """Return the filters' model of the atmosphere, fitted where angles can be measured."""
    if config.atmosphere == "printed":
        return exponential_model()
    low, high = (1e3 * bound for bound in config.tangent_km)
    heights = float(table.low) + float(table.step) * np.arange(table.log_angle.shape[0])
    angles = np.exp(np.asarray(table.log_angle))
    noise = FIT_SIGMAS * config.refraction_noise * ARCSEC
    most = np.interp(low, heights, angles) + noise
    top = np.interp(high, heights, angles)
    least = max(top - noise, LEAST_ANGLE * top)
    lowest, highest = np.interp([-most, -least], -angles, heights)
    return fitted_model(float(lowest), float(highest))


@cache
def filters(setup: Setup) -> dict[str, Filter]:
    """Return the filters by method."""
    timing = setup.timing
    given = (timing.period, timing.imu_step, MEAN_RADIUS)
    heights, angles = (sins_rkcns(*given, setup.slots, ray) for ray in ("height", "angle"))
    iterating = {"iterations": setup.iterations, "trials": setup.trials, "printed": setup.printed}
    return {
        "conventional": ckf(sins_total(*given)),
        "ckf": ckf(heights),
        "iterated-ckf": iterated_ckf(heights, **iterating),
        "modified-iterated-ckf": modified_iterated_ckf(heights, **iterating),
        "angle-ckf": ckf(angles),
        "oracle": linearised_at_truth(angles, lambda u: (u.before, u.after)),
    }


def problem_of(name: str, flight: Run, shared: Shared) -> tuple[FilterParams, Any, Obs]:
    """Return a method's parameters, inputs and observations in a flight.

    The oracle is told the density and observes angles, whose noise is exactly additive.
    """
    z, valid, start = flight.z, flight.valid, flight.start
    if name == "conventional":
        params = FilterParams(shared.world.noise, start)
        return params, flight.conventional, SureObs(z[:, :3], valid[:, :3])
    inputs = flight.limb
    if name == "oracle":
        inputs = inputs._replace(density=flight.density * jnp.ones_like(inputs.density))
    if name in ("oracle", "angle-ckf"):
        angles = z.at[:, 3:-3].set(inputs.angle)
        return FilterParams(shared.exact, start), inputs, SureObs(angles, valid)
    search = shared.search if "iterated" in name else ()
    return FilterParams(shared.limb, start, search), inputs, SureObs(z, valid)


@cache
def run_one(setup: Setup) -> Any:
    """Return the run of all methods as a function of its key and :class:`Shared`."""
    chosen = {name: filters(setup)[name] for name in setup.methods}

    def run_methods(key: Array, shared: Shared) -> RunOutput:
        flight = fly_run(key, shared.world, setup.timing)
        judged = []
        for name, filter in chosen.items():
            params, inputs, observations = problem_of(name, flight, shared)
            record = partial(_record, filter)
            estimates = run(filter, params, inputs, observations, record=record).record
            judged.append(_judge(flight.truth, estimates))
        row, curve, trace = jax.tree.map(lambda *leaves: jnp.stack(leaves), *judged)
        late = jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), (curve, trace))
        return RunOutput(row, *late)

    return run_methods


def _record(filter: Filter, state: Any, info: Any) -> Gaussian:
    del info
    return filter.estimate(state)


def _judge(truth: SinsTotal, estimates: Gaussian) -> tuple[Row, Any, Any]:
    """Compare estimates ``(K)`` with true states ``(K)``."""
    s = LAYOUT
    error = jax.vmap(local_total)(truth, estimates.mean)
    angles, true_angles = (jax.vmap(euler_from_dcm)(at.dcm) for at in (estimates.mean, truth))
    turned = wrapped_angle(angles, true_angles)[:, jnp.array([1, 0, 2])]
    consistency = jax.vmap(nees)(error, estimates.cov)
    shown = jnp.concatenate([error[:, s.dr], turned], axis=1)
    squares = shown**2
    position = jnp.sum(squares[:, :3], axis=1)
    row = Row(
        mean_square=jnp.mean(squares, axis=0),
        early=jnp.mean(position[:EARLY_STEPS]),
        bias_square=error[-1, s.nabla] ** 2,
        nees=jnp.mean(consistency),
        final_nees=consistency[-1],
        final_error=jnp.sqrt(jnp.sum(error[-1, s.phi] ** 2)),
    )
    sigma = jnp.sqrt(jnp.diagonal(estimates.cov, axis1=-2, axis2=-1))
    kept = jnp.concatenate([shown, error[:, s.eps.start :]], axis=1)
    curve = {"square": kept**2, "error": kept, "nees": consistency}
    return row, curve, {"error": kept, "sigma": sigma}
