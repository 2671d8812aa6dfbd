"""The paper's tables and claims, and what became of them."""

import numpy as np

from jaxnav.estimation.metrics import Interval, mean_interval, rmse, rmse_change, rmse_ratio
from jaxnav.estimation.montecarlo import Campaign
from jaxnav.studies.attitude import AXES
from jaxnav.studies.base import Claim, judged, verdict
from jaxnav.studies.rkcns.config import RkcnsConfig
from jaxnav.studies.rkcns.cost import flops
from jaxnav.studies.rkcns.methods import METHODS
from jaxnav.units import ARCSEC, MICRO_G

POSITION = ("px", "py", "pz")
COMPONENTS = (*POSITION, *AXES)
PUBLISHED = {
    "source": "Tables 3 and 4",
    "methods": {
        name: dict(zip(COMPONENTS, values, strict=True))
        for name, values in {
            "conventional": (104.2658, 506.7657, 237.6792, 0.8731, 0.9265, 0.8880),
            "ckf": (50.8478, 87.4702, 153.8121, 0.8897, 0.8218, 0.9105),
            "iterated-ckf": (28.2319, 81.9790, 97.2022, 0.8282, 0.7805, 0.7638),
            "modified-iterated-ckf": (27.2984, 59.8424, 63.7790, 0.8479, 0.7525, 0.8081),
        }.items()
    },
}
"""Means over 100 runs of the RMSE of a run, position in m and attitude in arcsec."""

FREE = ("scenario", "runs", "seed", "ablations", "cost", "iterations", "trials", "point_spread")
"""Fields a test of the claims may vary: the size of the study and what the paper leaves open."""

SAME = 0.05
"""Relative difference of RMSE below which two attitudes are called equal."""
AGREES = 0.1
"""Relative difference to a published level within which it is called reached."""
KNOWN_UG = 10.0
"""Error below which the accelerometer bias counts as estimated [micro g]."""
ITERATED = ("iterated-ckf", "modified-iterated-ckf")
TOO_LINEAR = (
    "attitude and accelerometers are observed linearly, and the height's second order in position, "
    "dr^2 / 2 R_e, is below a tenth of a metre for the errors at hand beside 100 m of noise, so an "
    "iteration has nothing to correct"
)
INSIDE_THE_LOGARITHM = (
    "noise that adds cancels from the augmented step; that of the angles is inside a logarithm, "
    "and iterating on it takes away the bias H (sigma / R)^2 / 2 that it leaves on a height: a "
    "metre at 25 km, and vertical; at 40 km it is the largest error (see the ablations)"
)
LOST_START = (
    "the second order of the height is many times its noise at the first fix; the ckf takes it for "
    "noise and needs more fixes, an iteration about its own estimate does not"
)


def assess(config: RkcnsConfig, campaign: Campaign, costs: dict[str, float] | None) -> list[Claim]:
    """Return the paper's claims with their verdicts.

    Args:
        config: The configuration of the scenario.
        campaign: Its Monte Carlo runs.
        costs: Microseconds per step of each method, if they were measured.
    """
    if config.scenario == "strong-nonlinearity":
        claims = [_iteration_pays(campaign, name) for name in ITERATED]
    else:
        claims = [
            _refraction_pays(campaign),
            _bias_is_estimated(campaign),
            _attitude_is_unchanged(campaign),
            *(_gain(campaign, name, axis) for name in ITERATED for axis in POSITION),
            *(_level(config, campaign, axis) for axis in AXES),
            _same_order(config, costs),
        ]
    return judged(config, FREE, claims)


def change(campaign: Campaign, method: str, rival: str, axes: tuple[str, ...]) -> Interval:
    """Return the change of RMSE, of the norm over some components, from a rival to a method."""
    return rmse_change(*_squares(campaign, method, rival, axes))


def _squares(
    campaign: Campaign, method: str, rival: str, axes: tuple[str, ...]
) -> tuple[np.ndarray, np.ndarray]:
    columns = [COMPONENTS.index(axis) for axis in axes]
    each = campaign.rows.mean_square[:, :, columns].sum(axis=-1)
    return each[:, METHODS.index(method)], each[:, METHODS.index(rival)]


def _norm(name: str, axes: tuple[str, ...]) -> float:
    return float(np.hypot.reduce([PUBLISHED["methods"][name][axis] for axis in axes]))


def _refraction_pays(campaign: Campaign) -> Claim:
    ratio = change(campaign, "ckf", "conventional", POSITION)
    printed = _norm("ckf", POSITION) / _norm("conventional", POSITION) - 1
    return Claim(
        id="refraction-improves-position",
        text="Refraction and the constraint lower the RMSE of the position of SINS/CNS with a CKF",
        published=printed,
        measured=ratio.value,
        ci95=(ratio.low, ratio.high),
        verdict=verdict(ratio.high < 0),
        why=f"the norm falls to {1 + ratio.value:.3f} of the conventional system's, published "
        f"{1 + printed:.3f}; the paper gives neither trajectory nor stars",
    )


def _bias_is_estimated(campaign: Campaign) -> Claim:
    errors = {
        name: rmse(campaign.rows.bias_square[:, METHODS.index(name)].mean(axis=-1) / MICRO_G**2)
        for name in ("ckf", "conventional")
    }
    ours, theirs = errors["ckf"], errors["conventional"]
    half = 1.96 * ours.se
    return Claim(
        id="accelerometer-bias-estimated",
        text="SINS/RKCNS estimates the accelerometer bias, SINS/CNS does not",
        published=None,
        measured=ours.value,
        ci95=(ours.value - half, ours.value + half),
        verdict=verdict(ours.value + half < KNOWN_UG < theirs.value),
        why=f"error at the end {ours.value:.2f} micro g against {theirs.value:.0f}; averaging the "
        "accelerometers' noise in free flight gives 50 / sqrt(t) micro g, whatever the filter",
    )


def _attitude_is_unchanged(campaign: Campaign) -> Claim:
    ratio = change(campaign, "ckf", "conventional", AXES)
    printed = _norm("ckf", AXES) / _norm("conventional", AXES) - 1
    return Claim(
        id="attitude-not-improved",
        text="SINS/RKCNS does not improve the attitude significantly",
        published=printed,
        measured=ratio.value,
        ci95=(ratio.low, ratio.high),
        verdict=verdict(max(abs(ratio.low), abs(ratio.high)) < SAME),
        why=f"the interval lies within {SAME:.0%}: the star tracker fixes the attitude",
    )


def _gain(campaign: Campaign, method: str, axis: str) -> Claim:
    """The change of RMSE of a position component from the CKF to an iterated filter."""
    ratio = change(campaign, method, "ckf", (axis,))
    printed = PUBLISHED["methods"][method][axis] / PUBLISHED["methods"]["ckf"][axis] - 1
    return Claim(
        id=f"{method}-beats-ckf-{axis}",
        text=f"{method.upper()} lowers the RMSE of {axis} against the CKF by {-printed:.1%}",
        published=printed,
        measured=ratio.value,
        ci95=(ratio.low, ratio.high),
        # Half of what is claimed is asked for: the paper gives no scatter.
        verdict=verdict(ratio.high < 0 and ratio.value < printed / 2),
        why=TOO_LINEAR if method == "iterated-ckf" else INSIDE_THE_LOGARITHM,
    )


def _level(config: RkcnsConfig, campaign: Campaign, axis: str) -> Claim:
    """The RMSE of an angle, as the paper takes it: the mean over runs of the RMSE of a run."""
    column = COMPONENTS.index(axis)
    squares = campaign.rows.mean_square[:, METHODS.index("conventional"), column]
    level = mean_interval(np.sqrt(squares) / ARCSEC)
    printed = PUBLISHED["methods"]["conventional"][axis]
    why = (
        f"a random walk of {config.random_walk} deg/sqrt(h) leaves "
        f"{60 * config.random_walk:.3g} arcsec after a second between fixes"
    )
    return Claim(
        id=f"attitude-level-{axis}",
        text=f"The RMSE of the {axis} angle of SINS/CNS is {printed} arcsec",
        published=printed,
        measured=level.value,
        ci95=(level.low, level.high),
        verdict=verdict(abs(level.value / printed - 1) < AGREES),
        why=f"{why}; a level within {AGREES:.0%} counts as reached",
    )


def _same_order(config: RkcnsConfig, costs: dict[str, float] | None) -> Claim:
    counted = flops(15, 6 + config.stars, config.iterations)
    printed = counted["modified-iterated-ckf"] / counted["ckf"]
    text = "The cost of the modified iterated CKF is of the order of that of the CKF"
    if costs is None:
        return Claim(
            "same-order-of-cost", text, printed, None, None, "not testable", "cost not measured"
        )
    ratio = costs["modified-iterated-ckf"] / costs["ckf"]
    each = ", ".join(f"{name} {counted[name]:.3g} flops, {costs[name]:.3g} us" for name in counted)
    return Claim(
        id="same-order-of-cost",
        text=text,
        published=printed,
        measured=ratio,
        ci95=None,
        verdict=verdict(ratio < 10),
        why=f"Eqs. (29)-(31) with n = 15, m = {6 + config.stars}, L = {config.iterations}: {each}",
    )


def _iteration_pays(campaign: Campaign, method: str) -> Claim:
    ratio = change(campaign, method, "ckf", POSITION)
    early = campaign.rows.early
    first = rmse_ratio(early[:, METHODS.index(method)], early[:, METHODS.index("ckf")])
    better = ratio.high < 0
    return Claim(
        id=f"{method}-beats-ckf",
        text=f"{method.upper()} is more accurate than the CKF where the observation is nonlinear",
        published=None,
        measured=ratio.value,
        ci95=(ratio.low, ratio.high),
        verdict=verdict(better),
        why=f"over the first ten fixes {first.value - 1:+.1%} "
        f"[{first.low - 1:+.1%}, {first.high - 1:+.1%}]" + (f"; {LOST_START}" if better else ""),
    )
