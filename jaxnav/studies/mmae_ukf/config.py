"""Configuration of the study ``mmae-ukf``: what the paper states and what it leaves open."""

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from jaxnav.config import (
    Count,
    Latitude,
    NotNegative,
    Positive,
    Probability,
    Runs,
    Seed,
    Share,
    check_fields,
    require,
)
from jaxnav.studies.base import require_flight_times, require_reset

SCENARIOS = {
    "paper": "true noise 1/2, 1, 2 times nominal in the three thirds of the flight",
    "reversed": "true noise 2, 1, 1/2 times nominal",
    "large-misalignment": "as paper, with an initial attitude error of many degrees",
}

STATES = 15
"""Tangent coordinates of the state."""


@dataclass(frozen=True)
class MmaeUkfConfig:
    """Banks of EKF and UKF under process noise that changes in flight (Zhao, Chen, He, Ge).

    The paper's Table I is not available: rates, the star tracker's noise, P0, the pitch programme
    and the rule of the sigma points are ours. Initial errors are drawn from P0 in every run.

    Attributes:
        scenario: Scenario to run; "all" runs the three.
        runs: Monte Carlo runs.
        seed: Root seed; run i is the same for any number of runs.
        star: How the star tracker's attitude is observed, "rotation-vector" or "euler"; the default
            is "euler" for "large-misalignment", where it matters, and the former otherwise.
        duration_s: Flight time [s]; below the 465 s after which the vehicle has no mass left.
        ins_rate_hz: Output rate of the inertial sensors [Hz].
        filter_period_s: Period of the filter and of the star tracker [s].
        latitude_deg: Geodetic latitude of the launch point [deg]; sets the radius of the Earth,
            that of the meridian's curvature.
        gyro_noise_deg_h: Nominal standard deviation ``wgt0`` of one gyro sample [deg/h].
        accel_noise_ug: Nominal standard deviation ``wga0`` of an accelerometer sample [micro g].
        accel_error_ug: Standard deviation of the Markov error of the accelerometers [micro g].
        accel_error_time_s: Correlation time of that error [s].
        star_noise_arcsec: Standard deviation of the star tracker, each axis [arcsec].
        p0_attitude_arcsec: Prior standard deviation of the attitude, each axis [arcsec].
        p0_velocity: Prior standard deviation of the velocity [m/s].
        p0_position: Prior standard deviation of the position [m].
        p0_drift_deg_h: Prior standard deviation of the gyro drift [deg/h].
        misalignment_deg: Size of the initial attitude error of "large-misalignment" [deg]; its
            direction is drawn, and P0 has the same mean square.
        settle_s: Start of the part of "large-misalignment" that the RMSE is taken over [s]; the
            other scenarios take the whole flight.
        models: Number of models in a bank.
        model_range: Lowest and highest factor of the models on both nominal deviations.
        reset_period_s: Period T of the assessment of IMMAE-UKF [s].
        reset_threshold: Threshold of that assessment in (0, 1].
        switching: Probability per filter period that the model of IMM-UKF changes.
        alpha: Spread of the unscented rule.
        beta: Second parameter of the unscented rule.
        kappa: Third parameter of the unscented rule, above -15.
        cost: Whether to time each method on its own.
    """

    scenario: Literal["paper", "reversed", "large-misalignment", "all"] = "paper"
    runs: Runs = 100
    seed: Seed = 0
    star: Literal["rotation-vector", "euler"] | None = None
    duration_s: Positive = 300.0
    ins_rate_hz: Positive = 100.0
    filter_period_s: Positive = 0.05
    latitude_deg: Latitude = 40.0
    gyro_noise_deg_h: Positive = 20.0
    accel_noise_ug: Positive = 50.0
    accel_error_ug: Positive = 50.0
    accel_error_time_s: Positive = 300.0
    star_noise_arcsec: Positive = 5.0
    p0_attitude_arcsec: Positive = 10.0
    p0_velocity: Positive = 0.1
    p0_position: Positive = 5.0
    p0_drift_deg_h: Positive = 0.5
    misalignment_deg: Annotated[float, Meta(gt=0, le=90)] = 20.0
    settle_s: NotNegative = 10.0
    models: Count = 10
    model_range: tuple[Positive, Positive] = (0.25, 4.0)
    reset_period_s: Positive = 10.0
    reset_threshold: Share = 0.3
    switching: Probability = 1e-3
    alpha: float = 1.0
    beta: float = 2.0
    kappa: Annotated[float, Meta(gt=-STATES)] = 0.0
    cost: bool = True

    def __post_init__(self) -> None:
        """Refuse values that mean nothing.

        Raises:
            ConfigError: With one sentence naming the field, its value and what is accepted.
        """
        check_fields(self)
        require_flight_times(self)
        require_reset(self, self.filter_period_s)
        scored = self.scenario in ("large-misalignment", "all")
        require(
            not scored or self.settle_s < self.duration_s,
            "settle_s",
            self.settle_s,
            f"between 0 and the flight time of {self.duration_s} s",
        )
        require(
            self.duration_s < LONGEST_S,
            "duration_s",
            self.duration_s,
            f"below {LONGEST_S:g} s, when the vehicle has no mass left",
        )
        # Beyond half a turn the sigma points would come round the other side.
        reach = abs(self.alpha) * (STATES + self.kappa) ** 0.5 * self.misalignment_deg
        require(
            not scored or reach < 180 * 3**0.5,
            "misalignment_deg",
            self.misalignment_deg,
            "so small that the sigma points stay within half a turn",
        )
        require(
            self.model_range[0] < self.model_range[1],
            "model_range",
            self.model_range,
            "a lower and a higher factor",
        )
        require(self.alpha != 0, "alpha", self.alpha, "other than zero")

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
    def schedule(self) -> tuple[float, float, float]:
        """True factors on the nominal deviations in the three thirds."""
        return (2.0, 1.0, 0.5) if self.scenario == "reversed" else (0.5, 1.0, 2.0)

    @property
    def star_form(self) -> Literal["rotation-vector", "euler"]:
        """How the star tracker's attitude is observed."""
        if self.star is not None:
            return self.star
        return "euler" if self.scenario == "large-misalignment" else "rotation-vector"

    @property
    def scored_from(self) -> int:
        """First step, counted from 0, of the part that the RMSE is taken over."""
        if self.scenario != "large-misalignment":
            return 0
        return min(round(self.settle_s / self.filter_period_s), self.steps - 1)


LONGEST_S = 465.0
"""Flight time at which the default vehicle has burnt all of its mass [s]."""
