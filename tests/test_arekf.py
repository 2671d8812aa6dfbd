"""The study arekf: the figures it must reach at full length, consistency, and bad input."""

from pathlib import Path

import numpy as np
import pytest

from jaxnav.config import ConfigError
from jaxnav.studies.arekf.analysis import GRADES, ratio_map
from jaxnav.studies.arekf.claims import change
from jaxnav.studies.arekf.config import ArekfConfig
from jaxnav.studies.arekf.figures import draw
from jaxnav.studies.arekf.methods import AXES, KINDS
from jaxnav.studies.arekf.study import run_campaign, run_study


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"scenario": "calm"}, "scenario is calm; it must be one of noise-drift, bias-dominated"),
        ({"factors": (1.0, 1.0)}, "factors"),
        ({"factors": (2.0, 10.0)}, "such that one of them is 1"),
        ({"reported": 4.0}, "reported is 4.0; it must be one of the factors"),
        ({"duration_s": 200.0}, "duration_s is 200.0; it must be at most 124 s"),
        ({"filter_period_s": 0.0333}, "filter_period_s is 0.0333"),
        ({"gnss_rate_hz": 7.0}, "gnss_rate_hz is 7.0"),
        ({"align_s": 1.0}, "align_s is 1.0; it must be at least 1.28 s"),
        ({"arw_deg_sqrt_h": -1.0}, "arw_deg_sqrt_h is -1.0; it must be positive"),
        ({"gnss_velocity": float("nan")}, "gnss_velocity is nan"),
        ({"outlier_share": 0.7}, r"outlier_share is 0.7; it must be in \[0, 0.5\)"),
        ({"p0_attitude_deg": (1.0, 1.0)}, "it must be three numbers"),
        ({"heading_deg": 120.0}, r"heading_deg is 120.0; it must be in \(0, 90\]"),
        ({"settle_s": 120.0}, "settle_s is 120.0"),
        ({"versoria_width": -0.1}, "versoria_width is -0.1"),
        ({"iae_memory": 0.5}, "iae_memory is 0.5"),
        ({"runs": 0}, "runs is 0"),
    ],
)
def test_configuration_refuses_what_means_nothing(given: dict, told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        ArekfConfig(**given)


def test_the_map_is_of_the_noise_and_not_of_the_bias() -> None:
    found = ratio_map(ArekfConfig(factors=(1.0, 10.0)))
    noisy, biased = (list(GRADES).index(name) for name in ("noise-dominated", "bias-dominated"))
    np.testing.assert_allclose(found.ratio[:, 0], 1, rtol=1e-12)
    assert np.all(found.ratio >= 1 - 1e-9), "the true noise is the best to believe"
    attitude, velocity, position = found.ratio[noisy, 1, -1]
    assert attitude > 1.8
    assert velocity > 1.8
    assert position < 1.05
    assert found.ratio[biased].max() < 1.1


@pytest.mark.slow
def test_noise_believed_ten_times_too_small_is_found_again() -> None:
    """A sample of ``checks/full_size``: the first half minute of four flights."""
    config = ArekfConfig(runs=4, duration_s=30.0, settle_s=10.0)
    campaign = run_campaign(config, 10.0)
    assert campaign.finite.all()
    for kind in KINDS:
        assert abs(change(campaign, "arekf", "oracle", kind).value) < 0.1
    assert change(campaign, "ekf", "arekf", "velocity").value > 0.2


@pytest.mark.slow
def test_results_of_the_sweep_hold_every_filter_and_array(tmp_path: Path) -> None:
    config = ArekfConfig(
        scenario="r-sweep", runs=4, duration_s=4.0, settle_s=1.0, align_s=5.0, cost=False
    )
    (result,) = run_study(config)
    assert tuple(result.methods) == tuple(f"ekf-{factor:g}" for factor in config.r_factors)
    errors = result.methods["ekf-1"]["rmse"]
    assert {"attitude", "velocity", "position"} <= set(errors)
    for kind in KINDS:
        parts = [errors[f"{kind}_{axis}"]["value"] for axis in AXES]
        assert np.hypot.reduce(parts) == pytest.approx(errors[kind]["value"], rel=1e-12)
    # what believes the least of the fixes strays the most from them
    position = [result.methods[f"ekf-{f:g}"]["rmse"]["position"]["value"] for f in (1, 100)]
    assert position[1] > position[0]
    assert set(result.dims) <= set(result.arrays)
    for name, axes in result.dims.items():
        assert result.arrays[name].ndim == len(axes), name
    paths = draw(result, tmp_path)
    assert [path.name for path in paths][:3] == [
        "figure-3-position.png",
        "figure-4-velocity.png",
        "figure-5-attitude.png",
    ]
    assert all(path.stat().st_size > 10_000 for path in paths)
    assert {claim.verdict for claim in result.claims} == {"not testable"}
