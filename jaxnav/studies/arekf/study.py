"""The study as a whole: scenarios, Monte Carlo over drift factors, measures."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from jaxnav.config import plain
from jaxnav.estimation.metrics import chi2_mean_bounds, rmse
from jaxnav.estimation.montecarlo import Campaign, monte_carlo
from jaxnav.navigation.states import STATES
from jaxnav.studies.arekf.analysis import ratio_map
from jaxnav.studies.arekf.claims import assess, change, squared_norms
from jaxnav.studies.arekf.config import DRIFTING, RECORD_S, SCENARIOS, ArekfConfig
from jaxnav.studies.arekf.cost import step_latencies
from jaxnav.studies.arekf.methods import AXES, KINDS, METHODS, run_one, setup_of, shared_of
from jaxnav.studies.arekf.simulation import build_world
from jaxnav.studies.arekf.sweep import labels_of, run_sweep
from jaxnav.studies.base import StudyResult, run_scenarios
from jaxnav.studies.timing import Latency
from jaxnav.units import DEG

UNITS = {"attitude": ("deg", DEG), "velocity": ("m/s", 1.0), "position": ("m", 1.0)}
LOST_M = 100.0
"""A method diverged in a run whose position is wrong by more than this at the end [m]."""
EPOCHS = 12
"""Number of times at which consistency is judged."""


def run_study(
    config: ArekfConfig, progress: Callable[[str, int, int], None] | None = None
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


def run_campaign(config: ArekfConfig, factor: float, **options: Any) -> Campaign:
    """Run the Monte Carlo at one storage drift factor; options are those of ``monte_carlo``."""
    shared = shared_of(config, build_world(config), factor)
    one = run_one(setup_of(config))
    key = jax.random.key(config.seed)
    # A trace is always kept: the program is then the same for all factors and scenarios.
    return monte_carlo(one, key, config.runs, shared, keep=1, **options)


def run_campaigns(
    config: ArekfConfig, progress: Callable[[int, int], None] | None = None
) -> dict[float, Campaign]:
    """Run the Monte Carlo of a scenario: at each drift factor where it has one, at 1 elsewhere.

    Args:
        config: The configuration of the scenario.
        progress: Called with (runs done, runs) over all factors.
    """
    if config.scenario == "r-sweep":
        return {1.0: run_sweep(config, keep=1, progress=progress)}
    factors = config.factors if config.scenario in DRIFTING else (1.0,)
    total = config.runs * len(factors)

    def tell(before: int) -> Callable[[int, int], None]:
        return lambda done, of: None if progress is None else progress(before + done, total)

    return {
        factor: run_campaign(config, factor, progress=tell(i * config.runs))
        for i, factor in enumerate(factors)
    }


def _run_scenario(config: ArekfConfig, progress: Callable[[int, int], None] | None) -> StudyResult:
    campaigns = run_campaigns(config, progress)
    first = config.scenario == "noise-drift"
    latencies = step_latencies(config) if config.cost and first else None
    shown = config.reported if config.scenario in DRIFTING else 1.0
    names = labels_of(config) if config.scenario == "r-sweep" else METHODS
    arrays, dims = _arrays(config, campaigns[shown], names)
    if config.scenario in DRIFTING:
        _add(arrays, dims, _factor_arrays(config, campaigns))
        if first and config.analysis:
            _add(arrays, dims, _map_arrays(config))
    return StudyResult(
        study="arekf",
        scenario=config.scenario,
        runs=config.runs,
        seed=config.seed,
        config=plain(config),
        methods=_measures(campaigns[shown], names, latencies),
        published={"source": "tables and figures not available as numbers", "methods": {}},
        claims=assess(config, campaigns, latencies),
        arrays=arrays,
        dims=dims,
        notes=_notes(config, campaigns, shown, names),
    )


Named = dict[str, tuple[Any, tuple[str, ...]]]
"""Arrays with the names of their axes."""


def _add(arrays: dict[str, Any], dims: dict[str, tuple[str, ...]], more: Named) -> None:
    arrays |= {name: array for name, (array, _) in more.items()}
    dims |= {name: axes for name, (_, axes) in more.items()}


def _measures(
    campaign: Campaign, names: tuple[str, ...], latencies: Mapping[str, Latency] | None
) -> dict[str, dict[str, Any]]:
    measures = {}
    for i, name in enumerate(names):
        measures[name] = _measures_of(campaign, i)
        if latencies is not None:
            own = latencies[name]
            measures[name] |= {"us_p50": round(own.p50, 2), "us_p99": round(own.p99, 2)}
    return measures


def _measures_of(campaign: Campaign, i: int) -> dict[str, Any]:
    """Return the entry of one method in ``summary.json``."""
    rows, curve = campaign.rows, campaign.mean_curve["square"][:, i]
    square = rows.mean_square[:, i]
    errors: dict[str, Any] = {}
    armse: dict[str, Any] = {}
    for j, kind in enumerate(KINDS):
        unit, scale = UNITS[kind]
        errors[kind] = {**rmse(square[:, j].sum(axis=-1) / scale**2)._asdict(), "unit": unit}
        over_time = np.sqrt(curve[:, j].sum(axis=-1)) / scale
        armse[kind] = {"value": float(over_time.mean()), "unit": unit}
        for k, axis in enumerate(AXES):
            own = rmse(square[:, j, k] / scale**2)
            errors[f"{kind}_{axis}"] = {**own._asdict(), "unit": unit, "of": kind}
    lost = ~np.isfinite(square).all(axis=(1, 2)) | ~(rows.final_square[:, i, 2] <= LOST_M**2)

    def per_kind(values: np.ndarray) -> dict[str, float]:
        return {kind: float(values[:, j].mean()) for j, kind in enumerate(KINDS)}

    return {
        "rmse": errors,
        "armse": armse,
        "stabilisation": per_kind(rows.stabilisation[:, i]),
        "convergence_s": per_kind(rows.convergence[:, i]),
        "anees": float(rows.final_nees[:, i].mean()),
        "anees_dof": STATES,
        "diverged": int(lost.sum()),
    }


def epochs_of(steps: int) -> np.ndarray:
    """Return the indices of the records at which consistency is judged."""
    return np.linspace(0, steps - 1, EPOCHS + 1).astype(int)[1:]


def _notes(
    config: ArekfConfig, campaigns: Mapping[float, Campaign], shown: float, names: tuple[str, ...]
) -> list[str]:
    campaign = campaigns[shown]
    off = campaign.rows.identified[:, 0] - 1
    notes = [
        f"Random walks identified from {config.align_s:g} s at rest: off by "
        f"{np.sqrt(np.mean(off**2)):.1%} RMS, {np.abs(off).max():.1%} at most."
    ]
    if config.scenario in DRIFTING:
        notes[:0] = [f"The table shows a storage drift factor of {shown:g}."]
        notes += [
            f"s = {s:g}: error of the EKF over that of AREKF "
            + ", ".join(f"{kind} {_ratio(own, kind)}" for kind in KINDS)
            + "; AREKF over oracle "
            + ", ".join(f"{1 + change(own, 'arekf', 'oracle', k).value:.3f}" for k in KINDS)
            for s, own in campaigns.items()
        ]
    if config.runs >= 2:
        low, high = chi2_mean_bounds(STATES, config.runs)
        at = epochs_of(len(campaign.mean_curve["nees"]))
        compared = ("ekf", "arekf", "oracle") if config.scenario in DRIFTING else names
        notes.append(
            f"ANEES of the {STATES} states at {EPOCHS} times, smallest and largest; a consistent "
            f"filter is within {low:.1f} and {high:.1f}: "
            + "; ".join(
                f"s = {s:g} "
                + ", ".join(
                    f"{name} {nees.min():.1f} {nees.max():.1f}"
                    for name, nees in zip(names, own.mean_curve["nees"][at].T, strict=True)
                    if name in compared
                )
                for s, own in campaigns.items()
            )
        )
    return notes


def _ratio(campaign: Campaign, kind: str) -> str:
    found = change(campaign, "ekf", "arekf", kind)
    return f"{1 + found.value:.2f} ({1 + found.low:.2f} to {1 + found.high:.2f})"


def _arrays(
    config: ArekfConfig, campaign: Campaign, names: tuple[str, ...]
) -> tuple[dict[str, Any], dict[str, tuple[str, ...]]]:
    scale = np.array([UNITS[kind][1] for kind in KINDS])[:, None]
    curve, trace = campaign.mean_curve, campaign.traces
    steps = curve["square"].shape[0]
    histories = ("time", "estimator", "kind", "axis")
    named: Named = {
        "time": (RECORD_S * np.arange(1, steps + 1), ("time",)),
        "trmse": (np.sqrt(curve["square"]) / scale, histories),
        "run_0_error": (trace["error"][0] / scale, histories),
        "run_0_sigma": (trace["sigma"][0] / scale, histories),
        "anees": (curve["nees"], ("time", "estimator")),
        "mean_square": (
            campaign.rows.mean_square / scale**2,
            ("run", "estimator", "kind", "axis"),
        ),
        "convergence": (campaign.rows.convergence, ("run", "estimator", "kind")),
        "identified": (campaign.rows.identified[:, 0], ("run", "sensor", "body_axis")),
        "estimator": (np.array(names), ("estimator",)),
        "kind": (np.array(KINDS), ("kind",)),
        "axis": (np.array(AXES), ("axis",)),
        "sensor": (np.array(("gyro", "accelerometer")), ("sensor",)),
        "unit": (np.array([UNITS[kind][0] for kind in KINDS]), ("kind",)),
    }
    arrays: dict[str, Any] = {}
    dims: dict[str, tuple[str, ...]] = {}
    _add(arrays, dims, named)
    coordinates = ("estimator", "kind", "axis", "sensor")
    return arrays, {name: axes for name, axes in dims.items() if name not in coordinates}


def _factor_arrays(config: ArekfConfig, campaigns: Mapping[float, Campaign]) -> Named:
    """Return errors ``(factors, estimators, kinds)`` and the ratios of EKF to AREKF."""
    scale = np.array([UNITS[kind][1] for kind in KINDS])
    level = np.sqrt([squared_norms(own).mean(axis=0) for own in campaigns.values()]) / scale
    ratio = [
        [[1 + bound for bound in change(own, "ekf", "arekf", kind)] for kind in KINDS]
        for own in campaigns.values()
    ]
    at = epochs_of(len(campaigns[1.0].mean_curve["nees"]))
    nees = [own.mean_curve["nees"][at] for own in campaigns.values()]
    return {
        "factor": (np.array(config.factors), ("factor",)),
        "rmse": (level, ("factor", "estimator", "kind")),
        "ratio": (np.array(ratio), ("factor", "kind", "bound")),
        "epoch_anees": (np.array(nees), ("factor", "epoch", "estimator")),
    }


def _map_arrays(config: ArekfConfig) -> Named:
    found = ratio_map(config)
    return {
        "map_ratio": (found.ratio, ("grade", "factor", "duration", "kind")),
        "grade": (np.array(found.grades), ("grade",)),
        "duration": (found.durations, ("duration",)),
    }
