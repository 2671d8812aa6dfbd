"""A number of a log or of its run, judged: it passes, is in doubt, a fault, or not seen."""

import math
from typing import Any, Literal, NamedTuple

import numpy as np

Verdict = Literal["pass", "doubt", "fault", "not seen"]
LEAST_WHITE = 50
"""Innovations below which their memory is not judged."""


class Finding(NamedTuple):
    """One number of a log and what it says.

    Attributes:
        name: What was looked at.
        verdict: "pass", "doubt", "fault", or "not seen" where the log does not show it.
        value: The number; NaN where it is not seen.
        accepted: Bounds within which it passes, as an interval.
        unit: Of the number.
        says: For a doubt or a fault, what it is and what to try, in a sentence.
    """

    name: str
    verdict: Verdict
    value: float
    accepted: tuple[float, float]
    unit: str
    says: str = ""


def faults(findings: list[Finding]) -> list[str]:
    """Return the sentences of the faults."""
    return [finding.says for finding in findings if finding.verdict == "fault"]


def document_of(findings: list[Finding]) -> list[dict[str, Any]]:
    """Return the findings for ``summary.json``."""
    return [finding._asdict() for finding in findings]


def judged(
    name: str,
    value: float,
    accepted: tuple[float, float],
    doubted: tuple[float, float],
    unit: str,
    says: str,
) -> Finding:
    """Return a finding: within ``accepted`` it passes, within ``doubted`` it is in doubt."""
    if not math.isfinite(value):
        return Finding(name, "not seen", math.nan, accepted, unit)
    inside = [low <= value <= high for low, high in (accepted, doubted)]
    verdict: Verdict = "pass" if inside[0] else "doubt" if inside[1] else "fault"
    return Finding(name, verdict, value, accepted, unit, "" if verdict == "pass" else says)


def size_of(group: str, value: float) -> Finding:
    """Judge the normalised innovation squared per channel of a group, such as "positions"."""
    says = (
        f"the {group} are {value**0.5 if value > 0 else 0:.3g} times as far from their prediction "
        f"as their standard deviations say (NIS {value:.3g} per channel)"
    )
    says += (
        ": noise is larger than stated, or a sensor is wrong; the standard deviations of the "
        "result are too small"
        if value > 1
        else ": the noise is stated too large; the standard deviations of the result are too "
        "large, and outliers pass"
    )
    return judged(f"NIS, {group}", value, (0.2, 3.0), (0.05, 10.0), "", says)


def memory_of(group: str, white: np.ndarray) -> Finding:
    """Judge how whitened innovations of a group, ``(N, m)`` in the order of time, follow another.

    Of a filter that is right they do not; fewer than fifty tell nothing.
    """
    memory = math.nan
    if len(white) > LEAST_WHITE:
        square = float(np.sum(white * white))
        memory = float(np.sum(white[1:] * white[:-1])) / square if square > 0 else math.nan
    says = (
        f"what the {group} are off lasts from fix to fix (correlation {memory:.2f}): the filter "
        "follows them too slowly, or their errors last, and its standard deviations are too small"
        if memory > 0
        else f"what the {group} are off goes to and fro from fix to fix (correlation "
        f"{memory:.2f}): the filter follows their noise, which is larger than it is told"
    )
    return judged(f"memory of {group}", memory, (-0.5, 0.8), (-0.8, 0.95), "", says)
