"""The SINS/CNS error model against its dense matrices, and its sign conventions."""

import jax
import jax.numpy as jnp
import numpy as np
from oracles import rotations, sins

from jaxnav.compiling import compiled
from jaxnav.navigation.models.sins_cns import (
    SinsCnsInput,
    SinsCnsParams,
    inputs_from_solution,
    sins_cns,
    sins_cns_attitude,
)
from jaxnav.navigation.states import ATTITUDE_LAYOUT, LAYOUT
from jaxnav.navigation.strapdown.base import NavState
from jaxnav.navigation.strapdown.launch_inertial import NavSolution
from jaxnav.numerics.lie import so3_local
from jaxnav.units import ARCSEC, DEG_PER_HOUR, MICRO_G

PERIOD, IMU_STEP = 0.05, 0.01
MODEL = sins_cns(PERIOD, IMU_STEP)
ATTITUDE_MODEL = sins_cns_attitude(PERIOD, IMU_STEP)
ATTITUDE_STATES = np.r_[LAYOUT.phi, LAYOUT.eps]
RADIUS = 6.371e6
I3 = np.eye(3)
PARAMS = SinsCnsParams(
    gyro_noise=jnp.array([1.0, 2.0, 3.0]) * DEG_PER_HOUR,
    accel_noise=jnp.array([500.0, 50.0, 5.0]) * MICRO_G,
    star_noise=jnp.array([1.0, 2.0, 4.0]) * ARCSEC,
    noise_scale=jnp.array(7.0),
)


def inputs():
    """Return inputs of ten steps with attitudes, forces and gradients of no special structure."""
    rng = np.random.default_rng(1)
    force = 40 * rng.standard_normal((10, 3))
    gradient = 1e-6 * rng.standard_normal((10, 3, 3))
    dcm = np.array([rotations.exp(p) for p in 2 * rng.standard_normal((10, 3))])
    minus_force_skew = np.array([rotations.skew(-f) for f in force])
    return SinsCnsInput(*map(jnp.asarray, (dcm, minus_force_skew, gradient, np.ones(10))))


def over_steps(function, *args):
    return np.asarray(compiled(jax.vmap(function, (0, *(None for _ in args))))(inputs(), *args))


def dense_transitions():
    u = inputs()
    matrices = zip(*map(np.asarray, u[:3]), strict=True)
    return np.array([np.eye(15) + PERIOD * sins.dynamics(*m) for m in matrices])


def test_transition_is_the_dense_matrix():
    rng = np.random.default_rng(2)
    x = rng.standard_normal(15)
    Phi = dense_transitions()
    jacobian = over_steps(lambda u, x: jax.jacfwd(MODEL.transition, argnums=1)(PARAMS, x, u), x)
    moved = over_steps(lambda u, x: MODEL.transition(PARAMS, x, u), x)
    np.testing.assert_allclose(jacobian, Phi, rtol=1e-15, atol=1e-18)
    np.testing.assert_allclose(moved, Phi @ x, rtol=0, atol=1e-14)


def test_process_noise_is_the_dense_product():
    x = jnp.zeros(15)
    Q = over_steps(lambda u, x: MODEL.process_noise(PARAMS, x, u), x)
    G = np.array([sins.noise_input(C) for C in inputs().dcm])
    Q0 = np.diag(np.concatenate([PARAMS.gyro_noise, PARAMS.accel_noise]) ** 2)
    dense = G @ Q0 @ G.transpose(0, 2, 1) * float(PARAMS.noise_scale) * PERIOD * IMU_STEP
    for block in (LAYOUT.phi, LAYOUT.dv):
        q, exact = Q[:, block, block], dense[:, block, block]
        scale = np.abs(exact).max()
        np.testing.assert_allclose(q, exact, rtol=0, atol=1e-15 * scale)
        np.testing.assert_allclose(q, q.transpose(0, 2, 1), rtol=0, atol=1e-15 * scale)
        np.testing.assert_array_less(0, np.linalg.eigvalsh(q))
    rest = np.ones((15, 15), bool)
    rest[LAYOUT.phi, LAYOUT.phi] = rest[LAYOUT.dv, LAYOUT.dv] = False
    np.testing.assert_array_equal(Q[:, rest], 0)


def test_the_attitude_model_is_a_block_of_the_whole():
    rng = np.random.default_rng(3)
    x = rng.standard_normal(15)
    part = x[ATTITUDE_STATES]
    assert ATTITUDE_LAYOUT._asdict() == {"phi": slice(0, 3), "eps": slice(3, 6)}
    pick = np.ix_(range(10), ATTITUDE_STATES, ATTITUDE_STATES)
    rest = np.setdiff1d(np.arange(15), ATTITUDE_STATES)
    Phi = dense_transitions()
    np.testing.assert_array_equal(Phi[:, ATTITUDE_STATES][:, :, rest], 0)

    def both(u, x, part):
        whole = (
            MODEL.process_noise(PARAMS, x, u),
            MODEL.transition(PARAMS, x, u),
            MODEL.observe(PARAMS, x, u),
            MODEL.observation_noise(PARAMS, x, u),
        )
        alone = (
            ATTITUDE_MODEL.process_noise(PARAMS, part, u),
            ATTITUDE_MODEL.transition(PARAMS, part, u),
            ATTITUDE_MODEL.observe(PARAMS, part, u),
            ATTITUDE_MODEL.observation_noise(PARAMS, part, u),
        )
        return whole, alone

    whole, alone = compiled(jax.vmap(both, (0, None, None)))(inputs(), x, part)
    np.testing.assert_array_equal(whole[0][pick], alone[0])
    np.testing.assert_allclose(np.asarray(whole[1])[:, ATTITUDE_STATES], alone[1], rtol=1e-15)
    for a, b in zip(whole[2:], alone[2:], strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(whole[2][0], x[:3])
    np.testing.assert_allclose(whole[3][0], (np.array([1.0, 2.0, 4.0]) * ARCSEC) ** 2, rtol=1e-15)


def test_misalignment_is_computed_against_reference():
    rng = np.random.default_rng(4)
    phi = rng.standard_normal((20, 3)) * 10.0 ** rng.uniform(-6, 0, (20, 1))
    C = np.array([rotations.exp(p) for p in 2 * rng.standard_normal((20, 3))])
    computed = np.array([rotations.exp(p) for p in phi]) @ C
    measure = compiled(jax.vmap(so3_local))
    np.testing.assert_allclose(measure(C, computed), phi, rtol=0, atol=3e-15)
    np.testing.assert_allclose(measure(computed, C), -phi, rtol=0, atol=3e-15)


def test_inputs_are_means_over_the_period():
    rng = np.random.default_rng(5)
    dcm = np.array([rotations.exp(p) for p in rng.standard_normal((4, 3))])
    position = rng.uniform(-1e5, 1e5, (4, 3))
    gained = rng.standard_normal((3, 3))
    state = NavState(*map(jnp.asarray, (dcm, np.zeros((4, 3)), position)))
    start = jax.tree.map(lambda leaf: leaf[0], state)
    ends = jax.tree.map(lambda leaf: leaf[1:], state)
    scale = np.arange(3.0)
    u = compiled(inputs_from_solution)(
        start, NavSolution(ends, jnp.asarray(gained)), PERIOD, RADIUS, scale
    )
    np.testing.assert_allclose(u.dcm, 0.5 * (dcm[:-1] + dcm[1:]), rtol=0, atol=1e-16)
    expected = [rotations.skew(-f) for f in gained / PERIOD]
    np.testing.assert_allclose(u.minus_force_skew, expected, rtol=1e-15)
    h = 10.0
    columns = [
        [(sins.gravity(r + h * e, RADIUS) - sins.gravity(r - h * e, RADIUS)) / (2 * h) for e in I3]
        for r in position[1:]
    ]
    np.testing.assert_allclose(
        u.gravity_gradient, np.array(columns).transpose(0, 2, 1), rtol=0, atol=1e-15
    )
    np.testing.assert_array_equal(u.true_scale, scale)
