"""The paper's claims, and what became of them; its numbers are not available."""

from collections.abc import Mapping

import numpy as np

from jaxnav.estimation.metrics import Interval, mean_interval, rmse_change
from jaxnav.estimation.montecarlo import Campaign
from jaxnav.studies.arekf.config import ArekfConfig
from jaxnav.studies.arekf.methods import KINDS, METHODS
from jaxnav.studies.base import Claim, judged, verdict
from jaxnav.studies.timing import Latency

FREE = (
    "scenario",
    "runs",
    "seed",
    "analysis",
    "cost",
    "reported",
    "iae_memory",
    "settle_s",
)
"""Fields a test of the claims may vary: the size of the study, what is shown, and methods and
numbers that are not the paper's."""

TWOFOLD = -0.5
"""Change of RMSE that "more than twofold" is."""
SIMILAR = 0.05
"""Relative difference below which two positions are called similar."""
SIMILAR_S = 1.0
"""Difference below which two times of convergence are called similar [s]."""
INSIGNIFICANT = 0.1
"""Relative difference of RMSE below which a factor on R is called insignificant."""
DECADE = (0.1, 10.0)
RIVALS = ("liekf", "se23-ekf", "versoria-ekf")
"""The paper's methods between its EKF and its AREKF."""
IMU_PERIOD_US = 2500.0

NOTHING_ADAPTS = (
    "none of them adapts Q: invariance changes how errors are linearised, which are small here, "
    "and Versoria takes for outliers the innovations that the noise made large"
)


def assess(
    config: ArekfConfig,
    campaigns: Mapping[float, Campaign],
    latencies: Mapping[str, Latency] | None,
) -> list[Claim]:
    """Return the claims of a scenario with their verdicts.

    Args:
        config: The configuration of the scenario.
        campaigns: Monte Carlo runs by the factor that the scenario varies: storage drift, or that
            on R; 1 alone where it varies none.
        latencies: Of a single step of each method, if they were measured.
    """
    if config.scenario == "r-sweep":
        claims = [_r_within_a_decade(config, campaigns[1.0], j) for j in range(len(KINDS))]
    elif config.scenario == "outliers":
        claims = [_pays(campaigns[1.0], "versoria-ekf", kind, _OUTLIERS) for kind in KINDS]
    elif config.scenario == "large-heading-error":
        claims = [
            _pays(campaigns[1.0], name, kind, _HEADING)
            for name in ("liekf", "se23-ekf")
            for kind in KINDS
        ]
    else:
        at = {s: campaigns[s] for s in sorted({config.reported, max(config.factors)})}
        claims = [
            *(_twofold(s, own, kind) for s, own in at.items() for kind in KINDS[:2]),
            *(_position_is_similar(s, own) for s, own in at.items()),
            _best(config.reported, campaigns[config.reported]),
            *(_between(config.reported, campaigns[config.reported], name) for name in RIVALS),
            _converges_alike(config.reported, campaigns[config.reported]),
            _too_slow(latencies),
        ]
        if config.scenario == "bias-dominated":
            claims = claims[:-1]
    return judged(config, FREE, claims)


def change(campaign: Campaign, method: str, rival: str, kind: str) -> Interval:
    """Return the change of RMSE of the norm of an error from a rival to a method."""
    square = squared_norms(campaign)[:, :, KINDS.index(kind)]
    return rmse_change(square[:, METHODS.index(method)], square[:, METHODS.index(rival)])


def squared_norms(campaign: Campaign) -> np.ndarray:
    """Return mean squares ``(runs, methods, 3)`` of attitude, velocity and position errors."""
    return campaign.rows.mean_square.sum(axis=-1)


def _twofold(factor: float, campaign: Campaign, kind: str) -> Claim:
    found = change(campaign, "arekf", "ekf", kind)
    bound = change(campaign, "oracle", "ekf", kind)
    return Claim(
        id=f"arekf-{kind}-twofold-at-{factor:g}",
        text=f"AREKF has less than half the {kind} error of the EKF, true noise {factor:g} times",
        published=TWOFOLD,
        measured=found.value,
        ci95=(found.low, found.high),
        verdict=verdict(found.high < TWOFOLD),
        why=f"knowing the noise would give {bound.value:+.1%}; the paper does not say how far its "
        "default noise was off",
    )


def _position_is_similar(factor: float, campaign: Campaign) -> Claim:
    found = change(campaign, "arekf", "ekf", "position")
    similar = max(abs(found.low), abs(found.high)) < SIMILAR
    return Claim(
        id=f"position-similar-at-{factor:g}",
        text=f"Positions of AREKF and EKF are similar, true noise {factor:g} times",
        published=None,
        measured=found.value,
        ci95=(found.low, found.high),
        verdict=verdict(similar),
        why=f"the interval {'lies' if similar else 'does not lie'} within {SIMILAR:.0%}",
    )


def _upper(found: Interval) -> float:
    return found.high


def _best(factor: float, campaign: Campaign) -> Claim:
    """AREKF against the best of the paper's methods, in each kind of error."""
    closest = [
        max((change(campaign, "arekf", rival, kind) for rival in ("ekf", *RIVALS)), key=_upper)
        for kind in KINDS[:2]
    ]
    worst = max(closest, key=lambda found: found.value)
    each = ", ".join(f"{kind} {of.value:+.1%}" for kind, of in zip(KINDS, closest, strict=False))
    return Claim(
        id="arekf-is-best",
        text=f"AREKF is the best of the paper's methods in attitude and velocity, {factor:g} times",
        published=None,
        measured=worst.value,
        ci95=(worst.low, worst.high),
        verdict=verdict(worst.high < 0),
        why=f"against the closest of them: {each}; an MMAE over the scale of the noise, not in the "
        f"paper, {change(campaign, 'mmae', 'arekf', 'attitude').value:+.1%} in attitude",
    )


def _between(factor: float, campaign: Campaign, name: str) -> Claim:
    """A rival is better than the EKF in attitude and velocity."""
    found = [change(campaign, name, "ekf", kind) for kind in KINDS[:2]]
    holds = all(of.high < 0 for of in found)
    worst = max(found, key=_upper)
    each = f"attitude {found[0].value:+.1%}, velocity {found[1].value:+.1%}"
    return Claim(
        id=f"{name}-beats-ekf",
        text=f"{name.upper()} beats the EKF in attitude and velocity, true noise {factor:g} times",
        published=None,
        measured=worst.value,
        ci95=(worst.low, worst.high),
        verdict=verdict(holds),
        why=each if holds else f"{each}: {NOTHING_ADAPTS}",
    )


def _converges_alike(factor: float, campaign: Campaign) -> Claim:
    times = campaign.rows.convergence
    late = times[:, METHODS.index("arekf")] - times[:, METHODS.index("ekf")]
    per_kind = [mean_interval(late[:, j]) for j in range(len(KINDS))]
    worst = max(per_kind, key=lambda found: abs(found.value))
    each = ", ".join(f"{kind} {of.value:+.2f} s" for kind, of in zip(KINDS, per_kind, strict=True))
    return Claim(
        id="converges-alike",
        text=f"AREKF and EKF converge in about the same time, true noise {factor:g} times",
        published=None,
        measured=worst.value,
        ci95=(worst.low, worst.high),
        verdict=verdict(all(max(abs(f.low), abs(f.high)) < SIMILAR_S for f in per_kind)),
        why=f"first time below the threshold: {each}; an attitude that wanders more crosses it "
        "earlier, so this measure of the paper says little",
    )


def _too_slow(latencies: Mapping[str, Latency] | None) -> Claim:
    text = "A step of the SE2(3)-EKF takes longer than the 2.5 ms of an inertial sample"
    if latencies is None:
        return Claim("se23-too-slow", text, None, None, None, "not testable", "not measured")
    each = ", ".join(f"{name} {of.p99:.0f}" for name, of in latencies.items())
    return Claim(
        id="se23-too-slow",
        text=text,
        published=IMU_PERIOD_US,
        measured=latencies["se23-ekf"].p99,
        ci95=None,
        verdict="not testable",
        why=f"the paper's is of a TMS320C6748; here 99 of 100 steps take less than, in us: {each}",
    )


_OUTLIERS = "fixes of ten times their noise are given a weight near zero"
_HEADING = (
    "an EKF linearises about an attitude that is wrong by tens of degrees, believes what it learns "
    "there and stays wrong; the dynamics of an invariant error do not depend on the attitude"
)


def _pays(campaign: Campaign, name: str, kind: str, why: str) -> Claim:
    """A filter beats the EKF where its own strength is asked for."""
    found = change(campaign, name, "ekf", kind)
    better = found.high < 0
    return Claim(
        id=f"{name}-beats-ekf-{kind}",
        text=f"{name.upper()} has a smaller {kind} error than the EKF",
        published=None,
        measured=found.value,
        ci95=(found.low, found.high),
        verdict=verdict(better),
        why=why if better else f"its interval is not below zero, though {why}",
    )


def _r_within_a_decade(config: ArekfConfig, campaign: Campaign, kind: int) -> Claim:
    """The largest change of RMSE that a factor on standard deviations within a decade makes."""
    square = squared_norms(campaign)[:, :, kind]
    own = config.r_factors.index(1.0)
    low, high = DECADE
    found = {
        factor: rmse_change(square[:, i], square[:, own])
        for i, factor in enumerate(config.r_factors)
        if i != own and low <= factor <= high
    }
    worst = max(found.values(), key=_upper, default=Interval(0.0, 0.0, 0.0))
    each = ", ".join(f"{factor:g}: {of.value:+.1%}" for factor, of in found.items())
    return Claim(
        id=f"r-within-a-decade-{KINDS[kind]}",
        text="Measurement noise (standard deviation) within an order of magnitude of the true one "
        f"hardly changes the {KINDS[kind]} error",
        published=None,
        measured=worst.value,
        ci95=(worst.low, worst.high),
        verdict=verdict(worst.high < INSIGNIFICANT),
        why=f"factors on the standard deviation, {each}; below {INSIGNIFICANT:.0%} is called "
        "insignificant",
    )
