"""What every check of a whole study may ask for."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from checks.full_size import Note


@pytest.fixture(autouse=True, scope="session")
def default_options() -> None:
    """Compile with the optimiser, unlike the suite: these run for longer than they compile."""


@pytest.fixture
def note(record_property: Callable[[str, object], None]) -> Note:
    """Keep a measured figure beside the outcome of the check."""

    def keep(name: str, value: Any) -> None:
        fields = value._asdict() if hasattr(value, "_asdict") else {"value": value}
        plain = {key: np.asarray(entry, float).tolist() for key, entry in fields.items()}
        record_property(name, plain if len(plain) > 1 else plain["value"])

    return keep
