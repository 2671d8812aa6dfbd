"""Star tables and directions: what is read and refused, proper motion, the launch frame."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.datasets.base import DataError
from jaxnav.datasets.make_stars import main
from jaxnav.datasets.stars import BUNDLED, load_stars
from jaxnav.navigation.stars import StarCatalogue, brighter, dcm_launch_icrs, directions
from jaxnav.units import ARCSEC, DEG

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data" / "stars"
HIPPARCOS = SHARED / "hipparcos_data_j1991.25.csv"
LIST_J2000 = SHARED / "d3celestial_stars.6.json"
needs_shared = pytest.mark.skipif(
    not (HIPPARCOS.is_file() and LIST_J2000.is_file()),
    reason=f"the copies of the catalogues are not there: {SHARED}",
)

HEADER = "hip,ra_deg,dec_deg,pmra_mas_yr,pmdec_mas_yr,hp_mag"
VEGA = "91262,279.2341083,38.7829932,201.02,287.46,0.09"
POLE = "7,30.0,90.0,100.0,0.0,2.0"


def separation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))


def unit(ra_deg: float | np.ndarray, dec_deg: float | np.ndarray) -> np.ndarray:
    ra, dec = np.deg2rad(ra_deg), np.deg2rad(dec_deg)
    return np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=-1)


def stars(tmp_path: Path, *lines: str) -> StarCatalogue:
    path = tmp_path / "stars.csv"
    path.write_text("\n".join([HEADER, *lines]) + "\n")
    return load_stars(path)


def test_the_bundled_table_is_complete_and_bright() -> None:
    catalogue = load_stars()
    assert catalogue.hip.shape == (7982,)
    assert catalogue.magnitude.max() <= 6.5
    assert catalogue.magnitude.min() == pytest.approx(-1.09, abs=0.01), "Sirius"
    assert np.all(np.diff(catalogue.hip) > 0)
    np.testing.assert_allclose(np.linalg.norm(directions(catalogue, 2025.0), axis=1), 1, rtol=1e-14)


@needs_shared
def test_the_bundled_table_is_made_by_its_script(tmp_path: Path) -> None:
    out = tmp_path / "made.csv"
    assert main([str(HIPPARCOS), "--out", str(out)]) == 0
    assert out.read_bytes() == BUNDLED.read_bytes()
    assert list(tmp_path.iterdir()) == [out], "the partial file is gone"


@needs_shared
def test_the_script_keeps_the_magnitude_it_is_given(tmp_path: Path) -> None:
    out = tmp_path / "few.csv"
    assert main([str(HIPPARCOS), "--magnitude", "3", "--out", str(out)]) == 0
    few = load_stars(out)
    assert 100 < few.hip.size < 250
    assert few.magnitude.max() <= 3


@needs_shared
def test_propagated_to_j2000_it_agrees_with_an_independent_list() -> None:
    document = json.loads(LIST_J2000.read_text(encoding="utf-8"))
    listed = {f["id"]: f["geometry"]["coordinates"] for f in document["features"]}
    catalogue = load_stars()
    known = np.isin(catalogue.hip, list(listed))
    assert known.sum() > 4500
    theirs = unit(*np.array([listed[n] for n in catalogue.hip[known]]).T)

    def apart(year: float) -> np.ndarray:
        return separation(directions(catalogue, year)[known], theirs) / ARCSEC

    assert np.median(apart(2000.0)) < 0.2
    assert apart(2000.0).max() < 1.5
    assert np.median(apart(1991.25)) > 0.3, "without proper motion most stars are worse"
    assert apart(1991.25).max() > 10, "and the fast ones are far off"


def test_known_stars_are_where_they_should_be() -> None:
    """ICRS positions at J2000 of the fundamental catalogues, to an arc second."""
    catalogue = load_stars()
    places = {
        32349: (101.287155, -16.716116),  # Sirius
        11767: (37.954561, 89.264109),  # Polaris
        91262: (279.234735, 38.783689),  # Vega
    }
    at = directions(catalogue, 2000.0)
    for hip, (ra, dec) in places.items():
        (index,) = np.flatnonzero(catalogue.hip == hip)
        assert separation(at[index], unit(ra, dec)) < 1.0 * ARCSEC, hip


def test_proper_motion_is_along_the_sky_and_can_be_undone(tmp_path: Path) -> None:
    catalogue = stars(tmp_path, VEGA, POLE)
    there = directions(catalogue, 2091.25)
    start = directions(catalogue, 1991.25)
    np.testing.assert_allclose(start[0], unit(279.2341083, 38.7829932), atol=1e-15)
    moved = separation(start, there) / ARCSEC
    # a century of sqrt(201^2 + 287^2) and of 100 mas a year; the pole moves too
    np.testing.assert_allclose(moved, [35.078, 10.0], atol=1e-3)
    back = directions(catalogue, 1891.25)
    np.testing.assert_allclose(back + there, 2 * start, atol=1e-7)


def test_jax_arrays_give_the_same(tmp_path: Path) -> None:
    catalogue = stars(tmp_path, VEGA, POLE)
    as_jax = jax.tree.map(jnp.asarray, catalogue)
    np.testing.assert_allclose(
        directions(as_jax, jnp.array(2025.0)), directions(catalogue, 2025.0), rtol=0, atol=1e-15
    )
    assert brighter(as_jax, 1.0).hip.tolist() == [91262]
    angles = (0.7, 1.2, 0.4)
    np.testing.assert_allclose(
        dcm_launch_icrs(*jnp.array(angles)), dcm_launch_icrs(*angles), rtol=0, atol=1e-15
    )


def test_brighter_keeps_all_columns_in_step(tmp_path: Path) -> None:
    catalogue = stars(tmp_path, VEGA, POLE)
    (kept,) = brighter(catalogue, 1.0).hip
    assert kept == 91262
    assert brighter(catalogue, 1.0).declination == pytest.approx(38.7829932 * DEG)
    with pytest.raises(ValueError, match=r"as bright as magnitude -2; the brightest is of 0\.09"):
        brighter(catalogue, -2.0)


def test_launch_axes_stand_on_the_vertical() -> None:
    latitude, sidereal, azimuth = 0.7, 1.2, 0.4
    C = dcm_launch_icrs(latitude, sidereal, azimuth)
    np.testing.assert_allclose(C @ C.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(C) == pytest.approx(1)
    np.testing.assert_allclose(
        C @ unit(np.rad2deg(sidereal), np.rad2deg(latitude)), [0, 1, 0], atol=1e-15
    )
    pole = C @ np.array([0.0, 0.0, 1.0])
    assert np.arcsin(pole[1]) == pytest.approx(latitude), "the pole stands at the latitude"
    north = dcm_launch_icrs(latitude, sidereal, 0.0) @ np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(north, [np.cos(latitude), np.sin(latitude), 0], atol=1e-15)
    # flying north, the east is to the right
    east = dcm_launch_icrs(latitude, sidereal, 0.0) @ unit(np.rad2deg(sidereal) + 90, 0.0)
    np.testing.assert_allclose(east, [0, 0, 1], atol=1e-15)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "the file has no star"),
        (HEADER, "the file has no star"),
        ("hip,ra_deg,dec_deg\n1,2,3", "line 1: the header does not name pmra_mas_yr"),
        (f"{HEADER}\n1,2,3", "line 2: the line has 3 columns; accepted are 6"),
        (f"{HEADER}\n1,2,x,0,0,3", "line 2: dec_deg is 'x'; accepted is a finite decimal"),
        (f"{HEADER}\n1,nan,2,0,0,3", "line 2: ra_deg is 'nan'"),
        (f"{HEADER}\n1,2,3,inf,0,3", "line 2: pmra_mas_yr is 'inf'"),
        (f"{HEADER}\n1,361,3,0,0,3", "line 2: ra_deg is 361; accepted is a number from 0.0"),
        (f"{HEADER}\n1,2,-90.1,0,0,3", "line 2: dec_deg is -90.1"),
        (f"{HEADER}\n1.5,2,3,0,0,3", "line 2: hip is 1.5; accepted is a whole number"),
        (
            f"{HEADER}\n{VEGA}\n{POLE}\n{VEGA}",
            "line 4: the star HIP 91262 is there twice, first on line 2",
        ),
        ("\x00\x01 binary", "line 1: the header does not name hip"),
        (f"{HEADER}\n{VEGA}\n# caf\udce9", "line 3: not UTF-8 text"),
    ],
)
def test_a_malformed_table_is_refused_in_one_sentence(tmp_path: Path, text: str, told: str) -> None:
    path = tmp_path / "stars.csv"
    path.write_text(text, encoding="utf-8", errors="surrogateescape")
    with pytest.raises(DataError) as caught:
        load_stars(path)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert told in message
    assert "accepted" in message
    assert "\n" not in message


def test_a_missing_table_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(DataError, match=r"nowhere\.csv: no such file or directory; accepted is"):
        load_stars(tmp_path / "nowhere.csv")
    with pytest.raises(DataError, match="is a directory"):
        load_stars(tmp_path)
    out = tmp_path / "out.csv"
    out.write_text("kept")
    assert main([str(tmp_path / "nowhere.csv"), "--out", str(out)]) == 2
    assert "no such file" in capsys.readouterr().err
    assert out.read_text() == "kept"


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--magnitude", "-9", "--out", "kept.csv"], "no star is as bright as magnitude -9"),
        (["--magnitude", "nan", "--out", "kept.csv"], "no star is as bright as magnitude nan"),
        (["--out", "folder"], "folder: is a directory; accepted is a file that can be written"),
        (["--out", "absent/x.csv"], "absent/x.csv: no such file or directory; accepted is"),
        (["--out", ""], "; accepted is a file that can be written"),
    ],
)
def test_the_script_refuses_in_one_sentence_and_loses_nothing(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
    options: list[str],
    told: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("folder").mkdir()
    Path("kept.csv").write_text("kept")
    columns = "source_id,ra,dec,parallax,pmra,pmdec,phot_g_mean_mag"
    Path("source.csv").write_text(f"{columns}\n91262,279.2,38.7,128.9,201.02,287.46,0.09\n")
    assert main(["source.csv", *options]) == 2
    told_there = capsys.readouterr().err
    assert told in told_there
    assert told_there.count("\n") == 1
    assert {path.name for path in Path().iterdir()} == {"folder", "kept.csv", "source.csv"}
    assert Path("kept.csv").read_text() == "kept"
