"""The methods of the study, and one run of them side by side."""

from collections.abc import Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.compiling import host
from jaxnav.estimation.banks.mixture import BankParams, panel
from jaxnav.estimation.banks.weights import bayes, fixed
from jaxnav.estimation.filters.adaptive import Adaptation, innovation_adaptive
from jaxnav.estimation.filters.kalman import ekf
from jaxnav.estimation.filters.robust import Versoria, versoria
from jaxnav.estimation.metrics import nees
from jaxnav.estimation.montecarlo import RunOutput
from jaxnav.estimation.run import run
from jaxnav.estimation.types import Filter, FilterParams, Gaussian, replicate
from jaxnav.navigation.models.sins_gnss import SinsGnssParams, sins_gnss
from jaxnav.navigation.states import LAYOUT, ErrorForm, LevelError, SinsLevel, error_form
from jaxnav.navigation.trajectory.arc import ArcProfile
from jaxnav.studies.arekf.config import ArekfConfig
from jaxnav.studies.arekf.simulation import Run, Timing, World, fly_run, timing_of

METHODS = ("ekf", "liekf", "se23-ekf", "versoria-ekf", "iae", "mmae", "arekf", "oracle")
FORMS: dict[str, LevelError] = {"liekf": "left-invariant", "se23-ekf": "right-invariant"}
SHARED = ("ekf", "mmae", "arekf", "oracle")
"""Methods that are weight rules over one set of members."""
AXES = ("east", "north", "up")
KINDS = ("attitude", "velocity", "position")


class Setup(NamedTuple):
    """What fixes the shape of a run: the static part of a configuration.

    Attributes:
        timing: Rates and periods.
        scales: Factors on the given noise of the bank's members.
    """

    timing: Timing
    scales: tuple[float, ...]


class Shared(NamedTuple):
    """What all runs share: the world, what the filters were given, and their own numbers.

    Attributes:
        world: The world.
        believed: Noise that the filters were given.
        kernel: Numbers of the Versoria filter.
        adaptation: Numbers of the innovation-based adaptation.
        settle: Time of flight from which errors count [s].
    """

    world: World
    believed: SinsGnssParams
    kernel: Versoria
    adaptation: Adaptation
    settle: Array


class Row(NamedTuple):
    """Statistics of one run; the leading axis of each is that of the methods.

    Attributes:
        mean_square: ``(methods, 3, 3) [rad^2, m^2/s^2, m^2]`` of the errors of attitude, velocity
            and position, east, north, up, over the flight.
        stabilisation: ``(methods, 3)`` mean of squared errors over their variances.
        convergence: ``(methods, 3) [s]`` time at which the norm of an error first falls below its
            threshold; the duration if it never does.
        final_nees: ``(methods,)`` NEES of the whole state at the end.
        final_square: ``(methods, 3)`` squared norms of the errors at the end.
        identified: ``(2, 3)`` identified random walks over the true ones, the same for all methods.
    """

    mean_square: Array
    stabilisation: Array
    convergence: Array
    final_nees: Array
    final_square: Array
    identified: Array


THRESHOLDS = (0.5 * np.pi / 180, 0.1, 2.0)
"""Errors of attitude [rad], velocity [m/s] and position [m] below which a run has converged."""


def setup_of(config: ArekfConfig) -> Setup:
    """Return the static part of a configuration."""
    return Setup(timing_of(config), config.factors)


def shared_of(config: ArekfConfig, world: World, factor: float) -> Shared:
    """Return what all runs share when the given noise is too small by a factor."""
    believed = world.noise._replace(
        gyro_noise=world.noise.gyro_noise / factor, accel_noise=world.noise.accel_noise / factor
    )
    kernel = Versoria(host.array(config.versoria_width), host.array(config.versoria_power))
    adaptation = Adaptation(*(host.array(x) for x in Adaptation(config.iae_memory)))
    late = config.scenario == "large-heading-error"
    settle = host.array(config.settle_s if late else 0.0)
    return Shared(world, believed, kernel, adaptation, settle)


@cache
def filters() -> dict[str, Filter]:
    """Return the filters by method; the panel stands for those that share its members."""
    plain = sins_gnss()
    rules = {name: bayes() if name == "mmae" else fixed() for name in SHARED}
    return {
        "panel": panel(ekf(plain), rules),
        **{name: ekf(sins_gnss(form, _origin())) for name, form in FORMS.items()},
        "versoria-ekf": versoria(ekf(plain)),
        "iae": innovation_adaptive(ekf(plain)),
    }


def _origin() -> Array:
    """Return the launch point, about which the right-invariant error turns."""
    return host.array([ArcProfile().latitude, ArcProfile().longitude, 0.0])


def form_of(name: str) -> ErrorForm:
    """Return the definition of the error of a method."""
    return error_form(FORMS.get(name, "additive"), _origin())


def params_of(name: str, flight: Run, shared: Shared, scales: Sequence[float]) -> Any:
    """Return the parameters of a filter in a flight."""
    start = flight.start
    if name == "panel":
        return _panel_params(flight, shared, scales)
    form = form_of(name)

    def own(columns: Array) -> Array:
        return jax.vmap(lambda d: form.from_additive(start.mean, d), 1, 1)(columns)

    cov = own(own(start.cov).T)
    of_wrappers = {"versoria-ekf": shared.kernel, "iae": shared.adaptation}
    return FilterParams(shared.believed, Gaussian(start.mean, cov), of_wrappers.get(name, ()))


def _panel_params(flight: Run, shared: Shared, scales: Sequence[float]) -> BankParams:
    """Return members at each scale, then that of the identified noise and that of the true one."""
    count = len(scales)
    walks = (shared.believed.gyro_noise, shared.believed.accel_noise)
    truth = (shared.world.noise.gyro_noise, shared.world.noise.accel_noise)
    grid = jnp.asarray(scales, walks[0].dtype)[:, None]
    gyro, accel = (
        jnp.concatenate([grid * believed[None], known[None], true[None]])
        for believed, known, true in zip(walks, flight.identified, truth, strict=True)
    )
    members = replicate(FilterParams(shared.believed, flight.start), count + 2)
    noise = members.model._replace(gyro_noise=gyro, accel_noise=accel)
    index = jnp.arange(count + 2)
    taking_part = {
        "ekf": index == scales.index(1.0),
        "mmae": index < count,
        "arekf": index == count,
        "oracle": index == count + 1,
    }
    priors = {name: jnp.where(own, 0.0, -jnp.inf) for name, own in taking_part.items()}
    return BankParams(members._replace(model=noise), dict.fromkeys(SHARED, ()), priors)


@cache
def run_one(setup: Setup) -> Any:
    """Return the run of all methods as a function of its key and :class:`Shared`."""

    def run_methods(key: Array, shared: Shared) -> RunOutput:
        flight = fly_run(key, shared.world, setup.timing)
        estimates: dict[str, Gaussian] = {}
        for name, filter in filters().items():
            found = run(
                filter,
                params_of(name, flight, shared, setup.scales),
                flight.inputs,
                flight.fixes,
                record=partial(record_estimate, filter),
                every=setup.timing.steps_per_record,
            ).record
            estimates |= found if name == "panel" else {name: found}
        return judge_all(flight, {name: estimates[name] for name in METHODS}, shared, setup)

    return run_methods


def judge_all(
    flight: Run, estimates: dict[str, Gaussian], shared: Shared, setup: Setup
) -> RunOutput:
    """Judge methods by name; their axis comes first in rows, second in histories.

    Methods of one definition of the error are judged side by side, which compiles once.
    """
    names = list(estimates)
    kinds = [FORMS.get(name, "additive") for name in names]
    order, pieces = [], []
    for kind in dict.fromkeys(kinds):
        alike = [name for name, own in zip(names, kinds, strict=True) if own == kind]
        together = jax.tree.map(
            lambda *leaves: jnp.stack(leaves), *(estimates[name] for name in alike)
        )
        one = partial(judge, form_of(alike[0]), flight, shared=shared, setup=setup)
        pieces.append(jax.vmap(one)(together))
        order += alike
    place = jnp.array([order.index(name) for name in names])
    row, curve, trace = jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[place], *pieces)
    late = jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), (curve, trace))
    return RunOutput(row, *late)


def record_estimate(filter: Filter, state: Any, info: Any) -> Any:
    """Record what a filter estimates."""
    del info
    return filter.estimate(state)


def judge(
    form: ErrorForm, flight: Run, estimates: Gaussian, shared: Shared, setup: Setup
) -> RunOutput:
    """Compare a method's estimates with true states.

    Errors are additive ones, the NEES is that of the filter's own.
    """
    truth, count = flight.truth, estimates.cov.shape[0]
    error = jax.vmap(error_form("additive", _origin()).local)(truth, estimates.mean)
    blocks = error[:, : LAYOUT.eps.start].reshape(count, 3, 3)
    variances = _additive_variances(form, estimates).reshape(count, 3, 3)
    # The error in the filter's own coordinates, from the estimate, whose tangent space P is in.
    own = -jax.vmap(form.local)(estimates.mean, truth)
    consistency = jax.vmap(nees)(own, estimates.cov)
    squares = blocks**2
    norms = jnp.sum(squares, axis=2)
    period = setup.timing.steps_per_record * setup.timing.clock.step
    time = period * jnp.arange(1, count + 1, dtype=norms.dtype)
    counted = time > shared.settle
    share = counted.astype(norms.dtype)[:, None, None] / jnp.sum(counted).astype(norms.dtype)
    below = norms < jnp.array(THRESHOLDS)[None] ** 2
    never = ~jnp.any(below, axis=0)
    true = shared.world.noise
    known = jnp.stack(flight.identified) / jnp.stack([true.gyro_noise, true.accel_noise])
    row = Row(
        mean_square=jnp.sum(share * squares, axis=0),
        stabilisation=jnp.mean(jnp.sum(share * squares / variances, axis=0), axis=1),
        convergence=jnp.where(never, time[-1], time[jnp.argmax(below, axis=0)]),
        final_nees=consistency[-1],
        final_square=norms[-1],
        identified=known,
    )
    curve = {"square": squares, "nees": consistency}
    return RunOutput(row, curve, {"error": blocks, "sigma": jnp.sqrt(variances)})


def _additive_variances(form: ErrorForm, estimates: Gaussian) -> Array:
    """Return the variances ``(T, 9)`` of attitude, velocity and position as additive errors."""

    def one(x: SinsLevel, P: Array) -> Array:
        turned = jax.vmap(lambda d: form.to_additive(x, d), 1, 1)
        return jnp.diag(turned(turned(P).T))[: LAYOUT.eps.start]

    return jax.vmap(one)(*estimates)
