"""The state as a manifold: the total-state inertial model, its Jacobians, filters and mixtures."""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from oracles import rotations

from jaxnav.compiling import compiled
from jaxnav.estimation.banks.mixture import moment_match
from jaxnav.estimation.filters.kalman import ekf
from jaxnav.estimation.filters.linearise import jacobians
from jaxnav.estimation.filters.sigma_point import square_root_ukf, ukf
from jaxnav.estimation.filters.square_root import square_root_ekf
from jaxnav.estimation.run import run
from jaxnav.estimation.types import Filter, FilterParams, Flag, Gaussian, Obs
from jaxnav.navigation.models.sins_total import (
    SinsTotalInput,
    SinsTotalParams,
    StarForm,
    sins_total,
)
from jaxnav.navigation.states import SinsTotal, local_total, retract_total
from jaxnav.navigation.strapdown.base import NavState
from jaxnav.navigation.strapdown.increments import accumulate
from jaxnav.navigation.strapdown.launch_inertial import mechanise_launch_inertial
from jaxnav.navigation.trajectory.rocket import RocketProfile, fly
from jaxnav.numerics.lie import dcm_from_euler, so3_exp, so3_log
from jaxnav.numerics.sigma import SigmaRule, cubature, unscented
from jaxnav.units import ARCSEC, DEG_PER_HOUR, MICRO_G

RADIUS, IMU_STEP, EVERY = 6.371e6, 0.01, 5
PERIOD = EVERY * IMU_STEP
STARS: tuple[StarForm, StarForm] = ("rotation-vector", "euler")
MODELS = {star: sins_total(PERIOD, IMU_STEP, RADIUS, star) for star in STARS}
each_star = pytest.mark.parametrize("star", STARS)
SIGMA = np.repeat([10 * ARCSEC, 0.1, 10.0, 0.1 * DEG_PER_HOUR, 50 * MICRO_G], 3)
NOISE = SinsTotalParams(
    jnp.full(3, 0.05 * DEG_PER_HOUR),
    jnp.full(3, 10 * MICRO_G),
    jnp.array(50 * MICRO_G),
    jnp.array(300.0),
    jnp.full(3, 5 * ARCSEC),
)


def random_states(rng: np.random.Generator, count: int) -> tuple[SinsTotal, SinsTotalInput]:
    """States all over the sphere but for its singular yaw, with drifts and inputs that matter."""
    angles = rng.uniform([-3.1, -1.2, -3.1], [3.1, 1.2, 3.1], (count, 3))
    velocity, position, drift, bias, dtheta, dvel = (
        jnp.array(size * rng.normal(size=(count, 3))) for size in (3e3, 1e5, 1e-2, 0.1, 0.2, 2.0)
    )
    dcm = jax.vmap(lambda a: dcm_from_euler(a[0], a[1], a[2]))(jnp.array(angles))
    state = SinsTotal(dcm, velocity, position, drift, bias)
    return state, SinsTotalInput(dtheta, dvel, jnp.ones(count))


@each_star
def test_jacobians_are_the_derivatives(star: StarForm) -> None:
    """Analytic, automatic and by central differences in the units of the states."""
    model = MODELS[star]
    state, inputs = random_states(np.random.default_rng(0), 16)
    units = jnp.array(np.repeat([1e-3, 1.0, 1e3, 1e-3, 1e-2], 3))

    def numeric(x: SinsTotal, u: SinsTotalInput) -> tuple[Array, Array]:
        y, z = model.transition(NOISE, x, u), model.observe(NOISE, x, u)

        def ends(dx: Array) -> tuple[Array, Array]:
            moved = model.retract(x, dx)
            after = model.transition(NOISE, moved, u)
            return model.local(y, after), model.residual(model.observe(NOISE, moved, u), z)

        steps = jnp.array([1.0, -1.0, 2.0, -2.0])[:, None, None] * jnp.diag(units)[None]
        Phi, H = (
            ((8 * (end[0] - end[1]) - (end[2] - end[3])) / 12).T
            for end in jax.vmap(jax.vmap(ends))(steps)
        )
        return Phi / units[None], H / units[None]

    @compiled
    def three_ways(state: SinsTotal, inputs: SinsTotalInput) -> list[tuple[Array, Array]]:
        automatic = model._replace(jacobians=None)
        return [
            jax.vmap(lambda x, u: jacobians(model, NOISE, x, u, 15))(state, inputs),
            jax.vmap(lambda x, u: jacobians(automatic, NOISE, x, u, 15))(state, inputs),
            jax.vmap(numeric)(state, inputs),
        ]

    given, automatic, differences = three_ways(state, inputs)
    for a, b, c in zip(given, automatic, differences, strict=True):
        # a column's scale is that of its largest entry, or of the unit it moves
        scale = np.maximum(np.abs(a).max(axis=1, keepdims=True), 1e-3)
        np.testing.assert_allclose(b / scale, a / scale, rtol=0, atol=1e-12)
        np.testing.assert_allclose(c / scale, a / scale, rtol=0, atol=1e-7)


def test_retract_and_local_are_inverse() -> None:
    rng = np.random.default_rng(1)
    state, _ = random_states(rng, 64)
    dx = rng.normal(size=(64, 15)) * np.repeat([1.0, 1e3, 1e5, 1e-2, 0.1], 3)
    dx[:, :3] *= rng.uniform(0, 3, (64, 1)) / np.linalg.norm(dx[:, :3], axis=1, keepdims=True)
    dx[0] = 0
    moved = jax.vmap(retract_total)(state, jnp.array(dx))
    scale = np.maximum(np.abs(dx).max(axis=0), 1)
    back = np.asarray(jax.vmap(local_total)(state, moved))
    np.testing.assert_allclose(back / scale, dx / scale, rtol=0, atol=1e-13)
    for C, C0, phi in zip(moved.dcm, state.dcm, dx[:, :3], strict=True):
        np.testing.assert_allclose(C, rotations.exp(phi) @ C0, rtol=0, atol=1e-13)


@cache
def flight() -> Any:
    """The first minute of the default flight at 100 Hz."""
    return fly(RocketProfile(), steps=6000, step=IMU_STEP, radius=RADIUS)


def without_errors(state: NavState) -> SinsTotal:
    """The state of perfect sensors."""
    zero = jnp.zeros(3)
    return SinsTotal(state.dcm, state.velocity, state.position, zero, zero)


def increments(count: int) -> SinsTotalInput:
    """Perfect increments of the first filter periods."""
    truth = flight()
    dtheta, dvel = accumulate(truth.dtheta, truth.dvel, EVERY)
    return SinsTotalInput(dtheta[:count], dvel[:count], jnp.ones(count))


VELOCITY_ERROR, POSITION_ERROR = 1e-6, 3e-3


def test_transition_is_the_mechanisation() -> None:
    """Positions are sums of trapezia of 0.05 s, not 0.01 s: T^2 / 12 times the gain in thrust."""
    truth = flight()
    start = jax.tree.map(lambda leaf: leaf[0], truth.state)
    fine = mechanise_launch_inertial(start, truth.dtheta, truth.dvel, IMU_STEP, RADIUS, EVERY).state
    model = MODELS["rotation-vector"]

    def step(x: SinsTotal, u: SinsTotalInput) -> tuple[SinsTotal, SinsTotal]:
        x = model.transition(NOISE, x, u)
        return x, x

    first = without_errors(start)
    coarse = compiled(lambda u: jax.lax.scan(step, first, u)[1])(increments(1200))
    np.testing.assert_allclose(coarse.dcm, fine.dcm, rtol=0, atol=1e-12)
    np.testing.assert_allclose(coarse.velocity, fine.velocity, rtol=0, atol=VELOCITY_ERROR)
    np.testing.assert_allclose(coarse.position, fine.position, rtol=0, atol=POSITION_ERROR)
    end = jax.tree.map(lambda leaf: leaf[EVERY::EVERY], truth.state)
    np.testing.assert_allclose(coarse.dcm, end.dcm, rtol=0, atol=1e-12)
    np.testing.assert_allclose(coarse.velocity, end.velocity, rtol=0, atol=VELOCITY_ERROR)


def test_accumulate_composes_rotations() -> None:
    rng = np.random.default_rng(2)
    dtheta, dvel = 0.3 * rng.normal(size=(10, 3)), rng.normal(size=(10, 3))
    turned, gained = accumulate(jnp.array(dtheta), jnp.array(dvel), 5)
    for k in (0, 1):
        C, total = np.eye(3), np.zeros(3)
        for j in range(5 * k, 5 * k + 5):
            total = total + C @ (dvel[j] + 0.5 * np.cross(dtheta[j], dvel[j]))
            C = C @ rotations.exp(dtheta[j])
        np.testing.assert_allclose(rotations.exp(np.asarray(turned[k])), C, rtol=0, atol=1e-14)
        np.testing.assert_allclose(gained[k], total, rtol=1e-13)
    with pytest.raises(ValueError, match="10 increments do not divide into periods of 4"):
        accumulate(jnp.array(dtheta), jnp.array(dvel), 4)


def filtered(filter: Filter, star: StarForm, rule: SigmaRule | tuple[()] = ()) -> Gaussian:
    """Forty steps of a filter that starts a few sigma off, with noisy stars."""
    truth = flight()
    rng = np.random.default_rng(3)
    first = jax.tree.map(lambda leaf: leaf[3000], truth.state)
    start = retract_total(without_errors(first), jnp.array(SIGMA * rng.normal(size=15)))
    u = jax.tree.map(lambda leaf: leaf[600:640], increments(1200))
    C = truth.state.dcm[3005:3205:5]
    noisy = jax.vmap(lambda C, e: so3_exp(e) @ C)(
        C, jnp.array(5 * ARCSEC * rng.normal(size=(40, 3)))
    )
    observe = MODELS[star].observe
    z = jax.vmap(lambda C: observe(NOISE, start._replace(dcm=C), None))(noisy)
    params = FilterParams(
        NOISE,
        Gaussian(start, jnp.diag(jnp.array(SIGMA**2))),
        jax.tree.map(jnp.asarray, rule),
    )
    estimate, info = run(filter, params, u, Obs(z, jnp.ones((40, 3), bool))).record
    assert np.all(np.asarray(info.flags) & ~Flag.ILL_CONDITIONED == 0)
    return estimate


@pytest.mark.slow
@each_star
def test_filters_agree_at_errors_of_arc_seconds(star: StarForm) -> None:
    """What is of second order in arc seconds is lost in the estimates of all forms and rules."""
    model = MODELS[star]
    reference = filtered(ekf(model), star)
    others = [filtered(square_root_ekf(model), star)] if star == "rotation-vector" else []
    builders = (ukf, square_root_ukf) if star == "rotation-vector" else (ukf,)
    for build in builders:
        filter = build(model)
        others += [
            filtered(filter, star, rule) for rule in (cubature(15), unscented(15, alpha=0.5))
        ]
    sigma = np.sqrt(np.diagonal(reference.cov, axis1=1, axis2=2))
    scale = sigma[:, :, None] * sigma[:, None]
    for other in others:
        apart = np.asarray(jax.vmap(local_total)(reference.mean, other.mean))
        assert np.abs(apart[:, :3]).max() < 1e-3 * ARCSEC
        assert np.abs(apart / sigma).max() < 1e-4
        np.testing.assert_allclose((other.cov - reference.cov) / scale, 0, atol=1e-4)


def test_residual_of_euler_angles_wraps() -> None:
    residual = MODELS["euler"].residual
    z, z_pred = jnp.array([np.pi - 0.01, 0.2, -np.pi + 0.02]), jnp.array([-np.pi + 0.01, 0.1, 3.1])
    expected = [-0.02, 0.1, 2 * np.pi - 3.1 - np.pi + 0.02]
    np.testing.assert_allclose(residual(z, z_pred), expected, atol=1e-14)
    np.testing.assert_allclose(residual(z_pred, z), -np.array(expected), atol=1e-14)


def test_residual_of_rotation_vectors_near_and_at_half_a_turn() -> None:
    """The logarithm jumps there; the residual of two attitudes close to it is their difference."""
    residual = MODELS["rotation-vector"].residual
    axis = np.array([0.6, 0.0, 0.8])
    small = np.array([1e-3, -2e-3, 5e-4])
    graded = compiled(
        lambda a, b: (residual(a, b), jax.jacfwd(residual)(a, b), jax.jacrev(residual, 1)(a, b))
    )
    for angle in (np.pi - 1e-3, np.pi - 1e-9, np.pi):
        z_pred = angle * axis
        z = np.asarray(so3_log(jnp.array(rotations.exp(small) @ rotations.exp(z_pred))))
        value, *slopes = graded(jnp.array(z), jnp.array(z_pred))
        np.testing.assert_allclose(value, small, atol=1e-13)
        np.testing.assert_allclose(slopes[0], rotations.left_jacobian(z), atol=2e-3)
        assert all(np.all(np.isfinite(slope)) for slope in slopes)


CENTRE, _ = random_states(np.random.default_rng(4), 1)
turned = compiled(
    jax.vmap(lambda dx: retract_total(jax.tree.map(lambda leaf: leaf[0], CENTRE), dx))
)
match = compiled(
    lambda log_weights, members: moment_match(log_weights, members, retract_total, local_total)
)
between = compiled(local_total)


def matched(weights: list[float], turns: list[np.ndarray]) -> tuple[SinsTotal, Gaussian]:
    """An attitude, and the match of members that are turned from it."""
    centre = jax.tree.map(lambda leaf: leaf[0], CENTRE)
    means = turned(jnp.array(np.stack(turns)))
    covs = jnp.array(np.tile(np.diag(SIGMA**2), (len(turns), 1, 1)))
    with np.errstate(divide="ignore"):
        log_weights = jnp.array(np.log(weights))
    return centre, match(log_weights, Gaussian(means, covs))


def test_mixture_on_a_manifold() -> None:
    zero, turn = np.zeros(15), np.zeros(15)
    turn[:3] = np.array([30.0, -20.0, 10.0]) * ARCSEC
    centre, alike = matched([0.2, 0.8, 0.0], [zero, zero, np.full(15, np.nan)])
    np.testing.assert_allclose(between(centre, alike.mean), 0, atol=1e-15)
    np.testing.assert_allclose(alike.cov, np.diag(SIGMA**2), rtol=1e-14)

    centre, opposite = matched([0.5, 0.5, 0.0], [turn, -turn, zero])
    np.testing.assert_allclose(between(centre, opposite.mean)[:3] / ARCSEC, 0, atol=1e-9)
    gained = np.diag(SIGMA**2) + np.outer(turn, turn)
    np.testing.assert_allclose(opposite.cov[:3, :3], gained[:3, :3], rtol=1e-10, atol=1e-20)


def test_mixture_does_not_depend_on_which_member_is_the_reference() -> None:
    """A hair's breadth of weight moves the tangent space: to third order in the turns, no more."""
    rng = np.random.default_rng(5)
    directions = rng.normal(size=(3, 3))
    gaps = []
    for size in (1e-2, 1e-3):
        turns = [np.concatenate([size * d, np.zeros(12)]) for d in directions]
        edge = 1e-12
        _, first = matched([1 / 3 + edge, 1 / 3, 1 / 3 - edge], turns)
        _, last = matched([1 / 3 - edge, 1 / 3, 1 / 3 + edge], turns)
        gaps.append(np.abs(between(first.mean, last.mean)[:3]).max())
    assert 0 < gaps[0] < 10 * 1e-6
    assert gaps[1] < 2e-3 * gaps[0]
