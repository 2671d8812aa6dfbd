"""The methods of the study, and one run of all of them side by side.

Single filters, their banks and the oracle watch the same members where they can: a method is a
weight rule over the members of one family. The members of the interacting bank exchange their
estimates, so they are its own.
"""

from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.compiling import host
from jaxnav.estimation.banks.imm import imm, imm_params, uniform_switching
from jaxnav.estimation.banks.mixture import BankParams, moment_match, panel
from jaxnav.estimation.banks.reset import WindowedReset, windowed_reset
from jaxnav.estimation.banks.rule import WeightRule
from jaxnav.estimation.banks.weights import bayes, chain, fixed
from jaxnav.estimation.bounds import oracle
from jaxnav.estimation.filters.kalman import ekf
from jaxnav.estimation.filters.sigma_point import ukf
from jaxnav.estimation.metrics import nees
from jaxnav.estimation.montecarlo import RunOutput
from jaxnav.estimation.run import run
from jaxnav.estimation.types import (
    Filter,
    FilterParams,
    Gaussian,
    Model,
    SureObs,
    replicate,
)
from jaxnav.navigation.models.sins_total import SinsTotalInput, StarForm, sins_total
from jaxnav.navigation.states import LAYOUT, SinsTotal
from jaxnav.numerics.lie import euler_from_dcm, so3_local, so3_retract, wrapped_angle
from jaxnav.numerics.sequences import hammersley, log_grid
from jaxnav.studies.attitude import DIVERGED_SIGMAS
from jaxnav.studies.mmae_ukf.config import MmaeUkfConfig
from jaxnav.studies.mmae_ukf.simulation import World, fly, launch_radius, noise_of

EKF_RULES: dict[str, WeightRule] = {"ekf": fixed(), "mmae-ekf": bayes()}
UKF_RULES: dict[str, WeightRule] = {
    "ukf": fixed(),
    "mmae-ukf": bayes(),
    "immae-ukf": chain(bayes(), windowed_reset()),
    "oracle": fixed(),
}
METHODS = ("ekf", "ukf", "mmae-ekf", "mmae-ukf", "immae-ukf", "imm-ukf", "oracle")
BANKS = ("mmae-ekf", "mmae-ukf", "immae-ukf", "imm-ukf")


class Setup(NamedTuple):
    """What fixes the shape of a run: the static part of a configuration."""

    period: float
    imu_step: float
    radius: float
    star: StarForm
    alpha: float
    beta: float
    kappa: float
    scored_from: int


class Member(NamedTuple):
    """Parameters of one member: those of its filter, and whether it is told the true noise."""

    filter: FilterParams
    informed: Array


class Shared(NamedTuple):
    """What all runs share: the world and the parameters of the banks, less where they start."""

    world: World
    ekf: BankParams
    ukf: BankParams
    imm: BankParams


class Row(NamedTuple):
    """Statistics of one run; the leading axis of each is that of :data:`METHODS`.

    Attributes:
        mean_square: ``(methods, 3) [rad^2]`` of the errors of yaw, pitch, roll where scored.
        nees: ``(methods,)`` time average of the attitude's NEES (three degrees of freedom).
        final_error: ``(methods,) [rad]`` norm of the attitude error at the end.
        settled: ``(methods,)`` steps after which the attitude error stays within
            :data:`~jaxnav.studies.attitude.DIVERGED_SIGMAS` star-tracker sigmas.
    """

    mean_square: Array
    nees: Array
    final_error: Array
    settled: Array


def setup_of(config: MmaeUkfConfig) -> Setup:
    """Return the static part of a configuration."""
    return Setup(
        config.filter_period_s,
        config.imu_step,
        launch_radius(config),
        config.star_form,
        config.alpha,
        config.beta,
        config.kappa,
        config.scored_from,
    )


def model_of(setup: Setup) -> Model:
    """Return the state-space model of a setup."""
    return sins_total(setup.period, setup.imu_step, setup.radius, setup.star)


def informed(filter: Filter) -> Filter:
    """Return a filter with :class:`Member` as parameters, told the truth where its member is."""

    def informed(member: Member, u: SinsTotalInput) -> FilterParams:
        scale = jnp.where(member.informed, jnp.sqrt(u.true_scale), 1)
        model = member.filter.model
        model = model._replace(
            gyro_noise=scale * model.gyro_noise, accel_noise=scale * model.accel_noise
        )
        return member.filter._replace(model=model)

    return oracle(filter, informed)._replace(init=lambda member: filter.init(member.filter))


def model_factors(config: MmaeUkfConfig) -> np.ndarray:
    """Return the banks' factors on (wgt0, wga0) ``(models, 2)``: Hammersley points in log space.

    The regular coordinate is on wgt: the attitude tells nothing of wga, so that only the distinct
    values of wgt make the members differ.
    """
    return log_grid(hammersley(config.models, 2), *config.model_range)


def shared_of(config: MmaeUkfConfig, world: World) -> Shared:
    """Return what all runs share."""
    grid = model_factors(config)
    nominal = host.ones((1, 2))
    models = config.models
    period = config.reset_period_s / config.filter_period_s
    reset = WindowedReset(host.array(period), host.array(config.reset_threshold))
    bank, alone, informed = (_prior(models + 2, chosen) for chosen in (range(models), [-2], [-1]))
    return Shared(
        world=world,
        ekf=BankParams(
            _members(config, world, host.concatenate([grid, nominal])),
            {"ekf": (), "mmae-ekf": ()},
            {"ekf": alone[:-1], "mmae-ekf": bank[:-1]},
        ),
        ukf=BankParams(
            _members(config, world, host.concatenate([grid, nominal, nominal]), informed=True),
            {"ukf": (), "mmae-ukf": (), "immae-ukf": ((), reset), "oracle": ()},
            {"ukf": alone, "mmae-ukf": bank, "immae-ukf": bank, "oracle": informed},
        ),
        imm=imm_params(_members(config, world, grid), uniform_switching(models, config.switching)),
    )


def _prior(count: int, chosen: Any) -> Array:
    """Return log-weights ``(count,)`` that leave all but the chosen members out."""
    prior = host.full(count, -host.inf)
    prior[list(chosen)] = 0.0
    return prior


def _members(
    config: MmaeUkfConfig, world: World, factors: np.ndarray, *, informed: bool = False
) -> Member:
    """Return members by their factors ``(C, 2)``; the last one may be told the truth."""
    count = factors.shape[0]
    noise = noise_of(config)
    scaled = replicate(noise, count)._replace(
        gyro_noise=host.array(factors[:, :1]) * noise.gyro_noise[None],
        accel_noise=host.array(factors[:, 1:]) * noise.accel_noise[None],
    )
    # The state that the members start from differs from run to run.
    anywhere = SinsTotal(host.eye(3), *(host.zeros(3) for _ in range(4)))
    initial = replicate(Gaussian(anywhere, host.diag(world.prior_sigma**2)), count)
    last = host.arange(count) == count - 1
    return Member(FilterParams(scaled, initial), last & informed)


def started(params: Any, start: SinsTotal) -> Any:
    """Return the parameters of a bank or of one member, its filters starting from one state."""
    if isinstance(params, BankParams):
        count = params.members.informed.shape[0]
        return params._replace(members=_restarted(params.members, replicate(start, count)))
    return _restarted(params, start)


def _restarted(member: Member, mean: SinsTotal) -> Member:
    initial = member.filter.initial._replace(mean=mean)
    return member._replace(filter=member.filter._replace(initial=initial))


class _Seen(NamedTuple):
    """What is kept of each step: attitudes ``(methods, ...)`` and weights ``(banks, models)``."""

    attitude: Gaussian
    weights: Array


def attitude_of(log_weights: Array, members: Any) -> Gaussian:
    """Return the attitude of mixtures ``(methods, M)`` of the members."""
    phi = LAYOUT.phi
    each = Gaussian(members.x.dcm, members.P[:, phi, phi])
    return jax.vmap(lambda lw: moment_match(lw, each, so3_retract, so3_local))(log_weights)


def _panel_record(names: tuple[str, ...], models: int) -> Any:
    banks = [name for name in names if name in BANKS]

    def record(state: Any, info: Any) -> _Seen:
        del info
        log_weights = jnp.stack([state.log_weights[name] for name in names])
        weights = jnp.exp(jnp.stack([state.log_weights[name] for name in banks]))
        return _Seen(attitude_of(log_weights, state.members), weights[:, :models])

    return record


def _imm_record(state: Any, info: Any) -> _Seen:
    del info
    one = state.log_weights[None]
    return _Seen(attitude_of(one, state.members), jnp.exp(one))


@cache
def run_one(setup: Setup, models: int) -> Any:
    """Return the run of all methods as a function of its key and :class:`Shared`."""
    model = model_of(setup)
    unscented = informed(ukf(model, alpha=setup.alpha, beta=setup.beta, kappa=setup.kappa))
    families = (
        (panel(informed(ekf(model)), EKF_RULES), _panel_record(tuple(EKF_RULES), models)),
        (panel(unscented, UKF_RULES), _panel_record(tuple(UKF_RULES), models)),
        (imm(unscented), _imm_record),
    )
    order = [(*EKF_RULES, *UKF_RULES, "imm-ukf").index(name) for name in METHODS]

    def run_methods(key: Array, shared: Shared) -> RunOutput:
        world = shared.world
        flight = fly(key, world, setup.period, setup.imu_step, setup.star)
        observations = SureObs(flight.z, jnp.ones(flight.z.shape, bool))
        seen = [
            run(filter, started(params, flight.start), flight.inputs, observations, record=record)
            for (filter, record), params in zip(families, shared[1:], strict=True)
        ]
        attitude, weights = jax.tree.map(
            lambda *parts: jnp.concatenate(parts, axis=1), *(trace.record for trace in seen)
        )
        attitude = jax.tree.map(lambda leaf: leaf[:, jnp.array(order)], attitude)
        return _judge(flight.truth.dcm, attitude, weights, world, setup)

    return run_methods


def _judge(
    truth: Array, attitude: Gaussian, weights: Array, world: World, setup: Setup
) -> RunOutput:
    """Compare attitudes ``(K, methods, 3, 3)`` with the true ones ``(K, 3, 3)``."""
    over_methods = jax.vmap(so3_local, in_axes=(None, 0))
    rotation = jax.vmap(over_methods)(truth, attitude.mean)
    angles = jax.vmap(jax.vmap(euler_from_dcm))(attitude.mean)
    error = wrapped_angle(angles, jax.vmap(euler_from_dcm)(truth)[:, None])
    error = error[..., jnp.array([1, 0, 2])]
    consistency = jax.vmap(jax.vmap(nees))(rotation, attitude.cov)
    size = jnp.sqrt(jnp.sum(rotation**2, axis=-1))
    row = Row(
        mean_square=jnp.mean(error[setup.scored_from :] ** 2, axis=0),
        nees=jnp.mean(consistency[setup.scored_from :], axis=0),
        final_error=size[-1],
        settled=steps_outside(size, world),
    )
    sigma = jnp.sqrt(jnp.diagonal(attitude.cov, axis1=-2, axis2=-1))
    curve = {"square": error**2, "weights": weights}
    return RunOutput(row, curve, {"error": error, "weights": weights, "sigma": sigma})


def steps_outside(size: Array, world: World) -> Array:
    """Return after how many steps attitude errors ``(K, ...) [rad]`` stay within the band."""
    outside = ~(size <= DIVERGED_SIGMAS * world.noise.star_noise[0])
    after = jnp.arange(1, size.shape[0] + 1).reshape(-1, *[1] * (size.ndim - 1))
    return jnp.max(jnp.where(outside, after, 0), axis=0)
