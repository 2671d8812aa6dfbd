"""Strapdown mechanisation: perfect increments, rotation compensation, the error model."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.compiling import compiled
from jaxnav.navigation.models.sins_cns import SinsCnsParams, inputs_from_solution, sins_cns
from jaxnav.navigation.states import LAYOUT
from jaxnav.navigation.strapdown.base import NavState
from jaxnav.navigation.strapdown.increments import rotation_compensated
from jaxnav.navigation.strapdown.launch_inertial import NavSolution, mechanise_launch_inertial
from jaxnav.navigation.trajectory.rocket import RocketProfile, fly
from jaxnav.numerics.lie import so3_exp, so3_local
from jaxnav.units import ARCSEC

RADIUS = 6.371e6
STEP = 0.01
mechanise = compiled(mechanise_launch_inertial, static_argnames=("step", "every"))
tilts = compiled(jax.vmap(so3_local))


@cache
def flight():
    """Return the default flight of 600 s as NumPy arrays."""
    truth = fly(RocketProfile(), steps=60_000, step=STEP, radius=RADIUS)
    return jax.tree.map(np.asarray, truth)


def at(state, index):
    return jax.tree.map(lambda leaf: leaf[index], state)


def test_perfect_increments_reproduce_the_flight():
    truth = flight()
    start = at(truth.state, 0)
    solution = mechanise(start, truth.dtheta, truth.dvel, STEP, RADIUS, every=5)
    true = at(truth.state, slice(5, None, 5))
    C = np.asarray(solution.state.dcm)
    position = np.linalg.norm(solution.state.position - true.position, axis=1)
    velocity = np.linalg.norm(solution.state.velocity - true.velocity, axis=1)
    tilt = np.linalg.norm(tilts(C, true.dcm), axis=1)
    assert position.max() < 1.0
    assert tilt.max() < 0.01 * ARCSEC
    # The midpoint rule's error, of second order in the step, and rounding.
    assert position.max() < 1e-3
    assert velocity.max() < 2e-6
    assert tilt.max() < 1e-7 * ARCSEC
    assert np.abs(C @ C.transpose(0, 2, 1) - np.eye(3)).max() < 1e-12


def test_velocity_increment_turns_with_the_body():
    dtheta, dvel = np.array([0.01, 0.0, -0.01]), np.array([0.0, 0.0, 0.1])
    turned = compiled(rotation_compensated)(dtheta, dvel)
    np.testing.assert_allclose(turned, [0.0, -0.5e-3, 0.1], rtol=1e-15, atol=1e-18)


def test_periods_group_the_same_steps():
    truth = flight()
    start = at(truth.state, 12_000)
    dtheta, dvel = truth.dtheta[12_000:12_020], truth.dvel[12_000:12_020]
    single = mechanise(start, dtheta, dvel, STEP, RADIUS)
    grouped = mechanise(start, dtheta, dvel, STEP, RADIUS, every=5)
    for one, five in zip(at(single.state, slice(4, None, 5)), grouped.state, strict=True):
        np.testing.assert_allclose(five, one, rtol=1e-15, atol=1e-15)
    total = np.asarray(single.specific_velocity).reshape(4, 5, 3).sum(axis=1)
    np.testing.assert_allclose(grouped.specific_velocity, total, rtol=1e-14, atol=1e-15)


def test_increments_must_divide_into_periods():
    start = NavState(jnp.eye(3), jnp.zeros(3), jnp.zeros(3))
    with pytest.raises(ValueError, match="7 increments do not divide into periods of 5"):
        mechanise_launch_inertial(start, jnp.zeros((7, 3)), jnp.zeros((7, 3)), STEP, RADIUS, 5)


def mechanised_errors(truth, small):
    """Return the errors ``(15, 15)`` after the flight, column j from a start or sensor error j.

    The central difference of runs with errors of both signs, divided by the size of the error.
    """
    start = at(truth.state, 0)
    s = LAYOUT

    def run(error):
        disturbed = NavState(
            so3_exp(error[s.phi]) @ start.dcm,
            start.velocity + error[s.dv],
            start.position + error[s.dr],
        )
        dtheta = truth.dtheta + STEP * error[s.eps][None]
        dvel = truth.dvel + STEP * error[s.nabla][None]
        return at(mechanise_launch_inertial(disturbed, dtheta, dvel, STEP, RADIUS).state, -1)

    def column(error):
        plus, minus = run(error), run(-error)
        phi = so3_local(minus.dcm, plus.dcm)
        dv, dr = plus.velocity - minus.velocity, plus.position - minus.position
        return jnp.concatenate([0.5 * phi, 0.5 * dv, 0.5 * dr, error[s.eps], error[s.nabla]])

    return jax.vmap(column, out_axes=1)(jnp.diag(small)) / small[None]


def modelled_errors(truth, every):
    """Return the product ``(15, 15)`` of the error model's transitions over the flight."""
    gained = jax.vmap(jnp.matmul)(
        truth.state.dcm[:-1], jax.vmap(rotation_compensated)(truth.dtheta, truth.dvel)
    )
    epochs = at(truth.state, slice(every, None, every))
    solution = NavSolution(epochs, jnp.sum(gained.reshape(-1, every, 3), axis=1))
    scale = jnp.ones(epochs.dcm.shape[0])
    period = every * STEP
    inputs = inputs_from_solution(at(truth.state, 0), solution, period, RADIUS, scale)
    params = SinsCnsParams(jnp.zeros(3), jnp.zeros(3), jnp.zeros(3), jnp.zeros(()))
    transition = partial(sins_cns(period, STEP).transition, params)

    def advance(X, u):
        return jax.vmap(transition, (1, None), 1)(X, u), None

    return jax.lax.scan(advance, jnp.eye(15), inputs)[0]


def test_errors_of_the_mechanisation_follow_the_error_model():
    whole = flight()
    truth = whole._replace(
        time=whole.time[:10_001],
        state=at(whole.state, slice(0, 10_001)),
        dtheta=whole.dtheta[:10_000],
        dvel=whole.dvel[:10_000],
    )
    small = np.repeat([1e-5, 1e-2, 10.0, 1e-7, 1e-4], 3)

    @compiled
    def errors(truth):
        coarse, fine = modelled_errors(truth, 10), modelled_errors(truth, 5)
        return mechanised_errors(truth, small), coarse, fine

    mechanised, coarse, fine = map(np.asarray, errors(truth))
    # Phi = I + F T is of first order in T: extrapolating it to T = 0 removes that error.
    limit = 2 * fine - coarse
    for row in LAYOUT:
        for column in LAYOUT:
            block = mechanised[row, column]
            scale = np.abs(block).max()
            np.testing.assert_allclose(limit[row, column], block, rtol=0, atol=2e-6 * scale)
            np.testing.assert_allclose(fine[row, column], block, rtol=0, atol=2e-3 * scale)
