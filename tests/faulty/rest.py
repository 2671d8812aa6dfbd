"""An inertial sensor at rest with noise of known size, and what goes wrong with its log."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxnav.datasets.inertial import ImuLog, assemble

RATE_HZ = 100.0
WALK = np.array([3 * [8e-5], 3 * [1e-3]]).ravel()
"""Random walks of gyros [rad/s/sqrt(Hz)] and accelerometers [m/s^2/sqrt(Hz)]."""
RATE_WALK = np.array([3 * [1e-6], 3 * [2e-5]]).ravel()
"""Random walk of the rate itself, per root second."""
MEAN = np.array([4e-3, -6e-3, 3e-3, 0.05, -0.1, 9.8])

Rows = tuple[np.ndarray, np.ndarray]
"""Stamps [s] and the six columns of a log."""


class Fault(NamedTuple):
    """What is done to a clean log, and what must be said: a refusal, a note, or neither.

    ``sensor`` is whether the numbers are then those of the sensor, and not of its output alone.
    """

    spoil: Callable[[np.random.Generator, np.ndarray, np.ndarray], Rows]
    refused: str | None = None
    noted: str | None = None
    sensor: bool = True


def clean(rng: np.random.Generator, count: int) -> Rows:
    """Return the rows of so many samples at rest."""
    step = 1 / RATE_HZ
    white = rng.normal(size=(count, 6)) * WALK / np.sqrt(step)
    walk = np.cumsum(rng.normal(size=(count, 6)), axis=0) * RATE_WALK * np.sqrt(step)
    return np.arange(count) * step, MEAN + white + walk


def log_of(time: np.ndarray, values: np.ndarray) -> ImuLog:
    """Return the rows as a reader makes them."""
    return assemble(np.rint(time * 1e9).astype(np.int64), values, "rest.csv")


def _spiked(rng: np.random.Generator, time: np.ndarray, values: np.ndarray) -> Rows:
    """Give one sample of each column a value far from all others."""
    values = values.copy()
    values[rng.integers(20, len(time) - 20, 6), np.arange(6)] += 600 * WALK
    return time, values


def _lost(rng: np.random.Generator, time: np.ndarray, values: np.ndarray) -> Rows:
    keep = rng.random(len(time)) > 1 / 3
    return time[keep], values[keep]


def _thinned(rng: np.random.Generator, time: np.ndarray, values: np.ndarray) -> Rows:
    del rng
    keep = np.arange(len(time)) % 3 != 2
    return time[keep], values[keep]


def _jittered(rng: np.random.Generator, time: np.ndarray, values: np.ndarray) -> Rows:
    return np.sort(time + 2e-3 * rng.normal(size=len(time))), values


def _jittered_with_gaps(rng: np.random.Generator, time: np.ndarray, values: np.ndarray) -> Rows:
    time, values = _jittered(rng, time, values)
    keep = np.ones(len(time), bool)
    keep[4000:4007] = keep[9000:9400] = keep[20000] = False
    return time[keep], values[keep]


def _jittered_and_lost(rng: np.random.Generator, time: np.ndarray, values: np.ndarray) -> Rows:
    return _lost(rng, *_jittered(rng, time, values))


def _swung(rng: np.random.Generator, time: np.ndarray, values: np.ndarray) -> Rows:
    values = values.copy()
    values[:, 2] += np.deg2rad(30) * np.sin(2 * np.pi * time / rng.uniform(0.3, 60))
    return time, values


def _dead(rng: np.random.Generator, time: np.ndarray, values: np.ndarray) -> Rows:
    del rng
    return time, values * [1, 0, 1, 1, 1, 1]


def _filtered(rng: np.random.Generator, time: np.ndarray, values: np.ndarray) -> Rows:
    """Average each sample with the two before, as the filter of a sensor does."""
    del rng
    return time[2:], (values[2:] + values[1:-1] + values[:-2]) / 3


def _held(rng: np.random.Generator, time: np.ndarray, values: np.ndarray) -> Rows:
    """Give each sample four times, with noise of a quarter of the density then."""
    del rng
    held = np.repeat(values[::4], 4, axis=0)[: len(time)]
    return time, MEAN + (held - MEAN) / 2


def _coarse(rng: np.random.Generator, time: np.ndarray, values: np.ndarray) -> Rows:
    del rng
    step = 60 * WALK
    return time, np.rint(values / step) * step


FAULTS = {
    "none": Fault(lambda rng, time, values: (time, values)),
    "stamps of ten digits": Fault(
        lambda rng, time, values: (np.rint(time), values), refused="too coarse for the rate"
    ),
    "four rows a stamp": Fault(
        lambda rng, time, values: (np.floor(time * RATE_HZ / 4) * 4 / RATE_HZ, values),
        refused="too coarse for the rate",
    ),
    "a spike a column": Fault(_spiked),
    "a third lost at random": Fault(_lost),
    "every third lost": Fault(_thinned, refused="follow each other without a loss"),
    "stamps that jitter": Fault(_jittered),
    "stamps that jitter, and gaps": Fault(_jittered_with_gaps),
    "stamps that jitter, a third lost": Fault(_jittered_and_lost, refused="not told from jitter"),
    "columns swapped": Fault(
        lambda rng, time, values: (time, values[:, [3, 4, 5, 0, 1, 2]]), refused="may be swapped"
    ),
    "degrees as radians": Fault(
        lambda rng, time, values: (time, values * np.repeat([180 / np.pi, 1], 3)),
        refused="look like deg/s",
    ),
    "a gyro that swings": Fault(_swung, refused="gyro_z moves by"),
    "a filter in the sensor": Fault(_filtered, noted="neighbouring samples are alike"),
    "samples held four times": Fault(_held, noted="neighbouring samples are alike"),
    "steps beyond the noise": Fault(
        _coarse, noted="most samples repeat the one before", sensor=False
    ),
    "a dead axis": Fault(_dead, noted="gyro_y: constant"),
}
