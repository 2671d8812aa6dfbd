"""The study as a whole: scenarios, Monte Carlo, ablations, measures."""

from collections.abc import Callable
from typing import Any

import numpy as np

from jaxnav.config import plain
from jaxnav.estimation.metrics import chi2_mean_bounds, rmse
from jaxnav.estimation.montecarlo import Campaign
from jaxnav.navigation.states import STATES
from jaxnav.studies.attitude import AXES, DIVERGED_SIGMAS
from jaxnav.studies.base import StudyResult, check_simulated, run_scenarios
from jaxnav.studies.rkcns import cost
from jaxnav.studies.rkcns.ablations import (
    Outcome,
    run_ablations,
    run_campaign,
    variations,
)
from jaxnav.studies.rkcns.claims import COMPONENTS, POSITION, PUBLISHED, assess
from jaxnav.studies.rkcns.config import SCENARIOS, RkcnsConfig
from jaxnav.studies.rkcns.methods import METHODS
from jaxnav.studies.rkcns.simulation import Limb, build_world, stars_of
from jaxnav.units import ARCSEC, DEG_PER_HOUR, MICRO_G

UNITS = {"m": 1.0, "arcsec": ARCSEC, "deg/h": DEG_PER_HOUR, "ug": MICRO_G}
SHOWN = (
    *((name, "m") for name in POSITION),
    *((name, "arcsec") for name in AXES),
    *((f"drift_{axis}", "deg/h") for axis in "xyz"),
    *((f"bias_{axis}", "ug") for axis in "xyz"),
)
"""Components of the histories with their units."""


def run_study(
    config: RkcnsConfig, progress: Callable[[str, int, int], None] | None = None
) -> list[StudyResult]:
    """Run one scenario, or all of them.

    Args:
        config: The configuration.
        progress: Called with (scenario, runs done, runs).

    Returns:
        One result per scenario.

    Raises:
        ConfigError: If 64-bit floats are off.
        DataError: If the star table is missing or malformed.
    """
    return run_scenarios(config, SCENARIOS, _run_scenario, progress)


def check(config: RkcnsConfig) -> None:
    """Raise what the study would refuse, before anything is written.

    Raises:
        ConfigError: If 64-bit floats are off, or no star is bright enough.
        DataError: If the star table is missing or malformed.
    """
    check_simulated(config)
    stars_of(config)


def _run_scenario(config: RkcnsConfig, progress: Callable[[int, int], None] | None) -> StudyResult:
    limb = build_world(config).limb
    chosen = variations(config) if config.ablations else ()
    total = config.runs * (1 + len(chosen))

    def tell(done: int, of: int) -> None:
        del of
        if progress is not None:
            progress(done, total)

    campaign = run_campaign(config, keep=1, progress=tell)
    timed = config.cost and config.scenario == "listed"
    costs = cost.step_costs(config) if timed else None
    outcomes = run_ablations(config, chosen, lambda done, of: tell(config.runs * (1 + done), of))
    arrays, dims = _arrays(config, campaign, limb)
    if outcomes:
        arrays |= {
            "variation": np.array([f"{o.label}, {o.method}" for o in outcomes]),
            "variation_rmse": np.array([o.position.value for o in outcomes]),
            "variation_se": np.array([o.position.se for o in outcomes]),
        }
        dims |= {"variation_rmse": ("variation",), "variation_se": ("variation",)}
    return StudyResult(
        study="rkcns",
        scenario=config.scenario,
        runs=config.runs,
        seed=config.seed,
        config={**plain(config), "catalogue": str(config.catalogue or "bundled")},
        methods=_measures(config, campaign, costs),
        published=PUBLISHED if config.scenario != "strong-nonlinearity" else _NOT_PUBLISHED,
        claims=assess(config, campaign, costs),
        arrays=arrays,
        dims=dims,
        notes=_notes(config, campaign, limb, outcomes),
    )


_NOT_PUBLISHED = {"source": "not in the paper", "methods": {}}


def _measures(
    config: RkcnsConfig, campaign: Campaign, costs: dict[str, float] | None
) -> dict[str, dict[str, Any]]:
    measures = {}
    counted = cost.flops(STATES, 6 + config.stars, config.iterations)
    for i, name in enumerate(METHODS):
        measures[name] = _measures_of(campaign.rows, i, config.star_noise_arcsec * ARCSEC)
        if costs is not None and name in costs:
            measures[name]["us_per_step"] = round(costs[name], 3)
        if name in counted:
            measures[name]["flops"] = round(counted[name])
    return measures


def _measures_of(rows: Any, method: int, star_noise: float) -> dict[str, Any]:
    """Return the entry of one method in ``summary.json``.

    Args:
        rows: :class:`~jaxnav.studies.rkcns.methods.Row` with a leading axis of runs.
        method: Index of the method.
        star_noise: Standard deviation of the star tracker [rad].
    """
    square, final = rows.mean_square[:, method], rows.final_error[:, method]
    lost = ~np.isfinite(square).all(axis=-1) | ~(final <= DIVERGED_SIGMAS * star_noise)
    errors = {
        name: {**rmse(square[:, j] / UNITS[unit] ** 2)._asdict(), "unit": unit}
        for j, (name, unit) in enumerate(SHOWN[: len(COMPONENTS)])
    }
    bias = rmse(rows.bias_square[:, method].mean(axis=-1) / MICRO_G**2)
    errors["accel_bias"] = {**bias._asdict(), "unit": "ug"}
    return {
        "rmse": errors,
        "rmse_position": {**rmse(square[:, :3].sum(axis=-1))._asdict(), "unit": "m"},
        "anees": float(rows.nees[:, method].mean()),
        "final_anees": float(rows.final_nees[:, method].mean()),
        "anees_dof": STATES,
        "diverged": int(lost.sum()),
    }


def _notes(
    config: RkcnsConfig, campaign: Campaign, limb: Limb, outcomes: list[Outcome]
) -> list[str]:
    seen = np.asarray(limb.seen)
    low, high = config.tangent_km
    notes = [
        f"Stars at the limb between {low:g} and {high:g} km: {seen.sum(axis=1).mean():.2f} of "
        f"{config.stars} on average, none in {np.mean(~seen.any(axis=1)):.1%} of the epochs."
    ]
    if config.runs >= 2:
        bounds = chi2_mean_bounds(STATES, config.runs)
        each = ", ".join(
            f"{name} {campaign.rows.final_nees[:, i].mean():.2f}" for i, name in enumerate(METHODS)
        )
        notes.append(
            f"ANEES of the {STATES} states at the end: {each}; a consistent filter is within "
            f"{bounds[0]:.2f} and {bounds[1]:.2f} but for one case in a million."
        )
    notes += [
        f"{o.label}, {o.method}: position {o.position.value:.4g} m +- {o.position.se:.2g}, "
        f"ANEES {o.anees:.3g}" + (f", {o.lost} runs without a finite error" if o.lost else "")
        for o in outcomes
    ]
    return notes


def _arrays(
    config: RkcnsConfig, campaign: Campaign, limb: Limb
) -> tuple[dict[str, Any], dict[str, tuple[str, ...]]]:
    scale = np.array([UNITS[unit] for _, unit in SHOWN])
    curve, trace = campaign.mean_curve, campaign.traces
    steps = curve["square"].shape[0]
    arrays = {
        "time": config.start_s + config.filter_period_s * np.arange(1, steps + 1),
        "trmse": np.sqrt(curve["square"]) / scale,
        "mean_error": curve["error"] / scale,
        "anees": curve["nees"],
        "run_0_error": trace["error"][0] / scale,
        "run_0_sigma": trace["sigma"][0],
        "mean_square": campaign.rows.mean_square,
        "tangent_height": np.where(limb.seen, limb.height, np.nan),
        "estimator": np.array(METHODS),
        "component": np.array([name for name, _ in SHOWN]),
        "unit": np.array([unit for _, unit in SHOWN]),
    }
    dims = {
        "time": ("time",),
        "trmse": ("time", "estimator", "component"),
        "mean_error": ("time", "estimator", "component"),
        "anees": ("time", "estimator"),
        "run_0_error": ("time", "estimator", "component"),
        "run_0_sigma": ("time", "estimator", "state"),
        "mean_square": ("run", "estimator", "axis"),
        "tangent_height": ("time", "star"),
    }
    return arrays, dims
