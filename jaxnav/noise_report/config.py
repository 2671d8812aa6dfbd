"""What `jaxnav allan` may be told about the analysis, free of JAX."""

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from jaxnav.config import NotNegative, Probability, check_fields, require


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

    start_s: NotNegative = 0.0
    end_s: float | None = None
    confidence: Probability = 0.95
    per_octave: Annotated[int, Meta(ge=1, le=8)] = 1
    accept_doubts: bool = False

    def __post_init__(self) -> None:
        """Refuse values that mean nothing.

        Raises:
            ConfigError: With one sentence naming the field, its value and what is accepted.
        """
        check_fields(self)
        if self.end_s is not None:
            accepted = f"after start_s, which is {self.start_s}"
            require(self.start_s < self.end_s, "end_s", self.end_s, accepted)
