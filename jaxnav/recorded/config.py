"""What `jaxnav filter` may be told, free of JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from jaxnav.config import (
    ConfigError,
    Count,
    Names,
    Positive,
    Positives,
    Probability,
    Seed,
    Share,
    check_fields,
    near,
    require,
)

ALIASES = {
    "liekf": "ekf",
    "se23-ekf": "ekf",
    "versoria-ekf": "versoria(ekf)",
    "sage-husa-ekf": "sage_husa(ekf)",
    "iae": "innovation_adaptive(ekf)",
}
"""Short names of filters; the first two have a definition of the error of their own."""
RuleName = Literal["floor", "bayes", "fixed", "forget", "markov", "penalty"]
When = Literal["auto", "on", "off"]


@dataclass(frozen=True)
class FilterConfig:
    """A recorded drive through a filter, or a bank of them.

    The members of a bank are the product of r_factors, q_factors and forgetting. The noise
    of the inertial sensors is far above a data sheet's: a car shakes them, and what their scale,
    axes and clock are off by acts like noise on the move. The defaults are near the likeliest on
    the recorded drive with RTK, whose sensors at rest have 0.0038 deg/s and 70 ug.

    Attributes:
        config: TOML file with these names; flags go before it.
        filter: The filter, or the members of the bank: any of `jaxnav list`, in wrappers as
            sage_husa(versoria(ekf)), or one of the short names liekf (left-invariant errors),
            se23-ekf (right-invariant ones), versoria-ekf, sage-husa-ekf and iae. With --from FILE
            also those of a Python file of your own.
        r_factors: Factors on the variances of the receiver, a member each.
        q_factors: Factors on the process noise, a member each.
        forgetting: Forgetting factors of sage_husa, a member each.
        rule: How a bank weighs its members; floor is Bayes' rule with a floor, and forget and
            markov are before Bayes' rule too.
        weight_floor: Least weight of a member under floor.
        rule_time_s: Time in which evidence fades by e under forget, or between switches (markov).
        gyro_noise_dps: Noise density of the gyros [deg/s/sqrt(Hz)].
        accel_noise_ug: Noise density of the accelerometers [ug/sqrt(Hz)].
        gyro_walk_dps: Random walk of the gyro drift [deg/s/sqrt(s)].
        accel_walk_ug: Random walk of the accelerometer bias [ug/sqrt(s)].
        position_sigma_m: Least standard deviation of a fix, an axis; larger ones of the log count.
        velocity_sigma: Least standard deviation of a velocity [m/s], an axis; likewise.
        time_offset_s: Added to the times of the fixes: the clock of the receiver against that of
            the inertial sensors.
        tune_offset: Whether to look for the likeliest offset, from there, and to use it.
        rate_hz: Rate of the filter; by default that of the inertial samples.
        constraints: Whether to observe that the vehicle does not move sideways or upwards, and
            rests at detected stops.
        steered_sigma: Standard deviation of the lateral and vertical velocity [m/s].
        steered_rate_hz: How often they are observed: errors of a car last longer than a sample.
        rest_sigma: Standard deviation of the velocity at a stop [m/s].
        rest_speed: Speed by the filter at which a stop is doubted: a smooth road feels like one
            [m/s].
        axle_m: From the inertial sensors to the middle of the rear axle: forward, left, up [m].
        mounting_deg: Rotation vector from the sensors' axes to the vehicle's [deg]; by default from
            the direction of motion in the first minute, by a run without the constraints.
        stop_gyro_dps: Angular rate that a stopped vehicle stays below [deg/s].
        stop_accel: Standard deviation of the specific force that it stays below [m/s^2].
        stop_time_s: For so long; both of means over 0.2 s.
        carry: States to find besides, with what is known before (one sigma): lever-arm (0.5 m),
            mounting (3 deg), time-offset (0.05 s), gyro-scale and accel-scale (0.5 %),
            position-error (1 m, over 60 s), which fixes have beside their noise.
        gate: Whether fixes that contradict the filter are refused, and named.
        gate_false_alarm: Probability to refuse a position or a velocity though the filter is right.
        gate_patience: Refusals in a row over which the gate opens by e, in squares.
        point: Which point the trajectory that is written is of: the inertial sensors, the antenna
            (where the filter finds it, if its lever arm is carried) or the rear axle.
        strict: Whether a fault that the audit finds makes the exit code 4.
        align_speed: Speed at which the course gives the heading, and the filter starts [m/s].
        outages: Whether to hide the fixes in windows and score against them; auto does if most
            fixes are RTK-fixed.
        outage_s: Length of a window.
        outage_every_s: From the start of a window to that of the next.
        added_noise: Whether to compare filters and banks on fixes with noise added.
        noise_start_s: Where the spans of added noise start, seconds since the first sample.
        noise_end_s: Where they end.
        noise_sigma_m: Standard deviation of the noise east and north in each span.
        noise_runs: Draws of the noise.
        noise_rate_hz: Rate of the filters in that comparison, and in the search for the offset.
        seed: Seed of the draws.
    """

    config: Path | None = None
    filter: str = "ekf"
    r_factors: Positives = (1.0,)
    q_factors: Positives = (1.0,)
    forgetting: Annotated[tuple[Share, ...], Meta(min_length=1)] = (0.97,)
    rule: RuleName = "floor"
    weight_floor: Positive = 1e-3
    rule_time_s: Positive = 10.0
    gyro_noise_dps: Positive = 0.1
    accel_noise_ug: Positive = 2000.0
    gyro_walk_dps: Positive = 0.002
    accel_walk_ug: Positive = 100.0
    position_sigma_m: Positive = 0.03
    velocity_sigma: Positive = 0.08
    time_offset_s: float = 0.0
    tune_offset: bool = False
    rate_hz: Positive | None = None
    constraints: bool = True
    steered_sigma: Positive = 0.25
    steered_rate_hz: Positive = 10.0
    rest_sigma: Positive = 0.05
    rest_speed: Positive = 1.0
    axle_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mounting_deg: tuple[float, float, float] | None = None
    stop_gyro_dps: Positive = 0.8
    stop_accel: Positive = 0.06
    stop_time_s: Positive = 2.0
    carry: Names = ()
    gate: bool = True
    gate_false_alarm: Probability = 1e-9
    gate_patience: Positive = 5.0
    point: Literal["sensors", "antenna", "axle"] = "sensors"
    strict: bool = False
    align_speed: Positive = 3.0
    outages: When = "auto"
    outage_s: Positive = 15.0
    outage_every_s: Positive = 35.0
    added_noise: bool = False
    noise_start_s: tuple[float, ...] = (120.0, 320.0)
    noise_end_s: tuple[float, ...] = (220.0, 420.0)
    noise_sigma_m: Positives = (6.0, 9.0)
    noise_runs: Count = 10
    noise_rate_hz: Positive = 10.0
    seed: Seed = 0

    def __post_init__(self) -> None:
        """Refuse values that mean nothing.

        Raises:
            ConfigError: With one sentence naming the field, its value and what is accepted.
        """
        check_fields(self)
        count = members(self)
        accepted = f"positive and below the equal weight of the {count} members"
        require(self.weight_floor < 1 / count, "weight_floor", self.weight_floor, accepted)
        accepted = f"above outage_s, which is {self.outage_s}"
        above = self.outage_every_s > self.outage_s
        require(above, "outage_every_s", self.outage_every_s, accepted)
        _check_spans(self)


ALONE: dict[str, Any] = {
    "filter": "ekf",
    "constraints": False,
    "gate": False,
    "carry": (),
    "r_factors": (1.0,),
    "q_factors": (1.0,),
}
"""A configuration's fields for one filter that knows the receiver and nothing else."""


def check(config: FilterConfig) -> None:
    """Hold a configuration against the filters that there are.

    Raises:
        ConfigError: If there is no such filter, or it has no use for what is given.
    """
    require(
        len(config.forgetting) == 1 or "sage_husa" in parts_of(config.filter),
        "forgetting",
        config.forgetting,
        f"one factor for {config.filter}; several make a bank of sage_husa(...)",
    )
    _check_carry(config)


def parts_of(name: str) -> tuple[str, ...]:
    """Return the wrappers and the filter that a name stands for, outermost first.

    Raises:
        ConfigError: If there is no such filter.
    """
    from jaxnav.estimation.register import chain_of

    try:
        return chain_of(ALIASES.get(name, name))
    except ValueError as error:
        short = ", ".join(ALIASES)
        raise ConfigError(f"{error}; or a short name: {short}") from None


def members(config: FilterConfig) -> int:
    """Return how many filters run: one, or the members of the bank."""
    return len(config.r_factors) * len(config.q_factors) * len(config.forgetting)


def _check_carry(config: FilterConfig) -> None:
    from jaxnav.recorded.carry import CARRIES

    for name in config.carry:
        if name not in CARRIES:
            raise ConfigError(f"carry is {name}{near(name, CARRIES)}")
    once = len(set(config.carry)) == len(config.carry)
    require(once, "carry", ", ".join(config.carry), "each state once")
    seen = config.constraints or "mounting" not in config.carry
    require(seen, "carry", "mounting", "left out without the constraints, which alone show it")


def _check_spans(config: FilterConfig) -> None:
    count = len(config.noise_sigma_m)
    for name in ("noise_start_s", "noise_end_s"):
        value = getattr(config, name)
        require(len(value) == count, name, value, f"{count} numbers, as in noise_sigma_m")
    ordered = zip(config.noise_start_s, config.noise_end_s, strict=True)
    require(
        all(0 <= start < end for start, end in ordered),
        "noise_end_s",
        config.noise_end_s,
        f"after noise_start_s, which is {config.noise_start_s} and not negative",
    )
