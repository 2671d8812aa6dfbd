"""Models put together of a process and named channels equal those stacked by hand."""

import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.estimation.filters.kalman import ekf
from jaxnav.estimation.models import Channel, ModelParams, Process, observing, shared
from jaxnav.estimation.run import run, simulate
from jaxnav.estimation.sampling import measured
from jaxnav.estimation.types import FilterParams, Gaussian, Model, Obs

F = jnp.array([[1.0, 0.1], [0.0, 1.0]])
H = jnp.array([[1.0, 0.5]])
PROCESS = Process(
    lambda p, x, u: F @ x, lambda p, x, u: p * jnp.eye(2), differential=lambda p, x, u: F
)
LINE = Channel(1, lambda p, x, u: H @ x, lambda p, x, u: p[None])
SHAPE = jnp.array([[2.0, 0.5], [0.5, 1.0]])
BENT = Channel(2, lambda p, x, u: jnp.sin(x), lambda p, x, u: p * SHAPE)
WHOLE = observing(PROCESS, {"line": LINE}, {"bent": BENT})
BY_HAND = Model(
    lambda p, x, u: F @ x,
    lambda p, x, u: p.process * jnp.eye(2),
    lambda p, x, u: jnp.concatenate([H @ x, jnp.sin(x)]),
    lambda p, x, u: jax.scipy.linalg.block_diag(
        p.channels["line"].reshape(1, 1), p.channels["bent"] * SHAPE
    ),
)
PARAMS = FilterParams(
    ModelParams(jnp.array(0.01), {"line": jnp.array(0.04), "bent": jnp.array(0.1)}),
    Gaussian(jnp.array([0.3, -0.2]), jnp.eye(2)),
)


def test_a_model_of_channels_is_the_one_stacked_by_hand() -> None:
    rng = np.random.default_rng(0)
    line, bent = rng.normal(size=(40, 1)), rng.normal(size=(40, 2))
    line[7], bent[9, 1] = np.nan, np.nan
    obs = WHOLE.stack({"bent": bent, "line": line}, {"bent": np.arange(40) % 3 > 0})
    assert obs.valid[:4].tolist() == [
        [True, False, False],
        *[[True, True, True]] * 2,
        [True] + [False] * 2,
    ]
    assert not obs.valid[7, 0]
    obs = obs._replace(valid=obs.valid & jnp.isfinite(jnp.hstack([line, bent])))
    ours, theirs = (run(ekf(model), PARAMS, None, obs).record for model in (WHOLE, BY_HAND))
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14)
    part = WHOLE.part(ours[1], "bent")
    np.testing.assert_array_equal(part.used, obs.valid[:, 1:])
    S = np.asarray(part.innovation_cov)
    nu = np.asarray(part.innovation)
    expected = [v @ np.linalg.solve(C, v) for v, C in zip(nu, S, strict=True)]
    np.testing.assert_allclose(part.nis, expected, rtol=1e-12)


IN_METRES = LINE._replace(residual=lambda z, predicted: 111e3 * (z - predicted))
WRAPPED = LINE._replace(residual=lambda z, predicted: (z - predicted + 0.5) % 1 - 0.5)


def test_noise_is_added_to_values_only_where_it_can_be() -> None:
    """In other units than the values it is refused, or not a number where that cannot be told."""
    states, noise = jnp.ones((50, 2)), jnp.array(1e-4)

    def drawn(channel: Channel) -> Any:
        return measured(jax.random.key(0), channel, noise, states, None)

    np.testing.assert_array_equal(drawn(WRAPPED), drawn(LINE))
    assert np.all(np.isnan(jax.jit(lambda: drawn(IN_METRES))()))
    for channel, whole in ((IN_METRES, False), (WRAPPED, True)):
        model = observing(PROCESS, {"one": channel})
        own = ModelParams(jnp.array(0.01), {"one": noise})
        zero, v = jnp.zeros((50, 2)), jnp.full((50, 1), 0.01)
        _, z = simulate(model, own, states[0], jnp.zeros((50, 0)), zero, v)
        assert np.all(np.isfinite(z)) == whole


NOT_ONE: Any = PROCESS
LONG = LINE._replace(size=2)
SEEN = Obs(jnp.ones((2, 3)), jnp.ones((2, 3), bool))
MISUSE = {
    "a list of channels": (
        lambda: observing(PROCESS, [LINE]),  # pyright: ignore[reportArgumentType]
        "must be a mapping of names to channels",
    ),
    "a filter for a process": (
        lambda: observing(ekf(WHOLE), {"a": LINE}),  # pyright: ignore[reportArgumentType]
        "process is a Filter; observing takes a Process, or a Model",
    ),
    "a model to be measured": (
        lambda: measured(jax.random.key(0), NOT_ONE, (), jnp.ones((3, 2)), None),
        "channel is Process; it must be a Channel",
    ),
    "noise of other units": (
        lambda: measured(jax.random.key(0), IN_METRES, jnp.array(1.0), jnp.ones((3, 2)), None),
        "noise cannot be added to its values, whose residual has other units; give the channel",
    ),
    "no channel": (lambda: observing(PROCESS), "there is no channel"),
    "two of one name": (lambda: observing(PROCESS, {"a": LINE}, {"a": BENT}), "two channels 'a'"),
    "the name of the process": (lambda: observing(PROCESS, {"process": LINE}), "named 'process'"),
    "no size": (lambda: observing(PROCESS, {"a": LINE._replace(size=0)}), "it must be at least 1"),
    "no Channel": (
        lambda: observing(PROCESS, {"a": NOT_ONE}),
        "it must be a Channel",
    ),
    "unknown name": (lambda: WHOLE.channel("lime"), "did you mean 'line'"),
    "no values": (lambda: WHOLE.stack({}), "no values to stack"),
    "values of another size": (
        lambda: WHOLE.stack({"bent": jnp.ones(3)}),
        "the last axis must be 2",
    ),
    "other steps": (
        lambda: WHOLE.stack({"line": jnp.ones((4, 1)), "bent": jnp.ones((5, 2))}),
        "all must have the same",
    ),
    "other parameters": (
        lambda: run(
            ekf(WHOLE),
            PARAMS._replace(model=1.0),
            None,
            Obs(jnp.ones((2, 3)), jnp.ones((2, 3), bool)),
        ),
        "takes ModelParams(process",
    ),
    "another size than said": (
        lambda: observing(PROCESS, {"a": LINE._replace(size=2)}, parts=shared).observe(
            1.0, jnp.ones(2), None
        ),
        "by its size it must be (2,)",
    ),
}


@pytest.mark.parametrize("name", MISUSE)
def test_misuse_is_refused_in_one_sentence(name: str) -> None:
    call, sentence = MISUSE[name]
    with pytest.raises(ValueError, match=re.escape(sentence)) as caught:
        call()
    assert "\n" not in str(caught.value)
