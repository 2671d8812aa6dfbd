"""The gate: what contradicts the filter is refused, what goes on doing so is let in."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnav as jn
from jaxnav.compiling import compiled
from jaxnav.estimation.filters.gated import Gate, Gated, gated
from jaxnav.estimation.types import Flag

STEPS = 400
DT = 0.2
GROUPS = ((0, 1), (2, 3))
"""Positions and velocities."""

F = np.kron([[1.0, DT], [0.0, 1.0]], np.eye(2))
Q = 0.04 * np.kron([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]], np.eye(2))
SIGMA = np.array([0.5, 0.5, 0.1, 0.1])
MODEL = jn.Model(
    transition=lambda p, x, u: jnp.asarray(F) @ x,
    process_noise=lambda p, x, u: jnp.asarray(Q),
    observe=lambda p, x, u: x,
    observation_noise=lambda p, x, u: p * jnp.asarray(SIGMA**2),
)
PRIOR = jn.FilterParams(jnp.array(1.0), jn.Gaussian(jnp.zeros(4), jnp.eye(4)))
BANK = jn.BankParams(jn.replicate(PRIOR, 2)._replace(model=jnp.array([1.0, 4.0])), ())
FILTERS = {
    "kf": (jn.kf(MODEL), PRIOR),
    "bank": (jn.mmae(jn.kf(MODEL)), BANK),
}
GATES = {name: gated(filter, GROUPS) for name, (filter, _) in FILTERS.items()}


def flight() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    x, states = np.array([0.0, 0.0, 3.0, 1.0]), []
    root = np.linalg.cholesky(Q)
    for _ in range(STEPS):
        x = F @ x + root @ rng.normal(size=4)
        states.append(x)
    truth = np.array(states)
    return truth, truth + SIGMA * rng.normal(size=truth.shape)


TRUTH, Z = flight()


def behind(params: Any, gate: Gate) -> Any:
    """Return the parameters of a filter or bank with those of its gate."""
    if isinstance(params, jn.BankParams):
        return Gated(params, gate)
    return params._replace(own=(gate, params.own))


def ran(name: str, z: np.ndarray, gate: Gate | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return means ``(T, 4)`` and flags ``(T,)``."""
    numbers = jax.tree.map(jnp.asarray, gate or Gate())
    estimate, info = jn.run(
        GATES[name],
        behind(FILTERS[name][1], numbers),
        jnp.zeros((STEPS, 1)),
        jn.Obs(jnp.asarray(z), jnp.ones(z.shape, bool)),
    ).record
    return np.asarray(estimate.mean), np.asarray(info.flags)


@pytest.mark.parametrize("name", FILTERS)
def test_a_clean_log_passes_and_is_what_it_was(name: str) -> None:
    filter, params = FILTERS[name]
    obs = jn.Obs(jnp.asarray(Z), jnp.ones(Z.shape, bool))
    plain = jn.run(filter, params, jnp.zeros((STEPS, 1)), obs).record[0].mean
    mean, flags = ran(name, Z)
    assert not np.any(flags & (Flag.REFUSED | Flag.REOPENED))
    np.testing.assert_allclose(mean, plain, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("off", [20.0, 100.0, 1.1e3, 1.6e5])
def test_one_fix_that_is_off_changes_nothing(name: str, off: float) -> None:
    clean, _ = ran(name, Z)
    for step in (50, 200, STEPS - 2):
        z = Z.copy()
        z[step, 0] += off
        mean, flags = ran(name, z)
        np.testing.assert_array_equal(np.flatnonzero(flags & Flag.REFUSED), [step])
        assert np.max(np.abs(mean - clean)[:, :2]) < 0.5
        # the velocities of that fix are another group, and were used
        assert not flags[step] & Flag.NO_OBSERVATION


@pytest.mark.parametrize("name", FILTERS)
def test_what_goes_on_contradicting_is_let_in(name: str) -> None:
    """The vehicle is carried away while the receiver is silent: the filter was wrong."""
    for jump, within in ((10.0, 40), (1e3, 90)):
        z = Z.copy()
        z[150:, 0] += jump
        mean, flags = ran(name, z)
        refused = np.flatnonzero(flags & Flag.REFUSED)
        assert refused[0] == 150
        assert refused[-1] < 150 + within
        again = np.flatnonzero(flags & Flag.REOPENED)
        assert len(again) >= 1
        late = slice(refused[-1] + 20, None)
        assert np.max(np.abs(mean - TRUTH - [jump, 0, 0, 0])[late, :2]) < 5 * SIGMA[0]


def refusals(alarm: float, runs: int, steps: int) -> np.ndarray:
    """Refusals ``(runs, steps, groups)`` in flights drawn from the model of the filter."""
    params = behind(PRIOR, Gate(false_alarm=alarm))
    root, sigma = jnp.asarray(np.linalg.cholesky(Q)), jnp.asarray(SIGMA)

    @compiled
    def one(key: Any) -> Any:
        first, process, noise = jax.random.split(key, 3)
        w = jax.random.normal(process, (steps, 4)) @ root.T
        v = jax.random.normal(noise, (steps, 4)) * sigma[None]
        u = jnp.zeros((steps, 1))
        _, z = jn.simulate(MODEL, PRIOR.model, jax.random.normal(first, (4,)), u, w, v)
        filter = GATES["kf"]
        return jn.run(filter, params, u, jn.observed(z), record=lambda _, info: info.refused).record

    refused = np.asarray(jax.vmap(one)(jax.random.split(jax.random.key(4), runs)))
    return refused[:, :, [group[0] for group in GROUPS]]


def test_under_the_model_the_gate_refuses_by_its_probability() -> None:
    """Exactly so before it has refused anything; after, its own filter has seen less."""
    for alarm, runs in ((0.05, 20_000), (1e-3, 50_000)):
        sigma = np.sqrt(alarm * (1 - alarm) / runs)
        share = refusals(alarm, runs, 1).mean(axis=(0, 1))
        assert np.all(np.abs(share - alarm) < 4 * sigma)
    later = refusals(0.01, 500, 100).mean(axis=(0, 1))
    np.testing.assert_allclose(later, 0.01, rtol=0.15)


def test_patience_and_false_alarm_are_parameters() -> None:
    z = Z.copy()
    z[150:, 0] += 10.0
    _, never = ran("kf", z, Gate(patience=jnp.inf))
    assert np.all(never[150:] & Flag.REFUSED)
    _, strict = ran("kf", Z, Gate(false_alarm=0.1))
    share = np.mean((strict & Flag.REFUSED) > 0)
    assert 0.1 < share < 0.3

    @compiled
    def score(patience: Any) -> Any:
        params = behind(PRIOR, Gate(patience=patience))
        obs = jn.Obs(jnp.asarray(z), jnp.ones(z.shape, bool))
        return jn.negative_log_likelihood(GATES["kf"], params, jnp.zeros((STEPS, 1)), obs)

    assert np.isfinite(jax.grad(score)(jnp.array(5.0)))


def test_groups_are_apart_and_parameters_are_its_own() -> None:
    with pytest.raises(ValueError, match="a channel can be in one group only"):
        gated(FILTERS["kf"][0], ((0, 1), (1, 2)))
    obs = jn.Obs(jnp.asarray(Z), jnp.ones(Z.shape, bool))
    with pytest.raises(ValueError, match=r"^params is a BankParams; a gated bank takes Gated"):
        jn.run(GATES["bank"], BANK, jnp.zeros((STEPS, 1)), obs)
    with pytest.raises(ValueError, match=r"^params is Gated, of a bank; a gated filter takes"):
        jn.run(GATES["kf"], Gated(PRIOR), jnp.zeros((STEPS, 1)), obs)
    for groups in ((), ((0,), ())):
        with pytest.raises(ValueError, match="needs groups of one channel or more"):
            gated(FILTERS["kf"][0], groups)
    with pytest.raises(ValueError, match="the model has no channel 'position'"):
        gated(FILTERS["kf"][0], ("position",))


def test_the_gate_holds_in_32_bits() -> None:
    narrow = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), PRIOR)
    z = jnp.asarray(Z, jnp.float32).at[50, 0].add(1.1e3)
    obs = jn.Obs(z, jnp.ones(z.shape, bool))
    params = behind(narrow, Gate(jnp.float32(1e-9), jnp.float32(5.0)))
    model = MODEL._replace(
        transition=lambda p, x, u: jnp.asarray(F, jnp.float32) @ x,
        process_noise=lambda p, x, u: jnp.asarray(Q, jnp.float32),
        observation_noise=lambda p, x, u: p * jnp.asarray(SIGMA**2, jnp.float32),
    )
    inputs = jnp.zeros((STEPS, 1), jnp.float32)
    flags = jn.run(gated(jn.kf(model), GROUPS), params, inputs, obs).record[1].flags
    np.testing.assert_array_equal(np.flatnonzero(flags & Flag.REFUSED), [50])


@pytest.mark.parametrize("left_out", ["not finite", "infinite variance", "not valid"])
def test_channels_that_are_not_used_do_not_widen_the_gate(left_out: str) -> None:
    """A square of 12 is beyond one in a thousand for one channel, and not for two."""
    fixed = MODEL._replace(
        transition=lambda p, x, u: x,
        process_noise=lambda p, x, u: jnp.zeros((2, 2)),
        observation_noise=lambda p, x, u: jnp.array([1.0, jnp.where(u > 0, jnp.inf, 1.0)]),
    )
    known = jn.FilterParams(jnp.array(1.0), jn.Gaussian(jnp.zeros(2), 1e-12 * jnp.eye(2)))
    obs = jn.Obs(jnp.array([[12**0.5, 0.0]]), jnp.array([[True, left_out != "not valid"]]))
    if left_out == "not finite":
        obs = obs._replace(z=obs.z.at[0, 1].set(jnp.nan))
    inputs = jnp.array([1.0 if left_out == "infinite variance" else 0.0])
    gate = Gate(jnp.array(1e-3), jnp.array(5.0))
    alone = gated(jn.kf(fixed), ((0, 1),))
    _, info = jn.run(alone, behind(known, gate), inputs, obs).record
    assert int(info.flags[0]) & Flag.REFUSED
    both = jn.Obs(jnp.array([[12**0.5, 0.0]]), jnp.ones((1, 2), bool))
    _, info = jn.run(alone, behind(known, gate), jnp.zeros(1), both).record
    assert not int(info.flags[0]) & Flag.REFUSED
