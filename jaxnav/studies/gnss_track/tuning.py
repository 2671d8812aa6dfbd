"""The noise and the switching of the track's models, found from its first half."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.estimation.banks.mixture import BankParams, bank, panel
from jaxnav.estimation.banks.weights import bayes, chain, fixed, markov
from jaxnav.estimation.filters.kalman import kf
from jaxnav.estimation.run import run
from jaxnav.estimation.tune.losses import negative_log_likelihood
from jaxnav.estimation.tune.transforms import POSITIVE, UNIT
from jaxnav.estimation.types import Info, Obs, replicate
from jaxnav.findings import Finding
from jaxnav.navigation.models.kinematic import KinematicInput
from jaxnav.studies.base import require_one_scenario
from jaxnav.studies.gnss_track.config import SCENARIOS, GnssTrackConfig
from jaxnav.studies.gnss_track.study import (
    BANKS,
    BLOCKS,
    MODEL,
    TrackData,
    audit,
    filter_params,
    load,
    panel_params,
    track_data,
    whitened,
)
from jaxnav.studies.tuned import Measure, Parameter, Problem, Values

BANK = bank(kf(MODEL), chain(markov(), bayes()))


class Part(NamedTuple):
    """A part of the track as the filters see it."""

    inputs: KinematicInput
    observations: Obs


def problem(config: GnssTrackConfig) -> Problem:
    """Return the tuning of a bank with Markov switching: fit on the first half of the track.

    The loss is the negative log-likelihood of the mixture's predictions. The verdict is the mean
    log-likelihood of a fix in the second half, after the filter has run through the first, beside
    every hand-set rule and single filter of the study; its samples are blocks of the half, whose
    means depend on each other less than neighbouring fixes do, yet a little, which makes the
    intervals too narrow.

    Raises:
        ConfigError: If no log is given, or the scenario is "all".
        DataError: If the log is malformed or too short.
    """
    require_one_scenario(config, SCENARIOS)
    data = track_data(config, load(config))
    half = data.time.size // 2
    whole = Part(data.inputs, data.observations)
    first = jax.tree.map(lambda leaf: leaf[:half], whole)
    params_of = partial(_bank_params, config, data)
    return Problem(
        parameters=_parameters(config),
        draw=lambda key, runs: first,
        loss=lambda values, part: negative_log_likelihood(BANK, params_of(values), *part),
        hard=None,
        held_out={"second half of the track": partial(_judge, config, data, half)},
        measure=Measure(
            "mean", "log-likelihood of a fix, the larger the better", "nats", per="blocks"
        ),
        samples=half,
        steps=150,
        optimiser="lbfgs",
        simulated=False,
        mode="forward",
        audit=partial(_audited, config, data),
    )


def _audited(config: GnssTrackConfig, data: TrackData, values: Values) -> list[Finding]:
    def record(state: Any, info: Info) -> Array:
        del state
        return whitened(info)

    params = _bank_params(config, data, values)
    trace = run(BANK, params, data.inputs, data.observations, record=record)
    return audit(np.asarray(trace.record))


def _parameters(config: GnssTrackConfig) -> dict[str, Parameter]:
    return {
        "q": Parameter(jnp.array(config.q), POSITIVE, "densities of the models [m^2/s^3]"),
        "position_sigma": Parameter(
            config.position_sigma, POSITIVE, "standard deviation of a fix, each axis [m]"
        ),
        "switching": Parameter(config.switching, UNIT, "probability to switch, per step"),
    }


def _bank_params(config: GnssTrackConfig, data: TrackData, values: Values) -> BankParams:
    one = filter_params(1.0, config, data)
    one = one._replace(model=one.model._replace(position_sigma=values["position_sigma"]))
    members = replicate(one, len(config.q))
    members = members._replace(model=members.model._replace(density=values["q"]))
    return BankParams(members, (values["switching"], ()))


def _judge(
    config: GnssTrackConfig, data: TrackData, half: int, values: Values, key: Array, runs: int
) -> dict[str, np.ndarray]:
    """Return the mean log-likelihood of a fix [nats] in blocks of the second half, by method."""
    del key, runs
    rules = {**dict.fromkeys(config.single_ids, fixed()), **BANKS}

    def recorded(state: Any, info: Any) -> Any:
        del state
        return jax.tree.map(
            lambda one: one.log_likelihood, info, is_leaf=lambda node: isinstance(node, Info)
        )

    def series(filter: Any, params: BankParams) -> Any:
        return run(filter, params, data.inputs, data.observations, record=recorded).record

    found = {"tuned": series(BANK, _bank_params(config, data, values))}
    found |= series(panel(kf(MODEL), rules), panel_params(config, data))
    found["hand-set"] = found.pop("markov")
    length = (data.time.size - half) // BLOCKS
    end = half + BLOCKS * length
    return {
        name: np.asarray(values[half:end]).reshape(BLOCKS, length).mean(axis=1)
        for name, values in found.items()
    }
