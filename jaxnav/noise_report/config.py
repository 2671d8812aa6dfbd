"""What `jaxnav allan` may be told about the analysis, free of JAX."""

import math
from dataclasses import dataclass

from jaxnav.studies.base import require


@dataclass(frozen=True)
class AllanConfig:
    """Noise coefficients of a recorded inertial log of a sensor at rest.

    Attributes:
        start_s: Begin of the part that is used, seconds since the first sample.
        end_s: End of that part; by default that of the log.
        confidence: Probability of the intervals.
        per_octave: Cluster times in an octave.
        accept_doubts: Analyse what does not look like a rest: a sensor that moves, swapped columns,
            an unlikely unit; the doubts are then notes. What no sensor gives stays refused.
    """

    start_s: float = 0.0
    end_s: float | None = None
    confidence: float = 0.95
    per_octave: int = 1
    accept_doubts: bool = False


def check(config: AllanConfig) -> None:
    """Raise :class:`~jaxnav.studies.base.ConfigError` if a parameter is out of its range."""
    require(0 <= config.start_s < math.inf, "start_s", config.start_s, "zero or positive")
    if config.end_s is not None:
        accepted = f"after start_s, which is {config.start_s}"
        require(config.start_s < config.end_s < math.inf, "end_s", config.end_s, accepted)
    require(0 < config.confidence < 1, "confidence", config.confidence, "between 0 and 1")
    require(1 <= config.per_octave <= 8, "per_octave", config.per_octave, "from 1 to 8")
