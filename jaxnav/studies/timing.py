"""What a step of a method costs on its own, where a paper names the price of its method."""

import time
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array

from jaxnav.estimation.run import run
from jaxnav.estimation.types import Filter, Obs

CALLS = 3000
RUNS = 16
STEPS = 200
REPEATS = 3


class Latency(NamedTuple):
    """How long one compiled step of one run takes [us]: the median, and 99 of 100 are faster."""

    p50: float
    p99: float


def step_latency(filter: Filter, params: Any, inputs: Any, observations: Obs) -> Latency:
    """Time single steps of a filter one by one, as a navigation computer would make them.

    Args:
        filter: The filter or bank.
        params: Its parameters.
        inputs: Inputs of the steps, leading axis of time; the last step is timed, from the state
            at t0.
        observations: Likewise.
    """

    def step(params: Any, state: Any, u: Any, obs: Obs) -> Any:
        return filter.update(params, filter.predict(params, state, u), u, obs)[0]

    last = jax.tree.map(lambda leaf: leaf[-1], (inputs, observations))
    state = jax.jit(filter.init)(params)
    compiled = jax.jit(step).lower(params, state, *last).compile()
    jax.block_until_ready(compiled(params, state, *last))
    times = []
    for _ in range(CALLS):
        begin = time.perf_counter()
        jax.block_until_ready(compiled(params, state, *last))
        times.append(time.perf_counter() - begin)
    median, slow = np.percentile(times, [50, 99])
    return Latency(1e6 * float(median), 1e6 * float(slow))


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
    compiled = jax.jit(jax.vmap(one)).lower(*given).compile()
    best = float("inf")
    for _ in range(REPEATS):
        begin = time.perf_counter()
        jax.block_until_ready(compiled(*given))
        best = min(best, time.perf_counter() - begin)
    return 1e6 * best / observations.z[..., 0].size
