"""Iterated filters: the Kalman filter where linear, the posterior's mode where not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from scipy.optimize import least_squares, minimize

from jaxnav.estimation.banks.mixture import BankParams, mmae
from jaxnav.estimation.filters.iterated import (
    Search,
    iterated_ckf,
    iterated_ekf,
    modified_iterated_ckf,
)
from jaxnav.estimation.filters.sigma_point import ckf
from jaxnav.estimation.run import run
from jaxnav.estimation.types import (
    Filter,
    FilterParams,
    Flag,
    Gaussian,
    Model,
    NonAdditive,
    Obs,
    replicate,
)

MAKERS = {"ekf": iterated_ekf, "ckf": iterated_ckf, "modified": modified_iterated_ckf}
CUBATURE = {name: MAKERS[name] for name in ("ckf", "modified")}
FINE = Search(spread=1e-4)
ANCHORS = jnp.array([[0.0, 0.0], [3.0, 0.0], [0.0, 4.0]])
SPREAD_NOISE = jnp.array([[0.02, 0.01, 0.0], [0.01, 0.03, 0.0], [0.0, 0.0, 0.02]])
OBSERVATION = jnp.array([[1.0, 0.0, 0.5], [0.0, 2.0, -0.3]])


def still(observe, noise, **slots) -> Model:
    """A state that stays, seen by a function."""
    return Model(
        transition=lambda p, x, u: x,
        process_noise=lambda p, x, u: jnp.zeros((x.shape[0],) * 2, x.dtype),
        observe=lambda p, x, u: observe(x),
        observation_noise=lambda p, x, u: p * noise,
        **slots,
    )


def ranges(x: Array) -> Array:
    return jnp.sqrt(jnp.sum((x[None] - ANCHORS) ** 2, axis=1))


RANGING = still(ranges, SPREAD_NOISE)
LINEAR = still(lambda x: OBSERVATION @ x, jnp.array([[0.5, 0.1], [0.1, 0.8]]))


def updated(filter: Filter, params: FilterParams, obs: Obs):
    @jax.jit
    def one(params: FilterParams, obs: Obs):
        state, info = filter.update(params, filter.init(params), 0.0, obs)
        return filter.estimate(state), info

    return one(params, obs)


def cases(count: int) -> tuple[Gaussian, Obs]:
    """Priors near the anchors, and observations some deviations off what they predict."""
    rng = np.random.default_rng(5)
    mean = jnp.array(1.5 + rng.normal(size=(count, 2)))
    root = jnp.array(rng.normal(size=(count, 2, 2)))
    cov = root @ jnp.swapaxes(root, 1, 2) + 0.3 * jnp.eye(2)[None]
    z = jax.vmap(ranges)(mean + 0.7 * jnp.array(rng.normal(size=(count, 2))))
    return Gaussian(mean, cov), Obs(z, jnp.ones((count, 3), bool))


@pytest.mark.parametrize("iterations", [1, 2, 5])
def test_linear_models_give_the_kalman_filter(iterations: int) -> None:
    """Whatever the number of iterations, over three updates with a channel lost in one."""
    prior = Gaussian(
        jnp.array([0.5, -0.5, 0.1]), jnp.array([[1, 0.2, 0], [0.2, 2, 0], [0, 0, 0.5]])
    )
    z = jnp.array([[1.0, 2.0], [0.3, jnp.nan], [-1.0, 0.5]])
    valid = jnp.isfinite(z)
    H, R = np.asarray(OBSERVATION), np.array([[0.5, 0.1], [0.1, 0.8]])
    x, P = np.asarray(prior.mean), np.asarray(prior.cov)
    for value, arrived in zip(np.asarray(z), np.asarray(valid), strict=True):
        A, N = H[arrived], R[np.ix_(arrived, arrived)]
        K = P @ A.T @ np.linalg.inv(A @ P @ A.T + N)
        x, P = x + K @ (value[arrived] - A @ x), P - K @ A @ P
    for name, make in MAKERS.items():
        filter, params = make(LINEAR, iterations=iterations), FilterParams(jnp.array(1.0), prior)
        trace = run(filter, params, jnp.zeros(3), Obs(z, valid))
        mean, cov = filter.estimate(trace.final)
        np.testing.assert_allclose(mean, x, rtol=1e-12, err_msg=name)
        np.testing.assert_allclose(cov, P, rtol=1e-12, atol=1e-14, err_msg=name)


def test_one_full_step_is_the_cubature_filter() -> None:
    priors, obs = cases(20)
    one, plain = iterated_ckf(RANGING, iterations=1, trials=0), ckf(RANGING)
    params = FilterParams(replicate(jnp.array(1.0), 20), priors)
    ours, info = jax.vmap(lambda p, o: updated(one, p, o))(params, obs)
    theirs, told = jax.vmap(lambda p, o: updated(plain, p, o))(params, obs)
    np.testing.assert_allclose(ours.mean, theirs.mean, rtol=1e-11)
    np.testing.assert_allclose(ours.cov, theirs.cov, rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(info.log_likelihood, told.log_likelihood, rtol=1e-10)
    np.testing.assert_allclose(info.nis, told.nis, rtol=1e-10)


def mode(prior: Gaussian, z: Array, start: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the minimiser of the posterior functional, and its value, by another's hand."""
    inner = np.linalg.inv(np.linalg.cholesky(np.asarray(prior.cov)))
    outer = np.linalg.inv(np.linalg.cholesky(np.asarray(SPREAD_NOISE)))
    anchors = np.asarray(ANCHORS)

    def residual(x: np.ndarray) -> np.ndarray:
        seen = np.sqrt(((x - anchors) ** 2).sum(axis=1))
        return np.concatenate([inner @ (x - prior.mean), outer @ (z - seen)])

    found = least_squares(residual, start, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return found.x, 2 * found.cost


def test_strongly_nonlinear_ones_find_the_mode_that_scipy_finds() -> None:
    """Forty iterations: Gauss-Newton converges linearly where residuals are large."""
    priors, obs = cases(24)
    params = FilterParams(replicate(jnp.array(1.0), 24), priors)
    for name, make in MAKERS.items():
        filter = make(RANGING, iterations=40, search=FINE)
        found, _ = jax.jit(jax.vmap(lambda p, o, f=filter: updated(f, p, o)))(params, obs)
        for i in range(24):
            prior = Gaussian(priors.mean[i], priors.cov[i])
            expected, _ = mode(prior, obs.z[i], np.asarray(found.mean[i]))
            np.testing.assert_allclose(found.mean[i], expected, atol=1e-6, err_msg=name)


def test_the_full_spread_has_another_fixed_point() -> None:
    """It is that of the statistical linearisation; the difference falls with the spread squared."""
    priors, obs = cases(24)

    def found(spread: float) -> Array:
        filter = iterated_ckf(RANGING, iterations=40, trials=0)
        search = Search(spread=jnp.full(24, spread), step=0.5 * jnp.ones(24))
        search = search._replace(sufficient=jnp.zeros(24), temperature=jnp.zeros(24))
        params = FilterParams(replicate(jnp.array(1.0), 24), priors, search=search)
        return jax.vmap(lambda p, o: updated(filter, p, o)[0].mean)(params, obs)

    exact = found(1e-4)
    far = jnp.median(jnp.linalg.norm(found(1.0) - exact, axis=1))
    near = jnp.linalg.norm(found(0.02) - exact, axis=1)
    nearer = jnp.linalg.norm(found(0.01) - exact, axis=1)
    assert far > 0.02
    assert 3.8 < float(jnp.median(near / nearer)) < 4.2


def implicit(x: Array, v: Array) -> Array:
    """Two channels whose noise is inside a logarithm and a product; three sources."""
    return jnp.stack([jnp.log(3.0 + v[0]) - 0.5 * x[0] ** 2, (1 + v[1]) * x[1] + v[2]])


SOURCES = jnp.array([0.3, 0.05, 0.1])


def noisy_model() -> Model:
    G = jax.jacfwd(lambda v: implicit(jnp.array([1.0, 1.0]), v))(jnp.zeros(3))
    return still(
        lambda x: implicit(x, jnp.zeros(3)),
        (G * SOURCES[None] ** 2) @ G.T,
        noisy=NonAdditive(lambda p, x, v, u: implicit(x, v), lambda p, x, u: SOURCES**2),
    )


def test_noise_that_does_not_add_is_estimated_with_the_state() -> None:
    """The least |xi|^2 + |v|^2 under h(x, v) = z, by SLSQP."""
    filter = modified_iterated_ckf(noisy_model(), iterations=60, search=FINE)
    mean, cov = np.array([1.2, 0.8]), np.array([[0.2, 0.05], [0.05, 0.3]])
    inner = np.linalg.inv(np.linalg.cholesky(cov))
    for z in ([-0.1, 0.5], [0.6, 1.4]):
        params = FilterParams(jnp.array(1.0), Gaussian(jnp.array(mean), jnp.array(cov)))
        found, _ = updated(filter, params, Obs(jnp.array(z), jnp.ones(2, bool)))
        best = minimize(
            lambda y: np.sum((inner @ (y[:2] - mean)) ** 2) + np.sum((y[2:] / SOURCES) ** 2),
            np.concatenate([mean, np.zeros(3)]),
            constraints={
                "type": "eq",
                "fun": lambda y, z=z: (
                    np.array([np.log(3 + y[2]) - 0.5 * y[0] ** 2, (1 + y[3]) * y[1] + y[4]])
                    - np.array(z)
                ),
            },
            options={"ftol": 1e-15, "maxiter": 500},
        )
        np.testing.assert_allclose(found.mean, best.x[:2], atol=1e-6)


def test_noise_that_adds_cancels_from_the_augmented_step() -> None:
    priors, obs = cases(12)
    params = FilterParams(replicate(jnp.array(1.0), 12), priors)
    given = RANGING._replace(
        noisy=NonAdditive(lambda p, x, v, u: ranges(x) + v, lambda p, x, u: p * SPREAD_NOISE)
    )
    ends = [
        jax.vmap(lambda p, o, f=filter: updated(f, p, o)[0])(params, obs)
        for filter in (
            iterated_ckf(RANGING, search=FINE),
            modified_iterated_ckf(RANGING, search=FINE),
            modified_iterated_ckf(given, search=FINE),
        )
    ]
    for other in ends[1:]:
        np.testing.assert_allclose(other.mean, ends[0].mean, rtol=1e-6)
        np.testing.assert_allclose(other.cov, ends[0].cov, rtol=1e-5, atol=1e-9)


def test_the_printed_iteration_diverges() -> None:
    """P = R = 1, h = x, z = 1: x_j+1 = 2 x_j + (1 + x_j) / 2, so that x_j = (2.5^j - 1) / 3."""
    scalar = still(lambda x: x, jnp.eye(1))
    prior = FilterParams(jnp.array(1.0), Gaussian(jnp.zeros(1), jnp.eye(1)))
    obs = Obs(jnp.ones(1), jnp.ones(1, bool))
    for make in CUBATURE.values():
        for iterations in (1, 2, 4, 8):
            printed, _ = updated(make(scalar, iterations=iterations, printed=True), prior, obs)
            np.testing.assert_allclose(printed.mean, [(2.5**iterations - 1) / 3], rtol=1e-9)
            corrected, _ = updated(make(scalar, iterations=iterations), prior, obs)
            np.testing.assert_allclose(corrected.mean, [0.5], rtol=1e-12)


def test_the_search_never_climbs_and_saves_what_full_steps_lose() -> None:
    """For atan far from its root a full Gauss-Newton step overshoots, further each time."""
    bent = still(lambda x: jnp.arctan(x), 1e-4 * jnp.eye(1))
    prior = Gaussian(jnp.array([2.0]), jnp.array([[4.0]]))
    obs = Obs(jnp.zeros(1), jnp.ones(1, bool))

    def functional(x: Array) -> float:
        return float((x[0] - 2.0) ** 2 / 4 + jnp.arctan(x[0]) ** 2 / 1e-4)

    def ends(trials: int) -> list[float]:
        made = (iterated_ekf(bent, iterations=j, trials=trials) for j in range(1, 9))
        params = FilterParams(jnp.array(1.0), prior)
        return [functional(updated(filter, params, obs)[0].mean) for filter in made]

    guarded, free = ends(8), ends(0)
    assert np.all(np.diff([functional(prior.mean), *guarded]) <= 1e-12)
    # The mode is near zero, where the prior alone costs one.
    assert guarded[-1] == pytest.approx(1.0, abs=0.01)
    assert min(free) > 100


def test_gradients_are_exact_and_finite() -> None:
    """Of estimate, covariance and likelihood, by prior, noise, step length and temperature."""
    obs = Obs(jnp.array([1.5, 2.6, 2.9]), jnp.ones(3, bool))
    lost = Obs(jnp.full(3, jnp.nan), jnp.zeros(3, bool))
    at = jnp.array([1.0, 1.4, 1.2, 0.9, 0.5])
    for make in MAKERS.values():
        filter = make(RANGING, iterations=2, trials=3)

        def outcome(a: Array, obs: Obs, cov: Array, filter: Filter = filter) -> Array:
            search = Search(spread=0.3, step=a[3], temperature=a[4])
            params = FilterParams(a[2], Gaussian(a[:2], cov), search=search)
            found, info = updated(filter, params, obs)
            return jnp.sum(found.mean) + jnp.sum(found.cov) + info.log_likelihood

        backward = jax.jit(jax.grad(outcome))
        exact = backward(at, obs, jnp.eye(2))
        np.testing.assert_allclose(
            jax.jit(jax.jacfwd(outcome))(at, obs, jnp.eye(2)), exact, rtol=1e-9
        )
        value = jax.jit(jax.vmap(outcome, (0, None, None)))
        step = 1e-4 * jnp.eye(5)
        ends = [value(at[None] + k * step, obs, jnp.eye(2)) for k in (-2, -1, 1, 2)]
        numeric = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / 12e-4
        np.testing.assert_allclose(exact, numeric, rtol=1e-6, atol=1e-8)
        assert np.all(np.isfinite(backward(at, lost, jnp.eye(2))))
        assert np.all(np.isfinite(backward(at, obs, jnp.diag(jnp.array([1.0, 0.0])))))


def test_the_smooth_search_tends_to_the_hard_one() -> None:
    priors, obs = cases(12)
    filter = iterated_ekf(RANGING, iterations=3)

    def found(temperature: float) -> Array:
        search = Search(temperature=temperature)

        def one(mean: Array, cov: Array, o: Obs) -> Array:
            given = FilterParams(jnp.array(1.0), Gaussian(mean, cov), search=search)
            return updated(filter, given, o)[0].mean

        return jax.vmap(one)(*priors, obs)

    gap = [float(jnp.max(jnp.abs(found(t) - found(0.0)))) for t in (1.0, 1e-2, 1e-8)]
    assert gap[0] > gap[1] > gap[2]
    assert gap[2] < 1e-5


def test_members_of_a_bank_may_differ_in_their_search() -> None:
    priors, obs = cases(1)
    first = jax.tree.map(lambda leaf: leaf[0], priors)
    one = Obs(obs.z[0], obs.valid[0])
    steps = jnp.array([0.25, 1.0])
    search = replicate(Search(1.0, 1.0, 0.0, 0.0), 2)._replace(step=steps)
    members = replicate(FilterParams(jnp.array(1.0), first), 2)._replace(search=search)
    filter = iterated_ckf(RANGING, iterations=2, trials=0)
    bank = mmae(filter)
    params = BankParams(members, ())
    state, _ = bank.update(params, bank.predict(params, bank.init(params), 0.0), 0.0, one)
    for j, step in enumerate(steps):
        alone = FilterParams(jnp.array(1.0), first, search=Search(step=step))
        expected, _ = updated(filter, alone, one)
        np.testing.assert_allclose(state.members.x[j], expected.mean, rtol=1e-12)
    assert not np.allclose(state.members.x[0], state.members.x[1])


def test_flags_and_counts() -> None:
    priors, obs = cases(1)
    prior, one = Gaussian(priors.mean[0], priors.cov[0]), Obs(obs.z[0], obs.valid[0])
    for make in MAKERS.values():
        filter = make(RANGING)
        none = Obs(jnp.full(3, jnp.nan), jnp.zeros(3, bool))
        kept, info = updated(filter, FilterParams(jnp.array(1.0), prior), none)
        assert int(info.flags) == Flag.NO_OBSERVATION
        np.testing.assert_allclose(kept.mean, prior.mean, rtol=1e-15)
        np.testing.assert_allclose(kept.cov, prior.cov, rtol=1e-13)
        _, info = updated(filter, FilterParams(jnp.array(1.0), prior), one)
        assert 1 <= int(info.iterations) <= 3
        bent = prior._replace(cov=jnp.array([[1.0, 2.0], [2.0, 1.0]]))
        _, info = updated(filter, FilterParams(jnp.array(1.0), bent), one)
        assert int(info.flags) & Flag.INDEFINITE
    broken = FilterParams(jnp.array(-100.0), prior)
    for make in (iterated_ekf, iterated_ckf):
        kept, info = updated(make(RANGING), broken, one)
        assert int(info.flags) & Flag.NOT_POSITIVE_DEFINITE
        assert info.log_likelihood == -jnp.inf
        np.testing.assert_array_equal(kept.mean, prior.mean)


def test_bad_arguments_are_named() -> None:
    with pytest.raises(ValueError, match="iterations = 0, trials = 6; an iterated filter needs at"):
        iterated_ckf(RANGING, iterations=0)
    with pytest.raises(ValueError, match="iterations = 3, trials = -1"):
        modified_iterated_ckf(RANGING, trials=-1)
    priors, obs = cases(1)
    wrong = FilterParams(jnp.array(1.0), Gaussian(priors.mean[0], priors.cov[0]), search=0.5)
    filter = iterated_ekf(RANGING)
    with pytest.raises(ValueError, match="search is a float; it must be a Search, or"):
        filter.update(wrong, filter.init(wrong), 0.0, Obs(obs.z[0], obs.valid[0]))
