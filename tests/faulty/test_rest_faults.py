"""Logs of a sensor at rest with a fault: right within its interval, or refused with the cause."""

import numpy as np
import pytest

from jaxnav.datasets.base import DataError
from jaxnav.noise_report.analysis import analyse, prepare
from jaxnav.noise_report.config import AllanConfig
from jaxnav.units import DEG_PER_SQRT_HOUR, HOUR
from tests.faulty.rest import FAULTS, WALK, clean, log_of

COUNT = 60_000
SEED = 11
UNITS = np.repeat([DEG_PER_SQRT_HOUR, HOUR**-0.5], 3)


def walks(document: dict) -> np.ndarray:
    """Values and intervals of the random walks ``(6, 3)`` over the truth."""
    entries = [next(iter(axis.values())) for axis in document["axes"].values()]
    shown = [[entry[key] for key in ("value", "low", "high")] for entry in entries]
    return np.array(shown, float) * (UNITS / WALK)[:, None]


@pytest.mark.parametrize("name", FAULTS)
def test_a_log_with_a_fault_is_right_or_refused(name: str) -> None:
    """A sample of ``checks/allan_faults.py``: one seed; the random walks within 8 %."""
    fault = FAULTS[name]
    rng = np.random.default_rng(SEED)
    rows = fault.spoil(rng, *clean(rng, COUNT))
    if fault.refused:
        with pytest.raises(DataError, match=fault.refused) as caught:
            prepare(log_of(*rows), AllanConfig())
        assert "accepted" in str(caught.value)
        return
    document, _ = analyse(prepare(log_of(*rows), AllanConfig()), AllanConfig())
    found = walks(document)[:, 0]
    found = found[np.isfinite(found)]
    assert len(found) == (5 if name == "a dead axis" else 6)
    if fault.sensor:
        np.testing.assert_allclose(found, 1, atol=0.08)
    if fault.noted:
        assert [note for note in document["notes"] if fault.noted in note]
    else:
        assert document["notes"] == []
