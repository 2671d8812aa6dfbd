"""SINS/GNSS in the local level frame: definitions of the error, Jacobians, masks, hard times."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.estimation.filters.kalman import ekf
from jaxnav.estimation.filters.linearise import jacobians
from jaxnav.estimation.run import Trace, run
from jaxnav.estimation.types import FilterParams, Flag, Gaussian, Obs, observed
from jaxnav.navigation.earth import FLAT, WGS84, Earth
from jaxnav.navigation.models.sins_gnss import SinsGnssInput, SinsGnssParams, sins_gnss
from jaxnav.navigation.states import LevelError, SinsLevel, error_form
from jaxnav.numerics.lie import so3_exp
from jaxnav.units import DEG, DEG_PER_HOUR, DEG_PER_SQRT_HOUR, MICRO_G

FORMS: tuple[LevelError, ...] = ("additive", "left-invariant", "right-invariant")
ORIGIN = jnp.array([34.0 * DEG, 108.0 * DEG, 500.0])
SIGMA = np.repeat([1e-3, 0.1, 3.0, 10 * DEG_PER_HOUR, 1e3 * MICRO_G], 3)
"""What the states are known to in flight: the scale by which derivatives are compared."""
PARAMS = SinsGnssParams(
    gyro_noise=jnp.full(3, 0.2 * DEG_PER_SQRT_HOUR),
    accel_noise=jnp.full(3, 1e-3),
    gyro_walk=jnp.full(3, 1e-7),
    accel_walk=jnp.full(3, 1e-5),
    velocity_noise=jnp.full(3, 0.1),
    position_noise=jnp.array([3.0, 3.0, 5.0]),
    lever_arm=jnp.array([0.4, -0.3, 0.8]),
)
each_form = pytest.mark.parametrize("form", FORMS)


def states(count: int, origin: Array = ORIGIN, biased: float = 1.0) -> SinsLevel:
    """States of a fast vehicle at any attitude, up to 50 km from the origin."""
    rng = np.random.default_rng(8)
    metres = np.array([6.4e6, 5.3e6, 1.0])
    spread = rng.uniform(-1, 1, (count, 3)) * [5e4, 5e4, 3e4] / metres
    if float(origin[0]) == 0:
        spread *= metres / [FLAT.semi_major, FLAT.semi_major, 1.0]
    return SinsLevel(
        dcm=jax.vmap(so3_exp)(jnp.array(rng.uniform(-2, 2, (count, 3)))),
        velocity=jnp.array(rng.normal(size=(count, 3)) * 300),
        position=jnp.array(np.asarray(origin) + spread),
        drift=biased * jnp.array(rng.normal(size=(count, 3)) * 100 * DEG_PER_HOUR),
        bias=biased * jnp.array(rng.normal(size=(count, 3)) * 1e4 * MICRO_G),
    )


def sensed(dt: float = 0.05) -> SinsGnssInput:
    """A period of strong thrust and fast turning."""
    turn, force = np.array([0.8, -0.4, 0.3]), np.array([45.0, -3.0, 9.0])
    return SinsGnssInput(
        jnp.array(turn * dt), jnp.array(force * dt), jnp.array(turn), jnp.array(dt)
    )


@each_form
def test_local_undoes_retract(form: LevelError) -> None:
    e = error_form(form, ORIGIN)
    rng = np.random.default_rng(2)
    dx = jnp.array(rng.normal(size=(50, 15)) * np.repeat([0.5, 30.0, 100.0, 1e-3, 1e-2], 3))
    x = states(50)
    back = compiled(jax.vmap(lambda x, d: e.local(x, e.retract(x, d))))(x, dx)
    # metres per radian are those at the one point or at the other: 100 m turn a latitude by 2e-5
    np.testing.assert_allclose(back, dx, rtol=2e-4, atol=1e-8)
    small = compiled(jax.vmap(lambda x, d: e.local(x, e.retract(x, d))))(x, 1e-4 * dx)
    np.testing.assert_allclose(small, 1e-4 * dx, rtol=1e-6, atol=2e-8)


@each_form
def test_to_additive_is_the_derivative_of_retract(form: LevelError) -> None:
    e, additive = error_form(form, ORIGIN), error_form("additive", ORIGIN)

    def derivative(x: SinsLevel) -> Array:
        return jax.jacfwd(lambda d: additive.local(x, e.retract(x, d)))(jnp.zeros(15))

    def given(x: SinsLevel) -> tuple[Array, Array]:
        columns = jax.vmap(lambda d: e.to_additive(x, d), out_axes=1)(jnp.eye(15))
        return columns, jax.vmap(lambda d: e.from_additive(x, d), 1, 1)(columns)

    x = states(20)
    forward, both = compiled(jax.vmap(given))(x)
    np.testing.assert_allclose(compiled(jax.vmap(derivative))(x), forward, rtol=1e-8, atol=1e-6)
    np.testing.assert_allclose(both, np.broadcast_to(np.eye(15), both.shape), atol=1e-9)


def relative(Phi: Array, rows: np.ndarray = SIGMA) -> np.ndarray:
    """A derivative in units of what its rows and columns are known to."""
    return np.asarray(Phi) * SIGMA / rows[:, None]


@each_form
def test_analytic_jacobians_agree_with_automatic_ones(form: LevelError) -> None:
    model = sins_gnss(form, ORIGIN)
    x = states(12)

    def both(x: SinsLevel) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        own = jacobians(model, PARAMS, x, sensed(), 15)
        return own, jacobians(model._replace(jacobians=None), PARAMS, x, sensed(), 15)

    (Phi, H), (auto_Phi, auto_H) = compiled(jax.vmap(both))(x)
    channels = np.repeat([0.1, 3.0], 3)
    for k in range(12):
        off = np.abs(relative(Phi[k]) - relative(auto_Phi[k]))
        # what is left out: Earth and transport rate of a period, 1e-5, next to the block's terms
        assert off.max() < 2e-4 * np.abs(relative(Phi[k])).max()
        np.testing.assert_allclose(
            relative(H[k], channels), relative(auto_H[k], channels), atol=2e-5
        )


def test_jacobian_is_exact_where_the_earth_is_flat() -> None:
    model = sins_gnss("additive", earth=FLAT)
    x = states(12, jnp.zeros(3))

    def both(x: SinsLevel) -> list[Array]:
        auto = model._replace(jacobians=None)
        return [jacobians(m, PARAMS, x, sensed(), 15)[0] for m in (model, auto)]

    own, automatic = compiled(jax.vmap(both))(x)
    np.testing.assert_allclose(own, automatic, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("form", FORMS[1:])
def test_invariant_errors_move_alike_everywhere_on_a_flat_earth(form: LevelError) -> None:
    """Without biases the transition of the first nine coordinates does not depend on the state."""
    model = sins_gnss(form, jnp.zeros(3), FLAT)

    def transitions(x: SinsLevel) -> list[Array]:
        forms = (model, model._replace(jacobians=None))
        return [jacobians(m, PARAMS, x, sensed(), 15)[0][:9, :9] for m in forms]

    for Phi in compiled(jax.vmap(transitions))(states(30, jnp.zeros(3), biased=0.0)):
        alike = np.broadcast_to(Phi[0], Phi.shape)
        np.testing.assert_allclose(Phi, alike, rtol=1e-9, atol=1e-9)
        assert np.abs(Phi[0] - np.eye(9)).max() > 0.01


def test_additive_error_moves_with_the_attitude() -> None:
    model = sins_gnss("additive", earth=FLAT)
    x = states(2, jnp.zeros(3), biased=0.0)
    Phi = compiled(jax.vmap(lambda x: jacobians(model, PARAMS, x, sensed(), 15)[0]))(x)
    assert np.abs(Phi[0, :9, :9] - Phi[1, :9, :9]).max() > 0.1


def test_noise_is_that_of_the_additive_error_in_other_coordinates() -> None:
    """Mahalanobis distances, which do not depend on coordinates, agree."""
    x = jax.tree.map(lambda leaf: leaf[0], states(1))
    push = np.random.default_rng(1).normal(size=15) * np.repeat([1e-3, 1e-2, 0, 1e-6, 1e-4], 3)
    sizes = []
    for name in FORMS:
        form = error_form(name, ORIGIN)
        Q = np.asarray(sins_gnss(name, ORIGIN).process_noise(PARAMS, x, sensed()))
        basis = np.stack([form.from_additive(x, e) for e in jnp.eye(15)], axis=1)
        kept = np.r_[0:6, 9:15]
        inner = np.linalg.inv(basis) @ Q @ np.linalg.inv(basis).T
        np.testing.assert_allclose(inner[6:9], 0, atol=1e-12)
        sizes.append(push[kept] @ np.linalg.solve(inner[np.ix_(kept, kept)], push[kept]))
    np.testing.assert_allclose(sizes, sizes[0], rtol=1e-9)


STEPS = 40


@cache
def drive(form: LevelError, earth: Earth = WGS84):
    """Compile a filter over a short flight with fixes at every other step."""
    filter = ekf(sins_gnss(form, ORIGIN, earth))
    x = jax.tree.map(lambda leaf: leaf[0], states(1))
    prior = Gaussian(x, jnp.diag(jnp.array(SIGMA) ** 2))

    @compiled
    def one(inputs: SinsGnssInput, obs: Obs) -> Trace:
        return run(filter, FilterParams(PARAMS, prior), inputs, obs)

    return one, x


def inputs_at(dt: np.ndarray) -> SinsGnssInput:
    rows = [sensed(float(step)) for step in dt]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *rows)


def fixes(x: SinsLevel, inputs: SinsGnssInput) -> Obs:
    """Fixes on the unaided path, with a little noise, at every other step."""
    model = sins_gnss()
    rng = np.random.default_rng(4)
    z = []
    for k in range(STEPS):
        u = jax.tree.map(lambda leaf, k=k: leaf[k], inputs)
        x = MOVE(x, u)
        z.append(np.asarray(model.observe(PARAMS, x, u)))
    noise = rng.normal(size=(STEPS, 6)) * np.repeat([0.1, 3 / 6.4e6], 3)
    noise[:, 5] *= 6.4e6
    valid = np.broadcast_to((np.arange(STEPS) % 2 == 1)[:, None], (STEPS, 6))
    return Obs(jnp.array(np.array(z) + noise), jnp.array(valid))


MOVE = compiled(lambda x, u: sins_gnss().transition(PARAMS, x, u))


def test_nan_in_any_channel_equals_the_masked_run_bitwise() -> None:
    one, x = drive("additive")
    inputs = inputs_at(np.full(STEPS, 0.05))
    obs = fixes(x, inputs)
    z = np.array(obs.z)
    z[~np.asarray(obs.valid)] = np.nan
    for channel, step in enumerate((1, 9, 17, 25, 33, 39)):
        z[step, channel] = [np.nan, np.inf, -np.inf, np.nan, 1e400, np.nan][channel]
    mask = np.isfinite(z)
    lost = one(inputs, observed(jnp.array(z)))
    masked = one(inputs, Obs(jnp.where(mask, z, 7.0), jnp.array(mask)))
    for a, b in zip(jax.tree.leaves(lost), jax.tree.leaves(masked), strict=True):
        np.testing.assert_array_equal(a, b)
    assert np.all(np.isfinite(lost.record[0].cov))


def test_time_that_stands_still_or_goes_back_changes_nothing() -> None:
    """A period of zero or less is the identity, whatever the sensors say in it."""
    one, x = drive("additive")
    dt = np.full(STEPS, 0.05)
    inputs = inputs_at(dt)
    obs = fixes(x, inputs)
    plain = one(inputs, obs)
    for bad in (0.0, -0.3):
        again = inputs._replace(dt=inputs.dt.at[20].set(bad), dtheta=inputs.dtheta.at[20].set(9.0))
        trace = one(again, obs)
        before, after = (jax.tree.map(lambda leaf, k=k: leaf[k], trace.record[0]) for k in (19, 20))
        assert not np.asarray(obs.valid)[20].any()
        for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-15, atol=1e-18)
        assert int(trace.record[1].flags[20]) == Flag.NO_OBSERVATION
    np.testing.assert_array_equal(plain.record[0].cov[:20], trace.record[0].cov[:20])


def test_a_gap_of_a_second_is_bridged_and_known() -> None:
    """One period of 1 s: the uncertainty grows as over twenty, and the filter goes on."""
    one, x = drive("additive")
    dt = np.full(STEPS, 0.05)
    dt[20] = 1.0
    inputs = inputs_at(dt)
    gap = one(inputs, fixes(x, inputs))
    sigma = np.sqrt(np.diagonal(gap.record[0].cov, axis1=1, axis2=2))
    assert np.all(sigma[20, :9] > sigma[19, :9])
    assert np.all(np.isfinite(sigma))
    nis = np.asarray(gap.record[1].nis)[21::2]
    assert nis.mean() < 16.8, "the fixes after it fit: chi-square of six, 1 % of one"


def test_filters_of_all_definitions_are_one_where_errors_are_small() -> None:
    """From the same prior, in each one's coordinates, to the same estimate and covariance."""
    small, plain = 1e-5, error_form("additive", ORIGIN)
    x = jax.tree.map(lambda leaf: leaf[0], states(1))
    quiet = jax.tree.map(lambda leaf: small * leaf, PARAMS)._replace(lever_arm=PARAMS.lever_arm)
    P = jnp.diag((small * jnp.array(SIGMA)) ** 2)
    off = np.random.default_rng(6).normal(size=6) * np.repeat([0.1, 3 / 6.4e6], 3)
    off[5] *= 6.4e6

    def posteriors(obs: Obs) -> list[tuple[Array, Array]]:
        found = []
        for name in FORMS:
            form, filter = error_form(name, ORIGIN), ekf(sins_gnss(name, ORIGIN))

            def columns(at: SinsLevel, A: Array, push=form.from_additive) -> Array:
                return jax.vmap(lambda d: push(at, d), 1, 1)(A)

            own = columns(x, columns(x, P).T)
            params = FilterParams(quiet, Gaussian(x, own))
            state = filter.predict(params, filter.init(params), sensed())
            state, _ = filter.update(params, state, sensed(), obs)
            back = columns(state.x, columns(state.x, state.P, form.to_additive).T, form.to_additive)
            found.append((plain.local(x, state.x), back))
        return found

    ahead = MOVE(x, sensed())
    z = sins_gnss().observe(PARAMS, ahead, sensed()) + small * jnp.array(off)
    found = compiled(posteriors)(Obs(z, jnp.ones(6, bool)))
    # in sigmas: what the analytic Jacobians leave out is below a thousandth
    scale = small * SIGMA
    first, *others = [(mean / scale, cov / np.outer(scale, scale)) for mean, cov in found]
    for mean, cov in others:
        np.testing.assert_allclose(mean, first[0], atol=1e-3)
        np.testing.assert_allclose(cov, first[1], atol=1e-3)


def test_the_error_must_be_a_known_one() -> None:
    with pytest.raises(ValueError, match="additive, left-invariant, right-invariant"):
        sins_gnss("middle-invariant", ORIGIN)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="give a position"):
        sins_gnss("right-invariant")
