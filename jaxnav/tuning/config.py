"""What ``jaxnav tune`` may be told, free of JAX."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from jaxnav.config import ConfigError, Count, Names, Positive, Seed, check_fields, require

VALUES = "as NAME=VALUE, or NAME=VALUE,VALUE,... of an array"
BOUNDS = "as NAME=LOW:HIGH"


@dataclass(frozen=True)
class TuneConfig:
    """Parameters of a study by gradient: fitted, validated, and judged on runs held out.

    Attributes:
        list: Print what can be tuned, where it starts and within what domain, and end.
        params: Names of the parameters to tune; the others keep their hand-set values. All by
            default.
        start: Where to begin instead of at the hand-set values, as NAME=VALUE; entries of an array
            are separated by commas.
        bounds: Bounds to stay within, as NAME=LOW:HIGH.
        optimiser: "adam" on batches, or "lbfgs" on one batch. The default is the study's.
        steps: Gradient steps; of "lbfgs", evaluations. The default is the study's.
        rate: Rate of Adam, which falls to zero by a cosine. The default is the study's.
        runs: Training runs in a batch. The default is the study's.
        seed: Root seed of training, validation and held-out runs.
        validation_runs: Runs that choose the best step and stop the fit early. The default is the
            study's.
        patience: Validations in a row, one in five steps, without a new best one that end the fit.
        held_out_runs: Runs that judge the outcome.
        check_gradient: Compare the gradient at the start with central differences.
        profile_points: Points of each parameter's profile of the loss, odd; 0 leaves them out.
    """

    list: bool = False
    params: Names = ()
    start: tuple[str, ...] = ()
    bounds: tuple[str, ...] = ()
    optimiser: Literal["adam", "lbfgs"] | None = None
    steps: Count | None = None
    rate: Positive | None = None
    runs: Count | None = None
    seed: Seed = 0
    validation_runs: Count | None = None
    patience: Count = 6
    held_out_runs: Annotated[int, Meta(ge=2)] = 100
    check_gradient: bool = False
    profile_points: Annotated[int, Meta(ge=0)] = 5

    def __post_init__(self) -> None:
        """Refuse values that mean nothing.

        Raises:
            ConfigError: With one sentence naming the field, its value and what is accepted.
        """
        check_fields(self)
        points = self.profile_points
        odd = points == 0 or (points >= 3 and points % 2 == 1)
        require(odd, "profile_points", points, "0, or odd and at least 3")


def parse_start(entries: tuple[str, ...]) -> dict[str, tuple[float, ...]]:
    """Return the given starting values by name.

    Raises:
        ConfigError: If an entry does not read as one.
    """
    return {
        name: tuple(_number(entry, part, VALUES) for part in text.split(","))
        for entry in entries
        for name, text in [_pair(entry, "start", VALUES)]
    }


def parse_bounds(entries: tuple[str, ...]) -> dict[str, tuple[float, float]]:
    """Return the given bounds by name.

    Raises:
        ConfigError: If an entry does not read as one, or its bounds are not in order.
    """
    found = {}
    for entry in entries:
        name, text = _pair(entry, "bounds", BOUNDS)
        ends = text.split(":")
        if len(ends) != 2:
            raise ConfigError(f"bounds is {entry!r}; it must be given {BOUNDS}")
        low, high = (_number(entry, end, BOUNDS) for end in ends)
        require(low < high < math.inf, f"bounds of {name}", text, "finite, LOW below HIGH")
        found[name] = (low, high)
    return found


def _pair(entry: str, field: str, accepted: str) -> tuple[str, str]:
    name, separator, text = entry.partition("=")
    if not (name and separator and text):
        raise ConfigError(f"{field} is {entry!r}; it must be given {accepted}")
    return name, text


def _number(entry: str, text: str, accepted: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise ConfigError(
            f"{text!r} in {entry!r} is no number; it must be given {accepted}"
        ) from None
    require(math.isfinite(value), entry.partition("=")[0], text, "finite")
    return value
