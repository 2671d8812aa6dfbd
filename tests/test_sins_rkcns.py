"""The model of free flight with refracted stars: its motion, its observations and their noise."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from scipy.integrate import solve_ivp

from jaxnav.compiling import compiled
from jaxnav.estimation.filters.iterated import modified_iterated_ckf
from jaxnav.estimation.filters.sigma_point import ckf
from jaxnav.estimation.types import FilterParams, Flag, Gaussian, Model, Obs
from jaxnav.navigation.atmosphere import RefractionTable, tabulate
from jaxnav.navigation.earth import GM, MEAN_RADIUS
from jaxnav.navigation.limb import fitted_model, seen_refraction
from jaxnav.navigation.models.sins_rkcns import (
    RayForm,
    SinsRkcnsInput,
    SinsRkcnsParams,
    observations,
    sins_rkcns,
)
from jaxnav.navigation.states import LAYOUT, SinsTotal, retract_total
from jaxnav.numerics.lie import dcm_from_euler, so3_exp
from jaxnav.units import ARCSEC, DEG_PER_HOUR, MICRO_G

PERIOD, IMU_STEP = 1.0, 0.01


def program(model: Model) -> Model:
    """A model whose equations are programs: a kernel for every operation takes longer."""
    equations = ("transition", "process_noise", "observe", "observation_noise")
    return model._replace(**{name: compiled(getattr(model, name)) for name in equations})


HEIGHTS = program(sins_rkcns(PERIOD, IMU_STEP, MEAN_RADIUS, 3))
ANGLES = program(sins_rkcns(PERIOD, IMU_STEP, MEAN_RADIUS, 3, "angle"))
MODELS: dict[RayForm, Model] = {"height": HEIGHTS, "angle": ANGLES}
CENTRE = np.array([0.0, MEAN_RADIUS, 0.0])


@cache
def table() -> RefractionTable:
    return tabulate(18e3, 30e3)


@cache
def params(form: RayForm = "height", density_sigma: float = 0.01) -> SinsRkcnsParams:
    return SinsRkcnsParams(
        gyro_noise=jnp.full(3, 1.0 * DEG_PER_HOUR),
        accel_noise=jnp.full(3, 500 * MICRO_G),
        star_noise=jnp.array([3.0, 4.0, 5.0]) * ARCSEC,
        refraction_noise=jnp.array(3 * ARCSEC),
        density_sigma=jnp.array(density_sigma),
        disturbance=jnp.array(1e-4),
        atmosphere=fitted_model(21e3, 28e3) if form == "height" else table(),
    )


@cache
def state() -> SinsTotal:
    return SinsTotal(
        dcm=dcm_from_euler(jnp.array(1.4), jnp.array(0.1), jnp.array(-2.0)),
        velocity=jnp.array([400.0, 1900.0, -30.0]),
        position=jnp.array([5e4, 4e5, 2e3]),
        drift=jnp.array([1.0, -2.0, 0.5]) * DEG_PER_HOUR,
        bias=jnp.array([100.0, -50.0, 20.0]) * MICRO_G,
    )


def limb_stars(x: SinsTotal, heights: tuple[float, ...]) -> Array:
    """Directions in which the straight line passes the Earth at some heights, spread in azimuth."""
    r = np.asarray(x.position) + CENTRE
    up = r / np.linalg.norm(r)
    east = np.cross(up, [0.0, 0.0, 1.0])
    east /= np.linalg.norm(east)
    found = []
    for j, height in enumerate(heights):
        level = np.cos(2.1 * j) * east + np.sin(2.1 * j) * np.cross(up, east)
        dip = np.arccos((MEAN_RADIUS + height) / np.linalg.norm(r))
        found.append(np.cos(dip) * level - np.sin(dip) * up)
    return jnp.array(found)


@cache
def seen() -> SinsRkcnsInput:
    """Three stars as they are truly seen; their rays pass between 22 and 27 km."""
    x = state()
    star = limb_stars(x, (20.9e3, 23.5e3, 26.0e3))
    position, given = x.position + jnp.array(CENTRE), table()
    angle = compiled(jax.vmap(lambda s: seen_refraction(given, position, s).angle))(star)
    return SinsRkcnsInput(jnp.array([0.01, -0.02, 0.03]), star, angle, jnp.array(1.0))


def test_the_vehicle_falls_freely_and_the_gyros_less_their_drift_turn_it() -> None:
    x, u = state(), seen()
    moved = HEIGHTS.transition(params(), x, u)

    def derivative(t: float, vr: np.ndarray) -> np.ndarray:
        r = vr[3:] + CENTRE
        return np.concatenate([-GM * r / np.linalg.norm(r) ** 3, vr[:3]])

    start = np.concatenate([x.velocity, x.position])
    end = solve_ivp(derivative, (0, PERIOD), start, rtol=1e-13, atol=1e-9).y[:, -1]
    np.testing.assert_allclose(moved.velocity, end[:3], atol=1e-9)
    np.testing.assert_allclose(moved.position, end[3:], atol=1e-8)
    turned = x.dcm @ compiled(so3_exp)(u.dtheta - PERIOD * x.drift)
    np.testing.assert_allclose(moved.dcm, turned, atol=1e-15)
    np.testing.assert_array_equal(moved.bias, x.bias)
    np.testing.assert_array_equal(moved.drift, x.drift)


def test_the_process_noise_is_that_of_white_rates_and_accelerations() -> None:
    p, s = params(), LAYOUT
    Q = np.asarray(HEIGHTS.process_noise(p, state(), seen()))
    gyro = float(p.gyro_noise[0] ** 2 * PERIOD * IMU_STEP)
    np.testing.assert_allclose(Q[s.phi, s.phi], gyro * np.eye(3), atol=1e-12 * gyro)
    pushed = p.disturbance**2
    for rows, columns, factor in ((s.dv, s.dv, 1.0), (s.dv, s.dr, 0.5), (s.dr, s.dr, 1 / 3)):
        np.testing.assert_allclose(Q[rows, columns], factor * pushed * np.eye(3), rtol=1e-13)
    np.testing.assert_allclose(Q, Q.T, rtol=1e-13, atol=1e-15 * gyro)
    assert not Q[s.eps.start :].any()


def test_at_the_truth_both_forms_explain_what_is_seen() -> None:
    x, u = state(), seen()
    heights = HEIGHTS.observe(params(), x, u)
    np.testing.assert_allclose(heights[3:6], 0, atol=2.0)
    angles = ANGLES.observe(params("angle"), x, u)
    np.testing.assert_allclose(angles[3:6], u.angle, rtol=1e-12)
    z = observations(x.dcm, u.angle, x.bias, "angle")
    np.testing.assert_allclose(ANGLES.residual(z, angles), 0, atol=1e-12)
    assert observations(x.dcm, u.angle, x.bias)[3:6].tolist() == [0, 0, 0]


def test_the_forms_have_the_same_slope_of_height_by_position() -> None:
    """By position, a height has the unit vector across the ray as slope, an angle a multiple."""
    x, u = state(), seen()

    def slope(form: RayForm) -> Array:
        given = params(form)

        def channels(dr: Array) -> Array:
            at = retract_total(x, jnp.zeros(15).at[LAYOUT.dr].set(dr))
            return MODELS[form].observe(given, at, u)[3:6]

        return compiled(jax.jacfwd(channels))(jnp.zeros(3))

    by_height, by_angle = slope("height"), slope("angle")
    np.testing.assert_allclose(np.linalg.norm(by_height, axis=1), 1, rtol=2e-3)
    np.testing.assert_allclose(jnp.sum(by_height * u.star, axis=1), 0, atol=2e-3)
    # dR = dh / (dh_a/dR - dh_ray/dR), the divisor being the height's noise per angle, negative.
    noise = jnp.sqrt(jnp.diag(HEIGHTS.observation_noise(params(density_sigma=0.0), x, u))[3:6])
    per_angle = noise / (3 * ARCSEC)
    np.testing.assert_allclose(by_angle * per_angle[:, None], by_height, rtol=0.03, atol=1e-3)


def test_a_height_at_25_km_is_uncertain_by_some_165_m() -> None:
    """(H / R + u) sigma with H / R = 44 and u = 7 to 18 m per arc second (specification)."""
    x = state()
    noise = HEIGHTS.observation_noise(params(density_sigma=0.0), x, seen())
    sigma = np.sqrt(np.diag(noise))[3:6]
    assert np.all((sigma > 100) & (sigma < 280))
    assert np.all(np.diff(sigma) > 0)


@pytest.mark.parametrize("form", ["height", "angle"])
def test_the_additive_noise_is_the_true_one_to_first_order(form: RayForm) -> None:
    x, u, p = state(), seen(), params(form)
    model = MODELS[form]
    assert model.noisy is not None
    variances = model.noisy.noise(p, x, u)
    zero, z = jnp.zeros_like(variances), model.observe(p, x, u)
    np.testing.assert_array_equal(compiled(model.noisy.observe)(p, x, zero, u), z)

    def residual(v: Array) -> Array:
        return model.residual(model.noisy.observe(p, x, v, u), z)  # pyright: ignore

    G = compiled(jax.jacfwd(residual))(zero)
    R = model.observation_noise(p, x, u)
    np.testing.assert_allclose(R, (G * variances[None]) @ G.T, rtol=1e-9, atol=1e-14)
    common = np.asarray(R)[3:6, 3:6]
    assert np.all(common[np.triu_indices(3, 1)] > 0), "one density moves all heights together"
    # 1 % of density is 1 % of a scale height.
    if form == "height":
        np.testing.assert_allclose(np.sqrt(common[0, 1]), 64, rtol=0.06)


def test_the_noise_of_the_accelerometers_is_that_of_their_mean() -> None:
    x, u, p = state(), seen(), params()
    R = HEIGHTS.observation_noise(p, x, u)
    expected = np.full(3, p.accel_noise[0] ** 2 * IMU_STEP / PERIOD)
    np.testing.assert_allclose(np.diag(R)[-3:], expected, rtol=1e-12)


def test_with_no_star_in_view_the_filter_uses_the_rest_and_says_how_much() -> None:
    x, u = state(), seen()
    lost = u._replace(star=jnp.zeros((3, 3)).at[:, 1].set(-1.0), angle=jnp.full(3, 1e-3))
    cov = jnp.diag(jnp.repeat(jnp.array([1e-5, 0.1, 100.0, 1e-6, 1e-3]), 3) ** 2)
    given = FilterParams(params(), Gaussian(x, cov))
    z = observations(x.dcm, lost.angle, x.bias)
    for filter in (ckf(HEIGHTS), modified_iterated_ckf(HEIGHTS)):
        start, update = compiled(filter.init)(given), compiled(filter.update)
        none = Obs(jnp.full(9, jnp.nan), jnp.zeros(9, bool))
        kept, info = update(given, start, lost, none)
        assert int(info.flags) == Flag.NO_OBSERVATION
        np.testing.assert_allclose(filter.estimate(kept).cov, cov, rtol=1e-9, atol=1e-30)
        without = Obs(z.at[3:6].set(jnp.nan), jnp.ones(9, bool).at[3:6].set(False))
        aided, info = update(given, start, lost, without)
        assert int(info.flags) == 0
        after = jnp.diag(filter.estimate(aided).cov)
        np.testing.assert_allclose(after[LAYOUT.dr], 1e4, rtol=1e-6)
        assert np.all(after[LAYOUT.nabla] < 0.9 * 1e-6)
        assert np.all(np.isfinite(filter.estimate(aided).cov))


def test_no_stars_at_all_leaves_attitude_and_accelerometers() -> None:
    x = state()
    bare = seen()._replace(star=jnp.zeros((0, 3)), angle=jnp.zeros(0))
    without = sins_rkcns(PERIOD, IMU_STEP, MEAN_RADIUS, 0)
    assert [name for name, _ in without.channels] == ["attitude", "accelerometer"]
    assert without.observe(params(), x, bare).shape == (6,)
    assert np.all(without.observation_noise(params(), x, bare) > 0)


def test_another_number_of_stars_than_the_model_has_is_refused() -> None:
    bare = seen()._replace(star=jnp.zeros((2, 3)), angle=jnp.zeros(2))
    with pytest.raises(ValueError, match=r"the input has stars \(2, 3\) and angles \(2,\); .* 3"):
        HEIGHTS.observe(params(), state(), bare)


def test_an_unknown_form_is_refused() -> None:
    with pytest.raises(ValueError, match="ray is 'length'; it must be one of height, angle"):
        sins_rkcns(1.0, 0.01, MEAN_RADIUS, 3, "length")  # pyright: ignore[reportArgumentType]
