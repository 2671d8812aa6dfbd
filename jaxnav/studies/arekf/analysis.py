"""What mis-set noise costs over sensor, factor and duration, by covariance analysis: no runs."""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.estimation.mismatch import Mismatch, MismatchState, mismatched
from jaxnav.estimation.run import run
from jaxnav.estimation.types import FilterParams, Gaussian, SureObs
from jaxnav.navigation.models.sins_gnss import SinsGnssInput, SinsGnssParams, sins_gnss
from jaxnav.navigation.sense import true_states
from jaxnav.navigation.states import LAYOUT, SinsLevel
from jaxnav.navigation.strapdown.increments import accumulate
from jaxnav.studies.arekf.config import BIASED, NOISY, ArekfConfig
from jaxnav.studies.arekf.simulation import build_world, noise_of, prior_sigma

GRADES = {
    "noise-dominated": NOISY,
    "half of its noise": replace(NOISY, arw=1.0, vrw=0.3),
    "with MEMS bias": replace(NOISY, drift=BIASED.drift, bias=BIASED.bias),
    "half, MEMS bias": replace(NOISY, arw=1.0, vrw=0.3, drift=BIASED.drift, bias=BIASED.bias),
    "bias-dominated": BIASED,
}
"""Sensors of the map."""
DURATIONS_S = (20.0, 40.0, 80.0)
"""Times of flight over which errors are averaged, beside the whole flight [s]."""


class PathInput(NamedTuple):
    """Inputs of the model with the true states at both ends of a step."""

    dtheta: Array
    gain: Array
    rate: Array
    dt: Array
    before: SinsLevel
    after: SinsLevel


class RatioMap(NamedTuple):
    """Root mean square errors over those of a filter with the true noise.

    Attributes:
        ratio: ``(grades, factors, durations, 3)`` of attitude, velocity and position.
        durations: ``(durations,) [s]``.
        grades: Names of the sensors.
    """

    ratio: np.ndarray
    durations: np.ndarray
    grades: tuple[str, ...]


def ratio_map(config: ArekfConfig) -> RatioMap:
    """Return the ratios of errors for each sensor, factor and duration along the true path."""
    inputs, valid = _path(config)
    grades = list(GRADES.values())
    sets = [(noise_of(grade, config.gnss_position), prior_sigma(config, grade)) for grade in grades]
    truth, sigma = jax.tree.map(lambda *leaves: jnp.stack(leaves), *sets)
    factors = jnp.asarray(config.factors)
    filter = mismatched(sins_gnss(), lambda u: (u.before, u.after))

    def squares(noise: SinsGnssParams, sigma: Array, factor: Array) -> Array:
        start = jax.tree.map(lambda leaf: leaf[0], inputs.before)
        prior = Gaussian(start, jnp.diag(sigma**2))
        believed = noise._replace(
            gyro_noise=noise.gyro_noise / factor, accel_noise=noise.accel_noise / factor
        )
        params = Mismatch(FilterParams(believed, prior), FilterParams(noise, prior))
        nothing = SureObs(jnp.zeros(valid.shape), valid)
        return run(filter, params, inputs, nothing, record=_norms).record

    over_factors = jax.vmap(squares, in_axes=(None, None, 0))
    found = np.asarray(
        compiled(jax.vmap(over_factors, in_axes=(0, 0, None)))(truth, sigma, factors)
    )
    durations = [*(at for at in DURATIONS_S if at < config.duration_s), config.duration_s]
    steps = [round(at / config.filter_period_s) for at in durations]
    level = np.sqrt(np.stack([found[:, :, :k].mean(axis=2) for k in steps], axis=2))
    matched = config.factors.index(1.0)
    return RatioMap(level / level[:, [matched]], np.array(durations), tuple(GRADES))


def _norms(state: MismatchState, info: Any) -> Array:
    """Record the variances ``(3,)`` of the norms of attitude, velocity and position."""
    del info
    return jnp.sum(jnp.diag(state.actual)[: LAYOUT.eps.start].reshape(3, 3), axis=1)


def _path(config: ArekfConfig) -> tuple[PathInput, Array]:
    """Return the true path as inputs of each step, and which steps have a fix ``(K, 6)``."""
    motion, every = build_world(config).trajectory, config.samples_per_step
    dtheta, gain = compiled(accumulate, static_argnums=2)(motion.dtheta, motion.dvel, every)
    none = jnp.zeros(3)
    states = true_states(SinsLevel, motion, every, none, none)
    before, after = (
        jax.tree.map(lambda leaf, at=at: leaf[at], states)
        for at in (slice(None, -1), slice(1, None))
    )
    u = SinsGnssInput(
        dtheta,
        gain,
        motion.dtheta[every - 1 :: every] / config.imu_step,
        jnp.full(config.steps, config.filter_period_s),
    )
    arrived = jnp.arange(1, config.steps + 1) % config.steps_per_fix == 0
    return PathInput(*u, before, after), jnp.broadcast_to(arrived[:, None], (config.steps, 6))
