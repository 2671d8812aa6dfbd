"""The paper's tables and claims, and what became of them."""

import numpy as np

from jaxnav.estimation.metrics import mean_interval, rmse_ratio
from jaxnav.estimation.montecarlo import Campaign
from jaxnav.studies.attitude import AXES
from jaxnav.studies.base import Claim, judged, verdict
from jaxnav.studies.immae.config import ImmaeConfig
from jaxnav.studies.immae.methods import BANKS, METHODS
from jaxnav.units import ARCSEC

PUBLISHED = {
    "matched-noise": {
        "source": "Table 2",
        "methods": {
            "kf": {"yaw": 0.18296, "pitch": 0.17572, "roll": 0.17851},
            "immae": {"yaw": 0.16666, "pitch": 0.15636, "roll": 0.16422},
        },
    },
    "noise-step": {
        "source": "Table 3",
        "methods": {
            "kf": {"yaw": 0.21911, "pitch": 0.26309, "roll": 0.25783},
            "mmae": {"yaw": 0.21413, "pitch": 0.22653, "roll": 0.22957},
            "immae": {"yaw": 0.19681, "pitch": 0.20683, "roll": 0.21063},
        },
    },
}
"""RMSE of the attitude in arcsec; the paper shows one run."""

FREE = ("scenario", "runs", "seed", "chain", "reset_period_s", "reset_threshold")
"""Fields a test of the claims may vary: the size of the study and what the paper leaves open."""

SINGLE_RUN_SIGMAS = 1.96
"""A published figure agrees if it is within this many deviations of a single run (95 %)."""
SETTLED = 0.9
"""Weight at which a model counts as chosen."""


def assess(config: ImmaeConfig, campaign: Campaign) -> list[Claim]:
    """Return the claims of the scenario's simulation with their verdicts.

    Args:
        config: The configuration of the scenario.
        campaign: Its Monte Carlo runs.
    """
    published = PUBLISHED[config.scenario]["methods"]
    rivals = [name for name in ("kf", "mmae") if name in published]
    claims = [_improvement(campaign, rival, axis, published) for rival in rivals for axis in AXES]
    claims += [_level(campaign, axis, published["immae"][axis]) for axis in AXES]
    if config.scenario == "matched-noise":
        claims.append(_first_model_chosen(config, campaign))
    elif len(config.theta) > 1:
        claims += [_second_model_chosen(config, campaign), _mmae_is_slow(config, campaign)]
    return judged(config, FREE, claims)


def _squares(campaign: Campaign, method: str, axis: str) -> np.ndarray:
    return campaign.rows.mean_square[:, METHODS.index(method), AXES.index(axis)]


def _scatter(per_run: np.ndarray) -> float:
    """Standard deviation of one run, NaN if there is only one."""
    return float(np.std(per_run, ddof=1)) if per_run.size > 1 else float("nan")


def _improvement(
    campaign: Campaign, rival: str, axis: str, published: dict[str, dict[str, float]]
) -> Claim:
    """The change of RMSE from a rival to IMMAE on one axis, over paired runs."""
    ours, theirs = _squares(campaign, "immae", axis), _squares(campaign, rival, axis)
    ratio = rmse_ratio(ours, theirs)
    printed = published["immae"][axis] / published[rival][axis] - 1
    scatter = _scatter(np.sqrt(ours / theirs))
    lower = bool(ratio.high < 1)
    agrees = abs(printed - (ratio.value - 1)) <= SINGLE_RUN_SIGMAS * scatter
    why = (
        f"the interval lies {'below' if lower else 'not wholly below'} zero and the published "
        f"single run is {abs(printed - ratio.value + 1):.3f} from the mean, "
        f"{'inside' if agrees else 'outside'} the 95 % range of a single run"
    )
    return Claim(
        id=f"immae-beats-{rival}-{axis}",
        text=f"IMMAE lowers the RMSE of the {axis} angle against {rival.upper()} by {-printed:.1%}",
        published=printed,
        measured=ratio.value - 1,
        ci95=(ratio.low - 1, ratio.high - 1),
        verdict=verdict(lower and agrees),
        why=why,
    )


def _level(campaign: Campaign, axis: str, printed: float) -> Claim:
    """The absolute RMSE of IMMAE on one axis against the table's."""
    single = np.sqrt(_squares(campaign, "immae", axis)) / ARCSEC
    value = float(np.sqrt(np.mean(single**2)))
    scatter = _scatter(single)
    half = SINGLE_RUN_SIGMAS * scatter
    agrees = abs(printed - value) <= half
    return Claim(
        id=f"immae-level-{axis}",
        text=f"The RMSE of the {axis} angle with IMMAE is {printed} arcsec",
        published=printed,
        measured=value,
        ci95=(value - half, value + half),
        verdict=verdict(agrees),
        why=f"the published single run is {printed - value:+.4f} arcsec from the mean, "
        f"{'inside' if agrees else 'outside'} the interval, the 95 % range of a single run; "
        "the paper gives neither trajectory nor discretisation",
    )


def _time_to_choose(
    config: ImmaeConfig, campaign: Campaign, bank: str, model: int, start: float
) -> float:
    """Seconds from ``start`` until the mean weight of a model exceeds :data:`SETTLED`."""
    weights = campaign.mean_curve["weights"][:, BANKS.index(bank), model]
    time = config.filter_period_s * np.arange(1, config.steps + 1)
    late = np.flatnonzero((weights > SETTLED) & (time > start))
    return float(time[late[0]] - start) if late.size else float("inf")


def _first_model_chosen(config: ImmaeConfig, campaign: Campaign) -> Claim:
    seconds = _time_to_choose(config, campaign, "immae", 0, 0.0)
    final = float(campaign.mean_curve["weights"][-1, BANKS.index("immae"), 0])
    return Claim(
        id="model-1-weight-to-one",
        text="The weight of model 1 (Q0) approaches 1 rapidly",
        published=None,
        measured=seconds,
        ci95=None,
        verdict=verdict(seconds < config.duration_s / 10 and final > SETTLED),
        why=f"the mean weight passes {SETTLED} after {seconds:.0f} s and ends at {final:.3f}",
    )


def _second_model_chosen(config: ImmaeConfig, campaign: Campaign) -> Claim:
    start = config.duration_s / 3
    seconds = _time_to_choose(config, campaign, "immae", 1, start)
    return Claim(
        id="model-2-weight-to-one",
        text="With IMMAE the weight of model 2 (10 Q0) approaches 1 rapidly in the middle third",
        published=None,
        measured=seconds,
        ci95=None,
        verdict=verdict(seconds < config.duration_s / 6),
        why=f"the mean weight passes {SETTLED} {seconds:.0f} s after the step",
    )


def _mmae_is_slow(config: ImmaeConfig, campaign: Campaign) -> Claim:
    start = config.duration_s / 3
    seconds = campaign.rows.crossing * config.filter_period_s - start
    mean, low, high = mean_interval(seconds)
    immae = _time_to_choose(config, campaign, "immae", 1, start)
    back = float(np.mean(campaign.rows.returned))
    return Claim(
        id="mmae-responds-slowly",
        text="MMAE responds slowly to the change of noise",
        published=None,
        measured=mean,
        ci95=(low, high),
        verdict=verdict(low > immae and back < 0.5),
        why=f"MMAE prefers model 2 to model 1 {mean:.0f} s after the step, while IMMAE gives it a "
        f"mean weight of {SETTLED} after {immae:.0f} s; at the end MMAE is back on model 1 in "
        f"{back:.0%} of the runs",
    )
