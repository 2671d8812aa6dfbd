"""Configuration of the study ``immae``: Table 1 of the paper and what the paper leaves open."""

from dataclasses import dataclass
from typing import Literal

from jaxnav.config import (
    Latitude,
    NotNegative,
    Positive,
    Positives,
    Probability,
    Runs,
    Seed,
    Share,
    check_fields,
)
from jaxnav.studies.base import require_flight_times, require_reset, require_weight_floor

SCENARIOS = {
    "matched-noise": "noise as nominal, and a single filter that believes four times that",
    "noise-step": "ten times the nominal noise in the middle third of the flight",
}


@dataclass(frozen=True)
class ImmaeConfig:
    """SINS/CNS attitude with process noise that is unknown or changes (Si, Wang, Niu).

    Attributes:
        scenario: Simulation of the paper to run; "all" runs both.
        runs: Monte Carlo runs.
        seed: Root seed; run i is the same for any number of runs.
        chain: "sins" mechanises noisy increments and filters the errors of that solution; "linear"
            simulates the error model itself.
        initial: "table" starts every run at the errors of Table 1; "drawn" draws initial errors,
            drift and bias from P0, as consistency statistics need.
        duration_s: Flight time [s].
        ins_rate_hz: Output rate of the inertial sensors [Hz].
        filter_period_s: Period of the filter and of the star tracker [s].
        initial_pitch_deg: Pitch on the rail [deg].
        latitude_deg: Geodetic latitude of the launch point [deg]; sets the Earth's radius.
        longitude_deg: Longitude of the launch point [deg]; without effect on a non-rotating Earth.
        gyro_noise_deg_h: Standard deviation of one gyro sample [deg/h].
        accel_noise_ug: Standard deviation of one accelerometer sample [micro g].
        gyro_drift_deg_h: Constant gyro drift, each axis [deg/h].
        accel_bias_ug: Constant accelerometer bias, each axis [micro g].
        star_noise_arcsec: Standard deviation of the star tracker, each axis [arcsec].
        initial_misalignment_arcsec: Initial misalignment, each axis [arcsec].
        p0_attitude_arcsec: Prior standard deviation of the misalignment [arcsec].
        p0_velocity: Prior standard deviation of the velocity [m/s].
        p0_position: Prior standard deviation of the position [m].
        p0_drift_deg_h: Prior standard deviation of the gyro drift [deg/h].
        p0_bias_ug: Prior standard deviation of the accelerometer bias [micro g].
        theta: Factors on Q0 of the bank's models.
        kf_theta: Factor on Q0 of the single Kalman filter; the default is the scenario's.
        step_theta: Factor on the true Q0 in the middle third of "noise-step".
        reset_period_s: Period T of IMMAE's assessment [s]; not given in the paper.
        reset_threshold: Threshold of IMMAE's assessment in (0, 1]; not given in the paper.
        weight_floor: Lower bound of the "floor" bank's weights.
        switching: Probability per filter period that the "markov" bank's model changes.
    """

    scenario: Literal["matched-noise", "noise-step", "all"] = "noise-step"
    runs: Runs = 100
    seed: Seed = 0
    chain: Literal["sins", "linear"] = "sins"
    initial: Literal["table", "drawn"] = "table"
    duration_s: Positive = 600.0
    ins_rate_hz: Positive = 100.0
    filter_period_s: Positive = 0.05
    initial_pitch_deg: float = 90.0
    latitude_deg: Latitude = 39.98
    longitude_deg: float = 116.34
    gyro_noise_deg_h: NotNegative = 1.0
    accel_noise_ug: NotNegative = 500.0
    gyro_drift_deg_h: float = 0.5
    accel_bias_ug: float = 100.0
    star_noise_arcsec: Positive = 1.0
    initial_misalignment_arcsec: tuple[float, float, float] = (10.0, 6.0, 10.0)
    p0_attitude_arcsec: Positive = 10.0
    p0_velocity: Positive = 0.1
    p0_position: Positive = 5.0
    p0_drift_deg_h: Positive = 0.5
    p0_bias_ug: Positive = 500.0
    theta: Positives = (1.0, 10.0, 100.0, 1000.0, 10000.0)
    kf_theta: Positive | None = None
    step_theta: Positive = 10.0
    reset_period_s: Positive = 10.0
    reset_threshold: Share = 0.9
    weight_floor: Positive = 1e-6
    switching: Probability = 1e-4

    def __post_init__(self) -> None:
        """Refuse values that mean nothing.

        Raises:
            ConfigError: With one sentence naming the field, its value and what is accepted.
        """
        check_fields(self)
        require_flight_times(self)
        require_reset(self, self.filter_period_s)
        require_weight_floor(self, len(self.theta))

    @property
    def steps(self) -> int:
        """Number of filter steps."""
        return round(self.duration_s / self.filter_period_s)

    @property
    def samples_per_step(self) -> int:
        """Inertial samples in a filter period."""
        return round(self.filter_period_s * self.ins_rate_hz)

    @property
    def imu_step(self) -> float:
        """Interval of the inertial samples [s]."""
        return 1 / self.ins_rate_hz

    @property
    def single_theta(self) -> float:
        """Factor on Q0 of the single Kalman filter."""
        if self.kf_theta is not None:
            return self.kf_theta
        return 4.0 if self.scenario == "matched-noise" else 1.0
