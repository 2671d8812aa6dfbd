"""Filters and mixtures on the manifold of the total-state SINS model."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.estimation.banks.mixture import moment_match
from jaxnav.estimation.filters.kalman import ekf
from jaxnav.estimation.filters.linearise import jacobians
from jaxnav.estimation.filters.sigma_point import ckf, square_root_ckf, square_root_ukf, ukf
from jaxnav.estimation.filters.square_root import square_root_ekf
from jaxnav.estimation.run import run
from jaxnav.estimation.types import FilterParams, Gaussian, Obs
from jaxnav.navigation.models.sins_cns import LAYOUT
from jaxnav.navigation.models.sins_total import (
    SinsTotal,
    SinsTotalInput,
    SinsTotalParams,
    local,
    retract,
    sins_total,
)
from jaxnav.navigation.strapdown import accumulate, mechanise_launch_inertial
from jaxnav.navigation.trajectory.boost import BoostProfile, fly_boost
from jaxnav.numerics.lie import so3_exp, so3_local, so3_log, so3_retract, wrapped_angle
from jaxnav.units import ARCSEC, DEG_PER_HOUR, MICRO_G

PERIOD, IMU_STEP, RADIUS, EVERY = 0.05, 0.01, 6.37e6, 5
STEPS = 40
MODELS = {form: sins_total(PERIOD, IMU_STEP, RADIUS, form) for form in ("rotation-vector", "euler")}
each_form = pytest.mark.parametrize("form", MODELS)
NOISE = SinsTotalParams(
    gyro_noise=jnp.full(3, 20 * DEG_PER_HOUR),
    accel_noise=jnp.full(3, 50 * MICRO_G),
    bias_sigma=jnp.array(50 * MICRO_G),
    bias_time=jnp.array(300.0),
    star_noise=jnp.full(3, 5 * ARCSEC),
)
SCALE = np.repeat([0.3, 100.0, 1000.0, 1e-3, 1e-2], 3)
"""Sizes of a tangent vector's blocks that make all of the model's terms matter."""
TRUE = fly_boost(BoostProfile(), steps=60 * 100, step=IMU_STEP, radius=RADIUS)


SO3 = (so3_retract, so3_local)


def origin() -> SinsTotal:
    """Return the state at lift-off, without sensor errors."""
    start = jax.tree.map(lambda leaf: leaf[0], TRUE.state)
    return SinsTotal(start.dcm, start.velocity, start.position, jnp.zeros(3), jnp.zeros(3))


def anywhere(count: int, seed: int = 0) -> tuple[SinsTotal, SinsTotalInput]:
    """Return random states far from the origin, and inputs of a turning, boosting vehicle."""
    rng = np.random.default_rng(seed)
    displaced = jax.vmap(retract, in_axes=(None, 0))
    x = displaced(origin(), jnp.array(rng.normal(size=(count, 15)) * SCALE))
    u = SinsTotalInput(
        jnp.array(0.1 * rng.normal(size=(count, 3))),
        jnp.array(2.0 * rng.normal(size=(count, 3))),
        jnp.ones(count),
    )
    return x, u


@each_form
def test_analytic_jacobians_equal_automatic_and_numerical_ones(form: str) -> None:
    model = MODELS[form]
    x, u = anywhere(20)

    def both(x: SinsTotal, u: SinsTotalInput) -> Any:
        automatic = model._replace(jacobians=None)
        return jacobians(model, NOISE, x, u, 15), jacobians(automatic, NOISE, x, u, 15)

    def central(x: SinsTotal, u: SinsTotalInput) -> Any:
        step = jnp.diag(jnp.array(1e-4 * SCALE))
        y, z = model.transition(NOISE, x, u), model.observe(NOISE, x, u)

        def moved(d: jax.Array) -> tuple[jax.Array, jax.Array]:
            there = retract(x, d)
            return (
                local(y, model.transition(NOISE, there, u)),
                model.residual(model.observe(NOISE, there, u), z),
            )

        ahead, behind = jax.vmap(moved)(step), jax.vmap(moved)(-step)
        width = jnp.array(2e-4 * SCALE)[:, None]
        return jax.tree.map(lambda a, b: ((a - b) / width).T, ahead, behind)

    analytic, automatic = jax.jit(jax.vmap(both))(x, u)
    numerical = jax.jit(jax.vmap(central))(x, u)
    rows = (SCALE, np.ones(3))
    for mine, derived, measured, row in zip(analytic, automatic, numerical, rows, strict=True):
        # in units in which every state is of order one
        unit = SCALE[None, None] / row[None, :, None]
        np.testing.assert_allclose(mine * unit, derived * unit, atol=1e-8, rtol=0)
        np.testing.assert_allclose(mine * unit, measured * unit, atol=2e-6, rtol=0)


def test_retract_and_local_are_inverse() -> None:
    x, _ = anywhere(50)
    rng = np.random.default_rng(1)
    d = rng.normal(size=(50, 15)) * SCALE
    turn = d[:, LAYOUT.phi]
    d[:, LAYOUT.phi] = turn / np.linalg.norm(turn, axis=1)[:, None] * rng.uniform(0, 3.1, (50, 1))
    back = jax.jit(jax.vmap(lambda x, d: local(x, retract(x, d))))(x, jnp.array(d))
    np.testing.assert_allclose(np.asarray(back) / SCALE, d / SCALE, atol=1e-9)


def test_transition_driven_by_increments_is_the_mechanisation() -> None:
    dtheta, dvel = accumulate(TRUE.dtheta, TRUE.dvel, EVERY)
    model = MODELS["rotation-vector"]

    def step(x: SinsTotal, u: tuple[jax.Array, jax.Array]) -> tuple[SinsTotal, SinsTotal]:
        x = model.transition(NOISE, x, SinsTotalInput(*u, jnp.ones(())))
        return x, x

    states = jax.jit(lambda u: jax.lax.scan(step, origin(), u)[1])((dtheta, dvel))
    start = jax.tree.map(lambda leaf: leaf[0], TRUE.state)
    fine = mechanise_launch_inertial(start, TRUE.dtheta, TRUE.dvel, IMU_STEP, RADIUS, EVERY).state
    tilt = jax.vmap(so3_local)(fine.dcm, states.dcm)
    assert np.abs(tilt).max() < 1e-12
    # the trapezoid of the position is over 0.05 s here and over 0.01 s there
    assert np.abs(states.velocity - fine.velocity).max() < 1e-5
    assert np.abs(states.position - fine.position).max() < 0.02


def test_accumulated_increments_are_the_product_of_rotations() -> None:
    rng = np.random.default_rng(2)
    dtheta = jnp.array(0.3 * rng.normal(size=(6, 3)))
    dvel = jnp.array(rng.normal(size=(6, 3)))
    turned, gained = accumulate(dtheta, dvel, 3)
    C = np.asarray(jax.vmap(so3_exp)(dtheta))
    for k in range(2):
        a, b, c = C[3 * k : 3 * k + 3]
        np.testing.assert_allclose(so3_exp(turned[k]), a @ b @ c, atol=1e-14)
        half = np.asarray(dvel + 0.5 * np.cross(dtheta, dvel))[3 * k : 3 * k + 3]
        np.testing.assert_allclose(gained[k], half[0] + a @ half[1] + a @ b @ half[2], atol=1e-14)
    with pytest.raises(ValueError, match="6 increments do not divide into periods of 4"):
        accumulate(dtheta, dvel, 4)


@pytest.mark.slow
@each_form
def test_filters_agree_at_errors_of_arc_seconds(form: str) -> None:
    """Six filters, forty steps: the differences are of the second order of arc seconds."""
    model = MODELS[form]
    sigma = jnp.repeat(jnp.array([10 * ARCSEC, 0.1, 5.0, 0.5 * DEG_PER_HOUR, 50 * MICRO_G]), 3)
    rng = np.random.default_rng(4)
    start = retract(origin(), sigma * jnp.array(rng.normal(size=15)))
    dtheta, dvel = accumulate(TRUE.dtheta, TRUE.dvel, EVERY)
    inputs = SinsTotalInput(dtheta[:STEPS], dvel[:STEPS], jnp.ones(STEPS))
    true = TRUE.state.dcm[EVERY::EVERY][:STEPS]
    seen = jax.vmap(so3_retract)(true, 5 * ARCSEC * jnp.array(rng.normal(size=(STEPS, 3))))
    as_state = SinsTotal(seen, *(jnp.zeros((STEPS, 3)) for _ in range(4)))
    z = jax.vmap(lambda x: model.observe(NOISE, x, None))(as_state)
    observations = Obs(z, jnp.ones((STEPS, 3), bool))
    params = FilterParams(NOISE, Gaussian(start, jnp.diag(sigma**2)))

    def final(build: Any) -> tuple[Gaussian, jax.Array]:
        filter = build(model)
        trace = run(filter, params, inputs, observations, record=lambda s, i: i.log_likelihood)
        return filter.estimate(trace.final), trace.record

    reference, likelihood = final(ekf)
    for build in (square_root_ekf, ukf, ckf, square_root_ukf, square_root_ckf):
        other, others = final(build)
        shift = np.asarray(local(reference.mean, other.mean)) / np.sqrt(np.diag(reference.cov))
        assert np.abs(shift).max() < 1e-3, build.__name__
        ratio = np.diag(other.cov) / np.diag(reference.cov)
        np.testing.assert_allclose(ratio, 1, atol=1e-4)
        np.testing.assert_allclose(others, likelihood, atol=2e-3)


def test_residuals_wrap() -> None:
    near = jnp.array([jnp.pi - 0.01, 0.0, -jnp.pi + 0.02])
    across = jnp.array([-jnp.pi + 0.01, 0.1, jnp.pi - 0.02])
    np.testing.assert_allclose(wrapped_angle(near, across), [-0.02, -0.1, 0.04], atol=1e-14)
    residual = MODELS["rotation-vector"].residual
    a = jnp.array([0.0, 0.0, jnp.pi - 0.01])
    b = jnp.array([0.0, 0.0, -jnp.pi + 0.01])
    np.testing.assert_allclose(residual(a, b), [0, 0, -0.02], atol=1e-12)
    slope = jax.jacfwd(lambda z: residual(z, b))(a)
    assert np.all(np.isfinite(slope))
    # about its own axis a rotation vector adds up
    np.testing.assert_allclose(slope[2, 2], 1, atol=1e-12)


def rotations(vectors: np.ndarray) -> jax.Array:
    """Return attitudes turned from one that is nothing special."""
    base = so3_exp(jnp.array([0.4, -1.0, 2.0]))
    return jax.vmap(so3_retract, in_axes=(None, 0))(base, jnp.array(vectors))


mixture = jax.jit(lambda log_weights, members: moment_match(log_weights, members, *SO3))


def test_mixture_of_rotations() -> None:
    covs = jnp.array([np.diag([1.0, 2.0, 3.0]), np.diag([3.0, 1.0, 2.0])]) * 1e-6
    even = jnp.log(jnp.array([0.5, 0.5]))
    same = mixture(even, Gaussian(rotations(np.zeros((2, 3))), covs))
    np.testing.assert_allclose(same.mean, rotations(np.zeros((1, 3)))[0], atol=1e-15)
    np.testing.assert_allclose(same.cov, covs.mean(axis=0), atol=1e-20)
    turn = np.array([0.2, -0.1, 0.3])
    apart = Gaussian(rotations(np.stack([turn, -turn])), covs)
    mixed = mixture(even, apart)
    np.testing.assert_allclose(mixed.mean, same.mean, atol=1e-14)
    np.testing.assert_allclose(mixed.cov, covs.mean(axis=0) + np.outer(turn, turn), atol=1e-14)
    # which member is the likelier, and so the reference, matters to second order only
    for size, bound in ((1e-2, 1e-6), (1e-3, 1e-9)):
        vectors = size * np.array([[1.0, 0.3, -0.5], [-0.2, 0.8, 0.6], [0.1, -0.7, 0.9]])
        three = Gaussian(rotations(vectors), jnp.zeros((3, 3, 3)))
        heavier = [jnp.log(jnp.array(w)) for w in ([0.334, 0.333, 0.333], [0.333, 0.334, 0.333])]
        means = [mixture(lw, three).mean for lw in heavier]
        gap = np.abs(so3_log(means[0] @ means[1].T)).max()
        # the weights themselves differ by a thousandth
        expected = np.abs(vectors[0] - vectors[1]).max() * 1e-3
        assert abs(gap - expected) < bound
