"""The study rkcns: the figures it must reach at full length, consistency, and bad input."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jaxnav.cli import main
from jaxnav.config import ConfigError
from jaxnav.studies.attitude import AXES
from jaxnav.studies.base import StudyResult
from jaxnav.studies.rkcns.ablations import LINEAR, variations
from jaxnav.studies.rkcns.claims import POSITION
from jaxnav.studies.rkcns.config import RkcnsConfig
from jaxnav.studies.rkcns.cost import flops
from jaxnav.studies.rkcns.figures import draw
from jaxnav.studies.rkcns.methods import METHODS
from jaxnav.studies.rkcns.simulation import build_world
from jaxnav.studies.rkcns.study import run_study

BARE = RkcnsConfig(runs=4, duration_s=200.0, ablations=False, cost=False)
"""Few flights, and short ones; ``checks/full_size`` has the whole."""


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"scenario": "paper"}, "scenario is paper; it must be one of listed, inferred"),
        ({"tangent_km": (-1.0, 25.0)}, r"tangent_km is \(-1.0, 25.0\); it must be a lower and a"),
        ({"tangent_km": (20.0, 90.0)}, "between the surface, 0, and the top of the atmosphere, 86"),
        ({"tangent_km": (25.0, 20.0)}, "tangent_km"),
        ({"stars": -1}, "stars is -1; it must be from 0 to 20"),
        ({"density_error": 0.5}, "density_error is 0.5"),
        ({"iterations": 0}, "iterations is 0; it must be from 1 to 50"),
        ({"trials": -1}, "trials is -1"),
        ({"start_s": 100.0}, "start_s is 100.0; it must be at least 131 s"),
        ({"duration_s": 900.0}, "duration_s is 900.0; it must be at most 780 s"),
        ({"duration_s": 160.5}, "a whole number of filter steps from the start of the filters"),
        ({"launch_period_s": 0.007}, "launch_period_s is 0.007"),
        ({"refraction_noise_arcsec": 0.0}, "refraction_noise_arcsec is 0.0; it must be positive"),
        ({"point_spread": float("nan")}, "point_spread is nan"),
        ({"p0_attitude_arcsec": (1.0, 2.0)}, "it must be three numbers"),
        ({"atmosphere": "us76"}, "atmosphere is us76; it must be one of fitted, printed"),
    ],
)
def test_configuration_refuses_what_means_nothing(given: dict, told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        RkcnsConfig(**given)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (None, "no such file or directory; accepted is a table of stars"),
        ("hip,ra\n1,2\n", "line 1: the header does not name ra_deg"),
        (
            "hip,ra_deg,dec_deg,pmra_mas_yr,pmdec_mas_yr,hp_mag\n1,2,3,4,5,9.9\n",
            "magnitude_limit is 6.5; it must be 9.9, the brightest, or above",
        ),
    ],
)
def test_a_bad_catalogue_ends_the_command_before_any_work(
    tmp_path: Path, capsys: pytest.CaptureFixture, text: str | None, told: str
) -> None:
    path, out = tmp_path / "stars.csv", tmp_path / "out"
    if text is not None:
        path.write_text(text)
    assert main(["run", "rkcns", "--catalogue", str(path), "--out", str(out)]) == 2
    message = " ".join(capsys.readouterr().err.split())
    assert told in message
    assert not list(out.glob("**/*")) if out.exists() else True


def test_stars_are_in_the_band_and_each_is_new_after_seconds() -> None:
    world = build_world(replace(BARE, duration_s=200.0))
    limb = world.limb
    assert limb.seen.all(), "three stars at every epoch"
    heights = np.asarray(limb.height)
    assert heights.min() >= 20e3
    assert heights.max() <= 25e3
    np.testing.assert_allclose(np.linalg.norm(limb.star, axis=-1), 1, rtol=1e-12)
    first = {tuple(star) for star in np.asarray(limb.star[0])}
    later = {tuple(star) for star in np.asarray(limb.star[30])}
    assert not first & later
    none = build_world(replace(BARE, duration_s=161.0, stars=0)).limb
    assert not none.seen.any()


def test_every_variation_is_a_valid_configuration() -> None:
    for scenario in ("listed", "inferred", "strong-nonlinearity"):
        config = RkcnsConfig(scenario=scenario)
        for change in variations(config):
            replace(config, **change.changes)
            assert set(change.shown) <= set(change.run)
    assert variations(RkcnsConfig()) == LINEAR


def test_the_papers_count_of_operations() -> None:
    """Eq. (29) for n = m = 1: 20/3 + 10 + 10 + 8 + 2 + 1 + 3 + 1; the others by the same hand."""
    counts = flops(1, 1, 1)
    assert counts["ckf"] == pytest.approx(20 / 3 + 35)
    assert counts["iterated-ckf"] == pytest.approx(23 / 3 + 21 + 8 + 5 + 5)
    assert counts["modified-iterated-ckf"] == pytest.approx(23 / 3 + 26 + 47 + 49 / 3 + 4 + 9 + 5)


@pytest.fixture(scope="module")
def short() -> StudyResult:
    (result,) = run_study(BARE)
    return result


@pytest.mark.slow
def test_refraction_shows_the_bias_within_forty_seconds(short: StudyResult) -> None:
    """A sample of ``checks/full_size``."""
    bias = {name: short.methods[name]["rmse"]["accel_bias"]["value"] for name in METHODS}
    assert all(bias[name] < 0.7 * bias["conventional"] for name in METHODS[1:])
    squares = short.arrays["mean_square"]
    ckf, iterated = (squares[:, METHODS.index(name)] for name in ("ckf", "iterated-ckf"))
    np.testing.assert_allclose(iterated, ckf, rtol=1e-3)


@pytest.mark.slow
def test_results_hold_every_method_and_array(short: StudyResult, tmp_path: Path) -> None:
    assert tuple(short.methods) == METHODS
    assert tuple(short.methods["ckf"]["rmse"]) == (*POSITION, *AXES, "accel_bias")
    assert set(short.dims) <= set(short.arrays)
    for name, axes in short.dims.items():
        assert short.arrays[name].ndim == len(axes), name
    assert short.arrays["time"][[0, -1]].tolist() == [161.0, 200.0]
    paths = draw(short, tmp_path)
    assert len(paths) == 5
    assert all(path.stat().st_size > 10_000 for path in paths)
