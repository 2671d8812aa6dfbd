"""From a recorded drive to what a filter takes: inputs, observations, the state at the start."""

from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.datasets.base import DataError
from jaxnav.datasets.drive import DriveLog
from jaxnav.datasets.inertial import ImuLog
from jaxnav.datasets.track import GnssTrack
from jaxnav.estimation.types import Gaussian, Model, Obs
from jaxnav.navigation.models.sins_gnss import SinsGnssInput
from jaxnav.navigation.models.vehicle import VehicleInput
from jaxnav.navigation.strapdown.increments import accumulate, increments_from_rates
from jaxnav.recorded.config import FilterConfig
from jaxnav.recorded.motion import seen_moving, since_start, still_samples, velocity_of
from jaxnav.recorded.start import initial, start_of

FASTER = 1.5
"""How many times faster than its samples a filter may be asked to run: a rate told roughly."""
BRIDGED_S = 60.0
"""Longest time without inertial samples that a filter is taken over."""


class Seen(NamedTuple):
    """What a channel saw at each period: values ``z`` ``(T, m)`` and which are ``valid``."""

    z: np.ndarray
    valid: np.ndarray

    def without(self, steps: np.ndarray) -> "Seen":
        """Return the same less what arrived in some periods."""
        valid = np.array(self.valid)
        valid[steps] = False
        return self._replace(valid=valid)


class Drive(NamedTuple):
    """A drive on a filter's clock, from the end of the alignment on: T periods and F fixes.

    Attributes:
        time: ``(T,) [s]`` ends of the periods since the first inertial sample.
        inputs: :class:`~jaxnav.navigation.models.vehicle.VehicleInput`, leading axis T.
        channels: By name: the fixes, and the constraints where they hold.
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
    channels: Mapping[str, Seen]
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

    def seen_by(self, model: Model) -> Obs:
        """Return the observations ``(T, m)`` of a model: of its channels, those of the drive."""
        names = [name for name, _ in model.channels if name in self.channels]
        return model.stack(
            {name: self.channels[name].z for name in names},
            {name: self.channels[name].valid for name in names},
        )

    def arrived(self, name: str) -> np.ndarray:
        """Return whether each fix ``(F,)`` has all values of one of the receiver's channels."""
        return np.all(self.channels[name].valid[self.fix_step], axis=1)


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
    time = since_start(log.imu.time_ns, log)
    fix_time = since_start(log.fixes.time_ns, log) + config.time_offset_s
    still = still_samples(log.imu, config)
    start = start_of(log, config, time, fix_time, still)
    if rate_hz is not None and rate_hz * log.imu.step_s > FASTER:
        raise DataError(
            f"{log.source}: rate_hz is {rate_hz:g} and the inertial samples come at "
            f"{1 / log.imu.step_s:.4g} Hz; accepted is a rate up to theirs"
        )
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
    moves = seen_moving(log.fixes, config, fix_time, time[ends])
    stopped = still[ends] & config.constraints & ~moves
    return Drive(
        time=time[ends],
        inputs=VehicleInput(
            _sensed(log.imu, time, start.sample, every, len(ends)),
            jnp.asarray(lag),
            jnp.asarray(grade),
        ),
        channels=_channels(log.fixes, config, time[ends], step, fix, stopped),
        initial=initial(start, position_noise),
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


def _channels(
    fixes: GnssTrack,
    config: FilterConfig,
    ends: np.ndarray,
    step: np.ndarray,
    fix: np.ndarray,
    stopped: np.ndarray,
) -> dict[str, Seen]:
    found = {}
    for name, values in (("velocity", velocity_of(fixes)), ("position", fixes.geodetic)):
        z = np.full((len(ends), 3), np.nan)
        z[step] = values[fix]
        known = np.isfinite(z)
        found[name] = Seen(np.where(known, z, 0), known)
    if config.constraints:
        ticks = np.floor(ends * config.steered_rate_hz)
        due = np.diff(ticks, prepend=ticks[0] - 1) > 0
        for name, size, held in (("steered", 2, due & ~stopped), ("rest", 3, due & stopped)):
            zero = np.zeros((len(ends), size))
            found[name] = Seen(zero, np.broadcast_to(held[:, None], zero.shape))
    return found
