"""The laws that every filter and bank obeys, over one table of all of them."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.estimation.filters.adaptive import innovation_adaptive
from jaxnav.estimation.filters.iterated import (
    iterated_ckf,
    iterated_ekf,
    modified_iterated_ckf,
)
from jaxnav.estimation.filters.kalman import ekf
from jaxnav.estimation.filters.robust import correntropy, versoria
from jaxnav.estimation.filters.sage_husa import sage_husa
from jaxnav.estimation.filters.sigma_point import square_root_ukf, ukf
from jaxnav.estimation.filters.square_root import square_root_ekf
from jaxnav.estimation.run import Trace, run
from jaxnav.estimation.tune.losses import negative_log_likelihood
from jaxnav.estimation.types import Filter, FilterParams, Flag, Gaussian, Model, Obs, SureObs
from tests.cases import SWITCHING, THETA, Noise, cases
from tests.oracles.kalman import (
    History,
    Linear,
    bayes_weights,
    floor_weights,
    immae_weights,
    interacting,
    kalman,
    markov_weights,
    mixture,
)

STEPS, RUNS, STATES, CHANNELS = 12, 6, 4, 2
LOST = 3


class Step(NamedTuple):
    """Input of the test's model: a dense transition that changes from step to step."""

    Phi: Array
    Q: Array
    offset: Array


OBSERVATION = np.array([[1.0, 0.0, 0.5, 0.0], [0.0, 1.0, 0.0, -0.3]])
NOISE = np.array([[0.5, 0.1], [0.1, 0.8]])


def dense_model() -> Model:
    """A linear model with dense matrices, an offset in both equations and correlated noise."""

    def dtype_of(x: Array, constant: np.ndarray) -> Array:
        return jnp.asarray(constant, x.dtype)

    return Model(
        transition=lambda p, x, u: u.Phi @ x + u.offset,
        process_noise=lambda p, x, u: p.q * u.Q,
        observe=lambda p, x, u: dtype_of(x, OBSERVATION) @ x + u.offset[:CHANNELS],
        observation_noise=lambda p, x, u: p.r * dtype_of(x, NOISE),
    )


def single(theta: float = 1.0) -> FilterParams:
    """Parameters of one filter; the true model has theta = 1."""
    prior = Gaussian(jnp.array([0.5, -0.5, 0.1, 0.0]), jnp.diag(jnp.array([1.0, 2.0, 0.5, 0.5])))
    return FilterParams(Noise(jnp.array(theta), jnp.array(1.0)), prior)


CASES = cases(dense_model(), single(), CHANNELS)
each_case = pytest.mark.parametrize("name", CASES)


class Problem(NamedTuple):
    """Data for a batch of runs that share the model's inputs."""

    inputs: Step
    z: Array
    valid: Array


def _problem() -> Problem:
    rng = np.random.default_rng(5)
    Phi = np.eye(STATES) + 0.2 * rng.normal(size=(STEPS, STATES, STATES))
    G = 0.3 * rng.normal(size=(STEPS, STATES, STATES))
    inputs = Step(
        jnp.array(Phi),
        jnp.array(G @ G.transpose(0, 2, 1)),
        jnp.array(rng.normal(size=(STEPS, STATES))),
    )
    valid = rng.uniform(size=(STEPS, CHANNELS)) > 0.25
    valid[LOST] = False
    return Problem(
        inputs, jnp.array(2 * rng.normal(size=(RUNS, STEPS, CHANNELS))), jnp.array(valid)
    )


PROBLEM = _problem()
_COMPILED: dict[str, Callable[..., Trace]] = {}
_TRACED: dict[str, int] = dict.fromkeys(CASES, 0)


def batch_run(name: str, params: Any, z: Array) -> Trace:
    """Run a case over a batch of measurements; compiled once per case."""
    if name not in _COMPILED:

        def one(params: Any, z: Array) -> Trace:
            _TRACED[name] += 1
            return run(CASES[name].filter, params, PROBLEM.inputs, Obs(z, PROBLEM.valid))

        _COMPILED[name] = compiled(jax.vmap(one, in_axes=(None, 0)))
    return _COMPILED[name](params, z)


def reference(theta: float, z: np.ndarray, valid: np.ndarray) -> History:
    """The NumPy filter of the test's model."""
    return without_offset(kalman(augmented(theta), shifted(z), valid))


def augmented(theta: float) -> Linear:
    """The test's model for NumPy: an offset is one more state that stays one."""
    steps = jax.tree.map(np.asarray, PROBLEM.inputs)
    Phi = np.zeros((STEPS, STATES + 1, STATES + 1))
    Phi[:, :STATES, :STATES], Phi[:, :STATES, STATES], Phi[:, STATES, STATES] = (
        steps.Phi,
        steps.offset,
        1,
    )
    Q = np.zeros_like(Phi)
    Q[:, :STATES, :STATES] = theta * steps.Q
    prior = single().initial
    P0 = np.zeros((STATES + 1, STATES + 1))
    P0[:STATES, :STATES] = prior.cov
    H = np.hstack([OBSERVATION, np.zeros((CHANNELS, 1))])
    return Linear(Phi, Q, H, NOISE, np.append(prior.mean, 1.0), P0)


def shifted(z: np.ndarray) -> np.ndarray:
    """Observations with the offset of their equation taken off."""
    return z - np.asarray(PROBLEM.inputs.offset)[:, :CHANNELS]


def without_offset(full: History) -> History:
    """The part of a history that the test's model has."""
    return History(full.mean[:, :STATES], full.cov[:, :STATES, :STATES], full.log_likelihood)


@each_case
def test_members_alike_equal_the_kalman_filter(name: str) -> None:
    trace = batch_run(name, CASES[name].alike, PROBLEM.z)
    estimate, info = trace.record
    for run_index in range(2):
        expected = reference(1.0, np.asarray(PROBLEM.z[run_index]), np.asarray(PROBLEM.valid))
        np.testing.assert_allclose(estimate.mean[run_index], expected.mean, atol=1e-11)
        np.testing.assert_allclose(estimate.cov[run_index], expected.cov, atol=1e-11)
        np.testing.assert_allclose(
            info.log_likelihood[run_index], expected.log_likelihood, atol=1e-11
        )


def test_imm_equals_the_textbook_loop() -> None:
    estimate, info = batch_run("imm", CASES["imm"].params, PROBLEM.z).record
    models = [augmented(theta) for theta in THETA]
    for run_index in range(RUNS):
        z = shifted(np.asarray(PROBLEM.z[run_index]))
        looped = interacting(models, np.asarray(SWITCHING), z, np.asarray(PROBLEM.valid))
        expected = without_offset(looped)
        np.testing.assert_allclose(estimate.mean[run_index], expected.mean, atol=1e-10)
        np.testing.assert_allclose(estimate.cov[run_index], expected.cov, atol=1e-10)
        np.testing.assert_allclose(
            info.log_likelihood[run_index], expected.log_likelihood, atol=1e-10
        )


WEIGHTS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "mmae": bayes_weights,
    "mmae of square roots": bayes_weights,
    "mmae of ukf": bayes_weights,
    "mmae of iterated_ckf": bayes_weights,
    "immae": lambda rows: immae_weights(rows, 5, 0.9),
    "immae of ckf": lambda rows: immae_weights(rows, 5, 0.9),
    "floor": lambda rows: floor_weights(rows, 1e-3),
    "markov": lambda rows: markov_weights(rows, 0.05),
}


@pytest.mark.parametrize("name", WEIGHTS)
def test_bank_equals_the_loop_over_models(name: str) -> None:
    estimate, _ = batch_run(name, CASES[name].params, PROBLEM.z).record
    for run_index in range(RUNS):
        z = np.asarray(PROBLEM.z[run_index])
        histories = [reference(theta, z, np.asarray(PROBLEM.valid)) for theta in THETA]
        rows = np.stack([history.log_likelihood for history in histories], axis=1)
        mean, cov = mixture(histories, WEIGHTS[name](rows))
        np.testing.assert_allclose(estimate.mean[run_index], mean, atol=1e-10)
        np.testing.assert_allclose(estimate.cov[run_index], cov, atol=1e-10)


@each_case
def test_covariance_is_symmetric_and_positive(name: str) -> None:
    estimate, _ = batch_run(name, CASES[name].params, PROBLEM.z).record
    cov = np.asarray(estimate.cov)
    np.testing.assert_allclose(cov, cov.swapaxes(-1, -2), atol=1e-15)
    assert np.linalg.eigvalsh(cov).min() > 0


@each_case
def test_order_of_the_batch_does_not_matter(name: str) -> None:
    order = jnp.array([3, 1, 5, 0, 4, 2])
    plain = batch_run(name, CASES[name].params, PROBLEM.z).record
    mixed = batch_run(name, CASES[name].params, PROBLEM.z[order]).record
    for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(mixed), strict=True):
        np.testing.assert_array_equal(a[order], b)


@each_case
def test_poisoned_run_leaves_the_others_bitwise_unchanged(name: str) -> None:
    plain = batch_run(name, CASES[name].params, PROBLEM.z).record
    poisoned = batch_run(name, CASES[name].params, PROBLEM.z.at[2, 1, 0].set(jnp.nan)).record
    others = np.array([0, 1, 3, 4, 5])
    told = np.zeros(STEPS, bool)
    told[1] = True
    for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(poisoned), strict=True):
        np.testing.assert_array_equal(a[others], b[others])
    raised = np.asarray(poisoned[1].flags)[2] & Flag.NOT_FINITE > 0
    np.testing.assert_array_equal(raised, told)


@each_case
def test_value_of_an_invalid_channel_is_never_used(name: str) -> None:
    plain = batch_run(name, CASES[name].params, PROBLEM.z)
    lost = jnp.where(PROBLEM.valid, PROBLEM.z, jnp.nan)
    for a, b in zip(
        jax.tree.leaves(plain),
        jax.tree.leaves(batch_run(name, CASES[name].params, lost)),
        strict=True,
    ):
        np.testing.assert_array_equal(a, b)


@each_case
def test_step_without_observation_is_a_prediction(name: str) -> None:
    """That the state is the predicted one shows in the comparison with the NumPy filter."""
    _, info = batch_run(name, CASES[name].params, PROBLEM.z).record
    assert not np.any(PROBLEM.valid[LOST])
    # The log of the sum of its weights, for a bank, right to the rounding of its log-weights.
    assert np.abs(info.log_likelihood[:, LOST]).max() <= 16 * np.finfo(float).eps
    np.testing.assert_array_equal(info.nis[:, LOST], 0)
    np.testing.assert_array_equal(info.innovation[:, LOST], 0)
    raised = np.asarray(info.flags) == Flag.NO_OBSERVATION
    np.testing.assert_array_equal(
        raised, np.broadcast_to(~np.any(PROBLEM.valid, axis=1), raised.shape)
    )


@each_case
def test_dtype_in_is_dtype_out(name: str) -> None:
    filter, params, _ = CASES[name]
    narrow = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), params)
    inputs = jax.tree.map(lambda leaf: leaf[0].astype(jnp.float32), PROBLEM.inputs)
    obs = Obs(PROBLEM.z[0, 0].astype(jnp.float32), jnp.ones(CHANNELS, bool))

    def step(params: Any) -> tuple[Any, Any, Gaussian]:
        state, info = filter.update(
            params, filter.predict(params, filter.init(params), inputs), inputs, obs
        )
        return state, info, filter.estimate(state)

    for leaf in jax.tree.leaves(jax.eval_shape(step, narrow)):
        assert leaf.dtype in (jnp.float32, jnp.int32, jnp.bool_), leaf
    if name in ("kf", "square_root_kf"):
        # op by op is slow; the banks are these kernels under vmap
        program = compiled(step)(narrow)
        for a, b in zip(jax.tree.leaves(step(narrow)), jax.tree.leaves(program), strict=True):
            np.testing.assert_allclose(a, b, rtol=2e-4, atol=2e-5)


@each_case
def test_second_call_does_not_trace_again(name: str) -> None:
    for scale in (1.0, 2.0, 3.0):
        batch_run(name, CASES[name].params, scale * PROBLEM.z)
    assert _TRACED[name] == 1


def test_covariance_is_shared_by_runs_that_share_their_inputs() -> None:
    """The covariance recursion stays unbatched when only the measurements are mapped."""
    case = CASES["kf"]

    def covariance_and_mean(z: Array) -> tuple[Array, Array]:
        observations = SureObs(z, PROBLEM.valid)
        final = run(case.filter, case.params, PROBLEM.inputs, observations).final
        return final.P, final.x

    # vmap refuses an output axis of None unless the value does not depend on the mapped input
    P, x = jax.vmap(covariance_and_mean, out_axes=(None, 0))(PROBLEM.z)
    assert P.shape == (STATES, STATES)
    assert x.shape == (RUNS, STATES)


def test_segments_change_neither_value_nor_gradient() -> None:
    case = CASES["kf"]
    observations = Obs(PROBLEM.z[0], PROBLEM.valid)

    def loss(q: Array, segment: int) -> Array:
        params = case.params._replace(model=case.params.model._replace(q=q))
        return negative_log_likelihood(
            case.filter, params, PROBLEM.inputs, observations, segment=segment
        )

    graded = compiled(jax.value_and_grad(loss), static_argnums=1)
    for segment in (5, 4):
        np.testing.assert_allclose(
            graded(jnp.array(1.3), segment), graded(jnp.array(1.3), 0), rtol=1e-12
        )


def test_run_refuses_lengths_that_differ() -> None:
    case = CASES["kf"]
    with pytest.raises(ValueError, match=r"\[11, 12\] steps"):
        run(case.filter, case.params, PROBLEM.inputs, Obs(PROBLEM.z[0, 1:], PROBLEM.valid[1:]))


def test_every_kth_record_is_that_of_the_whole_run() -> None:
    """With segments too, which are then of records."""
    case = CASES["kf"]
    observations = Obs(PROBLEM.z[0], PROBLEM.valid)

    def recorded(every: int, segment: int) -> Trace:
        return run(
            case.filter, case.params, PROBLEM.inputs, observations, every=every, segment=segment
        )

    whole = recorded(1, 0)
    for every, segment in ((3, 0), (4, 2)):
        part = recorded(every, segment)
        kept = jax.tree.map(lambda leaf, k=every: leaf[k - 1 :: k], whole.record)
        for a, b in zip(jax.tree.leaves(part.record), jax.tree.leaves(kept), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-14)
        for a, b in zip(jax.tree.leaves(part.final), jax.tree.leaves(whole.final), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-14)
    for every, accepted in (
        *((0, "it must be at least 1, and whole"), (-1, "it must be at least 1, and whole")),
        *((5, "12 steps must be a multiple"), (24, "12 steps must be a multiple")),
    ):
        with pytest.raises(ValueError, match=f"every is {every}; {accepted}"):
            recorded(every, 0)


def _misfits() -> dict[str, tuple[Model, FilterParams, Obs, str]]:
    """Models, parameters and data that do not fit together, and what is said about them."""
    model, params, obs = dense_model(), single(), Obs(PROBLEM.z[0], PROBLEM.valid)
    wide = Obs(jnp.zeros((STEPS, 3)), jnp.ones((STEPS, 3), bool))
    prior = params.initial._replace(cov=jnp.eye(3))
    return {
        "prior": (model, params._replace(initial=prior), obs, r"\(3, 3\).*\(4, 4\)"),
        "data": (model, params, wide, r"z \(3,\) and valid \(3,\).*\(2,\)"),
        "mask": (
            model,
            params,
            obs._replace(valid=wide.valid),
            r"z \(12, 2\) and valid \(12, 3\); both must be \(T, m\)",
        ),
        "R": (
            model._replace(observation_noise=lambda p, x, u: jnp.eye(3)),
            params,
            obs,
            r"\(3, 3\).*\(2, 2\) or \(2,\)",
        ),
        "diagonal of R": (
            model._replace(observation_noise=lambda p, x, u: jnp.ones(4)),
            params,
            obs,
            r"\(4,\).*\(2, 2\) or \(2,\)",
        ),
        "Q": (
            model._replace(process_noise=lambda p, x, u: jnp.eye(3)),
            params,
            obs,
            r"\(3, 3\).*\(4, 4\)",
        ),
        "transition": (
            model._replace(transition=lambda p, x, u: x[:3]),
            params,
            obs,
            r"\(4,\) to \(3,\)",
        ),
    }


MISFITS = _misfits()
BUILDERS = (
    ekf,
    square_root_ekf,
    ukf,
    square_root_ukf,
    iterated_ekf,
    iterated_ckf,
    modified_iterated_ckf,
)


@pytest.mark.parametrize("build", BUILDERS)
@pytest.mark.parametrize("wrong", MISFITS)
def test_shapes_that_do_not_fit_are_named(build: Callable[[Model], Filter], wrong: str) -> None:
    model, params, obs, message = MISFITS[wrong]
    with pytest.raises(ValueError, match=message):
        run(build(model), params, PROBLEM.inputs, obs)


NOISE_GIVEN = (versoria, correntropy, innovation_adaptive, partial(sage_husa, channels=CHANNELS))


@pytest.mark.parametrize("build", NOISE_GIVEN)
@pytest.mark.parametrize("wrong", MISFITS)
def test_filters_that_hand_noise_to_their_model_name_it_too(
    build: Callable[[Filter], Filter], wrong: str
) -> None:
    model, params, obs, message = MISFITS[wrong]
    channels = r"|3 channels" if wrong == "data" else ""
    with pytest.raises(ValueError, match=message + channels):
        run(build(ekf(model)), params, PROBLEM.inputs, obs)
