"""The boost phase: its equations of motion, pitch programme, forces and perfect increments."""

from functools import cache

import jax
import numpy as np
from oracles import rotations, sins
from oracles.matrices import central_difference

from jaxnav.compiling import compiled
from jaxnav.navigation.strapdown.launch_inertial import mechanise_launch_inertial
from jaxnav.navigation.trajectory.boost import BoostProfile, fly_boost, pitch
from jaxnav.units import ARCSEC, DEG

RADIUS = 6.371e6
STEP = 0.01
P = BoostProfile()


@cache
def flight():
    """Return the default flight of 300 s as NumPy arrays."""
    truth = fly_boost(P, steps=30_000, step=STEP, radius=RADIUS)
    return jax.tree.map(np.asarray, truth)


def slope(y):
    """Return the time derivative of samples at the inner instants, of fourth order in the step."""
    return (8 * (y[3:-1] - y[1:-3]) - (y[4:] - y[:-4])) / (12 * STEP)


def programme(t):
    """Return the pitch by the definition of the C2 step."""
    s = np.clip((t - 10.0) / 100.0, 0, 1)
    return (90.0 - 15.0 * (6 * s**5 - 15 * s**4 + 10 * s**3)) * DEG


def quadratic(t):
    """Return the pitch of Eq. (32) as meant, whose rate jumps at 10 s."""
    s = np.clip((110.0 - t) / 100.0, 0, 1)
    return (75.0 + 15.0 * s**2) * DEG


def test_perfect_increments_reproduce_the_flight():
    truth = flight()
    start = jax.tree.map(lambda leaf: leaf[0], truth.state)
    mechanise = compiled(mechanise_launch_inertial, static_argnames=("step", "every"))
    solution = mechanise(start, truth.dtheta, truth.dvel, STEP, RADIUS, every=5)
    C, v, r = jax.tree.map(lambda leaf: leaf[5::5], truth.state)
    position = np.linalg.norm(solution.state.position - r, axis=1)
    velocity = np.linalg.norm(solution.state.velocity - v, axis=1)
    tilt = np.abs(np.asarray(solution.state.dcm) @ C.transpose(0, 2, 1) - np.eye(3)).max()
    # The midpoint rule's error, of second order in the step (0.32 mm, 0.7 um/s), and rounding.
    assert position.max() < 1e-3
    assert velocity.max() < 2e-6
    assert tilt < 1e-7 * ARCSEC


def test_starts_at_rest_on_a_vertical_pad_with_the_thrust_alone():
    truth = flight()
    np.testing.assert_array_equal(truth.state.velocity[0], 0)
    np.testing.assert_array_equal(truth.state.position[0], 0)
    np.testing.assert_allclose(truth.state.dcm[0], rotations.dcm(np.pi / 2, 0, 0), atol=1e-15)
    # On the pad the accelerometers show the thrust; over 10 ms the mass burns 0.65 kg of 30 t.
    expected = STEP * 480e3 / (30e3 - 64.5 * STEP / 2)
    np.testing.assert_allclose(truth.dvel[0], [expected, 0, 0], rtol=2e-8, atol=1e-16)


def test_pitch_programme_is_c2_and_that_of_the_attitude():
    truth = flight()
    values = np.asarray(pitch(P, truth.time))
    np.testing.assert_allclose(values, programme(truth.time), rtol=0, atol=3e-15)
    np.testing.assert_allclose(
        values[[0, 1_000, 6_000, 11_000, 30_000]],
        np.array([90, 90, 82.5, 75, 75]) * DEG,
        rtol=1e-15,
    )
    np.testing.assert_allclose(
        truth.state.dcm[::1_000], [rotations.dcm(a, 0, 0) for a in values[::1_000]], atol=1e-14
    )
    np.testing.assert_allclose(np.cumsum(truth.dtheta[:, 2]), values[1:] - values[0], atol=1e-13)
    np.testing.assert_array_equal(truth.dtheta[:, :2], 0)

    def bends(f):
        """Return the second derivative 50 ms before and after either end of the turn."""
        at, h = np.array([9.95, 10.05, 109.95, 110.05]), 0.01
        return (f(at + h) - 2 * f(at) + f(at - h)) / h**2

    before, after = bends(lambda t: np.asarray(pitch(P, t))).reshape(2, 2).T
    assert np.abs(after - before).max() < 2e-6
    # The paper's quadratic must fail the same, and its rate by 5.2 mrad/s at the start.
    before, after = bends(quadratic).reshape(2, 2).T
    assert np.abs(after - before).min() > 2e-5
    jumps = np.abs(np.diff(truth.dtheta[:, 2])) / STEP
    assert jumps.max() < 2e-6
    assert np.abs(np.diff(quadratic(truth.time), n=2)).max() / STEP > 5e-3


def test_motion_obeys_the_equations_of_the_paper():
    truth = flight()
    t, v, r = truth.time[2:-2], truth.state.velocity, truth.state.position
    speed = np.linalg.norm(v, axis=1)
    x, y = r[2:-2, 0], r[2:-2, 1]
    theta = programme(t)
    gravity = sins.GM / (x**2 + (RADIUS + y) ** 2)
    drag = 0.5 * 1.225 * np.exp(-y / 7200.0) * 0.5 * speed[2:-2] ** 2
    along = (480e3 - drag) / (30e3 - 64.5 * t) - gravity * np.sin(theta)
    np.testing.assert_allclose(slope(speed), along, rtol=0, atol=1e-8)
    np.testing.assert_allclose(slope(r[:, 0]), speed[2:-2] * np.cos(theta), rtol=0, atol=1e-7)
    np.testing.assert_allclose(slope(r[:, 1]), speed[2:-2] * np.sin(theta), rtol=0, atol=1e-7)
    np.testing.assert_array_equal(v[:, 2], 0)
    np.testing.assert_array_equal(r[:, 2], 0)
    # Drag is there to be seen: at its most it takes a fortieth of the thrust.
    assert 1e4 < drag.max() < 1.5e4


def test_specific_force_is_acceleration_less_gravitation():
    truth = flight()
    acceleration = slope(truth.state.velocity)
    centre = truth.state.position[2:-2] + np.array([0.0, RADIUS, 0.0])
    gravity = -sins.GM * centre / np.linalg.norm(centre, axis=1)[:, None] ** 3
    force = np.einsum("kji,kj->ki", truth.state.dcm[2:-2], acceleration - gravity)
    # Mean of two neighbouring intervals against the value between them: second order in the step.
    mean = (truth.dvel[1:-2] + truth.dvel[2:-1]) / (2 * STEP)
    np.testing.assert_allclose(mean, force, rtol=0, atol=1e-6)
    axial, normal = mean[:, 0], mean[:, 1]
    assert axial.min() > 15.9
    assert axial.max() < 46
    assert np.abs(normal).max() < 3
    np.testing.assert_array_equal(truth.dvel[:, 2], 0)


def test_energy_gained_is_the_work_of_the_specific_force():
    truth = flight()
    speed = np.linalg.norm(truth.state.velocity, axis=1)
    centre = truth.state.position + np.array([0.0, RADIUS, 0.0])
    energy = 0.5 * speed**2 - sins.GM / np.linalg.norm(centre, axis=1)
    work = np.cumsum(truth.dvel[:, 0] * (speed[1:] + speed[:-1]) / 2)
    # 16.8 MJ/kg in all; the trapezium's error is of second order in the step.
    np.testing.assert_allclose(energy[1:] - energy[0], work, rtol=0, atol=0.01)
    assert 1.6e7 < work[-1] < 1.75e7


def test_flight_differentiates_by_its_profile():
    def last(values):
        truth = fly_boost(BoostProfile(*values), steps=40, step=2.5, radius=RADIUS)
        return truth.state.velocity[-1], truth.state.position[-1], truth.dvel[-1]

    values = np.array(P)
    # One relative direction through all ten numbers, both ways.
    direction = values * np.linspace(0.5, -1.0, len(values))

    fly = compiled(last)
    slopes = compiled(lambda a: jax.jvp(last, (a,), (direction,))[1])(values)
    for k, of in enumerate(slopes):
        numeric = central_difference(lambda a, k=k: np.asarray(fly(a)[k]), values, direction, 1e-4)
        np.testing.assert_allclose(of, numeric, rtol=1e-7, atol=1e-9)
    gradient = compiled(jax.grad(lambda a: last(a)[1][1]))(values)
    assert np.all(np.isfinite(gradient))
    np.testing.assert_allclose(gradient @ direction, slopes[1][1], rtol=1e-11)
