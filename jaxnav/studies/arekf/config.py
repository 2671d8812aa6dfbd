"""Configuration of the study ``arekf``: what the paper prints, and what it leaves open."""

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from jaxnav.config import (
    NotNegative,
    Positive,
    PositiveAxes,
    Positives,
    Runs,
    Seed,
    check_fields,
    require,
    require_different,
)

SCENARIOS = {
    "noise-drift": "the inertial noise is a few times what the filters were told",
    "bias-dominated": "the same with a sensor whose bias limits the filter",
    "r-sweep": "an extended filter told too little and too much noise of the fixes",
    "outliers": "known inertial noise, some fixes with ten times their noise",
    "large-heading-error": "known inertial noise, heading at launch wrong by tens of degrees",
}
DRIFTING = ("noise-drift", "bias-dominated")
"""Scenarios that are run for each storage drift factor."""


@dataclass(frozen=True)
class Sensor:
    """Grade of an inertial sensor with its receiver, in the units of data sheets.

    Attributes:
        arw: Angle random walk [deg/sqrt(h)].
        vrw: Velocity random walk [m/s/sqrt(h)].
        drift: Standard deviation of the gyro drift after alignment [deg/h].
        bias: Standard deviation of the accelerometer bias after alignment [mg].
        velocity: Standard deviation of a GNSS velocity [m/s].
    """

    arw: float
    vrw: float
    drift: float
    bias: float
    velocity: float


NOISY = Sensor(arw=2.0, vrw=0.6, drift=1.0, bias=0.2, velocity=0.05)
BIASED = Sensor(arw=0.2, vrw=0.05, drift=10.0, bias=1.0, velocity=0.1)
SENSORS = {
    "noise-drift": NOISY,
    "bias-dominated": BIASED,
    "r-sweep": BIASED,
    "outliers": BIASED,
    "large-heading-error": BIASED,
}


@dataclass(frozen=True)
class ArekfConfig:
    """A MEMS-SINS/GNSS on a short flight whose filters were given the wrong noise (Yang et al.).

    The paper's tables are not available: sensors, receiver and flight are ours. The true noise is
    that of the scenario's sensor, and the filters were given it divided by the storage drift
    factor. Initial errors and biases are drawn from P0.

    Attributes:
        scenario: Scenario to run; "all" runs the five.
        runs: Monte Carlo runs.
        seed: Root seed; run i is the same for any number of runs.
        duration_s: Time of flight [s].
        align_s: Time at rest before it, from which the noise is identified [s].
        ins_rate_hz: Output rate of the inertial sensors [Hz].
        gnss_rate_hz: Rate of the fixes [Hz].
        filter_period_s: Period of the filters [s].
        factors: Storage drift factors, of "noise-drift" and "bias-dominated"; also the grid of the
            bank.
        reported: The factor whose figures stand in the tables.
        arw_deg_sqrt_h: True angle random walk; the default is the scenario's.
        vrw_m_s_sqrt_h: True velocity random walk; the default is the scenario's.
        gyro_drift_deg_h: Standard deviation of the gyro drift; the default is the scenario's.
        accel_bias_mg: Standard deviation of the accelerometer bias; the default is the scenario's.
        gnss_velocity: Standard deviation of a GNSS velocity [m/s]; the default is the scenario's.
        gnss_position: Standard deviation of a GNSS position [m].
        p0_attitude_deg: Standard deviation of the attitude at launch about east, north, up [deg].
        p0_velocity: Standard deviation of the velocity at launch [m/s].
        p0_position: Standard deviation of the position at launch [m].
        heading_deg: Standard deviation of the heading in "large-heading-error" [deg].
        settle_s: Time of flight from which "large-heading-error" is scored [s].
        outlier_share: Share of the fixes that are outliers in "outliers".
        outlier_scale: Factor on the noise of an outlier.
        r_factors: Factors on the standard deviations that the EKF of "r-sweep" believes.
        versoria_width: Width ``tau`` of the Versoria weights.
        versoria_power: Power ``p`` of the Versoria weights.
        iae_memory: Memory of the innovation-based adaptation [updates].
        analysis: Whether to draw the map over factor, sensor and duration.
        cost: Whether to time each method on its own.
    """

    scenario: Literal[
        "noise-drift", "bias-dominated", "r-sweep", "outliers", "large-heading-error", "all"
    ] = "noise-drift"
    runs: Runs = 150
    seed: Seed = 0
    duration_s: Positive = 120.0
    align_s: Positive = 60.0
    ins_rate_hz: Positive = 400.0
    gnss_rate_hz: Positive = 10.0
    filter_period_s: Positive = 0.1
    factors: Positives = (1.0, 2.0, 3.0, 5.0, 10.0, 20.0)
    reported: Positive = 10.0
    arw_deg_sqrt_h: Positive | None = None
    vrw_m_s_sqrt_h: Positive | None = None
    gyro_drift_deg_h: Positive | None = None
    accel_bias_mg: Positive | None = None
    gnss_velocity: Positive | None = None
    gnss_position: Positive = 3.0
    p0_attitude_deg: PositiveAxes = (0.1, 0.1, 0.5)
    p0_velocity: Positive = 0.1
    p0_position: Positive = 3.0
    heading_deg: Annotated[float, Meta(gt=0, le=90)] = 60.0
    settle_s: NotNegative = 10.0
    outlier_share: Annotated[float, Meta(ge=0, lt=0.5)] = 0.05
    outlier_scale: Positive = 10.0
    r_factors: Positives = (0.01, 0.1, 0.3, 1.0, 3.0, 10.0, 100.0)
    versoria_width: NotNegative = 0.05
    versoria_power: Positive = 2.0
    iae_memory: Annotated[float, Meta(ge=1)] = 20.0
    analysis: bool = True
    cost: bool = True

    def __post_init__(self) -> None:
        """Refuse values that mean nothing.

        Raises:
            ConfigError: With one sentence naming the field, its value and what is accepted.
        """
        check_fields(self)
        self._require_rates()
        require_different(self, "factors", "r_factors")
        for name in ("factors", "r_factors"):
            value = getattr(self, name)
            require(1.0 in value, name, value, "such that one of them is 1")
        require(self.reported in self.factors, "reported", self.reported, "one of the factors")
        require(
            self.settle_s < self.duration_s,
            "settle_s",
            self.settle_s,
            f"zero or more, and below the duration of {self.duration_s:g} s",
        )

    def _require_rates(self) -> None:
        """Require that rates and durations are whole numbers of each other's periods."""
        for name, whole, part in (
            ("filter_period_s", self.filter_period_s * self.ins_rate_hz, "inertial samples"),
            ("gnss_rate_hz", 1 / (self.gnss_rate_hz * self.filter_period_s), "filter steps a fix"),
            ("duration_s", self.duration_s / RECORD_S, f"records, one every {RECORD_S:g} s"),
            ("filter_period_s", RECORD_S / self.filter_period_s, "filter steps a record"),
            ("gnss_rate_hz", RECORD_S * self.gnss_rate_hz, f"fixes a record of {RECORD_S:g} s"),
        ):
            fits = whole >= 1 - 1e-9 and abs(whole - round(whole)) < 1e-6
            require(fits, name, getattr(self, name), f"such that there is a whole number of {part}")
        require(
            self.duration_s <= LANDED_S,
            "duration_s",
            self.duration_s,
            f"at most {LANDED_S:g} s, before the vehicle is back at the ground",
        )
        require(
            self.align_s * self.ins_rate_hz >= LEAST_SAMPLES,
            "align_s",
            self.align_s,
            f"at least {LEAST_SAMPLES / self.ins_rate_hz:g} s, for the Allan variance",
        )

    @property
    def imu_step(self) -> float:
        """Interval of the inertial samples [s]."""
        return 1 / self.ins_rate_hz

    @property
    def samples_per_step(self) -> int:
        """Inertial samples in a filter period."""
        return round(self.filter_period_s * self.ins_rate_hz)

    @property
    def steps(self) -> int:
        """Number of filter steps."""
        return round(self.duration_s / self.filter_period_s)

    @property
    def steps_per_fix(self) -> int:
        """Filter steps from one fix to the next."""
        return round(1 / (self.gnss_rate_hz * self.filter_period_s))

    @property
    def steps_per_record(self) -> int:
        """Filter steps from one record of the errors to the next."""
        return round(RECORD_S / self.filter_period_s)

    @property
    def static_samples(self) -> int:
        """Inertial samples at rest."""
        return round(self.align_s * self.ins_rate_hz)

    @property
    def sensor(self) -> Sensor:
        """The true sensors."""
        base = SENSORS[self.scenario]
        own = {short: getattr(self, name) for name, short in _OPTIONAL.items()}
        return Sensor(**{n: v if v is not None else getattr(base, n) for n, v in own.items()})


RECORD_S = 0.2
"""Interval at which errors are recorded [s]."""
LANDED_S = 124.0
"""Time of flight until which the default vehicle is well above the ground [s]."""
LEAST_SAMPLES = 512
"""Fewest inertial samples at rest from which noise is identified."""

_OPTIONAL = {
    "arw_deg_sqrt_h": "arw",
    "vrw_m_s_sqrt_h": "vrw",
    "gyro_drift_deg_h": "drift",
    "accel_bias_mg": "bias",
    "gnss_velocity": "velocity",
}
