"""The paper's numbers and claims, and what became of them."""

import numpy as np

from jaxnav.estimation.metrics import Interval, rmse_ratio
from jaxnav.estimation.montecarlo import Campaign
from jaxnav.studies.base import Claim, judged, verdict
from jaxnav.studies.sage_husa.config import WINDOWS_S, SageHusaConfig
from jaxnav.studies.sage_husa.methods import BANKS, constant, methods_of, single

FREE = ("scenario", "runs", "seed")
"""Fields a test of the claims may vary."""

TABLE_4 = {
    "ukf": ((6.3643, 6.6866), (1.5321, 1.8067), (13.8936, 13.7319)),
    "sage-husa": ((3.7254, 3.8142), (1.2423, 1.3226), (6.9714, 7.2156)),
    "mmae": ((4.9558, 4.8517), (1.3075, 1.4829), (10.8799, 10.9979)),
    "exponential-decay": ((3.7961, 3.6485), (1.1767, 1.0659), (7.0322, 7.2199)),
    "proposed": ((3.4774, 3.5103), (1.0694, 1.0846), (6.3463, 6.5168)),
}
"""Mean squared errors east and north in the three intervals [m^2]."""
TABLE_2 = {
    0.95: (3.4178, 2.2838, 2.7963),
    0.97: (3.5405, 2.1956, 2.7265),
    0.99: (3.6641, 2.1116, 2.6564),
}
"""Mean squared errors north in the intervals of Experiment 1 [m^2]."""
NOISY = (0, 2)
"""The intervals of Table 4 with added noise."""
FOUND = 0.5
"""Weight above which the right model counts as identified."""


def assess(config: SageHusaConfig, campaign: Campaign) -> list[Claim]:
    """Return the claims of a scenario with their verdicts.

    Args:
        config: The configuration of the scenario.
        campaign: Its Monte Carlo runs.
    """
    pairs = [
        ("sage-husa", "ukf"),
        ("mmae", "ukf"),
        ("sage-husa", "mmae"),
        ("proposed", "ukf"),
        ("proposed", "mmae"),
        ("proposed", "exponential-decay"),
    ]
    intervals = range(len(config.intervals_s))
    claims = [_better(config, campaign, *pair, i) for pair in pairs for i in intervals]
    claims += [_beats_best_single(config, campaign, "proposed", i) for i in intervals]
    claims.append(_normaliser_does_nothing(config, campaign))
    claims += [_experiment_1(config, campaign, i) for i in range(len(WINDOWS_S))]
    claims.append(_identifies_faster(config, campaign))
    return judged(config, FREE, claims)


def change(
    config: SageHusaConfig, campaign: Campaign, method: str, rival: str, interval: int
) -> Interval:
    """Return the change of horizontal MSE in an interval of Table 4 from a rival to a method."""
    return _change(squares(config, campaign, method), squares(config, campaign, rival), interval)


def _change(own: np.ndarray, other: np.ndarray, interval: int) -> Interval:
    ratio = rmse_ratio(own[:, interval], other[:, interval])
    return Interval(*(bound**2 - 1 for bound in ratio))


def squares(config: SageHusaConfig, campaign: Campaign, method: str) -> np.ndarray:
    """Return mean squares ``(runs, intervals) [m^2]`` of a method, east and north averaged."""
    return campaign.rows.mean_square[:, methods_of(config).index(method)].mean(axis=-1)


def best_single(config: SageHusaConfig, campaign: Campaign, interval: int) -> str:
    """Return the single Sage-Husa filter with the least MSE in an interval, found afterwards."""
    names = [single(config, b) for b in config.forgetting]
    return min(names, key=lambda name: squares(config, campaign, name)[:, interval].mean())


def span_name(span: tuple[float, float]) -> str:
    """Return the name of an interval, as in "700-1200"."""
    return f"{span[0]:g}-{span[1]:g}"


def _printed(method: str, rival: str, interval: int) -> float:
    return sum(TABLE_4[method][interval]) / sum(TABLE_4[rival][interval]) - 1


def _better(
    config: SageHusaConfig, campaign: Campaign, method: str, rival: str, interval: int
) -> Claim:
    found = change(config, campaign, method, rival, interval)
    bound = change(config, campaign, "oracle", rival, interval)
    span = config.intervals_s[interval]
    return Claim(
        id=f"{method}-beats-{rival}-{span_name(span)}",
        text=f"{method} has a smaller MSE than {rival}, {span_name(span)} s",
        published=_printed(method, rival, interval),
        measured=found.value,
        ci95=(found.low, found.high),
        verdict=verdict(found.high < 0),
        why=f"knowing Q and R would give {bound.value:+.1%}",
    )


def _beats_best_single(
    config: SageHusaConfig, campaign: Campaign, method: str, interval: int
) -> Claim:
    rival = best_single(config, campaign, interval)
    found = change(config, campaign, method, rival, interval)
    repaired = change(config, campaign, "proposed-bayes-floor", rival, interval)
    bound = change(config, campaign, "oracle", rival, interval)
    span = config.intervals_s[interval]
    return Claim(
        id=f"{method}-beats-best-single-{span_name(span)}",
        text=f"{method} has a smaller MSE than the best single Sage-Husa filter, "
        f"{span_name(span)} s",
        published=_printed(method, "sage-husa", interval),
        measured=found.value,
        ci95=(found.low, found.high),
        verdict=verdict(found.high < 0),
        why=f"the best, found afterwards, is {rival}; the same bank under Bayes' rule with a floor "
        f"{repaired.value:+.1%} [{repaired.low:+.1%}, {repaired.high:+.1%}], knowing Q and R "
        f"{bound.value:+.1%}",
    )


def _normaliser_does_nothing(config: SageHusaConfig, campaign: Campaign) -> Claim:
    """The rule of half the NIS without the normaliser, and with it, both with a floor."""
    found = [
        change(config, campaign, "unnormalised-floor", "proposed-bayes-floor", i) for i in NOISY
    ]
    worst = max(found, key=lambda of: of.value)
    each = ", ".join(f"{of.value:+.1%}" for of in found)
    return Claim(
        id="normaliser-has-no-effect",
        text="Leaving the likelihood's normaliser out has no effect",
        published=0.0,
        measured=worst.value,
        ci95=(worst.low, worst.high),
        verdict=verdict(worst.low <= 0 <= worst.high),
        why=f"MSE without it over that with it, all else the same, in the noisy intervals: {each}; "
        "it differs from model to model, and without it the member wins whose S follows the "
        "innovation the closest",
    )


def _experiment_1(config: SageHusaConfig, campaign: Campaign, window: int) -> Claim:
    """The smallest forgetting factor is the best at first, the largest later."""
    small, large = min(config.forgetting), max(config.forgetting)
    better, worse = (small, large) if window == 0 else (large, small)
    at = len(config.intervals_s) + window
    names = methods_of(config)
    north = campaign.rows.mean_square[:, :, at, 1]
    ratio = rmse_ratio(
        north[:, names.index(constant(better))], north[:, names.index(constant(worse))]
    )
    found = Interval(*(bound**2 - 1 for bound in ratio))
    span = span_name(WINDOWS_S[window])
    printed = None
    if better in TABLE_2 and worse in TABLE_2:
        printed = TABLE_2[better][window] / TABLE_2[worse][window] - 1
    return Claim(
        id=f"forgetting-{better:g}-beats-{worse:g}-{span}",
        text=f"With d constant, b = {better:g} has a smaller MSE north than {worse:g}, {span} s",
        published=printed,
        measured=found.value,
        ci95=(found.low, found.high),
        verdict=verdict(found.high < 0),
        why=f"R starts at {config.start_r:g} times the true one; the paper does not say at what",
    )


def right_weight(config: SageHusaConfig, weights: np.ndarray) -> np.ndarray:
    """Return the weight of the members whose Q is the nearest to the true one.

    Args:
        config: The configuration of the scenario.
        weights: ``(..., members)``.
    """
    true = (config.true_vrw / config.vrw_believed) ** 2
    nearest = min(config.q_scales, key=lambda q: abs(np.log(q / true)))
    return weights[..., [q == nearest for _, q in config.grid]].sum(axis=-1)


def _identifies_faster(config: SageHusaConfig, campaign: Campaign) -> Claim:
    """Time from which the mean weight of the right Q stays above a half."""
    share = right_weight(config, campaign.mean_curve["weights"])
    times = {}
    for name in ("proposed", "proposed-bayes"):
        below = np.flatnonzero(share[:, list(BANKS).index(name)] < FOUND)
        last = below[-1] + 1 if below.size else 0
        times[name] = config.fix_interval_s * last if last < len(share) else np.inf
    each = ", ".join(
        f"{name} {f'{at:g} s' if np.isfinite(at) else 'never'}" for name, at in times.items()
    )
    gain = times["proposed"] - times["proposed-bayes"]
    return Claim(
        id="identifies-faster",
        text="The weight of the right model converges faster than under Bayes' rule",
        published=None,
        measured=float(gain) if np.isfinite(gain) else None,
        ci95=None,
        verdict=verdict(times["proposed"] < times["proposed-bayes"]),
        why="time from which the mean weight of the members with the Q nearest the truth stays "
        f"above {FOUND:g}: {each}",
    )
