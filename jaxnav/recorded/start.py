"""Where a filter starts: level, heading, drift, and how well each is known."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.datasets.base import DataError
from jaxnav.datasets.drive import DriveLog
from jaxnav.datasets.track import GnssTrack
from jaxnav.estimation.types import Gaussian
from jaxnav.navigation.alignment import align_with_heading, course_heading
from jaxnav.navigation.states import SinsLevel
from jaxnav.numerics.lie import so3_exp
from jaxnav.numerics.linalg import matmul
from jaxnav.numerics.masks import runs_of
from jaxnav.recorded.config import FilterConfig
from jaxnav.recorded.motion import course_velocity, speed_sigma
from jaxnav.units import DEG

DIRECTION_S = (12.0, 4.0)
"""Time before and after the first fast fix in which forward and backward are told apart."""
LEVEL_S = 2.0
"""Shortest rest to level by, and time to level by on the move [s]."""
REST_SIGMA = (0.5 * DEG, 5 * DEG, 0.03 * DEG)
"""Of tilt and heading [rad] and gyro drift [rad/s] after a rest; the heading is a course."""
MOVING_SIGMA = (3 * DEG, 5 * DEG, 0.5 * DEG)
"""The same when the vehicle was moving from the first sample on, and hardly turned meanwhile."""
MOST_DRIFT, UNKNOWN_DRIFT = 1.5 * DEG, 2.0 * DEG
"""A mean rate above the first, on the move, is a manoeuvre and no drift [rad/s]; the drift is then
unknown by the second, which is that of a poor sensor."""
VELOCITY_SIGMA = 0.3
BIAS_SIGMA = 0.2
"""Of the accelerometer bias [m/s^2], each axis: 20 mg, as data sheets of MEMS sensors have it."""


class Start(NamedTuple):
    """The start of a filter.

    Attributes:
        sample: Its inertial sample.
        state: The state there.
        at_rest: Whether it is from a rest.
        course_sigma: Standard deviation of the course [rad].
        drift_sigma: Of the gyro drift ``(3,) [rad/s]``.
    """

    sample: int
    state: SinsLevel
    at_rest: bool
    course_sigma: float
    drift_sigma: np.ndarray


def start_of(
    log: DriveLog,
    config: FilterConfig,
    time: np.ndarray,
    fix_time: np.ndarray,
    still: np.ndarray,
) -> Start:
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
    sigma = np.full(3, REST_SIGMA[2])
    return _started(log, sample, moving[0], dcm, gyro, sigma, at_rest=True)


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
    turned = np.diff(np.interp(fix_time[near], time, gained))
    seen, spans = np.diff(speed[near]), np.diff(fix_time[near])
    # A tilt and a bias push evenly.
    turned = turned - spans * np.sum(turned) / np.sum(spans)
    seen = seen - spans * np.sum(seen) / np.sum(spans)
    size = np.linalg.norm(turned) * np.linalg.norm(seen)
    return -1.0 if size > 0 and float(turned @ seen) < -0.5 * size else 1.0


def _last_rest(still: np.ndarray, shortest: int) -> slice | None:
    """Return the last run of rest of at least so many samples."""
    for begin, end in runs_of(still)[::-1]:
        if end - begin >= shortest:
            return slice(int(begin), int(end))
    return None


def _moving_start(log: DriveLog, time: np.ndarray, fix_time: np.ndarray, first: int) -> Start:
    """Return a start from the move: level by the force less what speed and bends make of it.

    The mean rate less that of the course is taken for the drift, unless it is more than one.

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
    believed = np.abs(drift) < MOST_DRIFT
    sigma = np.where(believed, MOVING_SIGMA[2], UNKNOWN_DRIFT)
    drift = np.where(believed, drift, 0.0)
    return _started(log, end, int(later[0]), dcm, drift, sigma, at_rest=False)


@compiled
def _headed(force: Array, turns: Array, velocity: Array) -> Array:
    """Return C_nb from levelling by a force and turning after, headed as a velocity points."""
    level = align_with_heading(force, 0.0)
    turned, _ = jax.lax.scan(lambda C, turn: (matmul(C, so3_exp(turn)), None), level, turns)
    heading, _ = course_heading(velocity)
    back = jnp.arctan2(turned[0, 0], turned[1, 0]) - heading
    return matmul(so3_exp(back * jnp.array([0.0, 0.0, 1.0], back.dtype)), turned)


def _started(
    log: DriveLog,
    sample: int,
    fix: int,
    dcm: Array,
    drift: np.ndarray,
    drift_sigma: np.ndarray,
    *,
    at_rest: bool,
) -> Start:
    velocity = np.nan_to_num(course_velocity(log.fixes)[fix])
    position = jnp.asarray(log.fixes.geodetic[fix])
    state = SinsLevel(dcm, jnp.asarray(velocity), position, jnp.asarray(drift), jnp.zeros(3))
    sigma = _course_sigma(log.fixes, fix, velocity)
    return Start(sample, state, at_rest, sigma, drift_sigma)


def _course_sigma(fixes: GnssTrack, fix: int, velocity: np.ndarray) -> float:
    """Return the standard deviation [rad] of the course of a fix."""
    # A differenced one is of many that might have been fast enough by chance.
    known = fixes.velocity is not None and np.isfinite(fixes.velocity[fix, :2]).all()
    sigma = speed_sigma(fixes, fix) * (1 if known else 2)
    return min(sigma / max(float(np.hypot(*velocity[:2])), 1e-3), math.pi / 2)


def initial(start: Start, position_noise: np.ndarray) -> Gaussian:
    """Return the state at a start with its covariance in additive errors."""
    tilt, heading, _ = REST_SIGMA if start.at_rest else MOVING_SIGMA
    heading = math.hypot(heading, start.course_sigma)
    # The fix is up to a sample old, and of the antenna.
    position = np.sqrt(position_noise**2 + 1.0)
    blocks: list[Any] = [
        [tilt, tilt, heading],
        np.full(3, VELOCITY_SIGMA),
        position,
        start.drift_sigma,
        np.full(3, BIAS_SIGMA),
    ]
    sigma = np.concatenate(blocks)
    assert math.isfinite(float(sigma.sum()))
    return Gaussian(start.state, jnp.asarray(np.diag(sigma**2)))
