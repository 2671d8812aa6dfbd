"""Recorded logs: what is read, what is refused and in which words."""

import sys
from pathlib import Path

import numpy as np
import pytest

from jaxnav.datasets.base import DataError
from jaxnav.datasets.rtklib import load_rtklib_pos
from jaxnav.datasets.track import GnssTrack, gaps, intervals_s, thin

REAL_FILE = (
    Path(__file__).resolve().parents[2] / "shared" / "data" / "rtk_drive" / "gnss_1934_sf.pos"
)
needs_real_file = pytest.mark.skipif(
    not REAL_FILE.is_file(), reason=f"the recorded drive is not there: {REAL_FILE}"
)

HEADER = (
    "%  GPST latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) "
    "sdun(m) age(s) ratio"
)
VELOCITY_HEADER = f"{HEADER} vn(m/s) ve(m/s) vu(m/s) sdvn sdve sdvu sdvne sdveu sdvun"
CALENDAR = "2025/07/08 19:34:{:06.3f}"
POSITION = "40.5 -105.25 1601.474 1 21 0.01 0.02 0.03 -0.001 0.002 0.003 0.0 12.5"
VELOCITY = "1.0 2.0 3.0 0.1 0.2 0.3 0.0 0.0 0.0"
SECOND = 10**9
START_NS = 1_752_003_240 * SECOND  # 2025/07/08 19:34:00, from `date -u -d ... +%s`


def epoch(second: float = 18.499, position: str = POSITION) -> str:
    return f"{CALENDAR.format(second)} {position}"


@pytest.fixture
def refusal(refusal_by):
    return refusal_by(load_rtklib_pos)


def track_at(times_s, **fields) -> GnssTrack:
    """A track whose heights number its epochs."""
    time_ns = np.array([round(t * SECOND) for t in times_s], dtype=np.int64) + START_NS
    count = np.arange(len(time_ns))
    ones = np.ones((len(time_ns), 3))
    track = GnssTrack(
        time_ns=time_ns,
        geodetic=ones * count[:, None],
        velocity=None,
        position_sigma=ones,
        velocity_sigma=None,
        quality=np.ones_like(time_ns),
        source="made.pos",
        duplicates=0,
    )
    return track._replace(**fields)


def kept(track: GnssTrack) -> list[int]:
    return track.geodetic[:, 2].astype(int).tolist()


# What is read


@pytest.mark.parametrize("header", [[], [HEADER]], ids=["by-count", "by-name"])
def test_columns_without_velocity(write, header):
    track = load_rtklib_pos(write(*header, epoch(18.499), epoch(18.749)))
    np.testing.assert_array_equal(track.time_ns - START_NS, [18_499_000_000, 18_749_000_000])
    np.testing.assert_array_equal(
        track.geodetic, [[np.deg2rad(40.5), np.deg2rad(-105.25), 1601.474]] * 2
    )
    np.testing.assert_array_equal(track.position_sigma, [[0.02, 0.01, 0.03]] * 2)
    assert track.velocity is None
    assert track.velocity_sigma is None
    np.testing.assert_array_equal(track.quality, [1, 1])
    assert track.duplicates == 0


@pytest.mark.parametrize("header", [[], [VELOCITY_HEADER]], ids=["by-count", "by-name"])
def test_columns_with_velocity_are_east_north_up(write, header):
    track = load_rtklib_pos(write(*header, f"{epoch()} {VELOCITY}"))
    np.testing.assert_array_equal(track.velocity, [[2.0, 1.0, 3.0]])
    np.testing.assert_array_equal(track.velocity_sigma, [[0.2, 0.1, 0.3]])
    np.testing.assert_array_equal(track.position_sigma, [[0.02, 0.01, 0.03]])


def test_columns_are_found_by_name_in_any_order(write):
    header = "% GPST Q latitude(deg) longitude(deg) height(m) sdu(m) sde(m) sdn(m) vu ve vn"
    line = f"{CALENDAR.format(0)} 5 -10 20 30 3 2 1 0.3 0.2 0.1"
    track = load_rtklib_pos(write(header, "% a comment", line))
    np.testing.assert_array_equal(track.geodetic, [[np.deg2rad(-10), np.deg2rad(20), 30]])
    np.testing.assert_array_equal(track.position_sigma, [[2, 1, 3]])
    np.testing.assert_array_equal(track.velocity, [[0.2, 0.1, 0.3]])
    assert track.velocity_sigma is None
    np.testing.assert_array_equal(track.quality, [5])


def test_dtypes_and_shapes(write):
    track = load_rtklib_pos(write(*(f"{epoch(s)} {VELOCITY}" for s in (0, 1, 2))))
    assert track.velocity is not None
    assert track.velocity_sigma is not None
    for array in (track.geodetic, track.velocity, track.position_sigma, track.velocity_sigma):
        assert array.shape == (3, 3)
        assert array.dtype == np.float64
    assert track.time_ns.shape == track.quality.shape == (3,)
    assert track.time_ns.dtype == track.quality.dtype == np.int64


def test_week_and_seconds_of_week_are_the_same_instant(write):
    # 2025/07/08 is the Tuesday of GPS week 2374.
    tow = 2 * 86_400 + 19 * 3600 + 34 * 60 + 18
    week = load_rtklib_pos(write(f"2374 {tow}.499 {POSITION}", name="week.pos"))
    calendar = load_rtklib_pos(write(epoch(18.499)))
    np.testing.assert_array_equal(week.time_ns, calendar.time_ns)


def test_commas_separate_as_blanks_do(write):
    comma = write(
        HEADER.replace(" ", ","),
        f"{CALENDAR.format(18.499)},{POSITION.replace(' ', ',  ')}",
        f"2374,243259.0,{POSITION.replace(' ', ',')}",
        name="comma.pos",
    )
    blank = write(HEADER, epoch(18.499), f"2374 243259.0 {POSITION}")
    for a, b in zip(load_rtklib_pos(comma), load_rtklib_pos(blank), strict=True):
        if isinstance(a, np.ndarray):
            np.testing.assert_array_equal(a, b)


def test_comments_blank_lines_and_line_ends(tmp_path):
    path = tmp_path / "crlf.pos"
    lines = ["% program : RTKLIB", "% inp file : caf\xe9.obs", "%", HEADER, epoch(1), "", epoch(2)]
    lines += ["% a comment between epochs", epoch(3)]
    path.write_bytes("\r\n".join(lines).encode("latin-1"))
    track = load_rtklib_pos(str(path))
    assert len(track.time_ns) == 3
    assert track.source == str(path)


def test_byte_order_mark_is_not_part_of_the_header(tmp_path):
    path = tmp_path / "mark.pos"
    path.write_text(f"{HEADER}\n{epoch()}\n", encoding="utf-8-sig")
    assert len(load_rtklib_pos(path).time_ns) == 1


def test_longitude_of_0_to_360_becomes_the_signed_one(write):
    lines = [epoch(k, POSITION.replace("-105.25", lon)) for k, lon in enumerate(("254.75", "180"))]
    track = load_rtklib_pos(write(*lines))
    np.testing.assert_array_equal(track.geodetic[:, 1], np.deg2rad([-105.25, 180.0]))


@pytest.mark.parametrize(
    ("stamp", "expected"),
    [
        ("1980/01/06 00:00:00", 315_964_800 * SECOND),
        ("0 0", 315_964_800 * SECOND),
        ("1 0.", (315_964_800 + 604_800) * SECOND),
        ("2024/02/29 23:59:59.999999999", 1_709_251_200 * SECOND - 1),
        ("2025/07/08 19:34:00.1", START_NS + 100_000_000),
        ("2025/07/08 19:34:00.000000001", START_NS + 1),
        ("2374 243240.123456789", START_NS + 123_456_789),
        ("2374 243240.1234567894", START_NS + 123_456_789),
        ("2374 243240.123456789500", START_NS + 123_456_790),
        ("2025/07/08 19:33:59.9999999999", START_NS),
    ],
)
def test_times_are_exact_to_the_nanosecond(write, stamp, expected):
    assert load_rtklib_pos(write(f"{stamp} {POSITION}")).time_ns.tolist() == [expected]


def test_every_millisecond_of_a_second_is_exact(write):
    track = load_rtklib_pos(write(*(epoch(k / 1000) for k in range(1000))))
    np.testing.assert_array_equal(track.time_ns, START_NS + np.arange(1000) * 1_000_000)


def test_repeated_times_keep_the_first_line_and_are_counted(write):
    moved = POSITION.replace("1601.474", "9999.0")
    lines = [epoch(1), epoch(1), epoch(2), epoch(2, moved), epoch(2, moved), epoch(3)]
    track = load_rtklib_pos(write(*lines))
    assert track.duplicates == 3
    np.testing.assert_array_equal(track.time_ns - START_NS, np.array([1, 2, 3]) * SECOND)
    np.testing.assert_array_equal(track.geodetic[:, 2], [1601.474] * 3)


# What is refused


def test_missing_file_and_directory_are_refused(tmp_path):
    with pytest.raises(DataError, match=r"absent\.pos: no such file.*accepted is a readable"):
        load_rtklib_pos(tmp_path / "absent.pos")
    with pytest.raises(DataError, match=r"is a directory; accepted is a readable RTKLIB \.pos"):
        load_rtklib_pos(tmp_path)


def test_permission_error_is_refused(write, monkeypatch):
    def deny(*args, **kwargs):
        raise PermissionError(13, "Permission denied")

    path = write(epoch())
    monkeypatch.setattr(Path, "read_text", deny)
    with pytest.raises(DataError, match=r"log\.txt: permission denied; accepted"):
        load_rtklib_pos(path)


@pytest.mark.parametrize("lines", [[], ["% program : RTKLIB", HEADER]], ids=["empty", "header"])
def test_file_without_solution_lines_is_refused(refusal, lines):
    assert "no solution line; accepted is at least one" in refusal(*lines)


def test_wrong_number_of_columns_is_refused_with_both_counts(refusal):
    short = epoch(2).rsplit(" ", 1)[0]
    message = refusal(HEADER, epoch(1), short)
    assert "line 3: the line has 14 columns; accepted are 15" in message
    assert "line 2: the line has 24 columns; accepted are 15" in refusal(
        HEADER, f"{epoch()} {VELOCITY}"
    )
    assert "line 2: the line has 15 columns; accepted are 24" in refusal(
        f"{epoch(1)} {VELOCITY}", epoch(2)
    )
    assert "line 1: the line has 14 columns; accepted are 15, or 24 with velocity" in refusal(short)


@pytest.mark.parametrize("text", ["40.x", "nan", "inf", "-inf", "1e999", "--"])
def test_text_that_is_no_finite_number_is_refused(refusal, text):
    message = refusal(HEADER, epoch(1), epoch(2, POSITION.replace("40.5", text)))
    assert f"line 3: latitude(deg) is {text!r}; accepted is a finite decimal number" in message


def test_every_column_must_be_a_number(refusal):
    message = refusal(epoch(1, POSITION.replace("12.5", "many")))
    assert "line 1: ratio is 'many'; accepted is a finite decimal number" in message


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("40.5", "90.0001", "latitude(deg) is 90.0001; accepted is a number from -90 to 90"),
        ("40.5", "-91", "latitude(deg) is -91; accepted is a number from -90 to 90"),
        ("-105.25", "-180.5", "longitude(deg) is -180.5; accepted is a number from -180 to 360"),
        ("-105.25", "361", "longitude(deg) is 361; accepted is a number from -180 to 360"),
        (" 1 21", " 12 21", "Q is 12; accepted is a number from 0 to 9"),
        (" 1 21", " 1.5 21", "Q is 1.5; accepted is a whole number"),
        ("0.02 ", "-0.02 ", "sde(m) is -0.02; accepted is a number from 0 to inf"),
    ],
)
def test_values_out_of_range_are_refused(refusal, old, new, expected):
    assert f"line 2: {expected}" in refusal(epoch(1), epoch(2, POSITION.replace(old, new, 1)))


def test_ends_of_the_ranges_are_accepted(write):
    ends = zip(("90", "-90", "0"), ("-180", "360", "180"), strict=True)
    lines = [
        epoch(k, POSITION.replace("40.5", lat).replace("-105.25", lon))
        for k, (lat, lon) in enumerate(ends)
    ]
    degrees = np.rad2deg(load_rtklib_pos(write(*lines)).geodetic[:, :2])
    np.testing.assert_allclose(degrees, [[90, -180], [-90, 0], [0, 180]], rtol=1e-15)


def test_time_that_goes_backwards_is_refused_with_both_times(refusal):
    message = refusal(HEADER, epoch(1), epoch(2), epoch(1.75))
    assert (
        "line 4: the time 2025/07/08 19:34:01.750 is before 2025/07/08 19:34:02.000 of the "
        "previous epoch; accepted are times that do not decrease"
    ) in message


@pytest.mark.parametrize(
    "stamp",
    [
        "2025/13/08 19:34:18.499",
        "2025/02/29 00:00:00.000",
        "2025/07/08 24:00:00.000",
        "2025/07/08 19:34:60.000",
        "2025-07-08 19:34:18.499",
        "2025/07/08 19:34",
        "08/07/2025 19:34:18.499",
        "1979/12/31 00:00:00.000",
        "2262/01/01 00:00:00.000",
        "2374 604800.000",
        "2374 -1.0",
        "99999 0.0",
        "2374 nan",
        "$GPGGA 193418.00",
    ],
)
def test_malformed_time_is_refused(refusal, stamp):
    message = refusal(HEADER, f"{stamp} {POSITION}")
    assert f"line 2: the time is {stamp!r}; accepted is GPST from 1980" in message
    assert "YYYY/MM/DD HH:MM:SS.sss or as GPS week and seconds of week" in message


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("latitude(deg) longitude(deg) height(m)", "x-ecef(m) y-ecef(m) z-ecef(m)"),
        ("latitude(deg) longitude(deg)", "latitude(d'\") longitude(d'\")"),
        ("latitude(deg) longitude(deg) height(m)", "e-baseline(m) n-baseline(m) u-baseline(m)"),
    ],
    ids=["ecef", "degrees-minutes-seconds", "baseline"],
)
def test_other_output_formats_are_refused(refusal, old, new):
    message = refusal("% program : RTKLIB", HEADER.replace(old, new), epoch())
    assert f"line 2: the columns {new}" in message
    assert "latitude, longitude, height in decimal degrees" in message


def test_header_of_another_format_later_in_the_file_is_refused(refusal):
    message = refusal(HEADER, epoch(1), HEADER.replace("latitude(deg)", "x-ecef(m)"), epoch(2))
    assert "line 3: the columns x-ecef(m)" in message


def test_times_other_than_gpst_are_refused(refusal):
    message = refusal(HEADER.replace("GPST", "UTC"), epoch())
    assert "line 1: the times are in UTC; accepted are times in GPST" in message


# Thinning, gaps and intervals


def test_thin_takes_1_hz_from_4_hz():
    assert kept(thin(track_at(np.arange(13) / 4), 1.0)) == [0, 4, 8, 12]


def test_thin_keeps_every_field_in_step(write):
    lines = [f"{epoch(s, POSITION)} {VELOCITY}" for s in (0, 0, 0.5, 1, 1.5, 2)]
    track = load_rtklib_pos(write(*lines))
    thinned = thin(track, 1.0)
    assert (thinned.source, thinned.duplicates) == (track.source, 1)
    for whole, part in zip(track, thinned, strict=True):
        if isinstance(whole, np.ndarray):
            np.testing.assert_array_equal(part, whole[::2])


def test_thin_does_not_drift_with_jitter():
    jitter = np.random.default_rng(0).uniform(-0.02, 0.02, 400)
    jitter[0] = 0.0
    assert kept(thin(track_at(np.arange(400) / 4 + jitter), 1.0)) == list(range(0, 400, 4))


def test_thin_takes_the_neighbour_of_a_missing_epoch():
    times = np.delete(np.arange(13) / 4, 4)
    assert kept(thin(track_at(times), 1.0)) == [0, 3, 7, 11]


def test_thin_stays_on_the_grid_beyond_a_gap_and_at_the_end():
    times = [0, 0.25, 0.5, 0.75, 1, 1.25, 1.5, 7.5, 7.75, 8, 8.25, 8.5, 8.75]
    assert kept(thin(track_at(times), 1.0)) == [0, 4, 9]


def test_thin_keeps_the_last_epoch_when_it_is_a_little_early():
    assert kept(thin(track_at([0, 0.25, 0.5, 0.75, 0.999]), 1.0)) == [0, 4]


def test_thin_at_the_median_interval_keeps_all_and_beyond_the_log_the_first():
    track = track_at(np.arange(9) / 4)
    assert kept(thin(track, 0.25)) == list(range(9))
    assert kept(thin(track, 1e300)) == [0]
    assert kept(thin(track_at([0.0]), 1.0)) == [0]


@pytest.mark.parametrize("period_s", [0.0, -1.0, np.nan, np.inf])
def test_thin_refuses_a_period_that_is_not_positive(period_s):
    with pytest.raises(DataError, match=rf"is {period_s}; accepted is a positive finite number"):
        thin(track_at([0, 1, 2]), period_s)


def test_thin_refuses_a_period_shorter_than_the_median_interval():
    with pytest.raises(DataError, match=r"made\.pos: .* 0\.2 s is shorter .* at least 0\.25 s"):
        thin(track_at(np.arange(9) / 4), 0.2)


def test_gaps_are_indices_of_the_epoch_after():
    track = track_at([0, 0.25, 0.5, 1.0, 1.25, 1.5, 1.75, 5.0])
    np.testing.assert_array_equal(gaps(track), [3, 7])
    np.testing.assert_array_equal(gaps(track, factor=2.0), [7])
    np.testing.assert_array_equal(gaps(track, factor=20.0), [])


@pytest.mark.parametrize("times", [[], [0.0]])
def test_logs_too_short_for_an_interval_have_no_gaps(times):
    track = track_at(times)
    assert gaps(track).shape == (0,)
    np.testing.assert_array_equal(intervals_s(track), np.zeros(len(times)))


@pytest.mark.parametrize("factor", [0.0, -1.5, np.nan])
def test_gaps_refuses_a_factor_that_is_not_positive(factor):
    with pytest.raises(DataError, match=rf"gap factor is {factor}; accepted is a positive"):
        gaps(track_at([0, 1, 2]), factor)


def test_intervals_come_from_the_integers():
    time_ns = START_NS + np.array([0, 1, 250_000_001, 250_000_001 + 3600 * SECOND])
    track = track_at(np.zeros(4), time_ns=time_ns)
    np.testing.assert_array_equal(intervals_s(track), [0.0, 1e-9, 0.25, 3600.0])


# The recorded drive


@needs_real_file
def test_recorded_drive_agrees_with_its_text():
    track = load_rtklib_pos(REAL_FILE)
    first, last = (REAL_FILE.read_text().splitlines()[k].split() for k in (1, -1))
    assert first[:2] == ["2025/07/08", "19:34:18.499"]
    assert last[:2] == ["2025/07/08", "19:43:27.499"]
    assert track.time_ns[[0, -1]].tolist() == [
        START_NS + 18_499_000_000,
        START_NS + (9 * 60 + 27) * SECOND + 499_000_000,
    ]
    for k, text in ((0, first), (-1, last)):
        north, east, up, *sigma = map(float, text[15:21])
        assert track.velocity is not None
        assert track.velocity_sigma is not None
        np.testing.assert_array_equal(track.velocity[k], [east, north, up])
        np.testing.assert_array_equal(track.velocity_sigma[k], [sigma[1], sigma[0], sigma[2]])
        np.testing.assert_array_equal(
            track.geodetic[k, :2], np.deg2rad(list(map(float, text[2:4])))
        )
        assert track.geodetic[k, 2] == float(text[4])


@needs_real_file
def test_recorded_drive_is_a_regular_4_hz_log():
    track = load_rtklib_pos(REAL_FILE)
    assert len(track.time_ns) == 2197
    assert np.sum(track.quality == 1) == 2189
    assert np.sum(track.quality == 2) == 8
    assert track.duplicates == 0
    assert np.median(intervals_s(track)[1:]) == 0.25
    assert gaps(track).size == 0
    assert len(thin(track, 1.0).time_ns) == 550


@needs_real_file
def test_reading_a_drive_takes_few_calls_a_fix():
    calls = 0

    def count(frame, event, argument):
        nonlocal calls
        calls += event == "call"

    sys.setprofile(count)
    try:
        track = load_rtklib_pos(REAL_FILE)
    finally:
        sys.setprofile(None)
    assert calls < 80 * len(track.time_ns)
