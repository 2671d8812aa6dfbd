"""What samples and fixes say of the motion by themselves: course, rest, movement."""

import jax
import jax.numpy as jnp
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from jaxnav.compiling import compiled
from jaxnav.datasets.drive import DriveLog
from jaxnav.datasets.inertial import ImuLog
from jaxnav.datasets.track import GnssTrack
from jaxnav.navigation.earth import offset_between
from jaxnav.recorded.config import FilterConfig
from jaxnav.units import DEG

DIFFERENCED_S = 5.0
"""Longest time over which positions are differenced for a course."""
SEEN_S = 1.5
"""Age of a velocity up to which it tells whether the vehicle moves."""
SMOOTHED_S = 0.2
"""Time over which samples are averaged before a stop is looked for: engines shake faster."""
PUSHED = 0.85
"""Horizontal force [m/s^2] beyond that of the log's middle which is not taken for a rest."""


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


def since_start(time_ns: np.ndarray, log: DriveLog) -> np.ndarray:
    """Return times [s] since the first inertial sample of a drive."""
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
    moved = offsets(fixes.geodetic[before[good]], fixes.geodetic[after[good]])
    velocity[good] = moved / span[good][:, None]
    return velocity


def offsets(position: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return east, north, up ``(N, 3) [m]`` from geodetic positions to others near."""
    return np.asarray(_between(jnp.asarray(position), jnp.asarray(other)))


_between = compiled(jax.vmap(offset_between))


def seen_moving(
    fixes: GnssTrack, config: FilterConfig, fix_time: np.ndarray, time: np.ndarray
) -> np.ndarray:
    """Return at which times ``(T,)`` the fixes show a motion that sensors cannot feel."""
    velocity = course_velocity(fixes)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    known = np.flatnonzero(np.isfinite(speed))
    if not len(known):
        return np.zeros(len(time), bool)
    sigma = np.array([speed_sigma(fixes, int(i)) for i in known])
    after = np.clip(np.searchsorted(fix_time[known], time), 0, len(known) - 1)
    before = np.maximum(after - 1, 0)
    earlier = time - fix_time[known[before]] < fix_time[known[after]] - time
    nearest = np.where(earlier, before, after)
    close = np.abs(fix_time[known][nearest] - time) < SEEN_S
    return close & (speed[known][nearest] > 3 * np.maximum(sigma, config.velocity_sigma)[nearest])


def speed_sigma(fixes: GnssTrack, fix: int) -> float:
    """Return the standard deviation [m/s] of a speed of :func:`course_velocity`."""
    known = fixes.velocity is not None and np.isfinite(fixes.velocity[fix, :2]).all()
    if known and fixes.velocity_sigma is not None:
        return float(np.nan_to_num(np.max(fixes.velocity_sigma[fix, :2])))
    # Two positions about a second apart.
    return 0.0 if known else 2**0.5 * float(np.max(fixes.position_sigma[fix, :2]))
