"""What every study is: scenarios of a configuration, a result, claims and their verdicts."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from jaxnav.config import plain, require
from jaxnav.findings import Finding


def require_one_scenario(config: Any, scenarios: Iterable[str]) -> None:
    """Require that a configuration names one of its study's scenarios, not "all" of them."""
    names = tuple(scenarios)
    require(config.scenario in names, "scenario", config.scenario, "one of " + ", ".join(names))


def require_reset(config: Any, shortest_s: float) -> None:
    """Require that ``reset_period_s`` and ``reset_threshold`` fit the windowed reset."""
    require(
        config.reset_period_s >= shortest_s,
        "reset_period_s",
        config.reset_period_s,
        f"at least one filter period of {shortest_s} s",
    )


def require_weight_floor(config: Any, models: int) -> None:
    """Require that ``weight_floor`` is below the equal weight of so many models."""
    require(
        config.weight_floor < 1 / models,
        "weight_floor",
        config.weight_floor,
        f"positive and below 1 / {models}, the equal weight",
    )


def require_flight_times(config: Any) -> None:
    """Require that rates, filter period and duration of a simulated flight fit together."""
    per_period = config.filter_period_s * config.ins_rate_hz
    require(
        per_period >= 1 - 1e-9 and abs(per_period - round(per_period)) < 1e-9 * per_period,
        "filter_period_s",
        config.filter_period_s,
        f"a whole number of inertial samples of {1 / config.ins_rate_hz:g} s",
    )
    require(
        config.duration_s >= config.filter_period_s,
        "duration_s",
        config.duration_s,
        f"at least one filter period of {config.filter_period_s} s",
    )


def require_x64() -> None:
    """Raise :class:`ConfigError` if JAX is set to 32-bit floats.

    Attitude covariances of arc seconds are near 1e-13 rad^2 beside positions in kilometres; the
    studies are written for 64-bit floats.
    """
    import jax

    require(
        jax.numpy.result_type(float) == "float64",
        "jax_enable_x64",
        False,
        "True before a study runs (jax.config.update('jax_enable_x64', True) or JAX_ENABLE_X64=1)",
    )


def check_simulated(config: Any) -> None:
    """Raise :class:`ConfigError` if a simulated study cannot run here, whatever its values."""
    del config
    require_x64()


def run_scenarios(
    config: Any,
    scenarios: Iterable[str],
    run_scenario: "Callable[[Any, Callable[[int, int], None] | None], StudyResult]",
    progress: Callable[[str, int, int], None] | None,
) -> "list[StudyResult]":
    """Run one scenario of a simulated study, or all of them.

    Args:
        config: The configuration; its ``scenario`` is one of them or "all".
        scenarios: Their names, in order.
        run_scenario: Takes the configuration of one scenario and what to call with (runs done,
            runs), if anything.
        progress: Called with (scenario, runs done, runs).

    Raises:
        ConfigError: If 64-bit floats are off.
    """
    check_simulated(config)
    names = tuple(scenarios) if config.scenario == "all" else (config.scenario,)
    return [
        run_scenario(
            replace(config, scenario=name), None if progress is None else partial(progress, name)
        )
        for name in names
    ]


@dataclass(frozen=True)
class Claim:
    """A claim of a paper, what was measured, and the verdict.

    Attributes:
        id: Stable identifier.
        text: The claim in one sentence.
        published: The published number, or ``None`` where the paper gives none.
        measured: The measured number.
        ci95: 95 % interval of the measured number over paired runs, or ``None``.
        verdict: ``reproduced``, ``not reproduced`` or ``not testable``.
        why: What the verdict rests on.
    """

    id: str
    text: str
    published: float | None
    measured: float | None
    ci95: tuple[float, float] | None
    verdict: str
    why: str


def untested(config: Any, free: tuple[str, ...]) -> str | None:
    """Return what keeps a configuration from testing a paper's claims, if anything does.

    Args:
        config: The configuration; the scenario that is tested is its class with no arguments.
        free: Fields a test of the claims may vary without becoming a test of something else.
    """
    if config.runs < 2:
        return "one run has no interval"
    paper, given = plain(type(config)()), plain(config)
    changed = [name for name in paper if name not in free and paper[name] != given[name]]
    return f"not at the study's default: {', '.join(changed)}" if changed else None


def judged(config: Any, free: tuple[str, ...], claims: list[Claim]) -> list[Claim]:
    """Return the claims, "not testable" if the configuration keeps them from being tested.

    Arguments are those of :func:`untested`.
    """
    reason = untested(config, free)
    if reason is None:
        return claims
    return [replace(claim, verdict="not testable", why=reason) for claim in claims]


def verdict(holds: bool) -> str:
    """Return the word for a claim that holds or does not."""
    return "reproduced" if holds else "not reproduced"


@dataclass(frozen=True)
class StudyResult:
    """One scenario of a study, ready to be written and printed.

    Attributes:
        study: Name of the study.
        scenario: Name of the scenario.
        runs: Number of runs.
        seed: Root seed.
        config: The configuration as plain values.
        methods: Per method id, the measures of ``summary.json``.
        published: The paper's numbers: ``source`` and ``methods``.
        claims: The claims with their verdicts.
        arrays: Named arrays for ``arrays.npz`` and the figures. One that is named like an axis
            holds that axis' coordinates and needs no entry in ``dims``.
        dims: Per array, the names of all its axes.
        notes: Sentences for the reader of the table.
        audit: What the innovations of recorded data say.
    """

    study: str
    scenario: str
    runs: int
    seed: int
    config: dict[str, Any]
    methods: dict[str, dict[str, Any]]
    published: dict[str, Any]
    claims: list[Claim]
    arrays: dict[str, Any] = field(default_factory=dict)
    dims: dict[str, tuple[str, ...]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    audit: list[Finding] = field(default_factory=list)

    @property
    def diverged(self) -> int:
        """The largest number of diverged runs of any method."""
        return max((int(m.get("diverged", 0)) for m in self.methods.values()), default=0)
