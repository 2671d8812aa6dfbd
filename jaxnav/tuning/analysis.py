"""The work of ``jaxnav tune``: fit, validate, judge on held-out runs, and say what it is worth."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
import optax
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.config import ConfigError, plain
from jaxnav.estimation.metrics import Interval, mean, mean_interval, rmse, rmse_ratio
from jaxnav.estimation.tune.fit import Fit, StartError, Validation, fit, fit_lbfgs
from jaxnav.estimation.tune.inspect import (
    GradientCheck,
    Profile,
    Uncertainty,
    check_gradient,
    fisher,
    profile,
)
from jaxnav.findings import document_of, faults
from jaxnav.results import SCHEMA, provenance
from jaxnav.studies.tuned import Measure, Problem
from jaxnav.tuning.config import TuneConfig
from jaxnav.tuning.selection import Selection, select

TRAIN, VALIDATE, JUDGE = range(3)
"""What the root key is folded with, so that no run serves two purposes."""
EVERY = 5
"""Steps between two validations."""
LOOSE_GRADIENT = 1e-4
"""Relative deviation from central differences above which a check of the gradient is a warning."""


class Report(NamedTuple):
    """The outcome: the document of ``summary.json``, arrays, and what the figures show.

    Attributes:
        document: As plain values.
        arrays: For ``tuning.npz``.
        fit: The fit.
        profile: The loss along each parameter, or ``None``.
    """

    document: dict[str, Any]
    arrays: dict[str, Any]
    fit: Fit
    profile: Profile | None


class _Losses(NamedTuple):
    """The loss of smooth and of hard rules, and data that no step has seen, if there are any."""

    smooth: Callable[[Any, Any], Array]
    hard: Callable[[Any, Any], Array] | None
    data: Any


def tune(
    name: str,
    study: dict[str, Any],
    problem: Problem,
    config: TuneConfig,
    progress: Callable[[str, int, int], None] | None = None,
) -> Report:
    """Tune a problem and judge the outcome.

    Args:
        name: Name of the study, or the source of a recorded log.
        study: Its configuration as plain values, for the document.
        problem: The problem.
        config: What was asked.
        progress: Called with (part, done, total).

    Raises:
        ConfigError: If a parameter is not there, a value or bound is outside its domain, or the
            loss at the start is not finite.
    """
    chosen = select(problem, config)
    root = jax.random.key(config.seed)
    keys = [jax.random.fold_in(root, purpose) for purpose in (TRAIN, VALIDATE, JUDGE)]
    losses = _losses(problem, keys, config)
    checked = _checked(problem, chosen, losses, config)
    try:
        found = _descend(problem, chosen, config, keys, losses, progress)
    except StartError as error:
        raise ConfigError(f"{error}; it must be finite where a fit begins") from None
    held_out = {}
    for number, (label, judge) in enumerate(problem.held_out.items(), 1):
        held_out[label] = judge(found.params, keys[JUDGE], config.held_out_runs)
        if progress is not None:
            progress("held out", number, len(problem.held_out))
    diverged = max((_diverged(scores) for scores in held_out.values()), default=0)
    profiled, missing = _profiled(found.params, chosen, losses, config)
    known, unknown = _uncertainty(problem, found.params, chosen, losses, config)
    findings = [] if problem.audit is None else problem.audit(found.params)
    document = {
        "schema": SCHEMA,
        "command": "tune",
        "study": name,
        "tuning": plain(config),
        "config": study,
        "provenance": provenance(),
        "parameters": _parameters(problem, chosen, found, known),
        "loss": _gap(chosen, found, losses),
        "fit": _course(found),
        "gradient_check": _gradient(checked),
        "measure": problem.measure._asdict(),
        "held_out": {
            label: _verdict(scores, problem.measure) for label, scores in held_out.items()
        },
        "audit": document_of(findings),
        "faults": faults(findings),
        "diverged": diverged,
        "notes": [*problem.notes, *missing, *unknown, *_warnings(found, checked, diverged)],
    }
    return Report(document, _arrays(found, profiled, held_out), found, profiled)


def _losses(problem: Problem, keys: list[Any], config: TuneConfig) -> _Losses:
    if problem.simulated:
        data = problem.draw(keys[VALIDATE], _validation_runs(problem, config))
    else:
        data = problem.draw(keys[TRAIN], 1)
    hard = None if problem.hard is None else compiled(problem.hard)
    return _Losses(compiled(problem.loss), hard, data)


def _validation_runs(problem: Problem, config: TuneConfig) -> int:
    return config.validation_runs or problem.validation_runs


def _checked(
    problem: Problem, chosen: Selection, losses: _Losses, config: TuneConfig
) -> GradientCheck | None:
    if not config.check_gradient:
        return None
    return check_gradient(
        problem.loss,
        chosen.start,
        data=(losses.data,),
        transform=chosen.transforms,
        mode=problem.mode,
    )


def _descend(
    problem: Problem,
    chosen: Selection,
    config: TuneConfig,
    keys: list[Any],
    losses: _Losses,
    progress: Callable[[str, int, int], None] | None,
) -> Fit:
    steps = config.steps or problem.steps
    runs = config.runs or problem.runs

    def moved(step: int, total: int, loss: float) -> None:
        del loss
        if progress is not None:
            progress("fit", step, total)

    def fresh(number: int) -> Any:
        return problem.draw(jax.random.fold_in(keys[TRAIN], number), runs)

    if (config.optimiser or problem.optimiser) == "lbfgs":
        return fit_lbfgs(
            problem.loss,
            chosen.start,
            data=(problem.draw(keys[TRAIN], runs),),
            transform=chosen.transforms,
            steps=steps,
            mode=problem.mode,
            progress=moved,
        )
    validation = Validation(losses.smooth, (losses.data,), EVERY, config.patience)
    schedule = optax.cosine_decay_schedule(config.rate or problem.rate, steps)
    return fit(
        problem.loss,
        chosen.start,
        data=() if problem.fresh else (problem.draw(keys[TRAIN], runs),),
        transform=chosen.transforms,
        optimiser=optax.adam(schedule),
        steps=steps,
        batches=fresh if problem.fresh else None,
        validation=validation if problem.simulated else None,
        mode=problem.mode,
        progress=moved,
    )


def _profiled(
    values: Any, chosen: Selection, losses: _Losses, config: TuneConfig
) -> tuple[Profile | None, list[str]]:
    """Return the profiles about an optimum, or why there are none: it may be at a domain's end."""
    if not config.profile_points:
        return None, []
    try:
        drawn = profile(
            losses.smooth,
            values,
            data=(losses.data,),
            transform=chosen.transforms,
            points=config.profile_points,
        )
    except ValueError as error:
        return None, [f"no profiles of the loss: {error}"]
    return drawn, []


def _uncertainty(
    problem: Problem, values: Any, chosen: Selection, losses: _Losses, config: TuneConfig
) -> tuple[Uncertainty | None, list[str]]:
    """Return what a likelihood knows of its optimum, or why it does not."""
    if not problem.samples:
        return None, []
    runs = _validation_runs(problem, config) if problem.simulated else 1
    try:
        known = fisher(
            problem.loss,
            values,
            problem.samples * runs,
            data=(losses.data,),
            transform=chosen.transforms,
            mode=problem.mode,
        )
    except ValueError as error:
        return None, [f"no standard deviations: {error}"]
    return known, ["the standard deviations are those of a model that is right"]


def _parameters(
    problem: Problem, chosen: Selection, found: Fit, known: Uncertainty | None
) -> dict[str, Any]:
    return {
        name: {
            "text": parameter.text,
            "domain": chosen.transforms[name].domain,
            "hand_set": np.asarray(parameter.start).tolist(),
            "start": np.asarray(chosen.start[name]).tolist(),
            "tuned": np.asarray(found.params[name]).tolist(),
            "sigma": None if known is None else np.asarray(known.sigma[name]).tolist(),
        }
        for name, parameter in problem.parameters.items()
    }


def _gap(chosen: Selection, found: Fit, losses: _Losses) -> dict[str, Any]:
    """Return the loss at start and optimum, of the smooth rules and of the hard ones."""
    gap: dict[str, Any] = {
        "start": float(losses.smooth(chosen.start, losses.data)),
        "tuned": float(losses.smooth(found.params, losses.data)),
    }
    if losses.hard is not None:
        gap["hard_start"] = float(losses.hard(chosen.start, losses.data))
        gap["hard_tuned"] = float(losses.hard(found.params, losses.data))
        gap["smooth_below_hard"] = 1 - gap["tuned"] / gap["hard_tuned"]
    return gap


def _course(found: Fit) -> dict[str, Any]:
    return {
        "steps": len(found.history) - 1,
        "rejected": found.rejected,
        "stopped": found.stopped,
        "validations": len(found.validation),
    }


def _gradient(checked: GradientCheck | None) -> dict[str, Any] | None:
    if checked is None:
        return None
    rows = zip(checked.labels, checked.gradient, checked.difference, strict=True)
    return {
        "largest_deviation": checked.error,
        "coordinates": {label: {"gradient": g, "difference": d} for label, g, d in rows},
    }


def _verdict(scores: dict[str, np.ndarray], measure: Measure) -> dict[str, Any]:
    """Return each method's measure, and the optimum against each other, paired over the runs."""
    tuned = scores["tuned"]
    return {
        "runs": int(tuned.size),
        "methods": {name: _measured(values, measure) for name, values in scores.items()},
        "tuned_over": {
            rival: compared(tuned, values, measure)._asdict()
            for rival, values in scores.items()
            if rival != "tuned"
        },
    }


def _measured(values: np.ndarray, measure: Measure) -> dict[str, Any]:
    value, se = rmse(values) if measure.kind == "mean-square" else mean(values)
    return {"value": value / measure.scale, "se": se / measure.scale, "unit": measure.unit}


def compared(tuned: np.ndarray, rival: np.ndarray, measure: Measure) -> Interval:
    """Return a ratio of RMSE, or a difference of means in the measure's unit, with 95 %."""
    if measure.kind == "mean-square":
        return rmse_ratio(tuned, rival)
    return mean_interval((tuned - rival) / measure.scale)


def _diverged(scores: dict[str, np.ndarray]) -> int:
    """Return in how many runs the score of a method is not finite."""
    return int(np.sum(~np.all(np.isfinite(np.stack(list(scores.values()))), axis=0)))


def _warnings(found: Fit, checked: GradientCheck | None, diverged: int) -> list[str]:
    notes = []
    if diverged:
        notes.append(f"a method diverged in {diverged} of the runs held out")
    if found.rejected:
        notes.append(f"{found.rejected} evaluations were not finite; their steps were taken back")
    if checked is not None and checked.error > LOOSE_GRADIENT:
        notes.append(
            f"the gradient deviates from central differences by {checked.error:.1e} of its largest "
            "entry: the loss is rough, or the horizon makes it explode"
        )
    return notes


def _arrays(
    found: Fit, profiled: Profile | None, held_out: dict[str, dict[str, np.ndarray]]
) -> dict[str, Any]:
    arrays: dict[str, Any] = {"history": found.history, "validation": found.validation}
    if profiled is not None:
        arrays |= {
            "profile_label": np.array(profiled.labels),
            "profile_value": profiled.value,
            "profile_loss": profiled.loss,
        }
    for number, scores in enumerate(held_out.values()):
        for method, values in scores.items():
            arrays[f"held_out_{number}_{method}"] = np.asarray(values)
    return arrays
