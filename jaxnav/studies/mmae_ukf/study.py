"""The study as a whole: scenarios, Monte Carlo, measures."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jaxnav.config import plain
from jaxnav.estimation.montecarlo import Campaign, monte_carlo
from jaxnav.studies.attitude import attitude_arrays, attitude_measures
from jaxnav.studies.base import StudyResult, run_scenarios
from jaxnav.studies.mmae_ukf import cost, sweep
from jaxnav.studies.mmae_ukf.claims import assess, discrepancies, gain
from jaxnav.studies.mmae_ukf.config import SCENARIOS, MmaeUkfConfig
from jaxnav.studies.mmae_ukf.methods import (
    BANKS,
    METHODS,
    model_factors,
    run_one,
    setup_of,
    shared_of,
)
from jaxnav.studies.mmae_ukf.simulation import build_world, true_scale
from jaxnav.units import ARCSEC

TILE = 2
"""Runs of a tile: three banks of ten unscented filters outgrow a cache with more (16 runs take 42 s
in tiles of eight and 30 s in tiles of two or four, two cores), and few runs then use all cores."""
QUICKLY_S = 1.0
"""A run has settled quickly if its attitude error stays within the band from this time on."""


def run_study(
    config: MmaeUkfConfig, progress: Callable[[str, int, int], None] | None = None
) -> list[StudyResult]:
    """Run one scenario, or all of them.

    Args:
        config: The configuration.
        progress: Called with (scenario, runs done, runs).

    Returns:
        One result per scenario.

    Raises:
        ConfigError: If 64-bit floats are off.
    """
    return run_scenarios(config, SCENARIOS, _run_scenario, progress)


def run_campaign(config: MmaeUkfConfig, **options: Any) -> Campaign:
    """Run the Monte Carlo of one scenario; options are those of ``monte_carlo``."""
    shared = shared_of(config, build_world(config))
    one = run_one(setup_of(config), config.models)
    key = jax.random.key(config.seed)
    return monte_carlo(one, key, config.runs, shared, **{"tile": TILE, **options})


def _run_scenario(
    config: MmaeUkfConfig, progress: Callable[[int, int], None] | None
) -> StudyResult:
    campaign = run_campaign(config, keep=1, progress=progress)
    costs = cost.step_costs(config) if config.cost else None
    arrays, dims = _arrays(config, campaign)
    if config.scenario == "large-misalignment":
        arrays |= {
            "settling": sweep.settling_times(config),
            "form": np.array(sweep.FORMS),
            "angle": np.array(sweep.ANGLES_DEG),
            "filter": np.array(sweep.FILTERS),
        }
        dims["settling"] = ("form", "angle", "filter", "run")
    return StudyResult(
        study="mmae-ukf",
        scenario=config.scenario,
        runs=config.runs,
        seed=config.seed,
        config=plain(config),
        methods=_measures(config, campaign, costs),
        published={"source": "Table II, not available", "methods": {}},
        claims=assess(config, campaign, costs),
        arrays=arrays,
        dims=dims,
        notes=_notes(config, campaign),
    )


def _measures(
    config: MmaeUkfConfig, campaign: Campaign, costs: dict[str, float] | None
) -> dict[str, dict[str, Any]]:
    rows = campaign.rows
    measures = attitude_measures(rows, METHODS, config.star_noise_arcsec * ARCSEC)
    for i, name in enumerate(METHODS):
        if config.scenario == "large-misalignment":
            quick = config.filter_period_s * rows.settled[:, i] <= QUICKLY_S
            measures[name]["settled_quickly"] = float(np.mean(quick))
        if costs is not None:
            measures[name]["us_per_step"] = round(costs[name], 3)
    return measures


def _notes(config: MmaeUkfConfig, campaign: Campaign) -> list[str]:
    """Sentences on what adaptation gains; banks whose memory fades are not in the paper."""
    if config.runs < 2:
        return []
    each = ", ".join(
        f"{name} {change.value:+.2%} [{change.low:+.2%}, {change.high:+.2%}]"
        for name in ("mmae-ukf", "immae-ukf", "imm-ukf", "oracle")
        for change in [gain(campaign, name, "ukf")]
    )
    notes = [f"Change of RMSE against the UKF, mean of the angles, 95 %: {each}."]
    if config.scenario == "large-misalignment":
        notes.append(
            f"RMSE from {config.settle_s:g} s on, star tracker as {config.star_form}; "
            f"settled_quickly is the share of runs within the band from {QUICKLY_S:g} s on. "
            "The oracle knows the noise, not how far off it starts: it is no bound here."
        )
    return notes


def _arrays(
    config: MmaeUkfConfig, campaign: Campaign
) -> tuple[dict[str, Any], dict[str, tuple[str, ...]]]:
    arrays, dims = attitude_arrays(campaign, config.filter_period_s, METHODS, BANKS)
    regular, uniform = discrepancies(config.seed)
    arrays |= {
        "settled": config.filter_period_s * campaign.rows.settled,
        "model_factors": model_factors(config),
        "true_factor": np.sqrt(np.asarray(true_scale(config))),
        "hammersley_discrepancy": np.array([regular]),
        "uniform_discrepancy": uniform,
    }
    dims |= {
        "settled": ("run", "estimator"),
        "model_factors": ("model", "parameter"),
        "true_factor": ("time",),
        "hammersley_discrepancy": ("one",),
        "uniform_discrepancy": ("set",),
    }
    return arrays, dims
