"""What all readers share: the error that a malformed file raises, and the parsing of text."""

import math
from pathlib import Path


class DataError(ValueError):
    """A file that is malformed, or a request that its contents cannot honour."""


def read_text(path: Path, accepted: str) -> str:
    """Return the text of a file; bytes that are not UTF-8 become replacement characters.

    Comments may hold file names in any encoding; what is parsed is ASCII.

    Args:
        path: The file.
        accepted: What would have been accepted, for the message.

    Raises:
        DataError: If the file cannot be read.
    """
    try:
        return path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise DataError(f"{path}: {reason}; accepted is {accepted}") from error


def number(name: str, text: str, low: float = -math.inf, high: float = math.inf) -> float:
    """Return the finite number of a field.

    Raises:
        DataError: If it is not one, or outside ``[low, high]``.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DataError(f"{name} is {text!r}; accepted is a finite decimal number")
    if not low <= value <= high:
        raise DataError(f"{name} is {text}; accepted is a number from {low} to {high}")
    return value
