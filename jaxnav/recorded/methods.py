"""The filters and banks that may be asked for, and what a run of one keeps."""

import itertools
from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.config import ConfigError
from jaxnav.estimation.banks.mixture import BankParams, bank
from jaxnav.estimation.banks.rule import WeightRule
from jaxnav.estimation.banks.weights import (
    Penalty,
    bayes,
    chain,
    fixed,
    floor,
    forget,
    markov,
    penalty,
)
from jaxnav.estimation.carried import Carried
from jaxnav.estimation.filters.gated import Gate, Gated, gated
from jaxnav.estimation.filters.sage_husa import SageHusa
from jaxnav.estimation.register import built
from jaxnav.estimation.run import Recorder
from jaxnav.estimation.types import (
    ChannelInfo,
    Filter,
    FilterParams,
    Gaussian,
    Info,
    Model,
    replicate,
)
from jaxnav.navigation.models.sins_gnss import SinsGnssParams
from jaxnav.navigation.models.vehicle import FIXES, VehicleParams, vehicle
from jaxnav.navigation.states import STATES, ErrorForm, LevelError, SinsLevel, error_form
from jaxnav.recorded.carry import carried, laws
from jaxnav.recorded.config import FilterConfig, members, parts_of
from jaxnav.recorded.preparation import Drive
from jaxnav.units import DEG, GRAVITY

ERRORS: dict[str, LevelError] = {"liekf": "left-invariant", "se23-ekf": "right-invariant"}
NOISE_RANGE = (0.1, 1e6)
"""Variance over the nominal that a Sage-Husa filter may estimate: RTK to hundreds of metres."""


class Method(NamedTuple):
    """A filter or bank with its model.

    Attributes:
        filter: What runs, behind its gate if it has one.
        model: The model of a member.
        form: The definition of its error.
        record: What a run keeps of a step: a :class:`Kept`.
        banked: Whether it is a bank.
    """

    filter: Filter
    model: Model
    form: ErrorForm
    record: Recorder
    banked: bool


class Kept(NamedTuple):
    """What is kept of each step.

    Attributes:
        mean: The state.
        sigma: ``(15,)`` standard deviations in additive errors.
        carried: States that are carried besides, by name.
        carried_sigma: ``(k,)`` their standard deviations.
        cov: ``(15 + k, 15 + k)`` covariance in additive errors where the run is written at another
            point than the sensors; ``(0, 0)`` elsewhere.
        nis: Normalised innovation squared.
        parts: By channel of the model, what the update told of it.
        flags: Sum of :class:`~jaxnav.estimation.types.Flag`.
        log_likelihood: Of the step.
        weights: ``(M,)`` of the members of a bank; ``(0,)`` of a filter.
    """

    mean: SinsLevel
    sigma: Array
    carried: dict[str, Array]
    carried_sigma: Array
    cov: Array
    nis: Array
    parts: dict[str, ChannelInfo]
    flags: Array
    log_likelihood: Array
    weights: Array

    @property
    def state(self) -> Any:
        """The state of the model, with what it carries."""
        return Carried(self.mean, self.carried) if self.carried else self.mean


def method(config: FilterConfig, origin: Array, *, constrained: bool = True) -> Method:
    """Return the filter or bank of a configuration; the same one again for the same choices.

    Args:
        config: The configuration.
        origin: Position about which the right-invariant error turns.
        constrained: Whether the model has the channels of the constraints.
    """
    error: LevelError = ERRORS.get(config.filter, "additive")
    about = tuple(np.asarray(origin).tolist()) if error == "right-invariant" else (0.0, 0.0, 0.0)
    weighed = config.rule if members(config) > 1 else None
    return _method(
        config.filter,
        weighed,
        config.gate,
        error,
        about,
        constrained,
        config.carry,
        config.point != "sensors",
    )


@cache
def _method(
    name: str,
    weighed: str | None,
    gate: bool,
    error: LevelError,
    about: tuple[float, ...],
    constrained: bool,
    carry: tuple[str, ...],
    whole: bool,
) -> Method:
    """Return a method; another call finds it and with it the programs compiled for it."""
    origin = jnp.array(about)
    model = vehicle(error, origin, constrained=constrained, carry=laws(carry))
    one, form = member(name, model), error_form(error, origin)
    chosen = one if weighed is None else bank(one, rule(weighed))
    if gate:
        chosen = gated(chosen, FIXES)

    def record(state: Any, info: Info) -> Kept:
        estimate = chosen.estimate(state)
        banked = state.inner if gate else state
        weights = jnp.zeros(0) if weighed is None else jnp.exp(banked.log_weights)
        point = estimate.mean
        mean, besides = (point.own, point.carried) if carry else (point, {})
        own = Gaussian(mean, estimate.cov[:STATES, :STATES])
        left = jnp.diag(estimate.cov)[STATES:]
        return Kept(
            mean,
            additive_sigma(form, own),
            besides,
            jnp.sqrt(jnp.maximum(left, 0)),
            additive_cov(form, mean, estimate.cov) if whole else jnp.zeros((0, 0)),
            info.nis,
            {name: model.part(info, name) for name, _ in model.channels},
            info.flags,
            info.log_likelihood,
            weights,
        )

    return Method(chosen, model, form, record, weighed is not None)


def member(name: str, model: Model) -> Filter:
    """Return a single filter by its name.

    Raises:
        ConfigError: If there is none, or it cannot filter this model.
    """
    try:
        return built(parts_of(name), model)
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(f"{name} cannot filter a drive: {error}") from error


def rule(name: str) -> WeightRule:
    """Return a weight rule by its name."""
    rules = {
        "floor": lambda: chain(bayes(), floor()),
        "bayes": bayes,
        "fixed": fixed,
        "forget": lambda: chain(forget(), bayes()),
        "markov": lambda: chain(markov(), bayes()),
        "penalty": penalty,
    }
    return rules[name]()


def rule_params(config: FilterConfig, period: float) -> Any:
    """Return the rule's parameters for a filter of a given period [s]."""
    share = jnp.array(period / config.rule_time_s)
    given = {
        "floor": ((), jnp.array(config.weight_floor)),
        "forget": (jnp.exp(-share), ()),
        "markov": (-jnp.expm1(-share), ()),
        "penalty": Penalty(),
    }
    return given.get(config.rule, ())


def model_params(
    config: FilterConfig, drive: Drive, lever_arm: np.ndarray, mounting: np.ndarray
) -> VehicleParams:
    """Return the parameters of the model, noise densities as the configuration has them."""

    def axes(value: float) -> Array:
        return jnp.full(3, value)

    micro_g = 1e-6 * GRAVITY
    return VehicleParams(
        SinsGnssParams(
            gyro_noise=axes(config.gyro_noise_dps * DEG),
            accel_noise=axes(config.accel_noise_ug * micro_g),
            gyro_walk=axes(config.gyro_walk_dps * DEG),
            accel_walk=axes(config.accel_walk_ug * micro_g),
            velocity_noise=jnp.asarray(drive.velocity_noise),
            position_noise=jnp.asarray(drive.position_noise),
            lever_arm=jnp.asarray(lever_arm),
        ),
        time_offset=jnp.array(0.0),
        mounting=jnp.asarray(mounting),
        axle=jnp.array(config.axle_m),
        steered_noise=jnp.full(2, config.steered_sigma),
        rest_noise=jnp.array(config.rest_sigma),
        rest_speed=jnp.array(config.rest_speed),
    )


def filter_params(
    config: FilterConfig,
    drive: Drive,
    lever_arm: np.ndarray,
    form: ErrorForm,
    mounting: np.ndarray | None = None,
) -> FilterParams | BankParams | Gated:
    """Return the parameters of a configuration's filter or bank, behind its gate if it has one.

    Args:
        config: The configuration.
        drive: The drive.
        lever_arm: From the inertial sensors to the antenna ``(3,) [m]``.
        form: The definition of the error.
        mounting: Rotation vector to the vehicle's axes ``(3,) [rad]``; ``None`` is no rotation.
    """
    inner = _ungated(config, drive, lever_arm, form, mounting)
    if not config.gate:
        return inner
    gate = Gate(jnp.array(config.gate_false_alarm), jnp.array(config.gate_patience))
    if isinstance(inner, BankParams):
        return Gated(inner, gate)
    return inner._replace(own=(gate, inner.own))


def _ungated(
    config: FilterConfig,
    drive: Drive,
    lever_arm: np.ndarray,
    form: ErrorForm,
    mounting: np.ndarray | None,
) -> FilterParams | BankParams:
    mounting = np.zeros(3) if mounting is None else mounting
    mean = drive.initial.mean
    cov = columns(form.from_additive, mean, drive.initial.cov)
    one = FilterParams(model_params(config, drive, lever_arm, mounting), Gaussian(mean, cov))
    names = parts_of(config.filter)
    one = one._replace(own=_own(names, jnp.array(config.forgetting[0])))
    if members(config) == 1:
        factors = jnp.array(config.r_factors[0]), jnp.array(config.q_factors[0])
        return carried(_scaled(one, *factors), config.carry)
    grid = jnp.array(grid_of(config))
    several = replicate(one, len(grid))
    several = several._replace(own=jax.vmap(partial(_own, names))(grid[:, 2]))
    several = jax.vmap(lambda one, r, q: carried(_scaled(one, r, q), config.carry))(
        several, grid[:, 0], grid[:, 1]
    )
    period = float(np.median(np.asarray(drive.inputs.inertial.dt)))
    return BankParams(several, rule_params(config, period))


def _own(names: tuple[str, ...], forgetting: Array) -> Any:
    """Return the parameters of wrappers and filter, those of Sage-Husa for any receiver."""
    own: Any = ()
    for name in reversed(names[:-1]):
        own = (sage_husa_params(forgetting) if name == "sage_husa" else (), own)
    return own


def sage_husa_params(forgetting: Array) -> SageHusa:
    """Return the parameters of a Sage-Husa filter that may find the noise of any receiver."""
    low, high = NOISE_RANGE
    plain = SageHusa(forgetting, low=low, high=high)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.result_type(float)), plain)


def grid_of(config: FilterConfig) -> list[tuple[float, float, float]]:
    """Return the members of a bank: factor on R, factor on Q, forgetting factor."""
    return list(itertools.product(config.r_factors, config.q_factors, config.forgetting))


def member_names(config: FilterConfig) -> list[str]:
    """Return a name for each member, with what differs between members alone."""
    varied = [("R x", config.r_factors), ("Q x", config.q_factors), ("b ", config.forgetting)]
    return [
        ", ".join(
            f"{name}{value:g}"
            for value, (name, values) in zip(entry, varied, strict=True)
            if len(values) > 1
        )
        for entry in grid_of(config)
    ]


def _scaled(params: FilterParams, r_factor: Array, q_factor: Array) -> FilterParams:
    """Return parameters with the variances of the receiver and the process noise multiplied."""
    inner, r, q = params.model.inner, jnp.sqrt(r_factor), jnp.sqrt(q_factor)
    inner = inner._replace(
        gyro_noise=q * inner.gyro_noise,
        accel_noise=q * inner.accel_noise,
        gyro_walk=q * inner.gyro_walk,
        accel_walk=q * inner.accel_walk,
        velocity_noise=r * inner.velocity_noise,
        position_noise=r * inner.position_noise,
    )
    return params._replace(model=params.model._replace(inner=inner))


def columns(push: Callable[[Any, Array], Array], x: SinsLevel, cov: Array) -> Array:
    """Return a covariance in other coordinates, taken there by their derivative ``push(x, d)``."""
    pushed = jax.vmap(lambda d: push(x, d), in_axes=1, out_axes=1)
    return pushed(pushed(cov).T)


def additive_cov(form: ErrorForm, x: SinsLevel, cov: Array) -> Array:
    """Return a covariance ``(15 + k, 15 + k)`` in additive errors; what is carried adds anyhow."""

    def push(x: SinsLevel, d: Array) -> Array:
        return jnp.concatenate([form.to_additive(x, d[:STATES]), d[STATES:]])

    return columns(push, x, cov)


def additive_sigma(form: ErrorForm, estimate: Gaussian) -> Array:
    """Return standard deviations ``(15,)`` in additive errors of an estimate in a form's."""
    cov = columns(form.to_additive, estimate.mean, estimate.cov)
    return jnp.sqrt(jnp.maximum(jnp.diag(cov), 0))
