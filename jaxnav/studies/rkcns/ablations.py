"""Variations of the study: how many stars, how high, how well the atmosphere is known."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxnav.estimation.metrics import Measured, rmse
from jaxnav.estimation.montecarlo import Campaign, monte_carlo
from jaxnav.studies.rkcns.config import RkcnsConfig
from jaxnav.studies.rkcns.methods import METHODS, run_one, setup_of, shared_of
from jaxnav.studies.rkcns.simulation import build_world

ITERATED = ("iterated-ckf", "modified-iterated-ckf")
LIMB = ("ckf", *ITERATED, "oracle")


class Variation(NamedTuple):
    """A change of the configuration.

    Attributes:
        label: Its name.
        changes: Fields of the configuration.
        shown: Methods whose errors are reported.
        run: Methods that are run; those of the study itself use its program again.
        printed: Iterate as the paper prints it.
    """

    label: str
    changes: dict[str, Any]
    shown: tuple[str, ...] = LIMB
    run: tuple[str, ...] = METHODS
    printed: bool = False


class Outcome(NamedTuple):
    """The position error over the flight that a method had in a variation.

    Attributes:
        label: Name of the variation.
        method: Name of the method.
        position: RMSE of the norm of the position error [m].
        anees: Mean over time and runs of the NEES of the 15 states.
        lost: Runs whose errors did not stay finite.
    """

    label: str
    method: str
    position: Measured
    anees: float
    lost: int


LINEAR = (
    Variation("constraint alone", {"stars": 0}, ("ckf",), ("ckf",)),
    Variation("1 star", {"stars": 1}),
    Variation("5 stars", {"stars": 5}, ("ckf",), ("ckf",)),
    Variation("near 20 km", {"tangent_km": (19.0, 21.0)}),
    Variation("near 25 km", {"tangent_km": (24.0, 26.0)}),
    Variation("near 40 km", {"tangent_km": (39.0, 41.0), "point_spread": 0.1}),
    Variation("density 1 %", {"density_error": 0.01}),
    Variation("printed constants", {"atmosphere": "printed"}),
    Variation("rays as angles", {}, ("angle-ckf",), ("angle-ckf",)),
    Variation("printed iteration", {}, ("iterated-ckf",), ("iterated-ckf",), printed=True),
)
NONLINEAR = (
    Variation("full spread", {"point_spread": 1.0}, ITERATED),
    Variation("lost by 5 km", {"lost_km": 5.0}),
    Variation("3 arcsec", {"refraction_noise_arcsec": 3.0}),
)


def variations(config: RkcnsConfig) -> tuple[Variation, ...]:
    """Return the variations of a scenario."""
    return {"listed": LINEAR, "strong-nonlinearity": NONLINEAR}.get(config.scenario, ())


def run_campaign(
    config: RkcnsConfig,
    methods: tuple[str, ...] = METHODS,
    *,
    printed: bool = False,
    **options: Any,
) -> Campaign:
    """Run the Monte Carlo of one scenario; options are those of ``monte_carlo``."""
    shared = shared_of(config, build_world(config))
    one = run_one(setup_of(config, methods, printed=printed))
    key = jax.random.key(config.seed)
    return monte_carlo(one, key, config.runs, shared, **options)


def run_ablations(
    config: RkcnsConfig,
    chosen: Sequence[Variation],
    progress: Callable[[int, int], None] | None = None,
) -> list[Outcome]:
    """Run variations over the same keys as the study.

    Args:
        config: The configuration of the scenario.
        chosen: The variations.
        progress: Called with (variations done, variations).
    """
    outcomes: list[Outcome] = []
    for done, change in enumerate(chosen, start=1):
        varied = replace(config, **change.changes)
        # A trace is kept because the study keeps one: the program is then the same.
        campaign = run_campaign(varied, change.run, printed=change.printed, keep=1)
        for name in change.shown:
            j = change.run.index(name)
            square = campaign.rows.mean_square[:, j, :3].sum(axis=-1)
            finite = np.isfinite(square)
            outcomes.append(
                Outcome(
                    change.label,
                    name,
                    rmse(square[finite]) if finite.any() else Measured(np.inf, np.nan),
                    float(np.mean(campaign.rows.nees[:, j])),
                    int(np.sum(~finite)),
                )
            )
        if progress is not None:
            progress(done, len(chosen))
    return outcomes
