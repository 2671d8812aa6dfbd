"""Inertial logs from CSV: what is read, what is refused and in which words, and the grid."""

from pathlib import Path

import numpy as np
import pytest

from jaxnav.datasets.base import DataError
from jaxnav.datasets.inertial import ImuLog, load_imu_csv, on_grid, window
from jaxnav.datasets.plausible import check_plausible
from jaxnav.units import GRAVITY

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
DRIVE, FLIGHT = DATA / "rtk_drive" / "imu_1934.csv", DATA / "rocket_hedy" / "imu.csv"
HEADER = "time [s],gyro_x [rad/s],gyro_y [rad/s],gyro_z [rad/s]," + (
    "accel_x [m/s^2],accel_y [m/s^2],accel_z [m/s^2]"
)
REST = "0.01,0.02,0.03,0.1,0.2,9.8"


def needs(path: Path):
    return pytest.mark.skipif(not path.is_file(), reason=f"the recorded log is not there: {path}")


@pytest.fixture
def refusal(refusal_by):
    return refusal_by(load_imu_csv)


def rows(*times: object) -> list[str]:
    return [f"{time},{REST}" for time in times]


# What is read


def test_columns_by_name_in_any_order_and_unit(write):
    header = "accel_z [g], accel_x [m/s^2],temperature, time [ms],gyro_y[ rad/s ],gyro_x [deg/s],"
    header += "gyro_z [deg/s],accel_y [g],accel_x_raw"
    line = "1.0, 0.5,21.5,{},0.25,180,-90,0.5,abc"
    log = load_imu_csv(write("", "# a comment", header, line.format(10), line.format("20.5")))
    np.testing.assert_array_equal(log.time_ns, [10_000_000, 20_500_000])
    np.testing.assert_allclose(log.gyro, [[np.pi, 0.25, -np.pi / 2]] * 2, rtol=1e-15)
    np.testing.assert_allclose(log.accel, [[0.5, GRAVITY / 2, GRAVITY]] * 2, rtol=1e-15)
    assert log.time_ns.dtype == np.int64
    assert log.gyro.dtype == log.accel.dtype == np.float64
    np.testing.assert_array_equal(log.valid, True)
    assert log.step_s == 0.0105
    assert (log.duplicates, log.nan_rows, log.gaps, log.missing) == (0, 0, 0, 0)
    assert log.source.endswith("log.txt")


@pytest.mark.parametrize(("unit", "scale"), [("s", 9), ("ms", 6), ("us", 3), ("ns", 0)])
def test_times_keep_every_nanosecond(write, unit, scale):
    stamps = [1_752_003_261_854_000_001, 1_752_003_261_864_000_003]
    texts = [f"{t // 10**scale}.{t % 10**scale:0{scale}}" if scale else str(t) for t in stamps]
    log = load_imu_csv(write(HEADER.replace("[s]", f"[{unit}]"), *rows(*texts)))
    np.testing.assert_array_equal(log.time_ns, stamps)


def test_duplicates_are_dropped_and_counted(write):
    log = load_imu_csv(write(HEADER, "0,0.1,0,0,0,0,9.8", "0,0.2,0,0,0,0,9.8", *rows(1, 1, 1, 2)))
    np.testing.assert_array_equal(log.time_ns, np.array([0, 1, 2]) * 10**9)
    np.testing.assert_array_equal(log.gyro[0], [0.1, 0, 0])
    assert log.duplicates == 3


def test_rows_with_an_entry_that_is_no_number_are_lost(write):
    bad = ["1,,0.02,0.03,0.1,0.2,9.8", "2,0.01,nan,0.03,0.1,0.2,9.8", "3,0,0,0,0,0,-inf"]
    log = load_imu_csv(write(HEADER, *rows(0), *bad, *rows(4)))
    np.testing.assert_array_equal(log.valid, [True, False, False, False, True])
    np.testing.assert_array_equal(log.gyro[1:4], 0)
    np.testing.assert_array_equal(log.accel[1:4], 0)
    assert log.nan_rows == 3


def test_gaps_are_counted_with_what_they_lack(write):
    # Median 10: 15 is jitter, 16 lacks one sample, 40 lacks three.
    log = load_imu_csv(write(HEADER.replace("[s]", "[ms]"), *rows(0, 10, 20, 35, 45, 61, 71, 111)))
    assert (log.gaps, log.missing) == (2, 4)
    assert log.step_s == pytest.approx(55e-3 / 5)


def test_step_is_the_mean_of_rounded_stamps(write):
    """A clock of 98.5 Hz in whole milliseconds has a median interval of 10 ms."""
    stamps = np.floor(np.arange(2000) * 1e3 / 98.5).astype(int)
    log = load_imu_csv(write(HEADER.replace("[s]", "[ms]"), *rows(*stamps)))
    assert log.step_s == pytest.approx(1 / 98.5, rel=1e-4)
    assert (log.gaps, len(on_grid(log).valid)) == (0, 2000)


# What is refused

REFUSED = {
    "empty": ((), ("no header", "time, gyro_x")),
    "no sample": ((HEADER,), ("no sample",)),
    "one sample": ((HEADER, *rows(0, 0)), ("1 samples", "at least two")),
    "missing column": ((HEADER.replace("gyro_y", "rate_y"),), ("line 1", "gyro_y")),
    "no unit": ((HEADER.replace("time [s]", "time"),), ("time has no unit", "s, ms, us, ns")),
    "unknown unit": ((HEADER.replace("[rad/s]", "[rpm]"),), ("gyro_x is 'rpm'", "rad/s, deg/s")),
    "column twice": ((f"{HEADER},time [s]",), ("time is there twice",)),
    "short row": ((HEADER, *rows(0), "1,2,3"), ("line 3", "3 columns", "are 7")),
    "words": ((HEADER, *rows(0), "1,fast,0,0,0,0,9.8"), ("line 3", "gyro_x is 'fast'")),
    "no time": ((HEADER, f",{REST}"), ("line 2", "time is ''")),
    "infinite time": ((HEADER, f"inf,{REST}"), ("time is 'inf'",)),
    "endless time": ((HEADER, f"1e999999999,{REST}"), ("within 146 years",)),
    "backwards": ((HEADER, "# note", *rows(0, 1, 0.5)), ("line 5", "0.5 is before")),
    "all lost": ((HEADER, "0,,,,,,", "1,,,,,,"), ("no sample of the log is complete",)),
    "headless": ((*rows(0, 1),), ("line 1", "does not name time")),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refusals(refusal, name):
    lines, words = REFUSED[name]
    message = refusal(*lines)
    for word in words:
        assert word in message


def test_files_that_cannot_be_read(tmp_path):
    for path in (tmp_path, tmp_path / "none.csv"):
        with pytest.raises(DataError, match=str(path)):
            load_imu_csv(path)


def test_units_that_are_wrong(refusal):
    times = np.arange(300) / 100
    in_g = [f"{t},0.01,0,0,0.01,0.02,1.0" for t in times]
    assert "looks like g;" in refusal(HEADER, *in_g)
    assert "header says g" in refusal(HEADER.replace("[m/s^2]", "[g]"), *rows(*times))
    assert "looks like mg" in refusal(HEADER, *(f"{t},0,0,0,10,20,1001" for t in times))
    assert "specific force is zero" in refusal(HEADER, *(f"{t},0,0,0,0,0,0" for t in times))
    # A tumbling body, and one at rest whose bias of half a degree per second is not in rad/s.
    assert "looks like deg/s" in refusal(HEADER, *(f"{t},50,60,70,3,4,9" for t in times))
    assert "look like deg/s" in refusal(HEADER, *(f"{t},0.5,0.1,-0.2,0.1,0.2,9.8" for t in times))


# The recorded logs


def drive() -> np.ndarray:
    """Rows ax, ay, az [g], gx, gy, gz [deg/s], ms; the first and the last may be partial."""
    return np.genfromtxt(DRIVE, delimiter=",", skip_header=1, skip_footer=1)


@needs(DRIVE)
def test_recorded_drive_is_read(tmp_path):
    path = tmp_path / "drive.csv"
    units = dict.fromkeys(("accel_x", "accel_y", "accel_z"), "g")
    units |= dict.fromkeys(("gyro_x", "gyro_y", "gyro_z"), "deg/s") | {"time": "ms"}
    table = drive()
    header = ",".join(f"{name} [{unit}]" for name, unit in units.items())
    np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.10g")
    log = load_imu_csv(path)
    assert len(log.valid) == len(table)
    assert (log.duplicates, log.nan_rows, log.gaps) == (0, 0, 0)
    np.testing.assert_allclose(log.step_s, 548.5 / len(table), rtol=1e-3)
    np.testing.assert_allclose(np.rad2deg(log.gyro), table[:, 3:6], rtol=1e-9)
    with pytest.raises(DataError, match="look like deg/s"):
        check_plausible(np.rad2deg(log.gyro), log.accel, log.step_s)
    with pytest.raises(DataError, match="looks like g;"):
        check_plausible(log.gyro, log.accel / GRAVITY, log.step_s)


@needs(FLIGHT)
def test_recorded_rocket_is_plausible_in_the_right_units():
    table = np.genfromtxt(FLIGHT, delimiter=",", skip_header=1, usecols=(2, 3, 4, 5, 6, 7))
    gyro, accel = np.deg2rad(table[:, 3:]), table[:, :3]
    check_plausible(gyro, accel, 0.01)
    with pytest.raises(DataError, match="looks like deg/s"):
        check_plausible(np.rad2deg(gyro), accel, 0.01)


def test_fast_motions_are_plausible():
    """A rocket of 15 turns a second that coasts, a steady turn, and free fall."""
    ones = np.ones((1000, 1))
    check_plausible(ones * [94.0, 0.5, 0.5], ones * [-3.0, 0.1, 0.1], 0.01)
    check_plausible(ones * [0.0, 0.01, 0.1], ones * [0.0, 0.8, 9.9], 0.01)
    check_plausible(ones * [2.0, 1.0, 0.5], ones * [0.01, 0.0, 0.02], 0.01)


# The grid


def made(times_ms, lost=()) -> ImuLog:
    """A log whose gyro numbers its samples from one."""
    count = np.arange(1.0, len(times_ms) + 1)
    valid = np.ones(len(times_ms), bool)
    valid[list(lost)] = False
    return ImuLog(
        time_ns=np.array(times_ms, np.int64) * 10**6,
        gyro=count[:, None] * np.ones(3),
        accel=-count[:, None] * np.ones(3),
        valid=valid,
        step_s=0.01,
        duplicates=1,
        nan_rows=len(lost),
        gaps=1,
        missing=2,
        source="made.csv",
    )


def test_grid_makes_gaps_lost_samples():
    log = on_grid(made([5, 15, 24, 54, 65], lost=[1]))
    np.testing.assert_array_equal(log.valid, [1, 0, 1, 0, 0, 1, 1])
    np.testing.assert_array_equal(log.gyro[:, 0], [1, 2, 3, 0, 0, 4, 5])
    np.testing.assert_array_equal(log.accel[:, 2], [-1, -2, -3, 0, 0, -4, -5])
    np.testing.assert_array_equal(log.time_ns, (5 + 10 * np.arange(7)) * 10**6)
    assert (log.duplicates, log.nan_rows, log.gaps, log.missing) == (1, 1, 1, 2)


def test_grid_refuses_a_gap_of_years():
    with pytest.raises(DataError, match=r"made\.csv: gaps of up to 3e\+07 s"):
        on_grid(made([0, 10, 20, 30_000_000_000]))


def test_window_counts_anew():
    log = made([0, 10, 20, 60, 70, 80], lost=[0, 5])
    part = window(log, 0.01, 0.07)
    np.testing.assert_array_equal(part.gyro[:, 0], [2, 3, 4, 5])
    assert (part.nan_rows, part.gaps, part.missing, part.duplicates) == (0, 1, 3, 1)
    np.testing.assert_array_equal(window(log).time_ns, log.time_ns)
    with pytest.raises(DataError, match=r"made\.csv: the window from 9.0 s to 10.0 s holds 0"):
        window(log, 9.0, 10.0)
