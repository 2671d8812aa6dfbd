"""The trajectory of the antenna or the axle, from that of the inertial sensors."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.navigation.earth import displaced, offset_between
from jaxnav.navigation.states import STATES, SinsLevel, error_form
from jaxnav.recorded.analysis import Report, analyse
from jaxnav.recorded.methods import Kept
from tests.test_recorded import QUIET, RATE, simulated

ARM = (-1.5, 0.4, -0.6)
BASE = replace(QUIET, constraints=False, outages="off", axle_m=ARM)
LEVER = np.array([0.8, -0.3, 1.1])
SAMPLES = 20_000


def moving(x: SinsLevel, arm: jax.Array) -> tuple[jax.Array, jax.Array]:
    """True velocity and position of a point, by differences of where it is."""
    offset = x.dcm @ arm
    swung = jnp.asarray(jnp.gradient(offset, 1 / RATE, axis=0))
    return x.velocity + swung, jax.vmap(displaced)(x.position, offset)


@cache
def report(point: str, *carry: str) -> Report:
    """The simulated drive with its antenna on an arm, the trajectory written at a point."""
    log, truth = simulated()
    velocity, position = moving(truth, jnp.array(LEVER))
    rng = np.random.default_rng(8)
    at = np.arange(len(log.fixes.time_ns)) * (RATE // 5)
    off = jnp.array(0.02 * rng.normal(size=(len(at), 3)))
    fixes = log.fixes._replace(
        geodetic=np.asarray(jax.vmap(displaced)(position[at], off)),
        velocity=np.asarray(velocity)[at] + 0.05 * rng.normal(size=off.shape),
    )
    log = log._replace(lever_arm=LEVER, fixes=fixes)
    return analyse(log, replace(BASE, point=point, carry=carry))


def metres(a: Kept, b: Kept) -> np.ndarray:
    """East, north, up from the positions of one run to those of another."""
    return np.asarray(jax.vmap(offset_between)(a.mean.position, b.mean.position))


@pytest.mark.parametrize(("point", "arm"), [("antenna", LEVER), ("axle", np.array(ARM))])
def test_a_point_is_on_its_arm_and_where_it_truly_is(point: str, arm: np.ndarray) -> None:
    found = report(point)
    sensors, there = found.kept, found.trajectory
    same = report("sensors").trajectory
    np.testing.assert_allclose(sensors.mean.position, same.mean.position, rtol=0, atol=1e-12)
    np.testing.assert_allclose(metres(sensors, there), sensors.mean.dcm @ arm, rtol=0, atol=2e-6)
    np.testing.assert_array_equal(there.sigma[:, :3], sensors.sigma[:, :3])
    velocity, position = moving(simulated()[1], jnp.array(arm))
    step = np.rint(found.drive.time * RATE).astype(int)
    off = np.asarray(jax.vmap(offset_between)(position[step], there.mean.position))
    slip = np.asarray(there.mean.velocity) - np.asarray(velocity)[step]
    settled = found.drive.time > 40
    for error, sigma in ((slip, there.sigma[:, 3:6]), (off, there.sigma[:, 6:9])):
        normalised = (error / np.asarray(sigma))[settled]
        assert np.sqrt(np.mean(normalised**2)) < 1.6
    wrong = np.asarray(sensors.mean.velocity) - np.asarray(velocity)[step]
    assert np.sqrt(np.mean(slip[settled] ** 2)) < 0.5 * np.sqrt(np.mean(wrong[settled] ** 2))


@pytest.mark.parametrize("carry", [(), ("accel-scale", "lever-arm", "time-offset")])
def test_what_is_not_known_of_attitude_drift_and_arm_counts(carry: tuple[str, ...]) -> None:
    """Standard deviations against those of points drawn from the whole covariance."""
    found = report("antenna", *carry)
    kept, there = found.kept, found.trajectory
    k = 3000
    cov = np.asarray(kept.cov[k])
    # The state comes first, then what is carried by name: accel_scale, lever_arm, time_offset.
    assert cov.shape[0] == STATES + (7 if carry else 0)
    draws = np.random.default_rng(0).multivariate_normal(
        np.zeros(len(cov)), cov, SAMPLES, method="eigh"
    )
    x = SinsLevel(*(leaf[k] for leaf in kept.mean))
    arm = kept.carried["lever_arm"][k] if carry else jnp.array(LEVER)
    rate = found.drive.inputs.inertial.rate[k]
    form = error_form("additive", jnp.zeros(3))

    def motion(x: SinsLevel, arm: jax.Array) -> tuple[jax.Array, jax.Array]:
        # Earth rate times the arm is 1e-4 m/s, and nearly the same in all draws.
        v = x.velocity + x.dcm @ jnp.cross(rate - x.drift, arm)
        return v, displaced(x.position, x.dcm @ arm)

    def drawn(d: jax.Array) -> jax.Array:
        own = d[STATES + 3 : STATES + 6] if carry else jnp.zeros(3)
        v, p = motion(form.retract(x, d[:STATES]), arm + own)
        return jnp.concatenate([v, offset_between(motion(x, arm)[1], p)])

    spread = np.std(np.asarray(jax.vmap(drawn)(jnp.array(draws))), axis=0)
    np.testing.assert_allclose(there.sigma[k, 3:9], spread, rtol=5 / (2 * SAMPLES) ** 0.5)


def test_the_run_keeps_no_covariances_it_does_not_need() -> None:
    found = report("sensors")
    assert found.kept.cov.shape[1:] == (0, 0)
    assert found.trajectory is found.kept
    assert found.document["config"]["point"] == "sensors"
