"""The studies at full size, held to the figures they must reach: tests of minutes, kept apart."""

from collections.abc import Callable
from typing import Any

Note = Callable[[str, Any], None]
"""Keeps a measured figure under a name: a number, an array or an interval."""
