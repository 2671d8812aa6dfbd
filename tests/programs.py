"""Counts the programs that are compiled."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import jax

COMPILED = "/jax/core/compile/backend_compile_duration"


@contextmanager
def compilations() -> Iterator[list[float]]:
    """Return a list that gets the seconds of each program compiled, or read from a cache."""
    seconds: list[float] = []

    def note(event: str, duration_secs: float, **kwargs: Any) -> None:
        del kwargs
        if event == COMPILED:
            seconds.append(duration_secs)

    jax.monitoring.register_event_duration_secs_listener(note)
    try:
        yield seconds
    finally:
        jax.monitoring.unregister_event_duration_listener(note)
