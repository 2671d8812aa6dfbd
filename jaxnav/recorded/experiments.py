"""What recorded fixes are good for beside being filtered: outages, and noise added to them."""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.datasets.base import DataError
from jaxnav.datasets.drive import DriveLog
from jaxnav.estimation.banks.mixture import BankParams, panel
from jaxnav.estimation.banks.rule import WeightRule
from jaxnav.estimation.banks.weights import Penalty, bayes, chain, fixed, floor, penalty
from jaxnav.estimation.filters.gated import Gated
from jaxnav.estimation.filters.kalman import ekf
from jaxnav.estimation.filters.sage_husa import sage_husa
from jaxnav.estimation.run import run
from jaxnav.estimation.types import Filter, FilterParams, Model, replicate
from jaxnav.navigation.earth import WGS84, metres_per_radian
from jaxnav.navigation.models.vehicle import FIXES, vehicle
from jaxnav.navigation.states import SinsLevel, error_form
from jaxnav.recorded.config import ALONE, FilterConfig
from jaxnav.recorded.methods import Kept, Method, filter_params, sage_husa_params
from jaxnav.recorded.preparation import Drive, Seen, prepare
from jaxnav.recorded.scoring import MOUNTING_S, fix_errors, horizontal

FREE_S = 5.0
"""Time with fixes after the last window, so that the filter is seen to recover."""
GRID_SIGMA = (0.03, 0.3, 3.0, 10.0)
"""Standard deviations [m] of positions of the bank over R; the third is that of a code receiver."""
GRID_FORGETTING = (0.9, 0.99)
GRID_Q = (1.0, 10.0)
PAPER_SIGMA = 2
"""Which of them is the filter that is told neither the carrier phase nor the added noise."""


TILE = 10
"""Draws that run at once."""


class Outages(NamedTuple):
    """Errors in W windows without fixes.

    Attributes:
        start: ``(W,) [s]`` since the first inertial sample.
        since: Times of the hidden fixes since the start of their window, ``(H,) [s]``.
        window: ``(H,)`` their windows.
        error: ``(H,) [m]`` horizontal errors there, by method.
        at_end: ``(W,) [m]`` those at the last hidden fix of each window, by method.
    """

    start: np.ndarray
    since: np.ndarray
    window: np.ndarray
    error: dict[str, np.ndarray]
    at_end: dict[str, np.ndarray]


class NoiseScores(NamedTuple):
    """Mean squares of the errors of methods under added noise, over N draws and K spans.

    Attributes:
        mean_square: ``(N, K, 2) [m^2]`` east and north, by method.
        fixes: ``(K,)`` number of fixes of each span.
        weights: ``(T, M)`` in the first draw, by bank.
        members: Names of the members, by bank.
        time: ``(T,) [s]``.
    """

    mean_square: dict[str, np.ndarray]
    fixes: np.ndarray
    weights: dict[str, np.ndarray]
    members: dict[str, list[str]]
    time: np.ndarray


def window_starts(drive: Drive, config: FilterConfig) -> np.ndarray:
    """Return the starts ``(W,) [s]`` of the windows: after the first minute, at equal distances.

    Raises:
        DataError: If the drive has no room for one.
    """
    first, last = drive.time[0] + MOUNTING_S, drive.time[-1] - config.outage_s - FREE_S
    if first > last:
        raise DataError(
            f"the drive lasts {drive.time[-1] - drive.time[0]:.6g} s after the alignment; accepted "
            f"for outages are at least {MOUNTING_S + config.outage_s + FREE_S:g} s, or --outages "
            "off"
        )
    return np.arange(first, last, config.outage_every_s)


def hide_and_score(
    method: Method, params: Any, drive: Drive, config: FilterConfig
) -> tuple[Outages, dict[str, Kept]]:
    """Hide the fixes in windows and score against them, with and without the constraints.

    One run each over the whole drive, so that a window starts from what the filter has recovered
    since the one before.

    Args:
        method: The filter or bank, with the channels of the constraints.
        params: Its parameters.
        drive: The drive.
        config: The configuration.

    Returns:
        The errors, by "inertial" and, if there are constraints, "constrained"; and the runs.
    """
    start = window_starts(drive, config)
    at = drive.time[drive.fix_step]
    window = np.searchsorted(start, at, side="right") - 1
    hidden = (window >= 0) & (at < start[window] + config.outage_s)
    left = {name: drive.channels[name].without(drive.fix_step[hidden]) for name in FIXES}
    drives = {"inertial": drive._replace(channels=left)}
    if config.constraints:
        drives["constrained"] = drive._replace(channels={**drive.channels, **left})
    one = single_model(params)
    errors, runs = {}, {}
    for name, partly in drives.items():
        obs = partly.seen_by(method.model)
        kept = run(method.filter, params, drive.inputs, obs, record=method.record).record
        off = fix_errors(method.model, one, drive, kept.state)["position"]
        errors[name], runs[name] = horizontal(off)[hidden], kept
    in_window = window[hidden]
    last = np.flatnonzero(np.diff(in_window, append=-1) != 0)
    at_end = {name: error[last] for name, error in errors.items()}
    since = at[hidden] - start[in_window]
    return Outages(start[in_window[last]], since, in_window, errors, at_end), runs


def single_model(params: FilterParams | BankParams | Gated) -> Any:
    """Return the model's parameters of a filter, or of the first member of a bank."""
    if isinstance(params, Gated):
        return single_model(params.inner)
    if isinstance(params, BankParams):
        return jax.tree.map(lambda leaf: leaf[0], params.members.model)
    return params.model


def add_noise(log: DriveLog, config: FilterConfig) -> NoiseScores:
    """Compare filters and banks on the fixes with noise added to their positions.

    All know the receiver and the inertial sensors alone, at the rate of ``noise_rate_hz``, and all
    start from the receiver's own standard deviations but one, "ekf-code", that takes 3 m:

    * "ekf": fixed; "mmae": a bank over the standard deviation of positions, Bayes' rule with a
      floor;
    * "sage-husa": with one forgetting factor; "bank-floor" and "bank-penalty": a bank of these
      over forgetting factor and process noise, by Bayes' rule with a floor and by the increasing
      penalty.

    Args:
        log: The drive.
        config: The configuration.

    Returns:
        Mean squares of the estimates against the fixes as they were.

    References:
        Song et al. (2022), Sensors 22:5976, Table 3 and Eqs. (26)-(27): noise of 6 m and 9 m.
    """
    plain = replace(config, **ALONE)
    drive = prepare(log, plain, config.noise_rate_hz)
    origin = drive.initial.mean.position
    model, form = vehicle(constrained=False), error_form("additive", origin)
    one = filter_params(plain, drive, log.lever_arm, form)
    assert isinstance(one, FilterParams)
    narrow = _until(drive, max(config.noise_end_s))
    noise, span = _noise(narrow, config)
    panels = {"plain": _r_panel(model, one), "adaptive": _adaptive_panel(model, one, config)}
    squares: dict[str, np.ndarray] = {}
    weights: dict[str, np.ndarray] = {}
    names: dict[str, list[str]] = {}
    for own in panels.values():
        mean, weight = _all_draws(own, model, narrow, noise)
        for i, name in enumerate(own.names):
            x = jax.tree.map(lambda leaf, i=i: leaf[:, :, i], mean)
            off = np.stack([_off(model, one.model, narrow, x, k) for k in range(len(noise))])
            squares[name] = np.stack(
                [np.mean(off[:, span == k, :2] ** 2, axis=1) for k in range(_spans(config))], 1
            )
            if name in own.banks:
                weights[name], names[name] = np.asarray(weight)[0, :, i], own.members
    counts = np.array([np.sum(span == k) for k in range(_spans(config))])
    return NoiseScores(squares, counts, weights, names, narrow.time[narrow.fix_step])


class _Panel(NamedTuple):
    filter: Filter
    params: BankParams
    names: tuple[str, ...]
    banks: tuple[str, ...]
    members: list[str]


def _until(drive: Drive, end: float) -> Drive:
    """Return a drive up to a time, with the channels of the receiver alone."""
    part = drive.time < end
    fixes = part[drive.fix_step]
    return drive._replace(
        time=drive.time[part],
        inputs=jax.tree.map(lambda leaf: leaf[part], drive.inputs),
        channels={name: Seen(*(leaf[part] for leaf in drive.channels[name])) for name in FIXES},
        fix_step=drive.fix_step[fixes],
        fix=drive.fix[fixes],
        stopped=drive.stopped[part],
    )


def _spans(config: FilterConfig) -> int:
    return len(config.noise_sigma_m)


def _noise(drive: Drive, config: FilterConfig) -> tuple[np.ndarray, np.ndarray]:
    """Return noise on latitude and longitude ``(N, F, 3)``, and the span of each fix or -1."""
    at = drive.time[drive.fix_step]
    span = np.full(len(at), -1)
    spans = zip(config.noise_start_s, config.noise_end_s, strict=True)
    for k, (start, end) in enumerate(spans):
        span[(at >= start) & (at < end)] = k
        if not np.any(span == k):
            raise DataError(
                f"there is no fix from {start:g} s to {end:g} s, where noise is to be added; the "
                f"fixes last from {at[0]:.6g} s to {at[-1]:.6g} s"
            )
    sigma = np.where(span >= 0, np.array(config.noise_sigma_m)[span], 0.0)
    rng = np.random.default_rng(config.seed)
    metres = rng.normal(size=(config.noise_runs, len(at), 2)) * sigma[:, None]
    scale = np.asarray(metres_per_radian(drive.initial.mean.position, WGS84))[:2]
    north_east = metres[..., ::-1] / scale
    return np.concatenate([north_east, np.zeros_like(north_east[..., :1])], axis=-1), span


def _r_panel(model: Any, one: FilterParams) -> _Panel:
    """Return two fixed filters and a bank over the standard deviation of positions."""
    count = len(GRID_SIGMA)
    several = replicate(one, count)
    up = one.model.inner.position_noise[2]
    sigma = jnp.array(GRID_SIGMA)
    position = jnp.stack([sigma, sigma, jnp.full(count, up)], axis=1)
    inner = several.model.inner._replace(position_noise=position)
    several = several._replace(model=several.model._replace(inner=inner))
    rules: dict[str, WeightRule] = {
        "ekf": fixed(),
        "ekf-code": fixed(),
        "mmae": chain(bayes(), floor()),
    }
    alone = {"ekf": 0, "ekf-code": PAPER_SIGMA}
    own = {"ekf": (), "ekf-code": (), "mmae": ((), jnp.array(1e-3))}
    params = BankParams(several, own, _priors(rules, alone, count))
    members = [f"{sigma:g} m" for sigma in GRID_SIGMA]
    return _Panel(panel(ekf(model), rules), params, tuple(rules), ("mmae",), members)


def _adaptive_panel(model: Any, one: FilterParams, config: FilterConfig) -> _Panel:
    """Return a Sage-Husa filter, and banks of them over forgetting factor and process noise."""
    grid = [(b, q) for q in GRID_Q for b in (config.forgetting[0], *GRID_FORGETTING)]
    count = len(grid)
    several = replicate(one, count)
    own = jax.vmap(sage_husa_params)(jnp.array([b for b, _ in grid]))
    root = jnp.sqrt(jnp.array([q for _, q in grid]))[:, None]
    inner = several.model.inner._replace(
        gyro_noise=root * several.model.inner.gyro_noise,
        accel_noise=root * several.model.inner.accel_noise,
    )
    several = several._replace(model=several.model._replace(inner=inner), own=own)
    rules: dict[str, WeightRule] = {
        "sage-husa": fixed(),
        "bank-floor": chain(bayes(), floor()),
        "bank-penalty": penalty(),
    }
    given = {"sage-husa": (), "bank-floor": ((), jnp.array(1e-3)), "bank-penalty": Penalty()}
    params = BankParams(several, given, _priors(rules, {"sage-husa": 0}, count))
    members = [f"b {b:g}, Q x{q:g}" for b, q in grid]
    base = sage_husa(ekf(model), current=True)
    return _Panel(panel(base, rules), params, tuple(rules), tuple(rules)[1:], members)


def _priors(rules: dict[str, WeightRule], alone: dict[str, int], count: int) -> dict[str, Any]:
    return {
        name: jnp.where(jnp.arange(count) == alone[name], 0.0, -jnp.inf) if name in alone else None
        for name in rules
    }


def _all_draws(
    own: _Panel, model: Model, drive: Drive, noise: np.ndarray
) -> tuple[SinsLevel, Array]:
    """Return estimates ``(N, F, rules)`` and weights ``(N, F, rules, M)`` at the fixes."""
    at, filter, names = jnp.asarray(drive.fix_step), own.filter, own.names

    def record(state: Any, info: Any) -> tuple[Any, Array]:
        del info
        estimate = filter.estimate(state)
        means = [estimate[name].mean for name in names]
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *means)
        return stacked, jnp.stack([jnp.exp(state.log_weights[name]) for name in names])

    seen = drive.seen_by(model)

    def one(noise: Array) -> tuple[SinsLevel, Array]:
        obs = seen._replace(z=seen.z.at[at, model.channel("position")].add(noise))
        kept = run(filter, own.params, drive.inputs, obs, record=record).record
        return jax.tree.map(lambda leaf: leaf[at], kept)

    return compiled(lambda noise: jax.lax.map(one, noise, batch_size=TILE))(jnp.asarray(noise))


def _off(model: Any, params: Any, drive: Drive, mean: Any, draw: int) -> np.ndarray:
    """Return the errors ``(F, 3) [m]`` of one draw against the fixes as they were."""
    x = jax.tree.map(lambda leaf: leaf[draw], mean)
    at = jnp.asarray(drive.fix_step)
    thin = drive._replace(
        inputs=jax.tree.map(lambda leaf: leaf[at], drive.inputs),
        channels=jax.tree.map(lambda leaf: leaf[drive.fix_step], drive.channels),
        fix_step=np.arange(len(drive.fix_step)),
    )
    return fix_errors(model, params, thin, x)["position"]
