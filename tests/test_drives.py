"""Recorded drives: axes and clocks against the data, round trips on written files, refusals."""

import struct
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxnav.datasets.base import DataError
from jaxnav.datasets.comma2k19 import load_comma2k19
from jaxnav.datasets.drive import DriveLog
from jaxnav.datasets.drive_csv import load_drive_csv
from jaxnav.datasets.formats import load_drive
from jaxnav.datasets.plausible import check_fixes
from jaxnav.datasets.rtk_drive import Rig, load_rtk_drive
from jaxnav.datasets.track import Sigmas
from jaxnav.navigation.earth import MEAN_RADIUS, dcm_ne, ecef_from_geodetic
from jaxnav.units import DEG, GRAVITY

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
DRIVE, SEGMENT = DATA / "rtk_drive", DATA / "comma2k19"
START_S, START_NS = 1_752_003_261, 1_752_003_261_854_000_000
NORTH = 10.0  # [m/s] speed of the drives made here


def needs(path: Path):
    return pytest.mark.skipif(not path.is_dir(), reason=f"the recorded drive is not there: {path}")


def since(time_ns: np.ndarray) -> np.ndarray:
    """Seconds since the tag's start, or since the phone's."""
    return (time_ns - (START_NS if time_ns[0] > 10**18 else 0)) / 1e9


def integral(time: np.ndarray, rate: np.ndarray) -> np.ndarray:
    steps = (rate[1:] + rate[:-1]) / 2 * np.diff(time)
    return np.concatenate([[0.0], np.cumsum(steps)])


def mean_between(at: np.ndarray, time: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """The mean of a rate over each interval of other stamps."""
    return np.diff(np.interp(at, time, integral(time, rate))) / np.diff(at)


def slope_and_correlation(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    return float(np.polyfit(x, y, 1)[0]), float(np.corrcoef(x, y)[0, 1])


def velocities(log: DriveLog) -> tuple[np.ndarray, np.ndarray]:
    assert log.fixes.velocity is not None
    assert log.fixes.velocity_sigma is not None
    return log.fixes.velocity, log.fixes.velocity_sigma


def tilt_deg(up: np.ndarray) -> float:
    return float(np.degrees(np.arccos(up[2] / np.linalg.norm(up))))


# The recorded drive with RTK


@pytest.fixture(scope="module")
def drive() -> DriveLog:
    return load_rtk_drive(DRIVE)


def motion(log: DriveLog) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Times [s] of samples and fixes, and speed [m/s] and course [rad] of the fixes."""
    east, north = velocities(log)[0][:, :2].T
    course = np.unwrap(np.arctan2(north, east))
    return since(log.imu.time_ns), since(log.fixes.time_ns), np.hypot(east, north), course


@needs(DRIVE)
def test_recorded_drive_is_complete(drive):
    assert (len(drive.imu.time_ns), len(drive.fixes.time_ns)) == (54_858, 2197)
    assert (drive.imu.duplicates, drive.imu.nan_rows, drive.imu.gaps) == (0, 0, 0)
    assert drive.imu.step_s == pytest.approx(0.01, rel=1e-4)
    assert drive.skipped_rows == 2
    assert drive.reference is None
    assert drive.imu.valid.all()
    assert Path(drive.source) == DRIVE


@needs(DRIVE)
def test_accelerometers_of_the_stopped_car_point_up(drive):
    time, fixed, speed, _ = motion(drive)
    force = drive.imu.accel[np.interp(time, fixed, speed) < 0.05].mean(axis=0)
    assert tilt_deg(force) < 2
    assert np.linalg.norm(force) == pytest.approx(9.8, abs=0.2)


@needs(DRIVE)
def test_forward_force_follows_the_speed(drive):
    time, fixed, speed, _ = motion(drive)
    inside = (fixed > 1) & (fixed < 547)
    told = (np.diff(speed) / np.diff(fixed))[inside[1:]]
    felt = mean_between(fixed, time, drive.imu.accel[:, 0])[inside[1:]]
    slope, correlation = slope_and_correlation(told, felt)
    assert 0.85 < slope < 1.15
    assert correlation > 0.8


@needs(DRIVE)
def test_turns_to_the_left_are_positive(drive):
    time, fixed, speed, course = motion(drive)
    rate = np.diff(course) / np.diff(fixed)
    # Slower than that, what the antenna's place turns of its course is no longer small
    moving = (speed[1:] > 4) & (speed[:-1] > 4)
    moving &= (fixed[1:] > 1) & (fixed[1:] < 547)
    felt = mean_between(fixed, time, drive.imu.gyro[:, 2])
    slope, correlation = slope_and_correlation(rate[moving], felt[moving])
    assert slope == pytest.approx(1, abs=0.04)
    assert correlation > 0.98


@needs(DRIVE)
def test_clock_of_the_samples_keeps_its_distance_to_the_fixes(drive):
    """From tick zero to the last one it would drift by 0.11 s; here the samples stay 35 ms late."""
    time, fixed, speed, _ = motion(drive)
    told = np.diff(speed) / np.diff(fixed)

    def offset(begin: float) -> float:
        inside = (fixed[1:] > begin) & (fixed[1:] < begin + 90)
        shifts = np.arange(-0.15, 0.1, 0.005)
        misfit = [
            np.std((mean_between(fixed + s, time, drive.imu.accel[:, 0]) - told)[inside])
            for s in shifts
        ]
        return float(shifts[np.argmin(misfit)])

    offsets = np.array([offset(begin) for begin in (1, 91, 271, 451)])
    np.testing.assert_allclose(offsets, 0.035, atol=0.015)


# The recorded segment of comma2k19


@pytest.fixture(scope="module")
def segment() -> DriveLog:
    return load_comma2k19(SEGMENT)


@needs(SEGMENT)
def test_recorded_segment_is_complete(segment):
    assert (len(segment.imu.time_ns), len(segment.fixes.time_ns)) == (6256, 579)
    assert segment.reference is not None
    assert len(segment.reference.time_ns) == 1200
    assert (segment.imu.duplicates, segment.imu.gaps, segment.skipped_rows) == (0, 0, 0)
    assert np.isnan(segment.fixes.velocity).sum(axis=0).tolist() == [0, 0, 579]
    np.testing.assert_array_equal(
        np.isnan(segment.fixes.velocity), np.isnan(segment.fixes.velocity_sigma)
    )


@needs(SEGMENT)
def test_reference_turns_back_to_earth_fixed_axes(segment):
    reference = segment.reference
    position = np.load(SEGMENT / "global_pose" / "frame_positions.npy")
    velocity = np.load(SEGMENT / "global_pose" / "frame_velocities.npy")
    back = jax.vmap(ecef_from_geodetic)(reference.geodetic)
    np.testing.assert_allclose(back, position, atol=1e-8)
    C_ne = np.array(jax.vmap(dcm_ne)(reference.geodetic[:, 0], reference.geodetic[:, 1]))
    np.testing.assert_allclose(np.einsum("rji,rj->ri", C_ne, reference.velocity), velocity)
    gram = reference.dcm @ np.swapaxes(reference.dcm, 1, 2)
    np.testing.assert_allclose(gram - np.eye(3), 0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(reference.dcm), 1)


@needs(SEGMENT)
def test_axes_of_the_reference_are_forward_left_up(segment):
    reference = segment.reference
    forward, up = reference.dcm[:, :, 0], reference.dcm[:, :, 2]
    heading, course = (np.arctan2(v[:, 1], v[:, 0]) for v in (forward, reference.velocity))
    assert np.degrees(np.abs(heading - course)).max() < 2
    assert tilt_deg(up.mean(axis=0)) < 5
    assert tilt_deg(segment.imu.accel.mean(axis=0)) < 5


@needs(SEGMENT)
def test_gyro_and_accelerometer_agree_with_the_reference(segment):
    """Each sensor against what the reference's attitude and velocity ask of it."""
    time, stamps = since(segment.imu.time_ns), since(segment.reference.time_ns)[::10]
    dcm, velocity = segment.reference.dcm[::10], segment.reference.velocity[::10]
    turn = np.swapaxes(dcm[:-1], 1, 2) @ dcm[1:]
    for axis, (row, column), least in ((0, (2, 1), 0.99), (1, (0, 2), 0.99), (2, (1, 0), 0.95)):
        rate = (turn[:, row, column] - turn[:, column, row]) / 2 / np.diff(stamps)
        felt = mean_between(stamps, time, segment.imu.gyro[:, axis])
        slope, correlation = slope_and_correlation(rate, felt)
        assert slope == pytest.approx(1, abs=0.05)
        assert correlation > least
    force = np.diff(velocity, axis=0) / np.diff(stamps)[:, None] + [0, 0, 9.8]
    asked = np.einsum("kji,kj->ki", (dcm[1:] + dcm[:-1]) / 2, force)
    for axis, least in ((0, 0.99), (1, 0.9)):
        felt = mean_between(stamps, time, segment.imu.accel[:, axis])
        slope, correlation = slope_and_correlation(asked[:, axis], felt)
        assert slope == pytest.approx(1, abs=0.05)
        assert correlation > least


@needs(SEGMENT)
def test_fixes_agree_with_the_reference_and_its_ellipsoid(segment):
    fixes, reference = segment.fixes, segment.reference
    inside = fixes.time_ns < reference.time_ns[-1]
    stamps, frames = fixes.time_ns[inside] / 1e9, reference.time_ns / 1e9
    there = np.stack([np.interp(stamps, frames, g) for g in reference.geodetic.T], axis=1)
    north, east, up = ((fixes.geodetic[inside] - there) * [MEAN_RADIUS, MEAN_RADIUS, 1]).T
    east = east * np.cos(there[0, 0])
    assert np.sqrt(np.mean(north**2 + east**2)) < 2
    assert abs(up.mean()) < 2
    velocity = np.stack([np.interp(stamps, frames, v) for v in reference.velocity.T[:2]], axis=1)
    error = fixes.velocity[inside, :2] - velocity
    assert np.sqrt(np.mean(error**2, axis=0)).max() < 0.15
    sigmas = Sigmas()
    assert np.sqrt(np.mean(north**2 + east**2) / 2) < sigmas.position[0] < 5


# A folder of RTKLIB's stream server made by hand


def write_rtk(
    folder: Path,
    count: int = 2000,
    *,
    cut: int = 10,
    line_end: str = "\n",
    counted_end: str = "\r\n",
    rate: float = 1.001,
    positions_scale: float = 1.0,
) -> Path:
    """A drive to the north at rest in its axes; the sensor's clock is slow by a thousandth."""
    ms = 261_906 + 10 * np.arange(count)
    lines = [f"0.0,{0.001 * (k % 7):.3f},-1.0,0.5,0.0,-1.0,{m}" for k, m in enumerate(ms)]
    lines[0] = lines[0][4:]
    text = line_end.join(lines) + line_end
    (folder / "imu_1.csv").write_bytes(text[: len(text) - cut].encode())
    ends = np.cumsum([len(line) + len(counted_end) for line in lines]) * positions_scale
    ticks = np.rint(131 + rate * (ms - ms[0]))
    tag = b"TIMETAG RTKLIB".ljust(60, b"\0") + struct.pack("<IId", 7, START_S, 0.854)
    tag += b"".join(struct.pack("<II", int(t), int(p)) for t, p in zip(ticks, ends, strict=True))
    (folder / "imu_1.csv.tag").write_bytes(tag)
    write_pos(folder / "gnss.pos", np.arange(0, 20, 0.5))
    return folder


def write_pos(path: Path, seconds: np.ndarray, hour: int = 19) -> None:
    lines = [
        f"2025/07/08 {hour:02d}:34:{22 + s:06.3f} {40 + np.degrees(NORTH * s / MEAN_RADIUS):.9f} "
        f"-105.0 1600.0 1 20 .01 .02 .03 0 0 0 0 0 {NORTH} 0.0 0.0 .05 .06 .07 0 0 0"
        for s in seconds
    ]
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(("line_end", "counted_end"), [("\n", "\r\n"), ("\n", "\n"), ("\r\n",) * 2])
def test_rtk_folder_is_read_on_the_clock_of_its_tag(tmp_path, line_end, counted_end):
    folder = write_rtk(tmp_path, line_end=line_end, counted_end=counted_end)
    rig = Rig(orientation_deg=(180.0, 0.0, 0.0), lever_arm=(1.0, 2.0, 3.0), delay_s=-0.25)
    log = load_rtk_drive(folder, rig)
    assert (len(log.imu.time_ns), log.skipped_rows) == (1998, 2)
    expected = START_NS + (131 + 1.001 * 10 * np.arange(1, 1999) - 250) * 1e6
    np.testing.assert_allclose(since(log.imu.time_ns), since(expected.astype(np.int64)), atol=1e-3)
    # Forward, right, down is the sensor's own frame rolled over, so forward, left, up is its own
    np.testing.assert_allclose(log.imu.gyro[0] / DEG, [0.5, 0.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(log.imu.accel[0] / GRAVITY, [0, 0.001, -1], atol=1e-12)
    np.testing.assert_array_equal(log.lever_arm, [1, 2, 3])
    np.testing.assert_array_equal(log.fixes.position_sigma[0], [0.02, 0.01, 0.03])


def test_repeated_and_lost_samples_of_an_rtk_folder_are_counted(tmp_path):
    folder = write_rtk(tmp_path)
    path = folder / "imu_1.csv"
    lines = path.read_text().split("\n")
    lines[100] = lines[99]
    lines[200] = lines[200].replace("-1.0", "nan ", 1)
    path.write_text("\n".join(lines))
    log = load_rtk_drive(folder)
    assert (log.imu.duplicates, log.imu.nan_rows, len(log.imu.time_ns)) == (1, 1, 1997)


def refused(load, path: Path, *words: str) -> None:
    with pytest.raises(DataError) as caught:
        load(path)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert "; accepted" in message
    assert "\n" not in message
    for word in words:
        assert word in message


def test_rtk_folders_that_do_not_go_together(tmp_path):
    folder = write_rtk(tmp_path)
    (folder / "second.pos").write_text("")
    refused(load_rtk_drive, folder, "*.pos there is gnss.pos, second.pos", "exactly one")
    (folder / "second.pos").unlink()
    write_pos(folder / "gnss.pos", np.arange(10.0), hour=18)
    refused(load_rtk_drive, folder, "fixes last from -3599.87 s", "same clock")
    (folder / "imu_1.csv.tag").write_bytes(b"something else")
    refused(load_rtk_drive, folder, "imu_1.csv.tag: not a time tag")
    (folder / "imu_1.csv.tag").unlink()
    refused(load_rtk_drive, folder, "imu*.csv.tag there is none")
    write_rtk(folder, positions_scale=3.0)
    refused(load_rtk_drive, folder, "the same recording")
    write_rtk(folder, rate=1.02)
    refused(load_rtk_drive, folder, "runs 0.98", "within 1%")
    write_rtk(folder)
    lines = (folder / "imu_1.csv").read_text().split("\n")
    (folder / "imu_1.csv").write_text("\n".join([*lines[:9], lines[9][4:], *lines[10:]]))
    refused(load_rtk_drive, folder, "line 10", "6 columns", "are 7")
    (folder / "imu_1.csv").write_text("")
    refused(load_rtk_drive, folder, "0 whole samples")


# A segment of comma2k19 made by hand


def write_segment(folder: Path, count: int = 2000) -> Path:
    """A drive to the north-east, at rest in its axes; no reference."""
    time = 100 + 0.01 * np.arange(count)
    fixed = np.arange(100.0, 100 + count / 100, 0.5)
    way = np.degrees(NORTH * np.sqrt(0.5) * (fixed - 100) / MEAN_RADIUS)
    lat, lon = 37.0 + way, -122.0 + way / np.cos(37 * DEG)
    fixes = np.stack([lat, lon, *np.array([[NORTH, 0, 30, 45]] * len(fixed)).T], axis=1)
    log = folder / "processed_log"
    arrays = {
        "IMU/accelerometer": (time, np.tile([0.1, 0.2, -9.8], (count, 1))),
        "IMU/gyro_uncalibrated": (time, np.tile([0.01, 0.02, 0.03], (count, 1))),
        "GNSS/live_gnss_ublox": (fixed, fixes),
    }
    for name, pair in arrays.items():
        for part, values in zip(("t", "value"), pair, strict=True):
            save(log / name / part, values)
    return folder


def save(path: Path, values: np.ndarray) -> None:
    """Save as the data set has it, without an ending."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        np.save(file, values)


def test_segment_without_reference_and_endings(tmp_path):
    sigmas = Sigmas((1.0, 2.0, 3.0), (0.1, 0.2, 0.3))
    log = load_comma2k19(write_segment(tmp_path), sigmas)
    assert log.reference is None
    np.testing.assert_array_equal(log.imu.accel[0], [0.1, -0.2, 9.8])
    np.testing.assert_array_equal(log.imu.gyro[0], [0.01, -0.02, -0.03])
    np.testing.assert_allclose(velocities(log)[0][0], [50**0.5, 50**0.5, np.nan])
    np.testing.assert_array_equal(velocities(log)[1][0], [0.1, 0.2, np.nan])
    np.testing.assert_array_equal(log.fixes.position_sigma[-1], [1, 2, 3])
    np.testing.assert_array_equal(log.fixes.quality, 5)
    assert log.imu.time_ns[0] == 100 * 10**9


def test_gyro_moves_to_the_stamps_of_the_accelerometer(tmp_path):
    folder = write_segment(tmp_path)
    gyro = folder / "processed_log" / "IMU" / "gyro_uncalibrated"
    time = 100 + 0.004 + 0.01 * np.arange(1500)
    save(gyro / "t", time)
    save(gyro / "value", np.stack([0.01 * (time - 100), 0 * time, 0 * time], axis=1))
    log = load_comma2k19(folder)
    inside = log.imu.valid
    np.testing.assert_array_equal(np.flatnonzero(inside)[[0, -1]], [1, 1499])
    at = since(log.imu.time_ns[inside]) - 100
    np.testing.assert_allclose(log.imu.gyro[inside, 0], 0.01 * at, atol=1e-9)
    assert log.imu.nan_rows == 501


def test_segments_that_are_not_whole(tmp_path):
    folder = write_segment(tmp_path)
    gnss = folder / "processed_log" / "GNSS" / "live_gnss_ublox"
    values = np.load(gnss / "value")
    holed = values.copy()
    holed[3, 0] = np.nan
    save(gnss / "value", holed)
    assert load_comma2k19(folder).skipped_rows == 1
    times = np.load(gnss / "t")
    save(gnss / "t", np.concatenate([times[:2], times[1:-1]]))
    assert load_comma2k19(folder).fixes.duplicates == 1
    save(gnss / "t", times[::-1])
    refused(load_comma2k19, folder, "fix 2 is before")
    save(gnss / "t", times + 1000)
    refused(load_comma2k19, folder, "last from 1000 s")
    save(gnss / "value", values[:, :5])
    refused(load_comma2k19, folder, "(40, 5)", "(40, 6)")
    (gnss / "value").write_text("no array")
    refused(load_comma2k19, folder, "value", "a NumPy array")
    (gnss / "value").unlink()
    refused(load_comma2k19, folder, "no such file")


# A drive in one CSV

SENSORS = (
    "time [s],gyro_x [deg/s],gyro_y [deg/s],gyro_z [deg/s],accel_x [g],accel_y [g],accel_z [g]"
)
PLACE = "lat [deg],lon [deg],height [m]"
VELOCITY = "vel_e [km/h],vel_n [km/h],vel_u [km/h]"
HEADER = f"{SENSORS},{PLACE},{VELOCITY}"
REST = "0.1,0.2,0.3,0.01,0.02,1.0"


def place(t: float, latitude: float = 40.0) -> str:
    return f"{latitude + np.degrees(NORTH * t / MEAN_RADIUS):.9f},-105.0,1600"


def csv_rows(count: int = 300, speed: str = "0,36,0") -> list[str]:
    """Samples at 10 Hz and a fix each second in a row of its own, 50 ms later."""
    rows = []
    for k in range(count):
        rows.append(f"{k / 10},{REST},,,,,,")
        if k % 10 == 0:
            rows.append(f"{k / 10 + 0.05},,,,,,,{place(k / 10 + 0.05)},{speed}")
    return rows


def test_drive_of_one_file(write):
    log = load_drive_csv(write(HEADER, *csv_rows()), lever_arm=(0.5, 0.0, 1.0))
    assert (len(log.imu.time_ns), len(log.fixes.time_ns), log.skipped_rows) == (300, 30, 0)
    np.testing.assert_allclose(log.imu.gyro[0] / DEG, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(log.imu.accel[0] / GRAVITY, [0.01, 0.02, 1])
    np.testing.assert_allclose(velocities(log)[0][0], [0, NORTH, 0])
    np.testing.assert_allclose(log.fixes.geodetic[0, 1:], [-105 * DEG, 1600])
    np.testing.assert_array_equal(log.fixes.time_ns[:2], [50_000_000, 1_050_000_000])
    np.testing.assert_array_equal(log.fixes.position_sigma[0], Sigmas().position)
    np.testing.assert_array_equal(velocities(log)[1][0], Sigmas().velocity)
    np.testing.assert_array_equal(log.lever_arm, [0.5, 0, 1])
    np.testing.assert_array_equal(log.fixes.quality, 0)


def test_rows_with_both_in_radians_and_with_sigmas(write):
    header = f"{SENSORS},lon [rad],lat [rad],height [m],sigma_e [m],sigma_vel_n [m/s],vel_n [m/s]"
    rows = [
        f"{t},{REST},{2 * np.pi - 1:.12f},{0.7 + NORTH * t / MEAN_RADIUS:.12f},10,{sigma},0.2,10"
        for t, sigma in ((0, 1.5), (1, ""), (2, 2.5))
    ]
    log = load_drive_csv(write(header, *rows))
    assert (len(log.imu.time_ns), len(log.fixes.time_ns)) == (3, 3)
    np.testing.assert_allclose(log.fixes.geodetic[0], [0.7, -1, 10])
    np.testing.assert_array_equal(log.fixes.position_sigma[:, 0], [1.5, 3, 2.5])
    np.testing.assert_array_equal(velocities(log)[0][0], [np.nan, 10, np.nan])
    np.testing.assert_array_equal(velocities(log)[1][0], [np.nan, 0.2, np.nan])


def test_drive_without_velocity(write):
    rows = [f"{t},{REST},{place(t)}" for t in range(30)]
    log = load_drive_csv(write(f"{SENSORS},{PLACE}", *rows))
    assert log.fixes.velocity is None
    assert log.fixes.velocity_sigma is None


def test_rows_without_anything_whole_are_skipped_and_repeats_dropped(write):
    rows = csv_rows()
    extra = [
        "30,,,,,,,40.0,,1600,,,",
        "30,0.1,,0.3,0,0,1,,,,,,",
        f"30,{REST},40.0,,,,,",
        "30" + "," * 12,
    ]
    repeat = [f"30,{REST},,,,,,", f"30.1,,,,,,,{place(30.1)},,,", f"30.1,,,,,,,{place(30.2)},,,"]
    log = load_drive_csv(write(HEADER, *rows, *extra, *repeat))
    assert log.skipped_rows == 3
    assert (log.imu.duplicates, log.fixes.duplicates) == (1, 1)
    assert (len(log.imu.time_ns), len(log.fixes.time_ns)) == (301, 31)
    np.testing.assert_array_equal(velocities(log)[0][-1], np.nan)


CSV_REFUSED = {
    "empty": ([], ("no header", "lat, lon, height")),
    "no row": ([HEADER], ("no sample",)),
    "missing columns": (
        [HEADER.replace("lat", "phi")],
        ("line 1", "does not name lat", "lat [deg]"),
    ),
    "unit": ([HEADER.replace("[km/h]", "[mph]")], ("vel_e is 'mph'", "m/s, km/h")),
    "columns": ([HEADER, f"0,{REST}"], ("line 2", "7 columns", "are 13")),
    "backwards": ([HEADER, *csv_rows(), *csv_rows()[:1]], ("line 332", "0.0 is before")),
    "words": ([HEADER, f"0,{REST},north,,,,,"], ("line 2", "lat is 'north'")),
    "no fix": ([HEADER, *(f"{k},{REST},,,,,," for k in range(9))], ("has no fix",)),
    "no sample": ([HEADER, *csv_rows()[1::11]], ("0 samples",)),
    "apart": (
        [HEADER, *(r for r in csv_rows() if ",0," not in r), f"90,,,,,,,{place(0)},,,"],
        ("fixes last from 90 s", "samples 29.9 s"),
    ),
    "latitude": (
        [HEADER, f"0,{REST},,,,,,", f"1,{REST},90.5,0,0,,,"],
        ("latitude of fix 1 is 90.5",),
    ),
    "degrees as radians": (
        [HEADER.replace("[deg],lon [deg]", "[rad],lon [rad]"), *csv_rows()],
        ("latitude of fix 1 is 2291.8", "deg"),
    ),
    "longitude": ([HEADER, *csv_rows(9), f"1,{REST},0,361,0,,,"], ("longitude of fix 2 is 361",)),
    "height": (
        [HEADER, *csv_rows(9), f"1,{REST},40,0,1600000,,,"],
        ("height of fix 2", "100000 m"),
    ),
    "speed": ([HEADER, *csv_rows(speed="0,10,0")], ("100 m", "27.78 m", "check units")),
    "axes": ([HEADER, *csv_rows(speed="36,0,0")], ("or elsewhere",)),
    "force": ([HEADER.replace("[g]", "[m/s^2]"), *csv_rows()], ("looks like g;",)),
    "sigma": (
        [f"{HEADER},sigma_e [m]", *(f"{row},0" for row in csv_rows())],
        ("position of fix 1 are 0, 3, 5", "positive"),
    ),
}


@pytest.mark.parametrize("name", CSV_REFUSED)
def test_refusals_of_one_file(refusal_by, name):
    lines, words = CSV_REFUSED[name]
    message = refusal_by(load_drive_csv)(*lines)
    for word in words:
        assert word in message


def test_ways_of_noisy_and_slow_fixes_are_plausible():
    """Metres of noise at rest, a turn in a circle, and a log across the date line."""
    time_ns = np.arange(600) * 10**8
    angle = np.arange(600) * 0.02
    noise = 3 * np.sin(1e3 * angle)
    still = np.stack([0.7 + noise / MEAN_RADIUS, 0 * noise, noise], axis=1)
    check_fixes(time_ns, still, np.zeros((600, 3)))
    course, circle = np.zeros((600, 3)), np.zeros((600, 3))
    course[:, :2] = 10 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    circle[:, :2] = 50 / MEAN_RADIUS * np.stack([-np.cos(angle), np.sin(angle)], axis=1)
    check_fixes(time_ns, circle, course)
    lon = np.remainder(np.pi + 20 * np.arange(600) / 10 / MEAN_RADIUS + np.pi, 2 * np.pi) - np.pi
    crossing = np.stack([0 * lon, lon, 0 * lon], axis=1)
    check_fixes(time_ns, crossing, np.tile([20.0, 0, 0], (600, 1)))


# Whichever format


def test_formats_are_told_apart(tmp_path, write):
    for name in ("rtk", "comma", "other"):
        (tmp_path / name).mkdir()
    assert load_drive(write_rtk(tmp_path / "rtk")).fixes.quality[0] == 1
    assert load_drive(write_segment(tmp_path / "comma")).fixes.quality[0] == 5
    assert load_drive(write(HEADER, *csv_rows())).fixes.quality[0] == 0
    refused(load_drive, tmp_path / "other", "imu*.csv", "processed_log", "CSV file")
    refused(load_drive, tmp_path / "absent", "no recorded drive")
