"""The study as a whole: scenarios, Monte Carlo, measures."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from jaxnav.estimation.metrics import trmse
from jaxnav.estimation.montecarlo import Campaign, monte_carlo
from jaxnav.studies.attitude import AXES, attitude_measures
from jaxnav.studies.base import StudyResult, plain, require_x64
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
    check(config)
    names = tuple(SCENARIOS) if config.scenario == "all" else (config.scenario,)
    return [_run_scenario(replace(config, scenario=name), progress) for name in names]


def check(config: ImmaeConfig) -> None:
    """Raise :class:`ConfigError` if the study cannot run here; the configuration checks itself."""
    del config
    require_x64()


def _run_scenario(
    config: ImmaeConfig, progress: Callable[[str, int, int], None] | None
) -> StudyResult:
    campaign = run_campaign(
        config,
        keep=1,
        progress=None
        if progress is None
        else lambda done, total: progress(config.scenario, done, total),
    )
    return StudyResult(
        study="immae",
        scenario=config.scenario,
        runs=config.runs,
        seed=config.seed,
        config=plain(config),
        methods=_measures(config, campaign),
        published=PUBLISHED.get(config.scenario, {}),
        claims=assess(config, campaign),
        arrays=_arrays(config, campaign),
        dims={
            "time": ("time",),
            "trmse": ("time", "estimator", "axis"),
            "mean_weights": ("time", "bank", "model"),
            "run_0_error": ("time", "estimator", "axis"),
            "run_0_sigma": ("time", "estimator", "component"),
            "run_0_weights": ("time", "bank", "model"),
            "mean_square": ("run", "estimator", "axis"),
            "nees": ("run", "estimator"),
        },
    )


def run_campaign(config: ImmaeConfig, **options: Any) -> Campaign:
    """Run the Monte Carlo of one scenario; options are those of ``monte_carlo``."""
    one = run_one(config.chain, config.filter_period_s, config.imu_step, len(config.theta))
    shared = Shared(build_world(config), panel_params(config))
    return monte_carlo(one, jax.random.key(config.seed), config.runs, shared, **options)


def _measures(config: ImmaeConfig, campaign: Campaign) -> dict[str, dict[str, Any]]:
    rows = campaign.rows
    return {
        name: attitude_measures(
            rows.mean_square[:, i],
            rows.nees[:, i],
            rows.final_error[:, i],
            config.star_noise_arcsec * ARCSEC,
        )
        for i, name in enumerate(METHODS)
    }


def _arrays(config: ImmaeConfig, campaign: Campaign) -> dict[str, Any]:
    curve, first = campaign.mean_curve, jax.tree.map(lambda leaf: leaf[0], campaign.traces)
    return {
        "time": config.filter_period_s * np.arange(1, config.steps + 1),
        "trmse": trmse(curve["square"]) / ARCSEC,
        "mean_weights": curve["weights"],
        "run_0_error": first["error"] / ARCSEC,
        "run_0_sigma": first["sigma"] / ARCSEC,
        "run_0_weights": first["weights"],
        "mean_square": campaign.rows.mean_square / ARCSEC**2,
        "nees": campaign.rows.nees,
        "estimator": np.array(METHODS),
        "axis": np.array(AXES),
        "bank": np.array(BANKS),
        "model": np.array(config.theta),
    }
