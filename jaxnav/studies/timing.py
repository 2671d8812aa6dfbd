"""What a step of a method costs on its own, where a paper names the price of its method."""

import time
from typing import Any

import jax
from jax import Array

from jaxnav.estimation.run import run
from jaxnav.estimation.types import Filter, Obs

RUNS = 16
STEPS = 200
REPEATS = 3


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
