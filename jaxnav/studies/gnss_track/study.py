"""The study as a whole: one recorded track, every single filter and every bank."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.config import ConfigError, plain
from jaxnav.datasets.base import DataError
from jaxnav.datasets.plausible import check_fixes
from jaxnav.datasets.rtklib import load_rtklib_pos
from jaxnav.datasets.track import GnssTrack, gaps, intervals_s, thin
from jaxnav.estimation.banks.mixture import BankParams, panel
from jaxnav.estimation.banks.reset import WindowedReset, windowed_reset
from jaxnav.estimation.banks.rule import WeightRule
from jaxnav.estimation.banks.weights import bayes, chain, fixed, floor, markov
from jaxnav.estimation.filters.kalman import kf
from jaxnav.estimation.metrics import root
from jaxnav.estimation.run import run
from jaxnav.estimation.types import FilterParams, Gaussian, Info, Obs, replicate
from jaxnav.findings import Finding, judged, memory_of, size_of
from jaxnav.navigation.earth import enu_from_geodetic
from jaxnav.navigation.models.kinematic import (
    KinematicInput,
    KinematicParams,
    constant_velocity,
)
from jaxnav.studies.base import StudyResult, require_x64
from jaxnav.studies.gnss_track.config import SCENARIOS, GnssTrackConfig

MODEL = constant_velocity(axes=2)
BANKS: dict[str, WeightRule] = {
    "mmae": bayes(),
    "immae": chain(bayes(), windowed_reset()),
    "floor": chain(bayes(), floor()),
    "markov": chain(markov(), bayes()),
}
UNLIKE = 3.0
"""Ratio of the log's standard deviation to the one that is used from which on it is told."""
BLOCKS = 30
"""Stretches of equal length whose scatter gives the standard error of a time average."""


class TrackData(NamedTuple):
    """A track as the filters see it: the first fix is the prior, the others are observations.

    Attributes:
        time: ``(T,) [s]`` since the first fix.
        inputs: Step lengths, ``(T,)``.
        observations: East and north ``(T, 2) [m]`` from the first fix.
        velocity: East and north ``(T, 2) [m/s]`` by the receiver's Doppler, or ``None``.
        initial: Prior at the first fix.
    """

    time: np.ndarray
    inputs: KinematicInput
    observations: Obs
    velocity: np.ndarray | None
    initial: Gaussian


def run_study(
    config: GnssTrackConfig, progress: Callable[[str, int, int], None] | None = None
) -> list[StudyResult]:
    """Run one scenario, or both.

    Args:
        config: The configuration; ``log`` must be given.
        progress: Called with (scenario, tracks done, tracks).

    Returns:
        One result per scenario.

    Raises:
        ConfigError: If no log is given, or 64-bit floats are off.
        DataError: If the log is malformed or too short.
    """
    track = load(config)
    names = tuple(SCENARIOS) if config.scenario == "all" else (config.scenario,)
    results = []
    for name in names:
        results.append(_run_scenario(replace(config, scenario=name), track))
        if progress is not None:
            progress(name, 1, 1)
    return results


def check(config: GnssTrackConfig) -> None:
    """Raise what :func:`run_study` would: :class:`ConfigError` or :class:`DataError`."""
    track = load(config)
    for name in SCENARIOS if config.scenario == "all" else (config.scenario,):
        scenario = replace(config, scenario=name)
        panel_params(scenario, track_data(scenario, track))


def load(config: GnssTrackConfig) -> GnssTrack:
    """Return the track of a configuration; raises as :func:`run_study` does."""
    require_x64()
    if config.log is None:
        raise ConfigError(
            "log is not given; it must be the path of an RTKLIB .pos file, by --log, or by "
            "--study.log where it is tuned"
        )
    track = load_rtklib_pos(config.log)
    try:
        check_fixes(track.time_ns, track.geodetic, track.velocity, track.position_sigma)
    except DataError as error:
        raise DataError(f"{track.source}: {error}") from None
    return track


def track_data(config: GnssTrackConfig, track: GnssTrack) -> TrackData:
    """Return a track in the local level frame of its first fix.

    Raises:
        DataError: If it has fewer than three fixes at the scenario's rate.
    """
    if config.scenario == "thinned":
        track = thin(track, config.thin_period_s)
    if len(track.time_ns) < 3:
        raise DataError(
            f"{track.source} has {len(track.time_ns)} fixes at the rate of {config.scenario}; "
            "a filter needs at least 3"
        )
    geodetic = jnp.asarray(track.geodetic)
    level = jax.vmap(enu_from_geodetic, in_axes=(0, None))(geodetic, geodetic[0])[:, :2]
    sigma = jnp.array([config.position_sigma] * 2 + [config.initial_speed_sigma] * 2)
    seconds = 1e-9 * (track.time_ns - track.time_ns[0]).astype(float)
    return TrackData(
        time=seconds[1:],
        inputs=KinematicInput(jnp.asarray(intervals_s(track)[1:])),
        observations=Obs(level[1:], jnp.ones((len(seconds) - 1, 2), bool)),
        velocity=None if track.velocity is None else track.velocity[1:, :2],
        initial=Gaussian(jnp.zeros(4), jnp.diag(sigma**2)),
    )


def filter_params(density: Array | float, config: GnssTrackConfig, data: TrackData) -> FilterParams:
    """Return the parameters of a single filter with one density [m^2/s^3]."""
    model = KinematicParams(jnp.asarray(density), jnp.asarray(config.position_sigma))
    return FilterParams(model, data.initial)


def panel_params(config: GnssTrackConfig, data: TrackData) -> BankParams:
    """Return the parameters of all methods over one set of members."""
    count = len(config.q)
    members = replicate(filter_params(1.0, config, data), count)
    members = members._replace(model=members.model._replace(density=jnp.array(config.q)))
    period = config.reset_period_s / float(np.median(np.asarray(data.inputs.dt)))
    if period < 1:
        raise ConfigError(
            f"reset_period_s is {config.reset_period_s}; it must be at least one step of "
            f"{config.reset_period_s / period:g} s"
        )
    rules: dict[str, Any] = {
        "mmae": (),
        "immae": ((), WindowedReset(jnp.array(period), jnp.array(config.reset_threshold))),
        "floor": ((), jnp.array(config.weight_floor)),
        "markov": (jnp.array(config.switching), ()),
    }
    priors: dict[str, Array | None] = dict.fromkeys(rules)
    for j, name in enumerate(config.single_ids):
        rules[name] = ()
        priors[name] = jnp.where(jnp.arange(count) == j, 0.0, -jnp.inf)
    return BankParams(members, rules, priors)


def _run_scenario(config: GnssTrackConfig, track: GnssTrack) -> StudyResult:
    data = track_data(config, track)
    rules = {**dict.fromkeys(config.single_ids, fixed()), **BANKS}
    comparison = panel(kf(MODEL), rules)

    def record(state: Any, info: Any) -> tuple[Array, Array, Array, Array]:
        estimate = comparison.estimate(state)
        mean = jnp.stack([estimate[name].mean for name in rules])
        likelihood = jnp.stack([info[name].log_likelihood for name in rules])
        weights = jnp.stack([jnp.exp(state.log_weights[name]) for name in BANKS])
        return mean, likelihood, weights, jnp.stack([whitened(info[name]) for name in rules])

    params = panel_params(config, data)
    trace = run(comparison, params, data.inputs, data.observations, record=record)
    mean, likelihood, weights, white = (np.asarray(leaf) for leaf in trace.record)
    best = int(np.argmax(likelihood.sum(axis=0)))
    return StudyResult(
        study="gnss-track",
        scenario=config.scenario,
        runs=1,
        seed=config.seed,
        config={**plain(config), "log": str(config.log)},
        methods=_measures(tuple(rules), mean, likelihood, white, data),
        published={},
        claims=[],
        arrays=_arrays(config, tuple(rules), mean, likelihood, weights, data),
        dims={
            "time": ("time",),
            "fix": ("time", "axis"),
            "estimate": ("time", "estimator", "component"),
            "log_likelihood": ("time", "estimator"),
            "weights": ("time", "bank", "model"),
            "doppler": ("time", "axis"),
        },
        notes=_notes(config, track, data),
        audit=audit(white[:, best]),
    )


def whitened(info: Info) -> Array:
    """Return the innovation ``(2,)`` of an update over its standard deviations."""
    return info.innovation / jnp.sqrt(jnp.diag(info.innovation_cov))


def audit(white: np.ndarray) -> list[Finding]:
    """Judge the whitened innovations ``(T, 2)`` of a run: their size and how they last.

    The mean of a few that are off by kilometres says nothing of the rest, so that the largest is
    judged by itself.
    """
    largest = float(np.max(np.abs(white)))
    at = int(np.argmax(np.max(np.abs(white), axis=1))) + 2
    return [
        size_of("positions", float(np.mean(white**2))),
        memory_of("positions", white),
        judged(
            "largest innovation",
            largest,
            (0.0, 20.0),
            (0.0, 100.0),
            "sigmas",
            f"fix {at} of those used is {largest:.3g} standard deviations from its prediction: it "
            "is off, or the receiver jumped; cut it out",
        ),
    ]


def _arrays(
    config: GnssTrackConfig,
    methods: tuple[str, ...],
    mean: np.ndarray,
    likelihood: np.ndarray,
    weights: np.ndarray,
    data: TrackData,
) -> dict[str, Any]:
    fixes = np.asarray(data.observations.z)
    missing = np.full_like(fixes, np.nan)
    return {
        "time": data.time,
        "fix": fixes,
        "estimate": mean,
        "log_likelihood": likelihood,
        "weights": weights,
        "doppler": missing if data.velocity is None else data.velocity,
        "estimator": np.array(methods),
        "bank": np.array(tuple(BANKS)),
        "model": np.array(config.q),
        "axis": np.array(("east", "north")),
        "component": np.array(("east", "north", "east velocity", "north velocity")),
    }


def _measures(
    methods: tuple[str, ...],
    mean: np.ndarray,
    likelihood: np.ndarray,
    white: np.ndarray,
    data: TrackData,
) -> dict[str, dict[str, Any]]:
    measures: dict[str, dict[str, Any]] = {}
    for i, name in enumerate(methods):
        total = likelihood[:, i]
        entry: dict[str, Any] = {
            "log_likelihood": float(total.sum()),
            "log_likelihood_se": _block_se(total) * total.size,
            "nis_per_channel": float(np.mean(white[:, i] ** 2)),
            "diverged": int(not np.all(np.isfinite(mean[:, i]))),
        }
        if data.velocity is not None:
            square = np.sum((mean[:, i, 2:] - data.velocity) ** 2, axis=-1)
            velocity = root(float(square.mean()), _block_se(square))
            entry["rmse"] = {"velocity": {**velocity._asdict(), "unit": "m/s"}}
        measures[name] = entry
    return measures


def _block_se(values: np.ndarray) -> float:
    """Return the standard error of a time average from the scatter of block means."""
    length = values.size // BLOCKS
    if length < 1:
        return float("nan")
    means = values[: BLOCKS * length].reshape(BLOCKS, length).mean(axis=1)
    return float(np.std(means, ddof=1) / np.sqrt(BLOCKS))


def _notes(config: GnssTrackConfig, track: GnssTrack, data: TrackData) -> list[str]:
    steps = np.asarray(data.inputs.dt)
    notes = [
        f"{steps.size} steps of {np.median(steps):g} s after the first fix of {track.source}; "
        f"standard errors from {BLOCKS} blocks of the track."
    ]
    if track.unsolved:
        notes.append(f"{track.unsolved} fixes without a solution were left out.")
    if track.duplicates:
        notes.append(f"{track.duplicates} fixes with a repeated time stamp were left out.")
    missing = gaps(thin(track, config.thin_period_s) if config.scenario == "thinned" else track)
    if missing.size:
        longest = float(np.max(steps[missing - 1]))
        notes.append(
            f"{missing.size} gaps in the log, the longest {longest:g} s, were predicted over."
        )
    coarse = int(np.sum(track.quality != 1))
    if coarse:
        notes.append(
            f"{coarse} of {track.quality.size} fixes are not RTK-fixed (Q is not 1) and are used "
            f"with the same sigma of {config.position_sigma:g} m."
        )
    stated = np.nan if track.position_sigma is None else np.median(track.position_sigma[:, :2])
    if stated > 0 and not 1 / UNLIKE < stated / config.position_sigma < UNLIKE:
        notes.append(
            f"The log states a standard deviation of {stated:.3g} m and the filters believe "
            f"{config.position_sigma:g} m, which is --position-sigma."
        )
    if data.velocity is None:
        notes.append("The log has no velocity: the estimates are not scored against one.")
    return notes
