"""Reads the numbers beside the tests, and says how far a printed number may be off."""

import csv
import json
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

HERE = Path(__file__).parent


def numbers(name: str) -> dict[str, np.ndarray]:
    """Return the arrays of a JSON file by name."""
    content = json.loads((HERE / name).read_text())
    return {key: np.asarray(value, float) for key, value in content.items()}


def columns(name: str) -> tuple[list[str], list[list[str]]]:
    """Return the head of a CSV file and its rows, as they are printed."""
    with (HERE / name).open(newline="") as file:
        head, *rows = csv.reader(file)
    return head, rows


def half_unit(printed: str) -> float:
    """Return half a unit of the last place of a number as it is printed, such as ``9.1600e-02``."""
    digits, _, exponent = printed.lower().partition("e")
    places = len(digits.partition(".")[2])
    return 0.5 * 10.0 ** (int(exponent or 0) - places)


def assert_as_printed(values: ArrayLike, printed: list[str]) -> None:
    """Assert that values ``(N,)`` round to what is printed, in every place."""
    expected = np.array([float(number) for number in printed])
    assert np.shape(values) == expected.shape
    # Beside half a unit, the rounding of the decimal number itself.
    room = np.array([half_unit(number) for number in printed]) * (1 + 1e-6)
    np.testing.assert_array_less(np.abs(np.asarray(values) - expected), room)
