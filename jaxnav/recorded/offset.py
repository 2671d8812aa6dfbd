"""The likeliest time offset between the receiver and the inertial sensors."""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.datasets.base import DataError
from jaxnav.datasets.drive import DriveLog
from jaxnav.estimation.filters.kalman import ekf
from jaxnav.estimation.run import run
from jaxnav.estimation.types import Filter, FilterParams, Info, Obs
from jaxnav.navigation.models.vehicle import vehicle
from jaxnav.navigation.states import error_form
from jaxnav.numerics.linalg import cholesky, solve_lower
from jaxnav.recorded.config import ALONE, FilterConfig
from jaxnav.recorded.methods import filter_params
from jaxnav.recorded.preparation import prepare
from jaxnav.recorded.turning import clocks

STEPS = 6
CLOSE_S = 5e-4
"""A step below half a millisecond ends the search."""
LARGEST_STEP_S = 0.2
"""The first order in the offset is good for less than that; a step back is half of that before."""


AGREE = 0.6
"""Correlation of two turn rates from which on their lag is believed."""
APART_S = 0.3
"""Lag above which the search begins there; below, it finds the way from where it is."""


class Offset(NamedTuple):
    """The likeliest offset [s] and its standard deviation [s]."""

    value_s: float
    sigma_s: float


def likeliest_offset(log: DriveLog, config: FilterConfig) -> Offset:
    """Return the offset that makes the fixes likeliest, by Gauss-Newton steps.

    The derivative of the log-likelihood is that of a filter of receiver and inertial sensors by
    the model's own offset; after each step the fixes are moved by it exactly.

        step = sum(dl/dt) / sum(dnu/dt' inv(S) dnu/dt)

    The standard deviation is the inverse root of the denominator: of an ideal filter, and so too
    small where other errors act like an offset. The search begins where the course of the fixes
    turns as the gyros do, which is found from half a minute away.

    Args:
        log: The drive.
        config: The configuration; the search starts from its offset, or nearby.

    Raises:
        DataError: If the search does not settle.
    """
    plain = replace(config, **ALONE)
    model = vehicle(constrained=False)
    filter = ekf(model)
    value, sigma, step = _nearby(log, config.time_offset_s), float("nan"), 0.0
    for _ in range(STEPS):
        drive = prepare(log, replace(plain, time_offset_s=value), config.noise_rate_hz)
        form = error_form("additive", drive.initial.mean.position)
        params = filter_params(plain, drive, log.lever_arm, form)
        # Whole hundreds of periods, so that a start moved by one does not compile anew.
        whole = slice(len(drive.time) // 100 * 100 or None)
        inputs = jax.tree.map(lambda leaf, whole=whole: leaf[whole], drive.inputs)
        obs = Obs(*(leaf[whole] for leaf in drive.seen_by(model)))
        slope, information = _score(filter, params, inputs, obs)
        sigma = float(information) ** -0.5
        newton, limit = float(slope / information), LARGEST_STEP_S
        if newton * step < 0:
            limit = 0.5 * abs(step)
        step = max(-limit, min(limit, newton))
        value += step
        if abs(step) < CLOSE_S:
            break
    else:
        raise DataError(
            f"{log.source}: the search for the likeliest time offset did not settle; at "
            f"{value:.3f} s it still moved by {abs(step):.3f} s; accepted is a drive that turns "
            "and changes its speed, or an offset by --time-offset-s"
        )
    return Offset(value, sigma)


def _nearby(log: DriveLog, offset_s: float) -> float:
    """Return an offset [s] near the likeliest: one given, unless course and gyro turn apart."""
    found = clocks(log, offset_s)
    if found is None or abs(found.correlation) < AGREE or abs(found.late_s) < APART_S:
        return offset_s
    return offset_s - found.late_s


@compiled(static_argnums=0)
def _score(filter: Filter, params: FilterParams, inputs: Any, obs: Obs) -> tuple[Array, Array]:
    """Return the derivative of the log-likelihood by the offset, and its information."""

    def record(state: Any, info: Info) -> Any:
        del state
        return info.log_likelihood, info.innovation, info.innovation_cov

    def followed(offset: Array) -> Any:
        own = params._replace(model=params.model._replace(time_offset=offset))
        return run(filter, own, inputs, obs, record=record).record

    zero = jnp.zeros(())
    (_, _, S), (slope, moved, _) = jax.jvp(followed, (zero,), (jnp.ones(()),))
    root = jax.vmap(lambda S: cholesky(S).factor)(S)
    whitened = jax.vmap(solve_lower)(root, moved)
    return jnp.sum(slope), jnp.sum(whitened**2)
