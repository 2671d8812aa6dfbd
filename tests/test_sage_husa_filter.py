"""Sage-Husa filters: loops in NumPy, noise that is found and stays positive definite."""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.estimation.filters.kalman import kf
from jaxnav.estimation.filters.sage_husa import SageHusa, averaging, sage_husa
from jaxnav.estimation.run import run
from jaxnav.estimation.types import (
    Filter,
    FilterParams,
    Flag,
    Gaussian,
    Model,
    NonAdditive,
    Obs,
)
from tests.oracles import adaptive as loop
from tests.oracles.kalman import Linear

PHI = np.array([[0.95, 0.3], [0.0, 0.9]])
Q = np.array([[0.3, 0.1], [0.1, 0.2]])
H = np.array([[1.0, 0.2], [0.3, 1.0]])
R = np.array([[1.0, 0.3], [0.3, 0.5]])
MODEL = Model(
    transition=lambda p, x, u: jnp.asarray(PHI, x.dtype) @ x,
    process_noise=lambda p, x, u: p * jnp.asarray(Q, x.dtype),
    observe=lambda p, x, u: jnp.asarray(H, x.dtype) @ x,
    observation_noise=lambda p, x, u: u * jnp.asarray(R, x.dtype),
)
"""The parameter is a factor on Q, the input one on R: how the receiver grades its data."""
STEPS = 240
LOST, UNUSABLE, PERFECT = slice(100, 110), 150, 170
"""Steps without data, with a noise that fails the update, and with one of zero."""


class Own(NamedTuple):
    """A case of the loop: the averaging, factor on Q, variance at the start, whether data fail."""

    averaging: loop.Averaging
    q: float = 1.0
    start: float = 1.0
    harmed: bool = True


OPEN = (-np.inf, np.inf)
OWN = {
    "held": Own(loop.Averaging(1.0, np.inf, 0.1, 100.0)),
    "average": Own(loop.Averaging(1.0, 0.0, *OPEN), start=0.0, harmed=False),
    "exact": Own(loop.Averaging(1.0, 1.0, *OPEN), q=0.0, start=0.0, harmed=False),
    "forgetting": Own(loop.Averaging(0.9, 3.0, 0.5, 2.0)),
    "endless": Own(loop.Averaging(0.97, np.inf, 0.01, 1e4)),
}
NAMES = list(OWN)


class Data(NamedTuple):
    """Grades ``(C, T)``, observations and masks ``(C, T, 2)`` of the cases."""

    grade: np.ndarray
    z: np.ndarray
    valid: np.ndarray


def walk(rng: np.random.Generator, steps: int, q: float, factor: np.ndarray) -> np.ndarray:
    """Observations ``(T, 2)`` of the model, from zero, with ``factor (T,)`` on its R."""
    w = np.sqrt(q) * rng.normal(size=(steps, 2)) @ np.linalg.cholesky(Q).T
    v = rng.normal(size=(steps, 2)) @ np.linalg.cholesky(R).T
    x, states = np.zeros(2), np.empty((steps, 2))
    for k in range(steps):
        x = PHI @ x + w[k]
        states[k] = x
    return states @ H.T + np.sqrt(factor)[:, None] * v


def _data() -> Data:
    """True noise first four times the model's, then a tenth of it; graded where data fail."""
    rng = np.random.default_rng(11)
    rows = []
    for own in OWN.values():
        grade, valid = np.ones(STEPS), np.ones((STEPS, 2), bool)
        if own.harmed:
            grade = rng.uniform(1, 3, STEPS)
        factor = np.where(np.arange(STEPS) < STEPS // 2, 4.0, 0.1)
        z = walk(rng, STEPS, own.q, grade * factor)
        if own.harmed:
            valid = rng.uniform(size=(STEPS, 2)) > 0.25
            valid[LOST], valid[[UNUSABLE, PERFECT]] = False, True
            grade[UNUSABLE], grade[PERFECT] = -1e3, 0.0
        rows.append((grade, z, valid))
    grades, observed, masks = (np.array(column) for column in zip(*rows, strict=True))
    return Data(grades, observed, masks)


DATA = _data()


def members(temperature: float = 0.02) -> FilterParams:
    """Parameters of the cases, a leading axis."""

    def column(values: Any) -> Array:
        return jnp.array(list(values), float)

    own = [column(values) for values in zip(*(o.averaging for o in OWN.values()), strict=True)]
    size = len(OWN)
    start = column(o.start for o in OWN.values())
    prior = Gaussian(jnp.zeros((size, 2)), start[:, None, None] * jnp.eye(2)[None])
    adaptation = SageHusa(*own, temperature=jnp.full(size, temperature))
    return FilterParams(column(o.q for o in OWN.values()), prior, own=adaptation)


FILTERS = {
    "clamped": {"form": "clamped"},
    "clamped, current": {"form": "clamped", "current": True},
    "clamped, smooth": {"form": "clamped", "smooth": True},
    "residual": {"form": "residual"},
    "printed": {"form": "printed"},
    "printed, current": {"form": "printed", "current": True},
}
HARD = [name for name in FILTERS if name != "clamped, smooth"]
LAGGED = ("clamped", "residual", "printed")


def built(name: str) -> Filter:
    """The filter of a name about the Kalman filter."""
    return sage_husa(kf(MODEL), channels=2, **FILTERS[name])


@cache
def program(name: str) -> Callable[..., Any]:
    """The runs of all cases: states and infos after each step."""
    filter = built(name)

    def one(params: FilterParams, grade: Array, obs: Obs) -> Any:
        return run(filter, params, grade, obs, record=lambda state, info: (state, info)).record

    return compiled(jax.vmap(one))


@cache
def ran(name: str) -> Any:
    """States and infos of the cases, as NumPy arrays."""
    found = program(name)(members(), DATA.grade, Obs(jnp.array(DATA.z), jnp.array(DATA.valid)))
    return jax.tree.map(np.asarray, found)


def linear(own: Own) -> Linear:
    """The model of a case for NumPy."""
    over = (STEPS, 2, 2)
    Phi, noise = np.broadcast_to(PHI, over), np.broadcast_to(own.q * Q, over)
    return Linear(Phi, noise, H, R, np.zeros(2), own.start * np.eye(2))


def looped(name: str, case: str) -> loop.NoiseHistory:
    """The loop of a filter over a case."""
    i, own, options = NAMES.index(case), OWN[case], FILTERS[name]
    grade, z, valid = (part[i] for part in DATA)
    current = bool(options.get("current", False))
    return loop.sage_husa(
        linear(own), grade, z, valid, own.averaging, str(options["form"]), current
    )


@pytest.mark.parametrize("name", HARD)
def test_filter_equals_the_loop(name: str) -> None:
    """Random masks, correlated noise that is graded, an update that fails and perfect data.

    The cases run as members of one batch, each loop on its own.
    """
    state, info = ran(name)
    # The innovation's covariance of the first step would be nu nu', which is singular.
    cases = [case for case in NAMES if (name, case) != ("printed, current", "average")]
    for case in cases:
        i, expected = NAMES.index(case), looped(name, case)
        for found, what in (
            (state.inner.x, expected.mean),
            (state.inner.P, expected.cov),
            (state.noise, expected.noise),
            (info.log_likelihood, expected.log_likelihood),
        ):
            np.testing.assert_allclose(found[i], what, rtol=1e-9, atol=1e-10)
        np.testing.assert_array_equal(state.samples[i], np.cumsum(expected.told, axis=0))
        raised = (info.flags[i] & Flag.INDEFINITE) > 0
        np.testing.assert_array_equal(raised, expected.indefinite)
        if OWN[case].harmed:
            assert np.isneginf(expected.log_likelihood[UNUSABLE])
    expected = looped(name, "forgetting")
    assert np.any(expected.indefinite) == name.startswith("printed")
    if name.startswith("clamped"):
        variance = np.diagonal(expected.noise, axis1=1, axis2=2)
        assert [variance.min(), variance.max()] == [0.5, 2.0]


@pytest.mark.parametrize("name", FILTERS)
def test_nothing_forgotten_and_the_start_held_is_the_kalman_filter(name: str) -> None:
    state, info = ran(name)
    i = NAMES.index("held")
    mean, cov, log_likelihood = plain_run()
    np.testing.assert_allclose(state.inner.x[i], mean, rtol=0, atol=1e-12)
    np.testing.assert_allclose(state.inner.P[i], cov, rtol=0, atol=1e-12)
    np.testing.assert_allclose(info.log_likelihood[i], log_likelihood, rtol=1e-11, atol=1e-11)


@cache
def plain_run() -> tuple[Array, Array, Array]:
    """Means, covariances and log-likelihoods of the Kalman filter on the case that is held."""
    i = NAMES.index("held")
    obs = Obs(jnp.array(DATA.z[i]), jnp.array(DATA.valid[i]))
    params = jax.tree.map(lambda leaf: leaf[i], members())
    grade = jnp.array(DATA.grade[i])
    estimate, info = run(kf(MODEL), params._replace(own=()), grade, obs).record
    return estimate.mean, estimate.cov, info.log_likelihood


@pytest.mark.parametrize("name", LAGGED)
def test_nothing_forgotten_is_the_sample_covariance(name: str) -> None:
    """Of what the run itself tells: the mean of ``nu nu' - H P H'``, or of ``e e' + H P+ H'``."""
    state, info = ran(name)
    L = np.linalg.cholesky(R)
    i = NAMES.index("average")
    used = L @ np.concatenate([np.eye(2)[None], state.noise[i, :-1]]) @ L.T
    e, spread = info.innovation[i], used - info.innovation_cov[i]
    if name == "residual":
        e, spread = DATA.z[i] - state.inner.x[i] @ H.T, H @ state.inner.P[i] @ H.T
    told = np.isfinite(info.log_likelihood[i])
    assert told.sum() > STEPS - 5
    mean = np.mean((e[:, :, None] * e[:, None, :] + spread)[told], axis=0)
    if name == "clamped":
        # Of the channels as a factor of the model's noise takes them apart.
        mean = L @ np.diag(np.diag(np.linalg.solve(L, np.linalg.solve(L, mean).T))) @ L.T
    np.testing.assert_allclose(L @ state.noise[i, -1] @ L.T, mean, rtol=1e-11)

    # A state that is known: the data less the prediction, one prior sample among them.
    i = NAMES.index("exact")
    np.testing.assert_array_equal(state.inner.x[i], 0)
    e = np.linalg.solve(L, DATA.z[i].T)
    plain = (np.eye(2) + e @ e.T) / (STEPS + 1)
    expected = np.diag(np.diag(plain)) if name == "clamped" else plain
    np.testing.assert_allclose(state.noise[i, -1], expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("name", FILTERS)
def test_noise_stays_as_it_is_where_nothing_was_told(name: str) -> None:
    """To the bit: without data, in a channel without, and after an update that failed."""
    state, info = ran(name)
    for case in ("forgetting", "endless"):
        i = NAMES.index(case)
        before, after = state.noise[i, :-1], state.noise[i, 1:]
        silent = [*range(*LOST.indices(STEPS)), UNUSABLE, PERFECT]
        for k in silent:
            np.testing.assert_array_equal(after[k - 1], before[k - 1])
            np.testing.assert_array_equal(state.samples[i, k], state.samples[i, k - 1])
        lost = ~DATA.valid[i, 1:]
        for channel in range(2):
            variance = after[:, channel, channel], before[:, channel, channel]
            np.testing.assert_array_equal(*(v[lost[:, channel]] for v in variance))
        assert np.ptp(after[:, 0, 0]) > 0.5
        assert info.flags[i, UNUSABLE] & Flag.NOT_POSITIVE_DEFINITE
        assert np.isfinite(info.log_likelihood[i, PERFECT])


def test_smooth_clamp_tends_to_the_hard_one() -> None:
    """The difference is of the order of the temperature, where bounds are met and elsewhere."""
    hard = ran("clamped")[0].noise
    obs = Obs(jnp.array(DATA.z), jnp.array(DATA.valid))
    cases = [NAMES.index(case) for case in ("forgetting", "endless")]

    def off(temperature: float) -> float:
        found = program("clamped, smooth")(members(temperature), DATA.grade, obs)[0].noise
        return float(np.abs(np.asarray(found) - hard)[cases].max())

    assert 1e-3 < off(1e-2) < 1e-1
    assert off(1e-4) < 1e-4
    assert off(1e-6) < 1e-6


LONG = 100_000


@cache
def long_data(factor: float, lost: float) -> tuple[np.ndarray, np.ndarray]:
    """Observations and masks ``(LONG, 2)`` with a constant factor on the model's noise."""
    rng = np.random.default_rng(21)
    z = walk(rng, LONG, 1.0, np.full(LONG, factor))
    return z, rng.uniform(size=z.shape) >= lost


@cache
def long_run(name: str) -> Callable[..., tuple[Array, Array]]:
    """Noise and flags after each step, for an averaging and data."""
    filter = built(name)

    def one(own: SageHusa, obs: Obs) -> tuple[Array, Array]:
        params = FilterParams(jnp.array(1.0), Gaussian(jnp.zeros(2), jnp.eye(2)), own=own)
        grade = jnp.ones(LONG)
        return run(filter, params, grade, obs, record=lambda s, i: (s.noise, i.flags)).record

    return compiled(one)


def long_noise(
    name: str, own: SageHusa, factor: float, lost: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Noise, flags and masks of a long run."""
    z, valid = long_data(factor, lost)
    arrays = SageHusa(*(jnp.array(value, float) for value in own[:5]))
    noise, flags = long_run(name)(arrays, Obs(jnp.array(z), jnp.array(valid)))
    return np.asarray(noise), np.asarray(flags), valid


@pytest.mark.parametrize("name", LAGGED)
def test_a_constant_noise_is_recovered(name: str) -> None:
    """Within 5 % in the time average, for b = 0.99."""
    noise, _, _ = long_noise(name, SageHusa(0.99, 10.0, 1e-3, 1e3), 4.0, 0.0)
    found = noise[1000:].mean(axis=0)
    np.testing.assert_allclose(np.diag(found), 4.0, rtol=0.05)
    np.testing.assert_allclose(found[0, 1], 0.0, atol=0.2)


@pytest.mark.parametrize("name", LAGGED)
def test_noise_stays_positive_definite_or_is_flagged(name: str) -> None:
    """Over 1e5 steps of data that are far better than said, channels coming and going."""
    noise, flags, valid = long_noise(name, SageHusa(0.8, 0.0, 1e-3, 1e3), 0.05, 0.25)
    least = np.linalg.eigvalsh(noise)[:, 0]
    raised = (flags & Flag.INDEFINITE) > 0
    if name != "printed":
        assert np.all(least > 0)
        assert not np.any(raised)
        return
    used = np.concatenate([np.eye(2)[None], noise[:-1]])
    both = valid[:, :, None] & valid[:, None, :]
    lost = np.linalg.eigvalsh(np.where(both, used, np.eye(2)))[:, 0] <= 0
    assert lost.mean() > 0.01
    np.testing.assert_array_equal(raised, lost)


@pytest.mark.parametrize("name", FILTERS)
def test_dtype_in_is_dtype_out(name: str) -> None:
    """With parameters as arrays, as they come, and by default."""
    filter = built(name)
    prior = Gaussian(jnp.zeros(2, jnp.float32), jnp.eye(2, dtype=jnp.float32))
    one = FilterParams(jnp.float32(1), prior)
    obs = Obs(jnp.zeros(2, jnp.float32), jnp.ones(2, bool))
    arrays = jax.tree.map(jnp.float32, SageHusa())

    def step(params: FilterParams, obs: Obs) -> tuple[Any, Any, Gaussian]:
        start = filter.predict(params, filter.init(params), jnp.float32(1))
        state, info = filter.update(params, start, jnp.float32(1), obs)
        return state, info, filter.estimate(state)

    for own in (arrays, SageHusa(), ()):
        shaped = jax.eval_shape(step, one._replace(own=own), obs)
        for leaf in jax.tree.leaves(shaped):
            assert leaf.dtype in (jnp.float32, jnp.int32, jnp.bool_), leaf


def test_share_of_a_sample() -> None:
    """As the weight among those before, through b = 1, and the same with many digits near it."""
    count = np.array([0.0, 1.0, 7.0, 1e6, np.inf])
    found = compiled(jax.vmap(averaging, (0, None)))
    b = np.array([0.5, 0.97, 1.0])
    expected = [loop.share(loop.Averaging(each, 0.0, 0.0, 0.0), count) for each in b]
    np.testing.assert_allclose(found(b, count), expected, rtol=1e-13)
    near = found(np.full(3, 1 - 1e-12), count)[0, :3]
    np.testing.assert_allclose(near, 1 / (count[:3] + 1), rtol=1e-11)


def test_what_cannot_be_asked_is_refused() -> None:
    noisy = NonAdditive(lambda p, x, v, u: H @ x + v, lambda p, x, u: jnp.ones(2))
    with pytest.raises(ValueError, match="form is 'fading'; it must be one of clamped, residual"):
        sage_husa(kf(MODEL), channels=2, form="fading")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="noise that does not add; a filter that estimates"):
        sage_husa(kf(MODEL._replace(noisy=noisy)), channels=2)
    with pytest.raises(ValueError, match="current is off"):
        sage_husa(kf(MODEL), channels=2, form="residual", current=True)
