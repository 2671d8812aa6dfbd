"""A car with known truth, the sensors on it, and what goes wrong with them: drives made for tests.

The car moves on a plane about a place on the Earth: forward speed and turn rate are given at knots
of time and joined by smooth steps, so that stops, reversing and bends are a few numbers.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from jaxnav.datasets.drive import DriveLog, checked
from jaxnav.datasets.inertial import assemble
from jaxnav.datasets.track import GnssTrack, without_repeats
from jaxnav.navigation.earth import WGS84

G = 9.805
ORIGIN = np.array([0.85, 0.15, 300.0])
"""Latitude, longitude [rad], height [m] of the start."""
RATE_HZ = 50.0
FIX_HZ = 5.0
GYRO_SIGMA, ACCEL_SIGMA = 2e-3, 0.03
"""Noise of a sample [rad/s], [m/s^2]."""
DRIFT, BIAS = np.array([2e-3, -1e-3, 3e-3]), np.array([0.05, -0.04, 0.06])
"""Gyro drift [rad/s] and accelerometer bias [m/s^2]."""
POSITION_SIGMA, VELOCITY_SIGMA = np.array([0.5, 0.5, 1.0]), np.array([0.05, 0.05, 0.08])

Leg = tuple[float, float, float]
"""Duration [s], forward speed [m/s] and turn rate to the left [deg/s] at its end."""

AROUND: tuple[Leg, ...] = (
    *((10.0, 0.0, 0.0), (6.0, 9.0, 0.0), (8.0, 10.0, 0.0), (3.0, 8.0, 18.0), (4.0, 8.0, 18.0)),
    *((3.0, 10.0, 0.0), (10.0, 14.0, 0.0), (4.0, 8.0, -15.0), (5.0, 8.0, -15.0), (4.0, 11.0, 0.0)),
    *((10.0, 12.0, 0.0), (6.0, 0.0, 0.0), (8.0, 0.0, 0.0), (6.0, 9.0, 0.0), (4.0, 8.0, 20.0)),
    *((5.0, 8.0, 20.0), (4.0, 12.0, 0.0), (12.0, 13.0, 0.0), (4.0, 9.0, -20.0), (6.0, 9.0, -20.0)),
    *((4.0, 12.0, 0.0), (10.0, 12.0, 0.0)),
)
"""A rest, straights, bends both ways and a stop; 140 s."""
REVERSED: tuple[Leg, ...] = (
    *((10.0, 0.0, 0.0), (5.0, -4.0, 0.0), (6.0, -4.0, 0.0), (4.0, 0.0, 0.0), (2.0, 0.0, 0.0)),
    *AROUND[1:],
)
"""Out of a parking place backwards, then as before."""
SMOOTHED_S = 1.0
"""Time over which speed and turn rate are smoothed."""


class Truth(NamedTuple):
    """The car at its samples: time [s], heading from north by east [rad], velocity, position."""

    time: np.ndarray
    heading: np.ndarray
    velocity: np.ndarray
    geodetic: np.ndarray


class Sensed(NamedTuple):
    """What the sensors gave, before it is assembled: faults are put in here."""

    time: np.ndarray
    gyro: np.ndarray
    accel: np.ndarray
    fix_time: np.ndarray
    place: np.ndarray
    velocity: np.ndarray | None
    sigma: np.ndarray
    quality: np.ndarray


Fault = Callable[[Sensed], Sensed]


def drive(
    legs: Sequence[Leg] = AROUND,
    seed: int = 0,
    heading_deg: float = 40.0,
    noise: float = 1.0,
) -> tuple[Truth, Sensed]:
    """Return the truth and what perfect sensors but for noise, drift and bias see of it."""
    rng = np.random.default_rng(seed)
    step = 1 / RATE_HZ
    knots = np.cumsum([0.0, *(leg[0] for leg in legs)])
    time = np.arange(round(knots[-1] * RATE_HZ) + 1) * step
    speed, left = (
        _smooth(np.interp(time, knots, [legs[0][i], *(leg[i] for leg in legs)])) for i in (1, 2)
    )
    turn = np.deg2rad(left)
    heading = np.deg2rad(heading_deg) - _integral(turn, step)
    ahead = np.stack([np.sin(heading), np.cos(heading), np.zeros_like(heading)], axis=1)
    velocity = speed[:, None] * ahead
    moved = _integral(velocity, step)
    a, e2 = WGS84.semi_major, WGS84.eccentricity2
    s = 1 - e2 * np.sin(ORIGIN[0]) ** 2
    north, east = a * (1 - e2) / s**1.5 + ORIGIN[2], a / s**0.5 + ORIGIN[2]
    geodetic = ORIGIN + np.stack(
        [moved[:, 1] / north, moved[:, 0] / (east * np.cos(ORIGIN[0])), moved[:, 2]], axis=1
    )
    surge = np.gradient(speed, step)
    force = np.stack([surge, speed * turn, np.full_like(speed, G)], axis=1)
    earth = WGS84.rate * np.array([0.0, np.cos(ORIGIN[0]), np.sin(ORIGIN[0])])
    forward, up = ahead, np.broadcast_to([0.0, 0.0, 1.0], ahead.shape)
    axes = np.stack([forward, np.cross(up, forward), up], axis=1)
    rate = np.stack([np.zeros_like(turn), np.zeros_like(turn), turn], axis=1) + axes @ earth
    shape = rate.shape
    shaken = ACCEL_SIGMA + 0.02 * np.abs(speed)[:, None]
    gyro = rate + DRIFT + noise * GYRO_SIGMA * rng.normal(size=shape)
    accel = force + BIAS + noise * shaken * rng.normal(size=shape)
    at = np.arange(0, len(time), round(RATE_HZ / FIX_HZ))
    place = geodetic[at] + noise * POSITION_SIGMA[[1, 0, 2]] * rng.normal(size=(len(at), 3)) / [
        north,
        east * np.cos(ORIGIN[0]),
        1,
    ]
    seen = velocity[at] + noise * VELOCITY_SIGMA * rng.normal(size=(len(at), 3))
    sensed = Sensed(
        time,
        gyro,
        accel,
        time[at],
        place,
        seen,
        np.tile(POSITION_SIGMA, (len(at), 1)),
        np.full(len(at), 5),
    )
    return Truth(time, heading, velocity, geodetic), sensed


def logged(sensed: Sensed) -> DriveLog:
    """Return the log that a loader would make of it."""
    fixes = GnssTrack(
        time_ns=np.rint(sensed.fix_time * 1e9).astype(np.int64),
        geodetic=sensed.place,
        velocity=sensed.velocity,
        position_sigma=sensed.sigma,
        velocity_sigma=None if sensed.velocity is None else np.full_like(sensed.sigma, 0.1),
        quality=sensed.quality,
        source="drive",
        duplicates=0,
    )
    values = np.hstack([sensed.gyro, sensed.accel])
    return checked(
        DriveLog(
            imu=assemble(np.rint(sensed.time * 1e9).astype(np.int64), values, "drive"),
            fixes=without_repeats(fixes),
            lever_arm=np.zeros(3),
            reference=None,
            skipped_rows=0,
            source="drive",
        )
    )


def heading_error(truth: Truth, time: np.ndarray, dcm: np.ndarray) -> np.ndarray:
    """Return the error of the heading [rad] of C_nb ``(T, 3, 3)`` at times, within half a turn."""
    estimate = np.arctan2(dcm[:, 0, 0], dcm[:, 1, 0])
    true = np.interp(time, truth.time, truth.heading)
    return np.remainder(estimate - true + np.pi, 2 * np.pi) - np.pi


def _smooth(values: np.ndarray) -> np.ndarray:
    width = round(SMOOTHED_S * RATE_HZ)
    padded = np.pad(values, width, mode="edge")
    return np.convolve(padded, np.full(width, 1 / width), "same")[width:-width]


def _integral(values: np.ndarray, step: float) -> np.ndarray:
    mean = (values[1:] + values[:-1]) / 2
    return np.concatenate([np.zeros_like(values[:1]), np.cumsum(mean, axis=0) * step])
