"""The noise of a recorded drive's filter, to be tuned by the likelihood of its fixes."""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.config import ConfigError
from jaxnav.datasets.drive import DriveLog
from jaxnav.estimation.run import run
from jaxnav.estimation.tune.losses import negative_log_likelihood
from jaxnav.estimation.tune.transforms import POSITIVE, UNIT, between
from jaxnav.estimation.types import Filter, Info, Obs
from jaxnav.findings import Finding
from jaxnav.recorded.audit import audit
from jaxnav.recorded.config import FilterConfig, members, parts_of
from jaxnav.recorded.methods import filter_params, method
from jaxnav.recorded.offset import likeliest_offset
from jaxnav.recorded.preparation import Drive, prepare
from jaxnav.studies.tuned import Measure, Parameter, Problem, Values

BLOCK_S = 30.0
"""Length of the blocks whose mean log-likelihoods are the samples of the verdict: their errors
depend on each other little, those of neighbouring fixes very much."""
LEAST_BLOCKS = 4


class Half(NamedTuple):
    """A part of the drive as the filter sees it: the receiver's channels alone."""

    inputs: Any
    observations: Obs


def problem(log: DriveLog, config: FilterConfig) -> Problem:
    """Return the tuning of a drive's filter or bank: fit on the first half, judged on the second.

    The loss is the negative log-likelihood of the fixes. The constraints take no part: what they
    observe is not measured, so that its likelihood says nothing. The filter runs at
    ``noise_rate_hz``; parameters have the names of the configuration, so that they can be given
    back to ``jaxnav filter``.

    Raises:
        ConfigError: If the drive is too short to be judged on its second half.
    """
    plain = replace(config, constraints=False, gate=False)
    if config.tune_offset:
        plain = replace(plain, time_offset_s=likeliest_offset(log, config).value_s)
    drive = prepare(log, plain, config.noise_rate_hz)
    half = len(drive.time) // 2
    block = round(BLOCK_S * config.noise_rate_hz)
    if half < LEAST_BLOCKS * block:
        raise ConfigError(
            f"the drive has {len(drive.time) / config.noise_rate_hz:.0f} s; to be judged on its "
            f"second half it must have at least {2 * LEAST_BLOCKS * BLOCK_S:.0f} s"
        )
    chosen = method(plain, drive.initial.mean.position, constrained=False)
    whole = Half(drive.inputs, drive.seen_by(chosen.model))
    first = jax.tree.map(lambda leaf: leaf[:half], whole)
    params_of = partial(_params, plain, drive, log, chosen.form)
    likelihood = compiled(partial(_blocks, chosen.filter, half, block))

    def loss(values: Values, part: Half) -> Array:
        return negative_log_likelihood(
            chosen.filter, params_of(values), *part, segment=max(1, round(half**0.5))
        )

    def judge(values: Values, key: Array, runs: int) -> dict[str, np.ndarray]:
        del key, runs
        hand_set = {name: jnp.asarray(entry.start) for name, entry in parameters.items()}
        return {
            name: np.asarray(likelihood(params_of(of), whole)) * config.noise_rate_hz
            for name, of in (("tuned", values), ("hand-set", hand_set))
        }

    def audited(values: Values) -> list[Finding]:
        kept = run(chosen.filter, params_of(values), *whole, record=chosen.record).record
        return audit(log, drive, kept)

    parameters = _parameters(plain)
    return Problem(
        parameters=parameters,
        draw=lambda key, runs: first,
        loss=loss,
        hard=None,
        held_out={"second half of the drive": judge},
        measure=Measure(
            "mean",
            "log-likelihood of the fixes, the larger the better",
            "nats/s",
            per=f"blocks of {BLOCK_S:g} s",
        ),
        samples=half,
        steps=80,
        optimiser="lbfgs",
        simulated=False,
        mode="forward",
        audit=audited,
        notes=(
            "fixes of a receiver depend on each other, which makes standard deviations too small",
        ),
    )


def _parameters(config: FilterConfig) -> dict[str, Parameter]:
    found = {
        "gyro_noise_dps": "noise density of the gyros [deg/s/sqrt(Hz)]",
        "accel_noise_ug": "noise density of the accelerometers [ug/sqrt(Hz)]",
        "gyro_walk_dps": "random walk of the gyro drift [deg/s/sqrt(s)]",
        "accel_walk_ug": "random walk of the accelerometer bias [ug/sqrt(s)]",
        "r_factors": "factors on the variances of the receiver",
    }
    parameters = {
        name: Parameter(_start(config, name), POSITIVE, text) for name, text in found.items()
    }
    if len(config.q_factors) > 1:
        text = "factors on the process noise; their scale is that of the densities"
        parameters["q_factors"] = Parameter(_start(config, "q_factors"), POSITIVE, text)
    if "sage_husa" in parts_of(config.filter):
        parameters["forgetting"] = Parameter(
            _start(config, "forgetting"), UNIT, "forgetting factors"
        )
    if members(config) > 1 and config.rule in ("forget", "markov"):
        text = "time in which evidence fades, or between switches [s]"
        parameters["rule_time_s"] = Parameter(config.rule_time_s, POSITIVE, text)
    if members(config) > 1 and config.rule == "floor":
        below = between(0.0, 1 / members(config))
        parameters["weight_floor"] = Parameter(config.weight_floor, below, "least weight")
    return parameters


def _start(config: FilterConfig, name: str) -> Any:
    return jnp.asarray(getattr(config, name), float)


def _params(config: FilterConfig, drive: Drive, log: DriveLog, form: Any, values: Values) -> Any:
    """Return the filter's parameters at values by the names of the configuration."""
    given = {
        name: tuple(value) if isinstance(getattr(config, name), tuple) else value
        for name, value in values.items()
    }
    return filter_params(replace(config, **given), drive, log.lever_arm, form)


def _blocks(filter: Filter, start: int, block: int, params: Any, whole: Half) -> Array:
    """Return the mean log-likelihood per step of each block from a step on."""

    def likelihood(state: Any, info: Info) -> Array:
        del state
        return info.log_likelihood

    series = run(filter, params, *whole, record=likelihood).record[start:]
    count = series.shape[0] // block
    return jnp.mean(series[: count * block].reshape(count, block), axis=1)
