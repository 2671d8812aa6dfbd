"""Configuration of the study ``gnss-track``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from jaxnav.config import Positive, Positives, Probability, Seed, Share, check_fields, require
from jaxnav.studies.base import require_weight_floor

SCENARIOS = {
    "full-rate": "every fix of the log",
    "thinned": "one fix per `thin_period_s`",
}


@dataclass(frozen=True)
class GnssTrackConfig:
    """A recorded GNSS track through a bank of constant-velocity filters.

    Attributes:
        log: RTKLIB solution file (.pos) with latitude, longitude, height; with velocity if the
            estimate is to be scored against it.
        scenario: Rate at which the fixes are used; "all" runs both.
        thin_period_s: Period of the fixes in "thinned" [s].
        q: Densities of the white acceleration of the bank's models [m^2/s^3].
        position_sigma: Standard deviation of a fix, each axis [m].
        initial_speed_sigma: Prior standard deviation of the velocity, each axis [m/s].
        reset_period_s: Period T of IMMAE's assessment [s].
        reset_threshold: Threshold of IMMAE's assessment in (0, 1].
        weight_floor: Lower bound of the "floor" bank's weights.
        switching: Probability per step that the "markov" bank's model changes.
        seed: Not used by a recorded log; kept in the summary.
        strict: Whether a fault that the audit finds ends the command with exit code 4.
    """

    log: Path | None = None
    scenario: Literal["full-rate", "thinned", "all"] = "full-rate"
    thin_period_s: Positive = 1.0
    q: Positives = (0.01, 0.1, 1.0, 10.0)
    position_sigma: Positive = 0.02
    initial_speed_sigma: Positive = 10.0
    reset_period_s: Positive = 5.0
    reset_threshold: Share = 0.9
    weight_floor: Positive = 1e-3
    switching: Probability = 0.02
    seed: Seed = 0
    strict: bool = False

    def __post_init__(self) -> None:
        """Refuse values that mean nothing.

        Raises:
            ConfigError: With one sentence naming the field, its value and what is accepted.
        """
        check_fields(self)
        names = self.single_ids
        require(len(set(names)) == len(names), "q", self.q, "different in every entry")
        require_weight_floor(self, len(self.q))

    @property
    def single_ids(self) -> tuple[str, ...]:
        """Method ids of the single filters."""
        return tuple(f"kf-{q:g}" for q in self.q)
