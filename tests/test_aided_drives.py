"""What further sensors do for a drive whose fixes are hidden, and for a recorded rocket."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from checks import wheel_speed
from jaxnav.compiling import compiled
from jaxnav.estimation.carried import Carried, CarriedParams, carrying, random_walk, with_carried
from jaxnav.estimation.filters.kalman import ekf
from jaxnav.estimation.metrics import chi2_mean_bounds, nees
from jaxnav.estimation.models import ModelParams, Process, observing
from jaxnav.estimation.run import run
from jaxnav.estimation.sampling import measured
from jaxnav.estimation.types import FilterParams, Gaussian
from jaxnav.navigation.atmosphere import pressure_height
from jaxnav.navigation.channels.barometer import Barometer, barometer
from jaxnav.navigation.models.sins_gnss import sins_gnss
from jaxnav.navigation.trajectory.vehicle import town_legs
from tests import town

RUNS, SECONDS, HIDDEN = 40, 150, 60
WALK = 600**-0.5
"""Drift of the barometer's bias [m/sqrt(s)]: a metre in ten minutes."""
CHEAP = town.NOISE._replace(accel_noise=jnp.full(3, 1e-2))
"""Accelerometers of a milligal over a second: 1 mg/sqrt(Hz)."""


def test_a_barometer_holds_the_height_while_fixes_are_hidden() -> None:
    """Vertical error after a minute, root mean square over 40 runs, and the NEES of the state."""
    plain = sins_gnss()
    carry = {"barometer_bias": random_walk(1)}
    aided = observing(sins_gnss(carry=carry), {"barometer": barometer()})

    @compiled
    def one(seed: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        drive = town.driven(seed, town_legs(2), SECONDS, noise=CHEAP)
        steps = len(drive.each_second)
        walk, first, noise = jax.random.split(jax.random.key(seed + 1000), 3)
        drift = WALK * town.CLOCK.step**0.5 * jax.random.normal(walk, (steps, 1))
        bias = 20 * jax.random.normal(first, (1, 1)) + jnp.cumsum(drift, axis=0)
        truth = Carried(drive.sensed.truth, {"barometer_bias": bias})
        params = Barometer(jnp.array(0.3), jnp.array(400.0), jnp.array(0.97))
        heights = measured(noise, barometer(), params, truth, None)
        shown = drive.each_second & (np.arange(steps) < steps - HIDDEN / town.CLOCK.step)
        fixes = {"velocity": drive.fixes[:, :3], "position": drive.fixes[:, 3:]}
        valid = dict.fromkeys(fixes, shown)
        start, inputs = drive.sensed.start, drive.sensed.inputs
        unaided = run(
            ekf(plain),
            FilterParams(CHEAP, start),
            inputs,
            plain.stack(fixes, valid),
            record=lambda state, info: (),
        ).final
        initial = with_carried(start, {"barometer_bias": (jnp.zeros(1), jnp.array([400.0]))})
        own = CarriedParams(CHEAP, {"barometer_bias": jnp.array(WALK)})
        final = run(
            ekf(aided),
            FilterParams(ModelParams(own, {"barometer": params}), initial),
            inputs,
            aided.stack({**fixes, "barometer": heights}, {**valid, "barometer": drive.each_second}),
            record=lambda state, info: (),
        ).final
        estimate: Gaussian = ekf(aided).estimate(final)
        last = jax.tree.map(lambda leaf: leaf[-1], truth)
        error = aided.local(last, estimate.mean)
        alone = plain.local(last.own, ekf(plain).estimate(unaided).mean)
        return alone[8], error[8], nees(error, estimate.cov)

    alone, vertical, squared = jax.vmap(one)(jnp.arange(RUNS))
    assert np.sqrt(np.mean(alone**2)) > 5 * np.sqrt(np.mean(vertical**2))
    low, high = chi2_mean_bounds(16, RUNS)
    assert low < np.mean(squared) < high


ROCKET = Path(__file__).parents[2] / "shared" / "data" / "rocket_hedy"


@pytest.mark.skipif(not ROCKET.exists(), reason="the recorded rocket is not in ../shared/data")
def test_the_barometer_of_a_recorded_rocket_finds_its_apogee() -> None:
    """By a vertical filter, in air taken as the standard one.

    The bias is carried, and known at the start to be the pressure height of the ground.
    """

    def columns(name: str, *which: int) -> np.ndarray:
        return np.genfromtxt(ROCKET / name, delimiter=",", skip_header=1, usecols=which).T

    (time, pressure), own = columns("baro.csv", 0, 3), columns("flightInfo.csv", 0, 1)
    flown = time < 60
    heights = pressure_height(jnp.asarray(pressure[flown]))
    dt = 0.01
    jerked = jnp.array([dt**3 / 6, dt**2 / 2, dt])
    Phi = jnp.array([[1, dt, dt**2 / 2], [0, 1, dt], [0, 0, 1]])
    vertical = Process(lambda p, x, u: Phi @ x, lambda p, x, u: p * jnp.outer(jerked, jerked))
    bias = "barometer_bias"
    model = observing(
        carrying(vertical, {bias: random_walk(1)}, period=dt),
        {"barometer": barometer(lambda x: x.own[0])},
    )
    ground = jnp.mean(heights[:50])
    start = Gaussian(jnp.zeros(3), jnp.diag(jnp.array([0.01, 0.01, 1.0])))
    params = FilterParams(
        ModelParams(
            CarriedParams(jnp.array(100.0**2), {bias: jnp.array(WALK)}),
            {"barometer": Barometer(jnp.array(3.0), jnp.array(0.0), jnp.array(1.0))},
        ),
        with_carried(start, {bias: (ground[None], jnp.array([1.0]))}),
    )
    obs = model.stack({"barometer": heights[:, None]})
    mean = run(ekf(model), params, jnp.zeros(len(heights)), obs).record[0].mean
    height = np.asarray(mean.own[:, 0])
    top = int(np.argmax(height))
    published = np.argmax(own[1])
    assert abs(height[top] - own[1, published]) < 40
    assert abs(time[top] - own[0, published]) < 1.5


SEGMENT = wheel_speed.SEGMENT


@pytest.mark.slow
@pytest.mark.skipif(not SEGMENT.exists(), reason="the recorded segment is not in ../shared/data")
def test_wheel_speeds_halve_the_error_of_a_recorded_drive_without_fixes() -> None:
    """A sample of `checks/wheel_speed.py`; its scale is that of the reference within 2 %."""
    found = wheel_speed.measured(SEGMENT, every_s=20.0)
    assert len(found["windows"]) == 2
    assert found["rms_m"]["wheels too"] < 0.5 * found["rms_m"]["constraints"]
    last = found["windows"][-1]
    assert abs(last["scale"] - found["scale_of_the_reference"]) < 0.02
    assert last["scale_sigma"] < 0.002
