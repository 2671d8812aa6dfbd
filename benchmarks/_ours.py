"""The library's own ways through the shared problem, as Monte Carlo studies of a bank."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from benchmarks._problem import IMU_STEP, PERIOD, Dense, Problem, bank_params, own_inputs
from jaxnav.estimation.banks.mixture import BankState, mmae
from jaxnav.estimation.filters.kalman import kf
from jaxnav.estimation.montecarlo import RunOutput, monte_carlo
from jaxnav.estimation.run import run
from jaxnav.estimation.types import Filter, Model, SureObs
from jaxnav.navigation.models.sins_cns import SinsCnsParams, sins_cns
from jaxnav.navigation.states import LAYOUT


class Statistics(NamedTuple):
    """What is kept of a run: mean and mean square of the attitude over time, and its last value."""

    mean: Array
    square: Array
    last: Array


def structured(problem: Problem, own: bool, tile: int | None = None) -> Callable[[], Statistics]:
    """Return the Monte Carlo study of the library's model, in tiles of a size or the default."""
    source = (problem.inputs, problem.tilt) if own else problem.inputs
    run_one = _study_run(mmae(kf(sins_cns(PERIOD, IMU_STEP))), _turned if own else _same)
    return _study(run_one, problem.z, source, bank_params(problem.noise, problem.P0), tile)


def unstructured(matrices: Dense) -> Callable[[], Statistics]:
    """Return the same study with the transition as a dense product, in the matrices' units."""
    H, P0, z = (jnp.asarray(m) for m in (matrices.H, matrices.P0, matrices.z))
    source = (jnp.asarray(matrices.F), jnp.asarray(matrices.Q))
    run_one = _study_run(mmae(kf(_dense_model(H))), _picked if matrices.own else _same)
    star = jnp.asarray(np.sqrt(np.diag(matrices.R)))
    noise = SinsCnsParams(jnp.zeros(3), jnp.zeros(3), star, jnp.ones(()))
    return _study(run_one, z, source, bank_params(noise, P0))


def _dense_model(H: Array) -> Model:
    """Return the model that knows no structure: its input is ``(F, Q0)``."""

    def noise(params: SinsCnsParams, x: Array, u: Any) -> Array:
        del x
        return params.noise_scale * u[1]

    return Model(
        transition=lambda params, x, u: u[0] @ x,
        process_noise=noise,
        observe=lambda params, x, u: H @ x,
        observation_noise=lambda params, x, u: params.star_noise**2,
    )


def _attitude(state: BankState, info: Any) -> Array:
    """Keep the bank's attitude alone: nobody asks for a covariance here."""
    del info
    return jnp.sum(jnp.exp(state.log_weights)[:, None] * state.members.x[:, LAYOUT.phi], axis=0)


def _study_run(bank: Filter, inputs_of: Callable[[Any, Array], Any]) -> Callable:
    """Return one run of ``bank`` as a function of its key, by which it finds its own data."""

    def run_one(key: Array, shared: Any) -> RunOutput:
        keys, z, source, params = shared
        index = run_index(keys, key)
        observations = SureObs(z[index], jnp.ones(z.shape[1:], bool))
        inputs = inputs_of(source, index)
        attitude = run(bank, params, inputs, observations, record=_attitude).record
        mean, square = jnp.mean(attitude, axis=0), jnp.mean(attitude**2, axis=0)
        return RunOutput(Statistics(mean, square, attitude[-1]))

    return run_one


def _same(source: Any, index: Array) -> Any:
    del index
    return source


def _turned(source: Any, index: Array) -> Any:
    inputs, tilt = source
    return own_inputs(inputs, tilt[index])


def _picked(source: Any, index: Array) -> Any:
    return jax.tree.map(lambda leaf: leaf[index], source)


def _study(
    run_one: Callable, z: Array, source: Any, params: Any, tile: int | None = None
) -> Callable[[], Statistics]:
    key, runs = jax.random.key(1), len(z)
    shared = (run_keys(key, runs), z, source, params)
    return lambda: monte_carlo(run_one, key, runs, shared, tile=tile).rows


def run_keys(key: Array, runs: int) -> Array:
    """Return the data of the keys that ``monte_carlo`` gives to runs 0, 1, ..."""
    keys = jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, jnp.arange(runs, dtype=jnp.int32))
    return jax.random.key_data(keys)


def run_index(keys: Array, key: Array) -> Array:
    """Return which of the :func:`run_keys` a run has, by which it finds data simulated before."""
    return jnp.argmax(jnp.all(keys == jax.random.key_data(key)[None], axis=-1))
