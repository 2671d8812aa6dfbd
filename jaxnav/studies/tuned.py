"""What a study offers to be tuned: parameters, simulated data, losses, and how they are judged."""

from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from jax import Array

from jaxnav.estimation.tune.transforms import Transform
from jaxnav.findings import Finding

Values = dict[str, Array]
"""Parameters by name."""


class Parameter(NamedTuple):
    """A parameter to be tuned.

    Attributes:
        start: Its hand-set value, a number or an array.
        transform: Its domain.
        text: One line: what it is, and its unit.
    """

    start: Any
    transform: Transform
    text: str


class HeldOut(Protocol):
    """Judges values on runs that no fit has seen, beside the methods they are compared with."""

    def __call__(self, values: Values, key: Array, runs: int) -> dict[str, np.ndarray]:
        """Return the measure of each run ``(runs,)``, by method.

        Of "tuned", the rules of the loss at ``values``, and of every method that it is compared
        with, all on the same runs: "hand-set", and of smooth rules their hard forms at ``values``.
        """
        ...


class Measure(NamedTuple):
    """What the scores of runs are.

    Attributes:
        kind: "mean-square", of which the root of the mean is shown and ratios of roots are
            compared; or "mean", of which the mean is shown and differences are compared.
        text: What it is.
        unit: Unit of what is shown.
        scale: What it is divided by to be in that unit.
        per: What each score is of: runs, or pieces of recorded data.
    """

    kind: Literal["mean-square", "mean"]
    text: str
    unit: str
    scale: float = 1.0
    per: str = "runs"


class Problem(NamedTuple):
    """A study as a problem of tuning.

    Attributes:
        parameters: By name; the start is the hand-set value.
        draw: ``(key, runs) -> data``, training data of so many runs.
        loss: ``(values, data) -> scalar``, differentiable in every parameter: the smooth rules.
        hard: The same of the hard rules; ``None`` if there is no other.
        held_out: By name, what start and optimum are judged on; the first decides.
        measure: What their scores are.
        samples: Number of samples that the mean of a likelihood is over, per run; 0 if the loss is
            no likelihood.
        runs: Training runs in a batch, by default.
        validation_runs: Runs that choose the best step, by default.
        steps: Gradient steps, by default; evaluations of "lbfgs".
        optimiser: "adam" or "lbfgs", by default.
        rate: Rate of the descent in unconstrained coordinates, by default.
        fresh: Whether every step draws a batch of its own.
        simulated: Whether ``draw`` simulates; else it gives the same recorded data for every key,
            and there is nothing to validate on.
        mode: Mode of differentiation, as for :func:`~jaxnav.estimation.tune.fit.fit`.
        notes: Sentences for the reader of the result.
        audit: Judges the innovations of recorded data at given values; ``None`` for simulated data.
    """

    parameters: Mapping[str, Parameter]
    draw: Callable[[Array, int], Any]
    loss: Callable[[Values, Any], Array]
    hard: Callable[[Values, Any], Array] | None
    held_out: Mapping[str, HeldOut]
    measure: Measure
    samples: int = 0
    runs: int = 16
    validation_runs: int = 32
    steps: int = 60
    optimiser: str = "adam"
    rate: float = 0.3
    fresh: bool = False
    simulated: bool = True
    mode: str = "reverse"
    notes: tuple[str, ...] = ()
    audit: Callable[[Values], list[Finding]] | None = None


def hand_set(problem: Problem) -> dict[str, Any]:
    """Return the start of every parameter."""
    return {name: parameter.start for name, parameter in problem.parameters.items()}
