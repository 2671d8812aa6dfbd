"""Sigma-point rules and filters: exact moments, ranges of the parameters, both forms alike."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.estimation.filters.kalman import ekf
from jaxnav.estimation.filters.sigma_point import ckf, drawn, square_root_ukf, ukf
from jaxnav.estimation.run import run
from jaxnav.estimation.tune.losses import negative_log_likelihood
from jaxnav.estimation.types import Filter, FilterParams, Flag, Gaussian, Info, Model, Obs
from jaxnav.numerics.sigma import SigmaRule, cubature, unscented
from tests.oracles.matrices import random_spd

STEPS = 20
RULES: dict[str, tuple[int, SigmaRule]] = {
    "cubature": (4, cubature(4)),
    "unscented": (4, unscented(4)),
    "one state": (1, unscented(1)),
    "fine": (4, unscented(4, alpha=1e-3)),
    "negative centre": (6, unscented(6, beta=0.0, kappa=-3.0)),
    "wide": (15, unscented(15, alpha=1.5, kappa=2.0)),
}


@pytest.mark.parametrize("name", RULES)
def test_rule_has_the_moments_of_a_gaussian(name: str) -> None:
    """Mean, covariance and the third moments, which vanish."""
    n, rule = RULES[name]
    rng = np.random.default_rng(n)
    P = random_spd(rng, 1, n)[0]
    cloud = drawn(rule, jnp.array(np.linalg.cholesky(P)))
    offsets = np.asarray(cloud.offsets)
    scale = rule.weight * np.abs(offsets).max() ** 3
    np.testing.assert_array_equal(cloud.centre, 0)
    np.testing.assert_allclose(rule.weight * offsets.sum(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(rule.weight * offsets.T @ offsets, P, rtol=1e-12, atol=1e-12)
    third = rule.weight * np.einsum("ki,kj,kl->ijl", offsets, offsets, offsets)
    np.testing.assert_allclose(third, 0, atol=1e-13 * scale)
    # what the points leave of the sum of one is the centre's weight for means
    assert rule.spread**2 * rule.weight == pytest.approx(0.5, rel=1e-14)


def test_cubature_is_an_unscented_rule_without_a_centre() -> None:
    """With lambda = 0 the covariance weight of the centre is 1 - alpha^2 + beta = beta."""
    for n in (1, 4, 15):
        even = unscented(n, alpha=1.0, beta=0.0, kappa=0.0)
        np.testing.assert_allclose(np.array(even, float), np.array(cubature(n), float), rtol=1e-15)
        assert unscented(n, beta=2.0).centre == 2
    by_hand = unscented(4, alpha=0.5, beta=2.0, kappa=1.0)  # n + lambda = 1.25
    expected = [1.25**0.5, 0.4, -2.75 / 1.25 + 1 - 0.25 + 2]
    np.testing.assert_allclose(np.array(by_hand, float), expected, rtol=1e-15)


def test_rules_without_meaning_are_refused() -> None:
    cases = [({"kappa": -15.0}, "= 0.0"), ({"kappa": -20.0}, "= -5.0"), ({"alpha": 0.0}, "= 0.0")]
    for keywords, total in cases:
        with pytest.raises(ValueError, match=rf"{total} for n = 15 states.*kappa above -15"):
            unscented(15, **keywords)
    with pytest.raises(ValueError, match=r"kappa = -20.0.* for n = 2 states"):
        filtered(ukf(VAN_DER_POL, kappa=-20.0), PARAMS)


def flow(x: Array) -> Array:
    """A mildly nonlinear oscillator."""
    return jnp.stack([x[0] + 0.1 * x[1], x[1] + 0.1 * ((1 - x[0] ** 2) * x[1] - x[0])])


VAN_DER_POL = Model(
    transition=lambda p, x, u: flow(x),
    process_noise=lambda p, x, u: 0.01 * jnp.eye(2),
    observe=lambda p, x, u: jnp.stack([x[0] + 0.1 * x[0] ** 2]),
    observation_noise=lambda p, x, u: jnp.full(1, 0.1),
)
PARAMS = FilterParams((), Gaussian(jnp.array([1.0, 0.5]), 0.1 * jnp.eye(2)))
Z = jnp.array(np.sin(0.1 * np.arange(STEPS)) + 0.3 * np.random.default_rng(1).normal(size=STEPS))
OBS = Obs(Z[:, None], jnp.ones((STEPS, 1), bool))


def filtered(filter: Filter, params: FilterParams) -> tuple[Gaussian, Info]:
    return run(filter, params, jnp.zeros(STEPS), OBS).record


def arrays(rule: SigmaRule) -> SigmaRule:
    return SigmaRule(*(jnp.asarray(entry) for entry in rule))


UKF, SQUARE_ROOT_UKF = ukf(VAN_DER_POL), square_root_ukf(VAN_DER_POL)


@pytest.mark.parametrize(
    "rule",
    [cubature(2), unscented(2, alpha=0.5), unscented(2, kappa=-1.0, beta=0.0), unscented(2, 1e-3)],
)
def test_rule_of_the_parameters_and_both_forms_agree(rule: SigmaRule) -> None:
    """Also with a negative centre, which is a downdate in the square-root form."""
    plain, seen = filtered(UKF, PARAMS._replace(own=arrays(rule)))
    rooted, seen_too = filtered(SQUARE_ROOT_UKF, PARAMS._replace(own=arrays(rule)))
    assert np.all(np.asarray(seen.flags) == 0)
    assert np.all(np.asarray(seen_too.flags) == 0)
    # weights of 1e6 leave ten digits
    tolerance = 1e-12 if rule.weight < 10 else 1e-8
    np.testing.assert_allclose(rooted.mean, plain.mean, rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(rooted.cov, plain.cov, rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(seen_too.log_likelihood, seen.log_likelihood, rtol=10 * tolerance)


def test_rule_of_the_parameters_equals_the_keyword() -> None:
    static, _ = filtered(ukf(VAN_DER_POL, alpha=0.7, beta=1.0, kappa=0.5), PARAMS)
    given, _ = filtered(UKF, PARAMS._replace(own=arrays(unscented(2, 0.7, 1.0, 0.5))))
    default, _ = filtered(UKF, PARAMS)
    np.testing.assert_allclose(given.mean, static.mean, rtol=1e-13)
    np.testing.assert_allclose(given.cov, static.cov, rtol=1e-13)
    assert np.abs(default.mean - static.mean).max() > 1e-5


@pytest.mark.parametrize("filter", [UKF, SQUARE_ROOT_UKF])
def test_gradient_by_alpha(filter: Filter) -> None:
    @compiled
    def loss(alpha: Array) -> Array:
        params = PARAMS._replace(own=unscented(2, alpha=alpha))
        return negative_log_likelihood(filter, params, jnp.zeros(STEPS), OBS)

    numeric = (loss(jnp.array(0.8 + 1e-5)) - loss(jnp.array(0.8 - 1e-5))) / 2e-5
    assert abs(numeric) > 1e-6
    np.testing.assert_allclose(compiled(jax.grad(loss))(jnp.array(0.8)), numeric, rtol=1e-6)


def squares(count: int) -> Model:
    """A constant state; what is seen is the square of its norm."""
    return Model(
        transition=lambda p, x, u: x,
        process_noise=lambda p, x, u: jnp.zeros((count, count)),
        observe=lambda p, x, u: jnp.sum(x * x)[None],
        observation_noise=lambda p, x, u: jnp.full(1, 0.01),
    )


def one_update(filter: Filter, params: FilterParams, z: float) -> tuple[Gaussian, Info]:
    def update(params: FilterParams, z: Array) -> tuple[Gaussian, Info]:
        obs = Obs(z, jnp.ones(1, bool))
        state, info = filter.update(params, filter.init(params), jnp.zeros(()), obs)
        return filter.estimate(state), info

    return compiled(update)(params, jnp.array([z]))


def test_square_of_a_gaussian_has_its_exact_moments() -> None:
    """Those of x^2 are m^2 + P and 4 m^2 P + 2 P^2, which a linear filter misses.

    With alpha = 1 and t = 1 + kappa the points lie at m +- sqrt(t P) and deviate from the mean by
    +-2 m sqrt(t P) + (t - 1) P with the weight 1 / (2 t), the centre by -P with 1 - 1/t + beta: in
    all 4 m^2 P + (t - 1 + beta) P^2, which is exact for kappa = 2 - beta.
    """
    m, P, R = 0.7, 0.4, 0.01
    params = FilterParams((), Gaussian(jnp.array([m]), jnp.array([[P]])))
    mean, variance = m**2 + P, 4 * m**2 * P + 2 * P**2
    for beta, kappa in ((2.0, 0.0), (0.0, 2.0), (1.0, 1.0)):
        for build in (ukf, square_root_ukf):
            filter = build(squares(1), beta=beta, kappa=kappa)
            _, info = one_update(filter, params, 2.0)
            np.testing.assert_allclose(info.innovation, [2 - mean], rtol=1e-13)
            np.testing.assert_allclose(info.innovation_cov, [[variance + R]], rtol=1e-13)
    _, linear = one_update(ekf(squares(1)), params, 2.0)
    np.testing.assert_allclose(linear.innovation, [2 - m**2], rtol=1e-13)
    np.testing.assert_allclose(linear.innovation_cov, [[4 * m**2 * P + R]], rtol=1e-13)


def test_downdate_that_fails_is_flagged_and_finite() -> None:
    """At the origin all points see 6 P, the centre 0: their spread is the centre's, taken away."""
    n = 6
    params = FilterParams((), Gaussian(jnp.zeros(n), jnp.eye(n)))
    for build, flag in (
        (square_root_ukf, Flag.INDEFINITE),
        (ukf, Flag.NOT_POSITIVE_DEFINITE),
    ):
        estimate, info = one_update(build(squares(n), beta=0.0, kappa=-3.0), params, 5.0)
        assert info.flags & flag
        assert np.all(np.isfinite(estimate.mean))
        assert np.linalg.eigvalsh(estimate.cov).min() >= 0
    _, control = one_update(ckf(squares(n)), params, 5.0)
    assert control.flags == 0


@pytest.mark.parametrize("build", [ukf, ckf])
def test_update_without_a_redraw_misses_the_process_noise(build) -> None:
    """Eq. (19) of Zhao et al. on a linear model: S = H (P- - Q) H' + R and P = P- - K S K'."""
    rng = np.random.default_rng(2)
    A, H, P0, Q, R = (
        rng.normal(size=(3, 3)),
        rng.normal(size=(2, 3)),
        *random_spd(rng, 2, 3),
        random_spd(rng, 1, 2)[0],
    )
    model = Model(
        transition=lambda p, x, u: jnp.array(A) @ x,
        process_noise=lambda p, x, u: jnp.array(Q),
        observe=lambda p, x, u: jnp.array(H) @ x,
        observation_noise=lambda p, x, u: jnp.array(R),
    )
    x0, z = rng.normal(size=3), rng.normal(size=(1, 2))
    params = FilterParams((), Gaussian(jnp.array(x0), jnp.array(P0)))
    filter = build(model, redraw=False)
    estimate, info = run(filter, params, jnp.zeros(1), Obs(jnp.array(z), jnp.ones((1, 2), bool)))[0]
    missing = A @ P0 @ A.T
    S = H @ missing @ H.T + R
    K = missing @ H.T @ np.linalg.inv(S)
    x = A @ x0
    np.testing.assert_allclose(info.innovation_cov[0], S, rtol=1e-12)
    np.testing.assert_allclose(estimate.mean[0], x + K @ (z[0] - H @ x), rtol=1e-11)
    expected = missing + Q - K @ S @ K.T
    np.testing.assert_allclose(estimate.cov[0], expected, rtol=1e-11, atol=1e-12)
