"""From a recorded drive to what a filter takes: inputs, observations, the state at the start."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.lib.stride_tricks import sliding_window_view

from jaxnav.compiling import compiled
from jaxnav.datasets.base import DataError
from jaxnav.datasets.drive import DriveLog
from jaxnav.datasets.inertial import ImuLog
from jaxnav.datasets.track import GnssTrack
from jaxnav.estimation.types import Gaussian, Obs
from jaxnav.navigation.alignment import align_with_heading, course_heading
from jaxnav.navigation.models.level_errors import SinsLevel
from jaxnav.navigation.models.sins_gnss import SinsGnssInput
from jaxnav.navigation.models.vehicle import CONSTRAINTS, FIXES, REST, STEERED, VehicleInput
from jaxnav.navigation.strapdown.increments import accumulate, increments_from_rates
from jaxnav.numerics.lie import so3_exp
from jaxnav.numerics.linalg import matmul
from jaxnav.recorded.config import FilterConfig
from jaxnav.units import DEG

CHANNELS = FIXES.stop + len(CONSTRAINTS)
SMOOTHED_S = 0.2
"""Time over which samples are averaged before a stop is looked for: engines shake faster."""
LEVEL_S = 2.0
"""Shortest rest to level by, and time to level by on the move [s]."""
REST_SIGMA = (0.5 * DEG, 5 * DEG, 0.03 * DEG)
"""Of tilt and heading [rad] and gyro drift [rad/s] after a rest; the heading is a course."""
MOVING_SIGMA = (3 * DEG, 5 * DEG, 0.5 * DEG)
"""The same when the vehicle was moving from the first sample on, and hardly turned meanwhile."""
VELOCITY_SIGMA = 0.3
BIAS_SIGMA = 0.2
"""Of the accelerometer bias [m/s^2], each axis: 20 mg, as data sheets of MEMS sensors have it."""


class Drive(NamedTuple):
    """A drive on a filter's clock, from the end of the alignment on: T periods and F fixes.

    Attributes:
        time: ``(T,) [s]`` ends of the periods since the first inertial sample.
        inputs: :class:`~jaxnav.navigation.models.vehicle.VehicleInput`, leading axis T.
        observations: ``(T, 11)``: fixes and constraints where they hold.
        initial: State at the start, its covariance in additive errors.
        fix_step: ``(F,)`` period of each fix that is used.
        fix: ``(F,)`` its place in the log.
        position_noise: Base of the fixes' standard deviations ``(3,) [m]``, east, north, up.
        velocity_noise: Likewise of their velocities [m/s].
        at_rest: Whether the alignment is from a rest.
        unused: Fixes outside the filter's time, or with no period of their own.
        stopped: ``(T,)`` whether the vehicle is found to be at rest.
        bridged_s: The longest period [s].
    """

    time: np.ndarray
    inputs: VehicleInput
    observations: Obs
    initial: Gaussian
    fix_step: np.ndarray
    fix: np.ndarray
    position_noise: np.ndarray
    velocity_noise: np.ndarray
    at_rest: bool
    unused: int
    stopped: np.ndarray
    bridged_s: float


class _Start(NamedTuple):
    """The start: sample and fix of it, state, and whether it is from a rest."""

    sample: int
    state: SinsLevel
    at_rest: bool


def prepare(log: DriveLog, config: FilterConfig, rate_hz: float | None = None) -> Drive:
    """Return a drive on the clock of a filter.

    A fix is observed at the end of the nearest period, which the model takes to the time of the
    fix by velocity and acceleration. Of two fixes of one period the nearer is used.

    Args:
        log: The drive.
        config: The configuration.
        rate_hz: Rate of the filter; ``None`` is that of the inertial samples. A period is a whole
            number of samples.

    Raises:
        DataError: If the vehicle never moves while there are fixes, or fewer than three fixes can
            be used.
    """
    time = _seconds(log.imu.time_ns, log)
    fix_time = _seconds(log.fixes.time_ns, log) + config.time_offset_s
    still = still_samples(log.imu, config)
    start = _start(log, config, time, fix_time, still)
    every = 1 if rate_hz is None else max(1, round(1 / (rate_hz * log.imu.step_s)))
    ends = np.arange(start.sample + every, len(time), every)
    if len(ends) < 2:
        raise DataError(
            f"{log.source}: {len(time) - start.sample} samples are left after the alignment at "
            f"{time[start.sample]:.6g} s; accepted are at least two periods of {every}"
        )
    step, fix = _nearest_periods(time[ends], fix_time)
    if len(step) < 3:
        raise DataError(
            f"{log.source}: {len(step)} fixes fall in the time after the alignment, from "
            f"{time[start.sample]:.6g} s to {time[ends[-1]]:.6g} s; accepted are at least three"
        )
    position_noise, velocity_noise = _base_noise(log.fixes, config)
    lag, grade = np.zeros(len(ends)), np.ones(len(ends))
    lag[step] = fix_time[fix] - time[ends][step]
    grade[step] = _grade(log.fixes, position_noise)[fix]
    stopped = still[ends] & config.constraints
    return Drive(
        time=time[ends],
        inputs=VehicleInput(
            _sensed(log.imu, time, start.sample, every, len(ends)),
            jnp.asarray(lag),
            jnp.asarray(grade),
        ),
        observations=_observations(log.fixes, config, time[ends], step, fix, stopped),
        initial=_initial(start, position_noise),
        fix_step=step,
        fix=fix,
        position_noise=position_noise,
        velocity_noise=velocity_noise,
        at_rest=start.at_rest,
        unused=len(fix_time) - len(fix),
        stopped=stopped,
        bridged_s=float(np.max(np.diff(time[start.sample :]))),
    )


def still_samples(imu: ImuLog, config: FilterConfig) -> np.ndarray:
    """Return at which samples ``(N,)`` the vehicle has been at rest for ``stop_time_s``.

    Of means over a fifth of a second, the rates stay below ``stop_gyro_dps`` from their median in
    quiet times, and the specific force scatters by less than ``stop_accel``.
    """
    width = max(1, round(SMOOTHED_S / imu.step_s))
    window = max(2, round(config.stop_time_s / imu.step_s))
    count = len(imu.valid)
    still = np.zeros(count, bool)
    if count < width + window:
        return still
    gyro, accel = (_means(values, width) for values in (imu.gyro, imu.accel))
    scatter = sliding_window_view(accel, window, axis=0).std(axis=-1).max(axis=1)
    quiet = scatter < config.stop_accel
    if not quiet.any():
        return still
    last = window - 1
    bias = np.median(gyro[last:][quiet], axis=0)
    # A drift is below a degree a second: what is quiet and turns more is a smooth bend.
    bias = np.where(np.abs(bias) < DEG, bias, 0)
    turning = sliding_window_view(np.abs(gyro - bias).max(axis=1), window).max(axis=1)
    still[width - 1 + last :] = quiet & (turning < config.stop_gyro_dps * DEG)
    return still


def _means(values: np.ndarray, width: int) -> np.ndarray:
    """Return means ``(N - width + 1, 3)`` of so many samples on end."""
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(values, axis=0)])
    return (total[width:] - total[:-width]) / width


def _seconds(time_ns: np.ndarray, log: DriveLog) -> np.ndarray:
    return (time_ns - log.imu.time_ns[0]) / 1e9


def velocity_of(fixes: GnssTrack) -> np.ndarray:
    """Return the velocities ``(F, 3)`` of a log of fixes, NaN where it has none."""
    if fixes.velocity is None:
        return np.full((len(fixes.time_ns), 3), np.nan)
    return fixes.velocity


def _base_noise(fixes: GnssTrack, config: FilterConfig) -> tuple[np.ndarray, np.ndarray]:
    """Return the medians of the logged standard deviations, or the configured ones if larger."""
    position = np.nanmedian(fixes.position_sigma, axis=0)
    velocity = np.zeros(3)
    if fixes.velocity_sigma is not None:
        known = np.isfinite(fixes.velocity_sigma).any(axis=0)
        velocity[known] = np.nanmedian(fixes.velocity_sigma[:, known], axis=0)
    return np.maximum(position, config.position_sigma_m), np.maximum(
        velocity, config.velocity_sigma
    )


def _grade(fixes: GnssTrack, base: np.ndarray) -> np.ndarray:
    """Return how many times worse than the base each fix says it is, one at least."""
    sigma = np.where(np.isfinite(fixes.position_sigma), fixes.position_sigma, base)
    return np.maximum(1.0, np.linalg.norm(sigma, axis=1) / np.linalg.norm(base))


def _nearest_periods(ends: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the periods whose ends are nearest to times, and the places of these; no period twice.

    A time that is farther than a typical period from any end has none.
    """
    above = np.clip(np.searchsorted(ends, times), 1, len(ends) - 1)
    nearest = above - (times - ends[above - 1] < ends[above] - times)
    away = np.abs(times - ends[nearest])
    place = np.flatnonzero(away <= 0.75 * np.median(np.diff(ends)))
    order = place[np.lexsort((away[place], nearest[place]))]
    step, first = np.unique(nearest[order], return_index=True)
    return step, order[first]


def _sensed(imu: ImuLog, time: np.ndarray, first: int, every: int, count: int) -> SinsGnssInput:
    part = slice(first, first + every * count + 1)
    dt = np.diff(time[part])
    return _condensed(
        jnp.asarray(imu.gyro[part]),
        jnp.asarray(imu.accel[part]),
        jnp.asarray(dt),
        jnp.asarray(imu.valid[part]),
        every,
    )


@compiled(static_argnums=4)
def _condensed(gyro: Array, accel: Array, dt: Array, valid: Array, every: int) -> SinsGnssInput:
    turned, gain = accumulate(*increments_from_rates(gyro, accel, dt, valid), every)
    period = jnp.sum(dt.reshape(-1, every), axis=1)
    return SinsGnssInput(turned, gain, turned / period[:, None], period)


def _observations(
    fixes: GnssTrack,
    config: FilterConfig,
    ends: np.ndarray,
    step: np.ndarray,
    fix: np.ndarray,
    stopped: np.ndarray,
) -> Obs:
    z, valid = np.zeros((len(ends), CHANNELS)), np.zeros((len(ends), CHANNELS), bool)
    seen = np.hstack([velocity_of(fixes), fixes.geodetic])[fix]
    known = np.isfinite(seen)
    z[step, FIXES], valid[step, FIXES] = np.where(known, seen, 0), known
    if config.constraints:
        ticks = np.floor(ends * config.steered_rate_hz)
        due = np.diff(ticks, prepend=ticks[0] - 1) > 0
        valid[:, STEERED] = (due & ~stopped)[:, None]
        valid[:, REST] = (due & stopped)[:, None]
    return Obs(jnp.asarray(z), jnp.asarray(valid))


def _start(
    log: DriveLog,
    config: FilterConfig,
    time: np.ndarray,
    fix_time: np.ndarray,
    still: np.ndarray,
) -> _Start:
    """Return where the filter starts: at the first fix whose course gives the heading."""
    velocity = velocity_of(log.fixes)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    inside = (fix_time >= time[0]) & (fix_time < time[-1])
    moving = np.flatnonzero(inside & (speed >= config.align_speed))
    if not len(moving):
        fastest = np.max(speed[inside & np.isfinite(speed)], initial=0.0)
        raise DataError(
            f"{log.source}: the fixes within the inertial samples are at most {fastest:.4g} m/s "
            f"fast; accepted is a drive that reaches align_speed, {config.align_speed} m/s"
        )
    sample = int(np.searchsorted(time, fix_time[moving[0]]))
    rest = _last_rest(still[:sample], max(1, round(LEVEL_S / log.imu.step_s)))
    if rest is None:
        return _moving_start(log, time, fix_time, moving[0])
    gyro, accel = (
        np.mean(values[rest][log.imu.valid[rest]], axis=0)
        for values in (log.imu.gyro, log.imu.accel)
    )
    part = slice(rest.stop, sample + 1)
    turns = (log.imu.gyro[part] - gyro) * np.diff(time[part], append=time[sample])[:, None]
    dcm = _headed(jnp.asarray(accel), jnp.asarray(turns), jnp.asarray(velocity[moving[0]]))
    return _started(log, sample, moving[0], dcm, jnp.asarray(gyro), at_rest=True)


def _last_rest(still: np.ndarray, shortest: int) -> slice | None:
    """Return the last run of rest of at least so many samples."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    for begin, end in edges.reshape(-1, 2)[::-1]:
        if end - begin >= shortest:
            return slice(int(begin), int(end))
    return None


def _moving_start(log: DriveLog, time: np.ndarray, fix_time: np.ndarray, first: int) -> _Start:
    """Return a start from the move: level by the force less what speed and bends make of it.

    The mean rate less that of the course is taken for the drift.

    Raises:
        DataError: If the fixes do not go on for the time to level by.
    """
    later = np.flatnonzero(fix_time >= fix_time[first] + LEVEL_S)
    velocity = velocity_of(log.fixes)
    later = [i for i in later if np.isfinite(velocity[i, :2]).all() and fix_time[i] < time[-1]]
    if not later:
        raise DataError(
            f"{log.source}: the fixes end within {LEVEL_S:g} s of the first that is fast enough, at"
            f" {fix_time[first]:.6g} s; accepted is a longer drive"
        )
    begin, end = (int(np.searchsorted(time, fix_time[i])) for i in (first, later[0]))
    part = np.arange(begin, end)[log.imu.valid[begin:end]]
    lasted = fix_time[later[0]] - fix_time[first]
    speed = np.linalg.norm(velocity[[first, later[0]], :2], axis=1)
    course = np.arctan2(velocity[[first, later[0]], 0], velocity[[first, later[0]], 1])
    left = -math.remainder(course[1] - course[0], 2 * math.pi) / lasted
    drift = np.mean(log.imu.gyro[part], axis=0) - [0.0, 0.0, left]
    surge = np.array([(speed[1] - speed[0]) / lasted, np.mean(speed) * left, 0.0])
    force = np.mean(log.imu.accel[part], axis=0) - surge
    dcm = _headed(jnp.asarray(force), jnp.zeros((1, 3)), jnp.asarray(velocity[later[0]]))
    return _started(log, end, int(later[0]), dcm, jnp.asarray(drift), at_rest=False)


@compiled
def _headed(force: Array, turns: Array, velocity: Array) -> Array:
    """Return C_nb from levelling by a force and turning after, headed as a velocity points."""
    level = align_with_heading(force, 0.0)
    turned, _ = jax.lax.scan(lambda C, turn: (matmul(C, so3_exp(turn)), None), level, turns)
    heading, _ = course_heading(velocity)
    back = jnp.arctan2(turned[0, 0], turned[1, 0]) - heading
    return matmul(so3_exp(back * jnp.array([0.0, 0.0, 1.0], back.dtype)), turned)


def _started(
    log: DriveLog, sample: int, fix: int, dcm: Array, drift: Array, *, at_rest: bool
) -> _Start:
    velocity = np.nan_to_num(velocity_of(log.fixes)[fix])
    position = jnp.asarray(log.fixes.geodetic[fix])
    return _Start(
        sample, SinsLevel(dcm, jnp.asarray(velocity), position, drift, jnp.zeros(3)), at_rest
    )


def _initial(start: _Start, position_noise: np.ndarray) -> Gaussian:
    tilt, heading, drift = REST_SIGMA if start.at_rest else MOVING_SIGMA
    # The fix is up to a sample old, and of the antenna.
    position = np.sqrt(position_noise**2 + 1.0)
    blocks: list[Any] = [
        [tilt, tilt, heading],
        np.full(3, VELOCITY_SIGMA),
        position,
        np.full(3, drift),
        np.full(3, BIAS_SIGMA),
    ]
    sigma = np.concatenate(blocks)
    assert math.isfinite(float(sigma.sum()))
    return Gaussian(start.state, jnp.asarray(np.diag(sigma**2)))
