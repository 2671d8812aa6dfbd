"""The sounding rocket: its flight against printed values, conservation laws, its increments."""

from functools import cache, partial

import jax
import numpy as np
from oracles import rotations, sins

from jaxnav.compiling import compiled
from jaxnav.navigation.trajectory.base import smooth_step
from jaxnav.navigation.trajectory.rocket import RocketProfile, attitude, axial_force, fly
from jaxnav.units import DEG

RADIUS = 6.371e6
STEP = 0.01


@cache
def flight():
    """Return the default flight of 600 s as NumPy arrays."""
    truth = fly(RocketProfile(), steps=60_000, step=STEP, radius=RADIUS)
    return jax.tree.map(np.asarray, truth)


def test_flights_of_the_specification():
    profiles = [
        RocketProfile(cutoff_time=1e-6),
        RocketProfile(burn_time=110.0, accel_end=40.0, pitch_end=75 * DEG, cutoff_time=1e-6),
    ]
    # Speed at burn-out [km/s], height at 160 s and at apogee [km], time of apogee [s], which is
    # printed to a whole second, once rounded and once truncated.
    printed = [[2.83, 225, 595, 458], [2.12, 185, 327, 338]]
    for profile, expected in zip(profiles, printed, strict=True):
        truth = fly(profile, steps=60_000, step=STEP, radius=RADIUS)
        from_centre = np.asarray(truth.state.position) + np.array([0.0, RADIUS, 0.0])
        height = np.linalg.norm(from_centre, axis=1) - RADIUS
        burn_out = np.asarray(truth.state.velocity)[round(profile.burn_time / STEP)]
        apogee = height.argmax()
        measured = [
            np.linalg.norm(burn_out) / 1e3,
            height[16_000] / 1e3,
            height[apogee] / 1e3,
            apogee * STEP,
        ]
        assert np.all(np.abs(np.subtract(measured, expected)) <= [0.005, 0.5, 0.5, 1.0])


def test_starts_at_rest_on_a_vertical_rail():
    start = jax.tree.map(lambda leaf: leaf[0], flight().state)
    np.testing.assert_array_equal(start.velocity, 0)
    np.testing.assert_array_equal(start.position, 0)
    np.testing.assert_allclose(start.dcm, rotations.dcm(np.pi / 2, 0.0, 0.0), rtol=0, atol=1e-15)
    np.testing.assert_allclose(start.dcm[:, 0], [0, 1, 0], rtol=0, atol=1e-16)


def test_smooth_step_has_two_continuous_derivatives():
    s = np.array([-2.0, -1e-9, 0.0, 1e-6, 0.25, 0.5, 0.75, 1 - 1e-6, 1.0, 1 + 1e-9, 3.0])
    c = np.clip(s, 0, 1)
    first = jax.grad(smooth_step)
    value, slope, curvature = (
        compiled(jax.vmap(f))(s) for f in (smooth_step, first, jax.grad(first))
    )
    np.testing.assert_allclose(value, 10 * c**3 - 15 * c**4 + 6 * c**5, rtol=0, atol=1e-14)
    np.testing.assert_allclose(slope, 30 * c**2 * (1 - c) ** 2, rtol=0, atol=1e-14)
    np.testing.assert_allclose(curvature, 60 * c * (1 - c) * (1 - 2 * c), rtol=0, atol=1e-13)
    outside = (s <= 0) | (s >= 1)
    for derivative in (slope, curvature):
        np.testing.assert_array_equal(np.asarray(derivative)[outside], 0)
    np.testing.assert_array_equal(np.asarray(value)[outside], c[outside])


def test_attitude_is_that_of_the_profile():
    p = RocketProfile()
    time = np.array([0.0, 10.0, 70.0, 130.0, 131.0, 166.0])
    C = np.asarray(compiled(jax.vmap(partial(attitude, p)))(time))
    # Half-way through the pitch-over it has done half; at 166 s the sway is at its quarter period
    # of 60 s and a third, 35 s after the cut-off, and the free motion is fully on.
    phase = 2 * np.pi * 35.0 / 60.0
    expected = [
        [90 * DEG, 0, 0],
        [90 * DEG, 0, 0],
        [85 * DEG, 0, 0],
        [80 * DEG, 0, 0],
        [80 * DEG, 0, 0],
        [80 * DEG + 2 * DEG * np.sin(phase), 2 * DEG * np.cos(phase), 70 * DEG],
    ]
    np.testing.assert_allclose(C, [rotations.dcm(*e) for e in expected], rtol=0, atol=1e-14)


def test_rotation_vectors_compose_to_the_attitudes():
    truth = flight()
    turn = np.array([rotations.exp(v) for v in truth.dtheta[::50]])
    np.testing.assert_allclose(
        truth.state.dcm[:-1:50] @ turn, truth.state.dcm[1::50], rtol=0, atol=3e-15
    )


def test_velocity_increments_add_up_to_the_burn():
    p, truth = RocketProfile(), flight()
    np.testing.assert_array_equal(truth.dvel[:, 1:], 0)
    slope = (p.accel_end - p.accel_start) / p.burn_time
    burn = 0.5 * (p.accel_start + p.accel_end) * p.burn_time
    # Over the cut-off, with s = t / cutoff_time: integrals of 1 - S(s) and of s (1 - S(s)).
    tail = p.cutoff_time * p.accel_end / 2 + p.cutoff_time**2 * slope / 7
    total = np.cumsum(truth.dvel[:, 0])
    np.testing.assert_allclose(total[12_999], burn, rtol=1e-12)
    np.testing.assert_allclose(total[-1], burn + tail, rtol=1e-12)
    np.testing.assert_array_equal(truth.dvel[13_100:], 0)
    force = compiled(partial(axial_force, p))(np.array([0.0, 65.0, 130.0, 130.5, 131.0, 600.0]))
    middle = 0.5 * (p.accel_end + 0.5 * slope)
    np.testing.assert_allclose(force, [18, 31.5, 45, middle, 0, 0], rtol=1e-15)


def test_free_flight_conserves_energy_and_angular_momentum():
    truth = flight()
    v, r = truth.state.velocity[13_100:], truth.state.position[13_100:]
    centre = r + np.array([0.0, RADIUS, 0.0])
    energy = 0.5 * np.sum(v * v, axis=1) - sins.GM / np.linalg.norm(centre, axis=1)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-12)
    momentum = np.cross(centre, v)
    np.testing.assert_allclose(momentum[:, 2], momentum[0, 2], rtol=1e-11)
    np.testing.assert_array_equal(momentum[:, :2], 0)
