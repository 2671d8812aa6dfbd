"""What all readers share: the error that a malformed file raises, and the parsing of text."""

import math
from pathlib import Path


class DataError(ValueError):
    """A file that is malformed, or a request that its contents cannot honour."""


def read_text(path: Path, accepted: str, errors: str = "replace") -> str:
    """Return the text of a file in UTF-8, with or without a byte order mark.

    Args:
        path: The file.
        accepted: What would have been accepted, for the message.
        errors: "replace" lets bytes that are not UTF-8 pass as replacement characters, for logs
            whose comments hold file names in any encoding; "strict" refuses them.

    Raises:
        DataError: If the file cannot be read, or is refused.
    """
    try:
        return path.read_text(encoding="utf-8-sig", errors=errors)
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise DataError(f"{path}, line {line}: not UTF-8 text; accepted is {accepted}") from None
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
