"""The study as a whole: scenarios, Monte Carlo, measures."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jaxnav.config import plain
from jaxnav.estimation.montecarlo import Campaign, monte_carlo
from jaxnav.studies.base import StudyResult, run_scenarios
from jaxnav.studies.sage_husa.claims import TABLE_4, assess, best_single, change, span_name
from jaxnav.studies.sage_husa.config import SCENARIOS, WINDOWS_S, SageHusaConfig
from jaxnav.studies.sage_husa.methods import (
    AXES,
    BANKS,
    constant,
    methods_of,
    run_one,
    setup_of,
    shared_of,
)
from jaxnav.studies.sage_husa.simulation import added_noise, build_world

UNIT = "m^2"
LOST_M = 200.0
"""A method diverged in a run whose horizontal position is wrong by more at the end [m]."""


def run_study(
    config: SageHusaConfig, progress: Callable[[str, int, int], None] | None = None
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


def run_campaign(config: SageHusaConfig, **options: Any) -> Campaign:
    """Run the Monte Carlo of a scenario; options are those of ``monte_carlo``."""
    shared = shared_of(config, build_world(config))
    one = run_one(setup_of(config))
    key = jax.random.key(config.seed)
    return monte_carlo(one, key, config.runs, shared, keep=1, **options)


def _run_scenario(
    config: SageHusaConfig, progress: Callable[[int, int], None] | None
) -> StudyResult:
    campaign = run_campaign(config, progress=progress)
    arrays, dims = _arrays(config, campaign)
    return StudyResult(
        study="sage-husa",
        scenario=config.scenario,
        runs=config.runs,
        seed=config.seed,
        config=plain(config),
        methods={name: _measures(config, campaign, name) for name in compared(config)},
        published=_published(config),
        claims=assess(config, campaign),
        arrays=arrays,
        dims=dims,
        notes=_notes(config, campaign),
    )


def compared(config: SageHusaConfig) -> list[str]:
    """Return the methods of Table 4 and their like: all but those of Experiment 1."""
    others = {constant(b) for b in config.forgetting}
    return [name for name in methods_of(config) if name not in others]


def _published(config: SageHusaConfig) -> dict[str, Any]:
    spans = [span_name(span) for span in config.intervals_s]
    return {
        "source": f"Table 4, MSE [{UNIT}]",
        "methods": {
            name: {
                axis: {span: pair[j] for span, pair in zip(spans, row, strict=True)}
                for j, axis in enumerate(AXES)
            }
            for name, row in TABLE_4.items()
        },
    }


def _measures(config: SageHusaConfig, campaign: Campaign, name: str) -> dict[str, Any]:
    """Return the entry of one method in ``summary.json``."""
    i, rows = methods_of(config).index(name), campaign.rows
    square = rows.mean_square[:, i]
    mse = {
        axis: {
            span_name(span): _measured(square[:, k, j]) for k, span in enumerate(config.intervals_s)
        }
        for j, axis in enumerate(AXES)
    }
    lost = ~np.isfinite(square).all(axis=(1, 2)) | ~(rows.final_square[:, i] <= LOST_M**2)
    return {
        "mse": mse,
        "anees": float(rows.nees[:, i, : len(config.intervals_s)].mean()),
        "anees_dof": len(AXES),
        "diverged": int(lost.sum()),
    }


def _measured(squares: np.ndarray) -> dict[str, Any]:
    count = squares.size
    se = float(squares.std(ddof=1) / np.sqrt(count)) if count > 1 else float("nan")
    return {"value": float(squares.mean()), "se": se, "unit": UNIT}


def _notes(config: SageHusaConfig, campaign: Campaign) -> list[str]:
    names, north = methods_of(config), campaign.rows.mean_square[..., 1]
    first = len(config.intervals_s)
    windows = ", ".join(f"{span_name(span)} s" for span in WINDOWS_S)
    notes = [
        f"Experiment 1, MSE north [{UNIT}] with constant d over {windows}: "
        + "; ".join(
            f"b = {b:g} "
            + " ".join(
                f"{value:.2f}" for value in north[:, names.index(constant(b)), first:].mean(axis=0)
            )
            for b in config.forgetting
        )
    ]
    for i, span in enumerate(config.intervals_s):
        rival = best_single(config, campaign, i)
        each = []
        for name in (*BANKS, "mmae", "oracle-r", "oracle"):
            found = change(config, campaign, name, rival, i)
            each.append(f"{name} {found.value:+.1%} [{found.low:+.1%}, {found.high:+.1%}]")
        notes.append(f"{span_name(span)} s, MSE against {rival}: " + ", ".join(each))
    return notes


def _arrays(
    config: SageHusaConfig, campaign: Campaign
) -> tuple[dict[str, Any], dict[str, tuple[str, ...]]]:
    curve, trace = campaign.mean_curve, campaign.traces
    histories = ("time", "estimator", "axis")
    weights = ("time", "bank", "member")
    variances = ("time", "member", "axis")
    spans = [span_name(span) for span in (*config.intervals_s, *WINDOWS_S)]
    named = {
        "trmse": (np.sqrt(curve["square"]), histories),
        "run_0_error": (trace["error"][0], histories),
        "run_0_sigma": (trace["sigma"][0], histories),
        "mean_weights": (curve["weights"], weights),
        "run_0_weights": (trace["weights"][0], weights),
        "mean_variance": (curve["variance"], variances),
        "run_0_variance": (trace["variance"][0], variances),
        "mean_square": (campaign.rows.mean_square, ("run", "estimator", "span", "axis")),
        "nees": (campaign.rows.nees, ("run", "estimator", "span")),
        "added": (np.asarray(added_noise(config)), ("time",)),
        "member_forgetting": (np.array([b for b, _ in config.grid]), ("member",)),
        "member_q_scale": (np.array([q for _, q in config.grid]), ("member",)),
    }
    coordinates = {
        "time": config.fix_interval_s * np.arange(1, config.steps + 1),
        "estimator": np.array(methods_of(config)),
        "axis": np.array(AXES),
        "bank": np.array(list(BANKS)),
        "span": np.array(spans),
    }
    arrays = {name: array for name, (array, _) in named.items()} | coordinates
    return arrays, {name: axes for name, (_, axes) in named.items()}
