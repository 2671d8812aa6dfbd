"""What a step of a method costs on its own, where a paper names the price of its method."""

import gc
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree

from jaxnav.compiling import accepted_options, compiled
from jaxnav.estimation.run import run
from jaxnav.estimation.types import Filter, Obs, SureObs

CALLS = 3000
WARM_UP = 300
RUNS = 16
STEPS = 200
REPEATS = 3


class Latency(NamedTuple):
    """How long one compiled step of one run takes [us]: the median, and 99 of 100 are faster."""

    p50: float
    p99: float


def step_latency(filter: Filter, params: Any, inputs: Any, observations: Obs) -> Latency:
    """Time single steps of a filter one by one, as a navigation computer would make them.

    The parameters are constants of the compiled step, as they are on board; the state, which is
    replaced in place, and the data of the step are packed into an array each, since every array
    that is passed costs a microsecond. The collection of garbage is put off meanwhile. Where JAX
    hands calls on to another thread (``jax_cpu_enable_async_dispatch``) the way there and back is
    part of what is measured.

    Args:
        filter: The filter or bank.
        params: Its parameters.
        inputs: Inputs of the steps, leading axis of time; the last step is timed, again and again
            from where it led.
        observations: Likewise.

    Returns:
        The quietest of three rounds, by its 99 %.
    """
    last = jax.tree.map(lambda leaf: leaf[-1], (inputs, observations))
    valid = last[1].valid
    state, unpack_state = ravel_pytree(compiled(filter.init)(params))
    data, unpack_data = ravel_pytree((last[0], last[1].z))

    @partial(jax.jit, donate_argnums=0, compiler_options=accepted_options())
    def step(packed: Array, data: Array, valid: Array) -> Array:
        u, z = unpack_data(data)
        predicted = filter.predict(params, unpack_state(packed), u)
        return ravel_pytree(filter.update(params, predicted, u, SureObs(z, valid))[0])[0]

    def timed(state: Array) -> tuple[Array, float]:
        begin = time.perf_counter()
        state = step(state, data, valid).block_until_ready()
        return state, time.perf_counter() - begin

    for _ in range(WARM_UP):
        state, _ = timed(state)
    rounds = []
    for _ in range(REPEATS):
        times = []
        with _garbage_left():
            for _ in range(CALLS):
                state, seconds = timed(state)
                times.append(seconds)
        rounds.append(Latency(*(1e6 * float(x) for x in np.percentile(times, [50, 99]))))
    return min(rounds, key=lambda found: found.p99)


@contextmanager
def _garbage_left() -> Iterator[None]:
    """Put the collection of garbage off."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()


def microseconds_per_step(filter: Filter, params: Any, inputs: Any, observations: Obs) -> float:
    """Time a filter over many runs at once on one device, compilation apart.

    Args:
        filter: The filter or bank.
        params: Its parameters, a leading axis of runs on every leaf.
        inputs: Inputs of the steps, leading axes of runs and of time; the first :data:`STEPS` of
            the steps are timed.
        observations: Likewise.

    Returns:
        Microseconds per filter step and run, the best of three.
    """
    inputs, observations = jax.tree.map(lambda leaf: leaf[:, :STEPS], (inputs, observations))

    def one(params: Any, inputs: Any, observations: Obs) -> Array:
        trace = run(
            filter, params, inputs, observations, record=lambda state, info: info.log_likelihood
        )
        return trace.record

    given = (params, inputs, observations)
    batch = compiled(jax.vmap(one))
    jax.block_until_ready(batch(*given))
    best = float("inf")
    for _ in range(REPEATS):
        begin = time.perf_counter()
        jax.block_until_ready(batch(*given))
        best = min(best, time.perf_counter() - begin)
    return 1e6 * best / observations.z[..., 0].size
