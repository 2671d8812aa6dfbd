"""How many samples lie between time stamps: loss, rounding, jitter and drift of known size."""

import numpy as np
import pytest

from jaxnav.datasets.stamps import steps_between

COUNT = 50_000
STEP = 10_000_000
"""Sampling interval [ns]."""
INDEX = np.arange(COUNT)


def between(stamps: np.ndarray) -> tuple[float, int, int, bool]:
    """Step [sampling intervals], gaps, missing samples, and whether gaps could be told."""
    found = steps_between(np.diff(np.rint(np.sort(stamps) * STEP).astype(np.int64)))
    assert found.between.min() >= 1
    gaps, missing = int(np.sum(found.between > 1)), int(np.sum(found.between - 1))
    return found.step / STEP, gaps, missing, found.certain


@pytest.mark.parametrize("share", [0.0, 0.1, 1 / 3, 0.5, 0.6])
def test_samples_lost_at_random_are_counted(share: float) -> None:
    rng = np.random.default_rng(1)
    kept = INDEX[rng.random(COUNT) >= share]
    step, _, missing, told = between(kept + 0.02 * rng.normal(size=len(kept)))
    assert step == pytest.approx(1, abs=1e-3)
    assert missing == kept[-1] - kept[0] + 1 - len(kept)
    assert told


def test_every_third_lost_is_not_a_longer_interval() -> None:
    kept = INDEX[INDEX % 3 != 2]
    step, gaps, missing, told = between(kept)
    assert (step, gaps, missing, told) == (1.0, COUNT // 3, COUNT // 3, True)


@pytest.mark.parametrize("sigma", [0.1, 0.2, 0.3])
def test_jitter_makes_no_gap_and_hides_none(sigma: float) -> None:
    rng = np.random.default_rng(2)
    stamps = INDEX + sigma * rng.normal(size=COUNT)
    assert between(stamps)[1:] == (0, 0, True)
    late = stamps + np.select([INDEX >= 40_000, INDEX >= 9_000], [306, 5], 0)
    step, gaps, missing, told = between(late)
    assert step == pytest.approx(1, abs=1e-3)
    assert (gaps, missing, told) == (2, 306, True)


def test_rounding_and_drift_make_no_gap() -> None:
    """A clock of 400 Hz in whole milliseconds, and one that drifts by three in ten thousand."""
    for stamps in (np.rint(INDEX * 2.5) / 2.5, INDEX * (1 + 3e-4 * INDEX / COUNT)):
        step, gaps, _, told = between(stamps)
        assert step == pytest.approx(1, abs=1e-3)
        assert (gaps, told) == (0, True)


@pytest.mark.parametrize("share", [0.02, 0.1, 1 / 3, 0.5])
def test_samples_lost_among_rounded_stamps_are_counted(share: float) -> None:
    """A sensor of 400 Hz with stamps in whole milliseconds; a clock that drifts besides."""
    rng = np.random.default_rng(4)
    kept = INDEX[rng.random(COUNT) >= share]
    drifting = kept * (1 + 1e-5 * kept / COUNT)
    step, _, missing, told = between(np.rint(drifting * 2.5) / 2.5)
    assert step == pytest.approx(1, abs=1e-4)
    assert missing == kept[-1] - kept[0] + 1 - len(kept)
    assert told


@pytest.mark.parametrize("share", [0.1, 1 / 3, 0.5, 0.6])
def test_loss_among_jitter_is_said_not_to_be_told(share: float) -> None:
    rng = np.random.default_rng(3)
    kept = INDEX[rng.random(COUNT) > share]
    assert not between(kept + 0.2 * rng.normal(size=len(kept)))[3]
