"""Wrappers nest in any order, each with parameters of its own, around any single filter."""

import itertools
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.estimation.banks.mixture import BankParams, bank, mmae
from jaxnav.estimation.banks.weights import bayes
from jaxnav.estimation.filters.adaptive import Adaptation, innovation_adaptive
from jaxnav.estimation.filters.gated import Gate, gated
from jaxnav.estimation.filters.kalman import ekf
from jaxnav.estimation.filters.robust import Versoria, versoria
from jaxnav.estimation.filters.sage_husa import SageHusa, sage_husa
from jaxnav.estimation.filters.sigma_point import ukf
from jaxnav.estimation.filters.wrapping import parted
from jaxnav.estimation.models import Channel, ModelParams, Process, observing
from jaxnav.estimation.run import run
from jaxnav.estimation.types import Filter, FilterParams, Flag, Gaussian, Obs, replicate

F = np.array([[1.0, 0.3], [-0.3, 1.0]])
STEPS, OUTLIER, LOST = 16, 6, 9
MODEL = observing(
    Process(lambda p, x, u: jnp.asarray(F) @ x + 0.1 * jnp.sin(x), lambda p, x, u: p * jnp.eye(2)),
    {
        "first": Channel(1, lambda p, x, u: jnp.sin(x[:1]) + x[1:], lambda p, x, u: p[None]),
        "both": Channel(2, lambda p, x, u: x, lambda p, x, u: p * jnp.array([1.0, 2.0])),
    },
)


class Wrapper(NamedTuple):
    """A wrapper, its parameters when it does nothing, and when it does something."""

    wrap: Callable[[Filter], Filter]
    idle: Any
    active: Any


WRAPPERS = {
    "adaptive": Wrapper(
        innovation_adaptive, Adaptation(memory=1e14), Adaptation(5.0, 0.1, 30.0, 0.05)
    ),
    "noise-finding": Wrapper(
        sage_husa, SageHusa(1.0, prior_count=jnp.inf), SageHusa(0.9, 3.0, 0.05, 50.0, 0.05)
    ),
    "robust": Wrapper(versoria, Versoria(width=0.0), Versoria(0.1, 1.7)),
    "gated": Wrapper(gated, Gate(false_alarm=1e-300), Gate(0.02, 3.0)),
}
FILTERS = {"ekf": ekf, "ukf": ukf}
PAIRS = [
    pytest.param(name, *pair, marks=[pytest.mark.slow] if name == "ukf" else [])
    for name in FILTERS
    for pair in itertools.permutations(WRAPPERS, 2)
]
each_pair = pytest.mark.parametrize(("name", "outer", "inner"), PAIRS)


def arrays(own: Any) -> Any:
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, float), own)


def params(outer: Any, inner: Any) -> FilterParams:
    noise = ModelParams(jnp.array(0.05), {"first": jnp.array(0.2), "both": jnp.array(0.3)})
    prior = Gaussian(jnp.array([0.3, -0.4]), jnp.diag(jnp.array([0.5, 0.8])))
    return FilterParams(noise, prior, arrays((outer, inner)))


@cache
def data() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(4)
    x, z = np.array([0.5, -0.2]), []
    for _ in range(STEPS):
        x = F @ x + 0.1 * np.sin(x) + np.sqrt(0.2) * rng.normal(size=2)
        z.append([np.sin(x[0]) + x[1] + 0.9 * rng.normal(), *(x + 0.5 * rng.normal(size=2))])
    found, valid = np.array(z), np.ones((STEPS, 3), bool)
    found[OUTLIER, 1:] += 15.0
    valid[LOST], valid[12, 2] = False, False
    return found, valid


def ran(filter: Filter, own: FilterParams, z: Array) -> Any:
    """Return estimates and infos of each step."""
    return run(filter, own, jnp.zeros(STEPS), Obs(z, jnp.asarray(data()[1]))).record


@cache
def plain(name: str) -> Any:
    filter = FILTERS[name](MODEL)
    own = params((), ())._replace(own=())
    return jax.tree.map(np.asarray, compiled(ran, static_argnums=0)(filter, own, data()[0]))


def directions(tree: Any, seed: int) -> Any:
    """Return a direction in which all parameters that are finite and not zero change."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(
        lambda leaf: jnp.asarray(0.1 * leaf * rng.uniform(0.5, 1, size=leaf.shape)), tree
    )


@each_pair
def test_a_pair_of_wrappers_obeys_the_laws(name: str, outer: str, inner: str) -> None:
    """Idle it is the filter; each has an effect; lost data is a prediction; both derivatives."""
    one, two = WRAPPERS[outer], WRAPPERS[inner]
    filter = one.wrap(two.wrap(FILTERS[name](MODEL)))
    z = jnp.asarray(data()[0])

    @compiled
    def all_of(several: FilterParams) -> Any:
        return jax.vmap(lambda own: ran(filter, own, z))(several)

    idle, first, second, both = (
        params(a, b)
        for a, b in (
            (one.idle, two.idle),
            (one.active, two.idle),
            (one.idle, two.active),
            (one.active, two.active),
        )
    )
    several = jax.tree.map(lambda *leaves: jnp.stack(leaves), idle, first, second, both)
    estimate, info = jax.tree.map(np.asarray, all_of(several))
    expected, _ = plain(name)
    np.testing.assert_allclose(estimate.mean[0], expected.mean, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(estimate.cov[0], expected.cov, rtol=1e-9, atol=1e-10)
    for other in (1, 2):
        assert np.abs(estimate.mean[other] - expected.mean).max() > 1e-3
        assert np.abs(estimate.mean[3] - estimate.mean[other]).max() > 1e-6
    assert np.all(np.isfinite(estimate.mean))
    np.testing.assert_allclose(estimate.cov, np.swapaxes(estimate.cov, -1, -2), atol=1e-14)
    assert np.linalg.eigvalsh(estimate.cov).min() > 0
    assert np.all(info.flags[:, LOST] & Flag.NO_OBSERVATION)
    assert not info.used[:, LOST].any()
    assert not info.innovation[:, LOST].any()

    def score(own: FilterParams) -> Array:
        estimate, info = ran(filter, own, z)
        return jnp.sum(estimate.mean**2) - jnp.sum(info.log_likelihood)

    towards = directions(both, 1)

    @compiled
    def slopes(own: FilterParams) -> tuple[Array, Array]:
        forward = jax.jvp(score, (own,), (towards,))[1]
        gradient = jax.grad(score)(own)
        parts = jax.tree.map(lambda g, d: jnp.sum(g * d), gradient, towards)
        return forward, sum(jax.tree.leaves(parts), jnp.zeros(()))

    forward, reverse = slopes(both)
    np.testing.assert_allclose(reverse, forward, rtol=1e-8)

    def moved(step: float) -> float:
        return float(value(jax.tree.map(lambda p, d: p + step * d, both, towards)))

    value = compiled(score)
    by_difference = (moved(1e-5) - moved(-1e-5)) / 2e-5
    np.testing.assert_allclose(forward, by_difference, rtol=1e-5, atol=1e-7)


def test_a_bank_of_wrapped_filters_has_parameters_of_each_member() -> None:
    """Alike, its members are the single filter; a bank of two factors weighs them."""
    filter = sage_husa(innovation_adaptive(gated(ekf(MODEL))))
    active = [WRAPPERS[name].active for name in ("noise-finding", "adaptive", "gated")]
    own = params(active[0], (active[1], active[2]))
    z = jnp.asarray(data()[0])
    single, _ = compiled(ran, static_argnums=0)(filter, own, z)
    members = BankParams(replicate(own, 2), ())
    run_bank = compiled(ran, static_argnums=0)
    several: Any = run_bank(mmae(filter), members, z)
    np.testing.assert_allclose(several[0].mean, single.mean, rtol=1e-10, atol=1e-12)
    noise, inner = replicate(own, 2).own
    noise = noise._replace(forgetting=jnp.array([0.5, 0.99]))
    apart = replicate(own, 2)._replace(own=(noise, inner))
    weighed: Any = run_bank(mmae(filter), BankParams(apart, ()), z)
    assert np.abs(weighed[0].mean - single.mean).max() > 1e-4


def test_what_a_gate_inside_refuses_stays_told() -> None:
    """An outer gate over one channel does not hide what an inner one left out of another."""
    filter = gated(versoria(gated(ekf(MODEL), ["both"])), ["first"])
    gate = Gate(1e-6, 3.0)
    _, info = ran(filter, params(gate, (Versoria(0.0), (gate, ()))), jnp.asarray(data()[0]))
    assert info.refused[OUTLIER].tolist() == [False, True, True]
    assert info.flags[OUTLIER] & Flag.REFUSED
    assert not info.used[OUTLIER, 1:].any()


def test_parameters_of_wrappers_may_be_left_out() -> None:
    """``()`` is what the wrapper or filter was built with; its own alone leaves the inner ones."""
    given = params(Versoria(0.2), Gate(0.1))
    assert parted(given, Versoria())[0] == Versoria(*arrays(Versoria(0.2)))
    alone = given._replace(own=Versoria(0.2))
    assert parted(alone, Versoria()) == (Versoria(0.2), alone._replace(own=()))
    left = given._replace(own=((), Gate(0.1)))
    assert parted(left, Versoria()) == (Versoria(), left._replace(own=Gate(0.1)))
    none = given._replace(own=())
    assert parted(none, Versoria()) == (Versoria(), none)


def test_the_old_form_warns_and_is_the_same_filter() -> None:
    own = params((), ())._replace(own=Versoria(*arrays(WRAPPERS["robust"].active)))
    z = jnp.asarray(data()[0])
    with pytest.warns(DeprecationWarning, match=r"^versoria\(build, model\) is versoria\(build"):
        old = versoria(ekf, MODEL)
    found, _ = compiled(ran, static_argnums=0)(old, own, z)
    expected, _ = compiled(ran, static_argnums=0)(versoria(ekf(MODEL)), own, z)
    np.testing.assert_array_equal(found.mean, expected.mean)


WRONG: Any = 3
MISUSE: dict[str, tuple[Callable[[], Any], str]] = {
    "a bank in a robust filter": (
        lambda: versoria(bank(ekf(MODEL), bayes())),
        r"^versoria hands noise to the model of a single filter, and a bank has one for each",
    ),
    "a place that is none": (
        lambda: gated(ekf(MODEL), [[7]]),
        r"^groups has the place 7; it must be whole, from 0 to 2$",
    ),
    "a negative place": (
        lambda: gated(ekf(MODEL), [[1, -1]]),
        r"^groups has the place -1; it must be whole, from 0 to 2$",
    ),
    "a name for a list of them": (
        lambda: gated(ekf(MODEL), "first"),
        r"^groups is 'first'; it must be a list of names or of places$",
    ),
    "a builder behind a gate": (
        lambda: gated(WRONG),
        r"^filter is 3; it must be a Filter",
    ),
    "bounds the wrong way round": (
        lambda: ran(
            sage_husa(ekf(MODEL)),
            params(SageHusa(low=10.0, high=1.0), ()),
            jnp.asarray(data()[0]),
        ),
        r"^low of SageHusa is 10 and high 1; low must not be above high$",
    ),
    "half an iteration": (
        lambda: versoria(ekf(MODEL), iterations=WRONG / 2),
        r"^iterations is 1\.5; it must be at least 1, and whole$",
    ),
    "a builder without its model": (
        lambda: sage_husa(ekf),
        r"^filter is the function ekf; sage_husa takes a filter, as ekf\(model\)$",
    ),
    "a filter and a model": (
        lambda: innovation_adaptive(ekf(MODEL), MODEL),
        r"^innovation_adaptive takes a filter, which knows its model: innovation_adaptive\(ekf",
    ),
    "the parameters the wrong way round": (
        lambda: ran(
            versoria(gated(ekf(MODEL))), params(Gate(), Versoria()), jnp.asarray(data()[0])
        ),
        r"^own is a Gate; it must be Versoria\(\.\.\.\), or \(\) for what the filter was built",
    ),
    "parameters of a wrapper for a plain filter": (
        lambda: ran(ekf(MODEL), params(Gate(), ()), jnp.asarray(data()[0])),
        r"^own is a tuple; this filter has no parameters of its own$",
    ),
    "parameters of a wrapper that the filter inside has not": (
        lambda: ran(versoria(ekf(MODEL)), params(Versoria(), Gate()), jnp.asarray(data()[0])),
        r"^own is a Gate; this filter has no parameters of its own$",
    ),
}


@pytest.mark.parametrize("case", MISUSE)
def test_misuse_is_refused_in_one_sentence(case: str) -> None:
    call, sentence = MISUSE[case]
    with pytest.raises(ValueError, match=sentence) as caught:
        call()
    assert "\n" not in str(caught.value)
