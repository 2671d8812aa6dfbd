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
from jaxnav.navigation.earth import metres_per_radian
from jaxnav.navigation.models.level_errors import SinsLevel
from jaxnav.navigation.models.sins_gnss import SinsGnssInput
from jaxnav.navigation.models.vehicle import CONSTRAINTS, FIXES, REST, STEERED, VehicleInput
from jaxnav.navigation.strapdown.increments import accumulate, increments_from_rates
from jaxnav.numerics.lie import so3_exp
from jaxnav.numerics.linalg import matmul
from jaxnav.recorded.config import FilterConfig
from jaxnav.units import DEG

CHANNELS = FIXES.stop + len(CONSTRAINTS)
DIFFERENCED_S = 5.0
"""Longest time over which positions are differenced for a course."""
BRIDGED_S = 60.0
"""Longest time without inertial samples that a filter is taken over."""
DIRECTION_S = (12.0, 4.0)
"""Time before and after the first fast fix in which forward and backward are told apart."""
SEEN_S = 1.5
"""Age of a velocity up to which it tells whether the vehicle moves."""
SMOOTHED_S = 0.2
"""Time over which samples are averaged before a stop is looked for: engines shake faster."""
PUSHED = 0.85
"""Horizontal force [m/s^2] beyond that of the log's middle which is not taken for a rest."""
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
        offset_s: What was added to the times of the fixes [s].
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
    offset_s: float


class _Start(NamedTuple):
    """The start: its sample, state, whether it is from a rest, and sigma of the course [rad]."""

    sample: int
    state: SinsLevel
    at_rest: bool
    course_sigma: float


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
    longest = int(np.argmax(np.diff(time[start.sample :]))) + start.sample
    if time[longest + 1] - time[longest] > BRIDGED_S:
        raise DataError(
            f"{log.source}: there is no inertial sample from {time[longest]:.6g} s to "
            f"{time[longest + 1]:.6g} s; accepted are gaps of up to {BRIDGED_S:g} s: cut the log "
            "there, or mend its clock"
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
    moves = _seen_moving(log.fixes, config, fix_time, time[ends])
    stopped = still[ends] & config.constraints & ~moves
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
        offset_s=config.time_offset_s,
    )


def still_samples(imu: ImuLog, config: FilterConfig) -> np.ndarray:
    """Return at which samples ``(N,)`` the vehicle has been at rest for ``stop_time_s``.

    Of means over a fifth of a second, the rates stay below ``stop_gyro_dps`` from their median in
    quiet times, and the specific force scatters by less than ``stop_accel`` about a level mean: a
    steady braking is as quiet, and pushes. A rest on a slope of more than 5 deg is not found.
    """
    width = max(1, round(SMOOTHED_S / imu.step_s))
    window = max(2, round(config.stop_time_s / imu.step_s))
    count = len(imu.valid)
    still = np.zeros(count, bool)
    if count < width + window:
        return still
    gyro, accel = (_means(values, width) for values in (imu.gyro, imu.accel))
    scatter = sliding_window_view(accel, window, axis=0).std(axis=-1).max(axis=1)
    level = sliding_window_view(accel[:, :2], window, axis=0).mean(axis=-1)
    pushed = np.abs(level - np.median(accel[:, :2], axis=0)).max(axis=1)
    quiet = (scatter < config.stop_accel) & (pushed < PUSHED)
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


def course_velocity(fixes: GnssTrack) -> np.ndarray:
    """Return velocities ``(F, 3)`` for a course: those of the log, else of the positions.

    Positions a second apart or more are differenced, so that their noise stays below that of a car
    on the move.
    """
    velocity = np.array(velocity_of(fixes))
    unknown = ~np.isfinite(velocity[:, :2]).all(axis=1)
    if not unknown.any() or len(velocity) < 3:
        return velocity
    time = (fixes.time_ns - fixes.time_ns[0]) / 1e9
    before = np.clip(np.searchsorted(time, time - 0.5, side="right") - 1, 0, None)
    after = np.clip(np.searchsorted(time, time + 0.5), None, len(time) - 1)
    span = time[after] - time[before]
    good = unknown & (span > 0) & (span < DIFFERENCED_S)
    scale = np.asarray(_metres(jnp.asarray(fixes.geodetic[good])))
    turn = fixes.geodetic[after[good]] - fixes.geodetic[before[good]]
    turn[:, 1] = np.remainder(turn[:, 1] + np.pi, 2 * np.pi) - np.pi
    velocity[good] = (scale * turn)[:, [1, 0, 2]] / span[good][:, None]
    return velocity


_metres = compiled(jax.vmap(metres_per_radian))


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


def _seen_moving(
    fixes: GnssTrack, config: FilterConfig, fix_time: np.ndarray, time: np.ndarray
) -> np.ndarray:
    """Return at which times ``(T,)`` the fixes show a motion that sensors cannot feel."""
    velocity = course_velocity(fixes)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    known = np.flatnonzero(np.isfinite(speed))
    if not len(known):
        return np.zeros(len(time), bool)
    sigma = np.array([_speed_sigma(fixes, i) for i in known])
    after = np.clip(np.searchsorted(fix_time[known], time), 0, len(known) - 1)
    before = np.maximum(after - 1, 0)
    earlier = time - fix_time[known[before]] < fix_time[known[after]] - time
    nearest = np.where(earlier, before, after)
    close = np.abs(fix_time[known][nearest] - time) < SEEN_S
    return close & (speed[known][nearest] > 3 * np.maximum(sigma, config.velocity_sigma)[nearest])


def _speed_sigma(fixes: GnssTrack, fix: int) -> float:
    """Return the standard deviation [m/s] of a speed of :func:`course_velocity`."""
    known = fixes.velocity is not None and np.isfinite(fixes.velocity[fix, :2]).all()
    if known and fixes.velocity_sigma is not None:
        return float(np.nan_to_num(np.max(fixes.velocity_sigma[fix, :2])))
    # Two positions about a second apart.
    return 0.0 if known else 2**0.5 * float(np.max(fixes.position_sigma[fix, :2]))


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
    velocity = course_velocity(log.fixes)
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
    ahead = _direction(log, time, fix_time, speed, moving[0]) * velocity[moving[0]]
    dcm = _headed(jnp.asarray(accel), jnp.asarray(turns), jnp.asarray(ahead))
    return _started(log, sample, moving[0], dcm, jnp.asarray(gyro), at_rest=True)


def _direction(
    log: DriveLog, time: np.ndarray, fix_time: np.ndarray, speed: np.ndarray, fix: int
) -> float:
    """Return 1 if the vehicle moves forward at a fix, -1 if backward, by what its surge says.

    The increments of the speed between fixes and those of the forward accelerometer go together in
    the one case and against each other in the other. Where they do neither it is taken for forward.
    """
    before, after = DIRECTION_S
    near = np.isfinite(speed) & (fix_time >= max(time[0], fix_time[fix] - before))
    near = np.flatnonzero(near & (fix_time <= min(time[-1], fix_time[fix] + after)))
    # A vehicle that has been slower than this meanwhile may have changed its direction.
    slow = near[speed[near] < 0.5]
    begin = slow[slow < fix][-1:] if np.any(slow < fix) else near[:1]
    end = slow[slow > fix][:1]
    near = near[(near >= begin[0]) & (near <= (end[0] if len(end) else near[-1]))]
    if len(near) < 3:
        return 1.0
    force = np.where(log.imu.valid, log.imu.accel[:, 0], 0.0)
    gained = np.concatenate([[0.0], np.cumsum(force[:-1] * np.diff(time))])
    told = np.diff(np.interp(fix_time[near], time, gained))
    seen, spans = np.diff(speed[near]), np.diff(fix_time[near])
    # A tilt and a bias push evenly.
    told = told - spans * np.sum(told) / np.sum(spans)
    seen = seen - spans * np.sum(seen) / np.sum(spans)
    size = np.linalg.norm(told) * np.linalg.norm(seen)
    return -1.0 if size > 0 and float(told @ seen) < -0.5 * size else 1.0


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
    velocity = course_velocity(log.fixes)
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
    velocity = np.nan_to_num(course_velocity(log.fixes)[fix])
    position = jnp.asarray(log.fixes.geodetic[fix])
    state = SinsLevel(dcm, jnp.asarray(velocity), position, drift, jnp.zeros(3))
    return _Start(sample, state, at_rest, _course_sigma(log.fixes, fix, velocity))


def _course_sigma(fixes: GnssTrack, fix: int, velocity: np.ndarray) -> float:
    """Return the standard deviation [rad] of the course of a fix."""
    # A differenced one is of many that might have been fast enough by chance.
    known = fixes.velocity is not None and np.isfinite(fixes.velocity[fix, :2]).all()
    sigma = _speed_sigma(fixes, fix) * (1 if known else 2)
    return min(sigma / max(float(np.hypot(*velocity[:2])), 1e-3), math.pi / 2)


def _initial(start: _Start, position_noise: np.ndarray) -> Gaussian:
    tilt, heading, drift = REST_SIGMA if start.at_rest else MOVING_SIGMA
    heading = math.hypot(heading, start.course_sigma)
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
