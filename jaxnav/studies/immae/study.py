"""The study as a whole: scenarios, Monte Carlo, measures."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jaxnav.config import plain
from jaxnav.estimation.montecarlo import Campaign, monte_carlo
from jaxnav.studies.attitude import attitude_arrays, attitude_measures
from jaxnav.studies.base import StudyResult, run_scenarios
from jaxnav.studies.immae.claims import PUBLISHED, assess
from jaxnav.studies.immae.config import SCENARIOS, ImmaeConfig
from jaxnav.studies.immae.methods import (
    BANKS,
    METHODS,
    Shared,
    panel_params,
    run_one,
)
from jaxnav.studies.immae.simulation import build_world
from jaxnav.units import ARCSEC


def run_study(
    config: ImmaeConfig, progress: Callable[[str, int, int], None] | None = None
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


def _run_scenario(config: ImmaeConfig, progress: Callable[[int, int], None] | None) -> StudyResult:
    campaign = run_campaign(config, keep=1, progress=progress)
    arrays, dims = attitude_arrays(campaign, config.filter_period_s, METHODS, BANKS)
    return StudyResult(
        study="immae",
        scenario=config.scenario,
        runs=config.runs,
        seed=config.seed,
        config=plain(config),
        methods=attitude_measures(campaign.rows, METHODS, config.star_noise_arcsec * ARCSEC),
        published=PUBLISHED.get(config.scenario, {}),
        claims=assess(config, campaign),
        arrays={**arrays, "model": np.array(config.theta)},
        dims=dims,
    )


def run_campaign(config: ImmaeConfig, **options: Any) -> Campaign:
    """Run the Monte Carlo of one scenario; options are those of ``monte_carlo``."""
    one = run_one(config.chain, config.filter_period_s, config.imu_step, len(config.theta))
    shared = Shared(build_world(config), panel_params(config))
    return monte_carlo(one, jax.random.key(config.seed), config.runs, shared, **options)
