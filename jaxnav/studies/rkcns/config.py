"""Configuration of the study ``rkcns``: Table 2 of the paper and what the paper leaves open."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta

from jaxnav.config import Latitude, Positive, PositiveAxes, Runs, Seed, check_fields, require
from jaxnav.studies.base import require_flight_times

SCENARIOS = {
    "listed": "the sensors of Table 2, gyro random walk 0.5 deg/sqrt(h)",
    "inferred": "gyro random walk 0.004 deg/sqrt(h), which the published attitude needs",
    "strong-nonlinearity": "as inferred, position lost at the start, refraction noise 0.1 arcsec",
}

RANDOM_WALK = {"listed": 0.5, "inferred": 0.004, "strong-nonlinearity": 0.004}
REFRACTION_NOISE = {"listed": 3.0, "inferred": 3.0, "strong-nonlinearity": 0.1}
SPREAD = {"listed": 1.0, "inferred": 1.0, "strong-nonlinearity": 1e-3}


@dataclass(frozen=True)
class RkcnsConfig:
    """Starlight refraction and the free-flight constraint aid a SINS/CNS (Shi, Chen, Wang).

    The paper gives neither the trajectory nor the stars, the constants of the refraction model, P0,
    Q or the line search: these are ours. Initial errors, drift and bias are drawn from P0, the
    errors of the launch are carried to the start of the filters by dead reckoning.

    Attributes:
        scenario: Scenario to run; "all" runs the three.
        runs: Monte Carlo runs.
        seed: Root seed; run i is the same for any number of runs.
        duration_s: Time of flight at the end [s].
        start_s: Time of flight at which the filters start [s], after burn-out.
        ins_rate_hz: Output rate of the inertial sensors [Hz].
        filter_period_s: Period of the filters and of the star sensors [s].
        launch_period_s: Period of the dead reckoning from launch to the start [s].
        latitude_deg: Latitude of the launch point [deg].
        sidereal_deg: Local sidereal time at launch [deg].
        azimuth_deg: Direction of flight from north by east [deg].
        year: Julian year that the catalogue is propagated to.
        catalogue: Star table to use instead of the bundled one.
        magnitude_limit: Faintest Hipparcos magnitude that the star sensors see.
        stars: Refracted stars used at an epoch, at most.
        tangent_km: Lowest and highest tangent height of the stars to use [km].
        random_walk_deg_sqrt_h: Angle random walk of the gyros; the default is the scenario's.
        accel_noise_ug_sqrt_hz: Noise density of the accelerometers [micro g/sqrt(Hz)].
        gyro_drift_deg_h: Standard deviation of the constant gyro drift, each axis [deg/h].
        accel_bias_ug: Standard deviation of the constant accelerometer bias, each axis [micro g].
        star_noise_arcsec: Standard deviation of the star tracker, each axis [arcsec].
        refraction_noise_arcsec: Standard deviation of a refraction angle [arcsec]; the default is
            the scenario's.
        density_error: Relative standard deviation of the atmosphere's density, one error a run.
        atmosphere: "fitted" to the traced atmosphere, or the "printed" constants of Eq. (40).
        p0_attitude_arcsec: Standard deviation of the misalignment at launch, x, y, z [arcsec].
        p0_velocity: Standard deviation of the velocity at launch [m/s].
        p0_position: Standard deviation of the position at launch [m].
        lost_km: Standard deviation of the position at the start of "strong-nonlinearity" [km].
        iterations: Gauss-Newton steps of the iterated filters.
        trials: Step lengths that their search tries; 0 takes the full step.
        point_spread: Spread of their points as a factor on that of the prior; the default is the
            scenario's.
        ablations: Whether to run the variations of stars, heights, density and model.
        cost: Whether to time each method on its own.
    """

    scenario: Literal["listed", "inferred", "strong-nonlinearity", "all"] = "listed"
    runs: Runs = 100
    seed: Seed = 0
    duration_s: Positive = 600.0
    start_s: Positive = 160.0
    ins_rate_hz: Positive = 100.0
    filter_period_s: Positive = 1.0
    launch_period_s: Positive = 0.05
    latitude_deg: Latitude = 40.0
    sidereal_deg: float = 0.0
    azimuth_deg: float = 90.0
    year: float = 2025.0
    catalogue: Path | None = None
    magnitude_limit: float = 6.5
    stars: Annotated[int, Meta(ge=0, le=20)] = 3
    tangent_km: tuple[float, float] = (20.0, 25.0)
    random_walk_deg_sqrt_h: Positive | None = None
    accel_noise_ug_sqrt_hz: Positive = 50.0
    gyro_drift_deg_h: Positive = 1.0
    accel_bias_ug: Positive = 100.0
    star_noise_arcsec: Positive = 3.0
    refraction_noise_arcsec: Positive | None = None
    density_error: Annotated[float, Meta(ge=0, lt=0.2)] = 0.0
    atmosphere: Literal["fitted", "printed"] = "fitted"
    p0_attitude_arcsec: PositiveAxes = (10.0, 360.0, 10.0)
    p0_velocity: Positive = 0.1
    p0_position: Positive = 5.0
    lost_km: Positive = 50.0
    iterations: Annotated[int, Meta(ge=1, le=50)] = 3
    trials: Annotated[int, Meta(ge=0, le=30)] = 6
    point_spread: Positive | None = None
    ablations: bool = True
    cost: bool = True

    def __post_init__(self) -> None:
        """Refuse values that mean nothing.

        Raises:
            ConfigError: With one sentence naming the field, its value and what is accepted.
        """
        check_fields(self)
        require_flight_times(self)
        self._require_phases()
        low, high = self.tangent_km
        require(
            0 <= low < high <= TOP_KM,
            "tangent_km",
            self.tangent_km,
            f"a lower and a higher height between the surface, 0, and the top of the atmosphere, "
            f"{TOP_KM:g} km",
        )

    def _require_phases(self) -> None:
        """Require that start, rates and periods divide the flight."""
        for name, whole, part in (
            ("launch_period_s", self.launch_period_s * self.ins_rate_hz, "inertial samples"),
            ("start_s", self.start_s / self.launch_period_s, "launch periods"),
            ("duration_s", (self.duration_s - self.start_s) / self.filter_period_s, "filter steps"),
        ):
            fits = whole >= 1 - 1e-9 and abs(whole - round(whole)) < 1e-6
            place = " from the start of the filters" if name == "duration_s" else ""
            require(fits, name, getattr(self, name), f"a whole number of {part}{place}")
        require(
            self.start_s >= FREE_FLIGHT_S,
            "start_s",
            self.start_s,
            f"at least {FREE_FLIGHT_S:g} s, when the specific force has gone to zero",
        )
        require(
            self.duration_s <= RETURN_S,
            "duration_s",
            self.duration_s,
            f"at most {RETURN_S:g} s, when the vehicle comes back to the atmosphere",
        )

    @property
    def steps(self) -> int:
        """Number of filter steps."""
        return round((self.duration_s - self.start_s) / self.filter_period_s)

    @property
    def samples_per_step(self) -> int:
        """Inertial samples in a filter period."""
        return round(self.filter_period_s * self.ins_rate_hz)

    @property
    def launch_samples(self) -> int:
        """Inertial samples before the filters start."""
        return round(self.start_s * self.ins_rate_hz)

    @property
    def imu_step(self) -> float:
        """Interval of the inertial samples [s]."""
        return 1 / self.ins_rate_hz

    @property
    def random_walk(self) -> float:
        """Angle random walk of the gyros [deg/sqrt(h)]."""
        given = self.random_walk_deg_sqrt_h
        return RANDOM_WALK[self.scenario] if given is None else given

    @property
    def refraction_noise(self) -> float:
        """Standard deviation of a refraction angle [arcsec]."""
        given = self.refraction_noise_arcsec
        return REFRACTION_NOISE[self.scenario] if given is None else given

    @property
    def spread(self) -> float:
        """Spread of the iterated filters' points as a factor on that of the prior."""
        return SPREAD[self.scenario] if self.point_spread is None else self.point_spread

    @property
    def lost(self) -> float:
        """Standard deviation of the position lost at the start [m]."""
        return 1e3 * self.lost_km if self.scenario == "strong-nonlinearity" else 0.0


TOP_KM = 86.0
"""Top of the atmosphere's model [km]."""
FREE_FLIGHT_S = 131.0
"""Time of flight at which the default vehicle's thrust has decayed to zero [s]."""
RETURN_S = 780.0
"""Time of flight until which the default vehicle is above 86 km [s]."""
