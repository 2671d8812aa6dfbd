"""The paper's claims, and what became of them; its Table II is not available."""

import numpy as np

from jaxnav.estimation.metrics import Interval, rmse_change
from jaxnav.estimation.montecarlo import Campaign
from jaxnav.numerics.sequences import hammersley, star_discrepancy
from jaxnav.studies.attitude import AXES
from jaxnav.studies.base import Claim, judged, verdict
from jaxnav.studies.mmae_ukf.config import MmaeUkfConfig
from jaxnav.studies.mmae_ukf.methods import METHODS

FREE = ("scenario", "runs", "seed", "cost", "reset_period_s", "reset_threshold", "switching")
"""Fields a test of the claims may vary: the size of the study, and methods that are not the
paper's."""

VISIBLE = 0.005
"""Relative difference of RMSE below which two filters are called equal."""
PAPERS_METHODS = ("ekf", "ukf", "mmae-ekf", "mmae-ukf")
DISCREPANCY_POINTS = 250
DISCREPANCY_SETS = 50
TOO_ALIKE = (
    "at errors of arc seconds the difference of the two filters is of the second order of those "
    "errors, some 1e-9 rad"
)

MEMORY = (
    "the weights settle on the noise averaged over the flight, so that the bank gains little of "
    "what knowing the noise would"
)
BAD_START = (
    "after a bad start the members with much noise recover first and keep the weight, whatever the "
    "true noise"
)


def assess(
    config: MmaeUkfConfig, campaign: Campaign, costs: dict[str, float] | None
) -> list[Claim]:
    """Return the paper's claims with their verdicts.

    Args:
        config: The configuration of the scenario.
        campaign: Its Monte Carlo runs.
        costs: Microseconds per step of each method, if they were measured.
    """
    claims = [
        _bank_beats_single(campaign, "mmae-ekf", "ekf"),
        _bank_beats_single(campaign, "mmae-ukf", "ukf"),
        _ukf_beats_ekf(campaign, "mmae-ukf", "mmae-ekf"),
        _ukf_beats_ekf(campaign, "ukf", "ekf"),
        _most_expensive(costs),
    ]
    return [*judged(config, FREE, claims), _hammersley_spreads_better(config.seed)]


def gain(campaign: Campaign, method: str, rival: str) -> Interval:
    """Return the change of RMSE, mean of the three angles, from a rival to a method."""
    squares = campaign.rows.mean_square.mean(axis=-1)
    return rmse_change(squares[:, METHODS.index(method)], squares[:, METHODS.index(rival)])


def _per_axis(campaign: Campaign, method: str, rival: str) -> list[Interval]:
    squares = campaign.rows.mean_square
    a, b = squares[:, METHODS.index(method)], squares[:, METHODS.index(rival)]
    return [rmse_change(a[:, j], b[:, j]) for j in range(len(AXES))]


def _bank_beats_single(campaign: Campaign, bank: str, single: str) -> Claim:
    """A bank against its single filter; every angle's interval has to lie below zero."""
    change = gain(campaign, bank, single)
    axes = _per_axis(campaign, bank, single)
    ceiling = gain(campaign, "oracle", single)
    each = ", ".join(f"{axis} {of.value:+.1%}" for axis, of in zip(AXES, axes, strict=True))
    return Claim(
        id=f"{bank}-beats-{single}",
        text=f"{bank.upper()} is more accurate than {single.upper()} in all three angles",
        published=None,
        measured=change.value,
        ci95=(change.low, change.high),
        verdict=verdict(all(of.high < 0 for of in axes)),
        why=f"{each}; {MEMORY if ceiling.value < 0 else BAD_START} ({ceiling.value:+.1%} for "
        "the filter that is told the noise)",
    )


def _ukf_beats_ekf(campaign: Campaign, ours: str, rival: str) -> Claim:
    change = gain(campaign, ours, rival)
    better = change.high < 0 and change.value < -VISIBLE
    alike = max(abs(change.low), abs(change.high)) < VISIBLE
    if alike:
        reason = TOO_ALIKE
    elif better:
        reason = "the interval lies below zero"
    elif change.high < 0:
        reason = f"the interval lies below zero, but by less than {VISIBLE:.1%}"
    else:
        reason = "the interval does not lie below zero"
    return Claim(
        id=f"{ours}-beats-{rival}",
        text=f"{ours.upper()} is obviously more accurate than {rival.upper()}",
        published=None,
        measured=change.value,
        ci95=(change.low, change.high),
        verdict=verdict(better),
        why=reason,
    )


def _most_expensive(costs: dict[str, float] | None) -> Claim:
    text = "MMAE-UKF has the highest computational cost of the four methods"
    if costs is None:
        return Claim(
            "mmae-ukf-costs-most", text, None, None, None, "not testable", "cost was not measured"
        )
    own = costs["mmae-ukf"]
    next_dearest = max(costs[name] for name in PAPERS_METHODS if name != "mmae-ukf")
    each = ", ".join(f"{name} {costs[name]:.3g}" for name in PAPERS_METHODS)
    return Claim(
        id="mmae-ukf-costs-most",
        text=text,
        published=None,
        measured=own / next_dearest,
        ci95=None,
        verdict=verdict(own > next_dearest),
        why=f"microseconds per step: {each}; the measure is the ratio to the next dearest",
    )


def discrepancies(seed: int) -> tuple[float, np.ndarray]:
    """Return the L2-star discrepancy of the Hammersley set, and that of sets of random numbers."""
    rng = np.random.default_rng(seed)
    sets = rng.uniform(size=(DISCREPANCY_SETS, DISCREPANCY_POINTS, 2))
    regular = star_discrepancy(hammersley(DISCREPANCY_POINTS, 2))
    return regular, np.array([star_discrepancy(points) for points in sets])


def _hammersley_spreads_better(seed: int) -> Claim:
    regular, uniform = discrepancies(seed)
    return Claim(
        id="hammersley-spreads-better",
        text=f"{DISCREPANCY_POINTS} Hammersley points are spread better than uniform random ones",
        published=None,
        measured=regular / float(uniform.mean()),
        ci95=None,
        verdict=verdict(bool(regular < uniform.min())),
        why=f"L2-star discrepancy {regular:.2e}, against {uniform.mean():.2e} on average and "
        f"{uniform.min():.2e} at best of {DISCREPANCY_SETS} random sets",
    )
