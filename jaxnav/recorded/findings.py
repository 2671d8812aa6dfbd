"""A number of a recorded drive, judged: it passes, is in doubt, a fault, or not seen."""

import math
from typing import Any, Literal, NamedTuple

Verdict = Literal["pass", "doubt", "fault", "not seen"]


class Finding(NamedTuple):
    """One number of a drive and what it says.

    Attributes:
        name: What was looked at.
        verdict: "pass", "doubt", "fault", or "not seen" where the drive does not show it.
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
