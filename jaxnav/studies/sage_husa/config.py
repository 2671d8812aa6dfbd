"""Configuration of the study ``sage-husa``: what the paper prints, and what it leaves open."""

from dataclasses import dataclass
from itertools import product
from typing import Annotated, Literal

from msgspec import Meta

from jaxnav.config import (
    NotNegative,
    Positive,
    PositiveAxes,
    Positives,
    Probability,
    Runs,
    Seed,
    check_fields,
    require,
    require_different,
)
from jaxnav.studies.base import require_weight_floor

SCENARIOS = {
    "tuned": "noisy accelerometers, and filters that know their noise",
    "mistuned": "accelerometers five times better than the filters believe",
}


@dataclass(frozen=True)
class SageHusaConfig:
    """A vehicle's INS/GNSS, fixes noisier than the filters believe for two times (Song et al.).

    The paper gives sensors, receiver and added noise (Tables 1 and 3), but neither the drive, the
    state, the accelerometers' noise, the rates nor the members of the bank: those are ours. Initial
    errors and biases are drawn from P0.

    Attributes:
        scenario: Scenario to run; "all" runs both.
        runs: Monte Carlo runs.
        seed: Root seed; run i is the same for any number of runs.
        duration_s: Length of the drive [s].
        ins_rate_hz: Output rate of the inertial sensors [Hz].
        fix_interval_s: Interval of the fixes, and period of the filters [s].
        arw_deg_sqrt_h: Angle random walk.
        vrw: True velocity random walk [m/s/sqrt(s)]; the default is the scenario's.
        vrw_believed: What the filters believe it to be [m/s/sqrt(s)].
        gyro_drift_deg_h: Standard deviation of the gyro drift.
        accel_bias_mg: Standard deviation of the accelerometer bias.
        gnss_velocity: Standard deviation of a GNSS velocity [m/s].
        gnss_position: Standard deviation of a GNSS position without added noise [m].
        first_noise_s: Start and end of the first added noise [s].
        second_noise_s: Start and end of the second [s].
        first_noise: Standard deviation that it adds to east and north [m].
        second_noise: Likewise.
        p0_attitude_deg: Standard deviation of the attitude at the start about east, north, up.
        p0_velocity: Standard deviation of the velocity at the start [m/s].
        p0_position: Standard deviation of the position at the start [m].
        forgetting: Forgetting factors of the bank.
        single_forgetting: The one of the single Sage-Husa filter, one of them.
        q_scales: Factors on the accelerometers' part of Q of the bank, 1 among them: the part that
            the paper gives no number for.
        r_scales: Factors on the horizontal position's R of the MMAE, 1 among them.
        prior_count: Samples that the filters' R counts for at the start.
        clamp: Smallest and largest R over the filters' R at the start.
        penalty_scale: Of the penalty ``scale k^exponent``.
        penalty_exponent: Likewise.
        decay_steps: Observations over which the decaying penalty falls by e.
        decay_least: What it falls to.
        weight_floor: Floor on the weights of the banks that have one.
        start_r: R that Experiment 1 starts from over the true one.
    """

    scenario: Literal["tuned", "mistuned", "all"] = "tuned"
    runs: Runs = 100
    seed: Seed = 0
    duration_s: Positive = 3500.0
    ins_rate_hz: Positive = 20.0
    fix_interval_s: Positive = 1.0
    arw_deg_sqrt_h: Positive = 0.2
    vrw: Positive | None = None
    vrw_believed: Positive = 0.05
    gyro_drift_deg_h: Positive = 0.5
    accel_bias_mg: Positive = 10.0
    gnss_velocity: Positive = 0.5
    gnss_position: Positive = 3.0
    first_noise_s: tuple[float, float] = (700.0, 1200.0)
    second_noise_s: tuple[float, float] = (1800.0, 2300.0)
    first_noise: Positive = 6.0
    second_noise: Positive = 9.0
    p0_attitude_deg: PositiveAxes = (0.5, 0.5, 1.0)
    p0_velocity: Positive = 0.5
    p0_position: Positive = 3.0
    forgetting: Annotated[tuple[Probability, ...], Meta(min_length=1)] = (0.95, 0.97, 0.99)
    single_forgetting: Probability = 0.97
    q_scales: Positives = (0.1, 1.0, 10.0)
    r_scales: Positives = (0.5, 1.0, 3.0, 5.0, 10.0)
    prior_count: NotNegative = 10.0
    clamp: tuple[Positive, Positive] = (0.1, 100.0)
    penalty_scale: NotNegative = 0.5
    penalty_exponent: NotNegative = 0.15
    decay_steps: Positive = 1000.0
    decay_least: NotNegative = 0.05
    weight_floor: Positive = 1e-3
    start_r: Positive = 10.0

    def __post_init__(self) -> None:
        """Refuse values that mean nothing.

        Raises:
            ConfigError: With one sentence naming the field, its value and what is accepted.
        """
        check_fields(self)
        self._require_times()
        require_different(self, "forgetting", "q_scales", "r_scales")
        for name in ("q_scales", "r_scales"):
            value = getattr(self, name)
            require(1.0 in value, name, value, "such that one of them is 1")
        require(
            self.single_forgetting in self.forgetting,
            "single_forgetting",
            self.single_forgetting,
            "one of the forgetting factors",
        )
        low, high = self.clamp
        require(low < 1 < high, "clamp", self.clamp, "a number below 1 and one above")
        require_weight_floor(self, len(self.grid))

    def _require_times(self) -> None:
        """Require that the fixes fall on inertial samples, and the intervals into the drive."""
        per_fix = self.fix_interval_s * self.ins_rate_hz
        whole = per_fix >= 1 - 1e-9 and abs(per_fix - round(per_fix)) < 1e-6
        accepted = "such that there is a whole number of inertial samples"
        require(whole, "fix_interval_s", self.fix_interval_s, accepted)
        start, end = self.first_noise_s
        least = WINDOWS_S[-1][1]
        require(
            least <= start < end,
            "first_noise_s",
            self.first_noise_s,
            f"a start and a later end from {least:g} s on, after the intervals of Experiment 1",
        )
        accepted = f"a start and a later end from {end:g} to {self.duration_s:g} s"
        inside = end < self.second_noise_s[0] < self.second_noise_s[1] <= self.duration_s
        require(inside, "second_noise_s", self.second_noise_s, accepted)

    @property
    def samples_per_step(self) -> int:
        """Inertial samples from one fix to the next."""
        return round(self.fix_interval_s * self.ins_rate_hz)

    @property
    def steps(self) -> int:
        """Number of fixes."""
        return int(self.duration_s / self.fix_interval_s + 1e-9)

    @property
    def true_vrw(self) -> float:
        """True velocity random walk [m/s/sqrt(s)]."""
        return VRW[self.scenario] if self.vrw is None else self.vrw

    @property
    def intervals_s(self) -> tuple[tuple[float, float], ...]:
        """The intervals of Table 4: the noisy ones, and the one between them [s]."""
        between = (self.first_noise_s[1], self.second_noise_s[0])
        return (self.first_noise_s, between, self.second_noise_s)

    @property
    def grid(self) -> tuple[tuple[float, float], ...]:
        """Forgetting factor and factor on Q of each member of the bank."""
        return tuple(product(self.forgetting, self.q_scales))


VRW = {"tuned": 0.05, "mistuned": 0.01, "all": 0.05}
"""True velocity random walk of the scenarios [m/s/sqrt(s)]."""
WINDOWS_S = ((0.0, 100.0), (200.0, 300.0), (400.0, 500.0))
"""Intervals of Experiment 1 [s]."""
