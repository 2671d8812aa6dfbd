"""Runs over time: the only ``lax.scan`` over filter time."""

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.core import Tracer
from jax.experimental import checkify

from jaxnav.arguments import (
    described,
    require_array,
    require_function,
    require_switch,
    require_whole,
)
from jaxnav.compiling import compiled
from jaxnav.estimation.checks import (
    require_filter,
    require_model,
    require_observations,
    require_steps,
)
from jaxnav.estimation.debugging import check_covariance, checking
from jaxnav.estimation.models import disturbed
from jaxnav.estimation.types import Filter, FilterParams, Gaussian, Input, Model, Obs, Params
from jaxnav.numerics.conditioning import KEPT

Recorder = Callable[[Any, Any], Any]


class Trace(NamedTuple):
    """What a run returns: ``record``'s pytree with a leading time axis, and the last state."""

    record: Any
    final: Any


def run(
    filter: Filter,
    params: Params,
    inputs: Input,
    observations: Obs,
    *,
    record: Recorder | None = None,
    every: int = 1,
    segment: int = 0,
    debug: bool = False,
) -> Trace:
    """Run a filter over time: step k predicts over ``[t_{k-1}, t_k]``, then updates at ``t_k``.

    Args:
        filter: The filter or bank.
        params: Its parameters.
        inputs: Inputs of the steps on the filter's clock, a leading time axis ``T`` on every leaf.
        observations: ``z`` ``(T, m)`` and ``valid`` ``(T, m)``; a sensor of a lower rate is not
            valid in the steps between.
        record: ``(state, info) -> pytree`` of what to keep per step; the default keeps
            ``(filter.estimate(state), info)``.
        every: Keep the record of every so many steps only, from the first such on; ``T`` must be a
            multiple.
        segment: Length of the segments whose inside is computed again by the backward pass, so that
            a gradient holds ``T / segment + segment`` states instead of ``T``, at the price of
            running forward once more; 0 is one segment. About ``sqrt(T)`` holds least.
        debug: Whether every covariance is checked: that of the process noise, of the observation
            noise and of the estimate must be finite, symmetric and positive semi-definite in each
            step. Several times slower, and not within a transformation of JAX.

    Returns:
        The trace.

    Raises:
        ValueError: If the filter, its parameters or the observations are not what they must be, the
            leading axes of inputs and observations differ, or are no multiple of ``every``; with
            ``debug``, if a covariance is none, with the first step at which it is not.
    """
    require_filter(filter)
    require_observations(observations)
    filter.check(params)
    steps = require_steps(inputs=inputs, observations=observations)
    every, segment = require_whole("every", every, 1), require_whole("segment", segment, 0)
    if steps % every:
        raise ValueError(f"every is {every}; {steps} steps must be a multiple of it")
    if record is not None:
        require_function("record", record, "state", "info")
    require_switch("debug", debug)
    given = (params, inputs, observations)
    if debug:
        return _debugged(_checked(filter, record, every, segment), given)
    return _run(filter, record, every, segment, *given)


@cache
def _checked(filter: Filter, record: Recorder | None, every: int, segment: int) -> Any:
    scan = partial(_scan, filter, record, every, segment, debug=True)
    return jax.jit(checkify.checkify(scan, errors=checkify.user_checks))


def _debugged(scan: Any, given: tuple[Any, Input, Obs]) -> Trace:
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(given)):
        raise ValueError("debug is True within a transformation of JAX; it must be run outside")
    error, trace = scan(*given)
    said = error.get()
    if said is not None:
        raise ValueError(said.partition(" (`check` failed)")[0])
    return trace


def _scan(
    filter: Filter,
    record: Recorder | None,
    every: int,
    segment: int,
    params: Params,
    inputs: Input,
    observations: Obs,
    debug: bool = False,
) -> Trace:
    def advance(state: Any, now: tuple[Input, Obs, Array | None]) -> tuple[Any, Any]:
        u, obs, index = now
        with checking(index):
            state, info = filter.update(params, filter.predict(params, state, u), u, obs)
            check_covariance("the covariance of the estimate", lambda: filter.estimate(state).cov)
        return state, info

    def step(state: Any, now: tuple[Input, Obs, Array | None]) -> tuple[Any, Any]:
        if every > 1:
            state, infos = jax.lax.scan(advance, state, now)
            info = jax.tree.map(lambda leaf: leaf[-1], infos)
        else:
            state, info = advance(state, now)
        kept = (filter.estimate(state), info) if record is None else record(state, info)
        return state, kept

    over = (inputs, observations, jnp.arange(len(observations.valid)) if debug else None)
    if every > 1:
        over = jax.tree.map(lambda leaf: leaf.reshape(-1, every, *leaf.shape[1:]), over)
    final, kept = scan_in_segments(step, filter.init(params), over, segment)
    return Trace(kept, final)


_run = compiled(_scan, static_argnums=(0, 1, 2, 3))


def scan_in_segments(
    step: Callable[[Any, Any], tuple[Any, Any]], carry: Any, xs: Any, segment: int
) -> tuple[Any, Any]:
    """Scan ``step`` over the leading axis of ``xs``, checkpointing segments of a given length.

    A backward pass keeps of each step its start and what is named
    :data:`~jaxnav.numerics.conditioning.KEPT`, and computes the rest again. The values are those of
    ``lax.scan``; a remainder shorter than a segment is scanned at the end.
    """
    # To write down all that a step computes on its way costs more than to compute it again.
    policy = jax.checkpoint_policies.save_only_these_names(KEPT)
    step = jax.checkpoint(step, prevent_cse=False, policy=policy)
    length = jax.tree.leaves(xs)[0].shape[0]
    if not 0 < segment < length:
        return jax.lax.scan(step, carry, xs)
    whole = length // segment

    @jax.checkpoint
    def inner(carry: Any, chunk: Any) -> tuple[Any, Any]:
        return jax.lax.scan(step, carry, chunk)

    def fold(leaf: Array) -> Array:
        return leaf[: whole * segment].reshape(whole, segment, *leaf.shape[1:])

    carry, kept = jax.lax.scan(inner, carry, jax.tree.map(fold, xs))
    kept = jax.tree.map(lambda leaf: leaf.reshape(whole * segment, *leaf.shape[2:]), kept)
    if whole * segment == length:
        return carry, kept
    carry, rest = jax.lax.scan(step, carry, jax.tree.map(lambda leaf: leaf[whole * segment :], xs))
    return carry, jax.tree.map(lambda a, b: jnp.concatenate([a, b]), kept, rest)


def simulate(
    model: Model,
    params: Params,
    start: Any,
    inputs: Input,
    process_noise: Array,
    observation_noise: Array,
) -> tuple[Any, Array]:
    """Simulate a state-space model: states at ``t_1 .. t_T`` and their noisy observations.

    Args:
        model: The model; ``retract`` applies the process noise.
        params: Its parameters (without the filter's prior).
        start: State at t0.
        inputs: Inputs of the steps, leading axis ``T``.
        process_noise: ``(T, n)`` samples in tangent coordinates.
        observation_noise: ``(T, m)`` samples, added to the observation.

    Returns:
        The states, leading axis ``T``, and the observations ``(T, m)``, not a number where noise
        cannot be added to them (:func:`~jaxnav.estimation.models.disturbed`).

    Raises:
        ValueError: If an argument is not what it must be, leading axes differ, or the noise of a
            step has not the size of the state's tangent or of the observation.
    """
    require_model(model)
    if isinstance(params, FilterParams):
        raise ValueError(
            "params is a FilterParams; simulate takes those of the model, params.model"
        )
    listed = list | str | Gaussian
    for leaf in jax.tree.leaves(start, is_leaf=lambda node: isinstance(node, listed)):
        if isinstance(leaf, listed):
            raise ValueError(f"start is {described(leaf)}; it must be a state, as an array (n,)")
    require_array("process_noise", process_noise)
    require_array("observation_noise", observation_noise)
    require_steps(inputs=inputs, process_noise=process_noise, observation_noise=observation_noise)

    def step(x: Any, now: tuple[Input, Array, Array]) -> tuple[Any, tuple[Any, Array]]:
        u, w, v = now
        tangent = jax.eval_shape(model.local, x, x)
        _require_shape("process_noise", w, tangent.shape)
        moved = model.retract(model.transition(params, x, u), w)
        before, after = _types_of(x), _types_of(moved)
        if before != after:
            raise ValueError(f"start is {before}; a step makes {after} of it, which must be alike")
        z = model.observe(params, moved, u)
        _require_shape("observation_noise", v, jnp.shape(z))
        return moved, (moved, disturbed(model.residual, z, v))

    return jax.lax.scan(step, start, (inputs, process_noise, observation_noise))[1]


def _require_shape(name: str, noise: Array, shape: tuple[int, ...]) -> None:
    if noise.shape != shape:
        raise ValueError(f"{name} is {noise.shape} in a step; by the model it must be {shape}")


def _types_of(x: Any) -> str:
    """Return shapes and kinds of a state's arrays, in words."""
    return ", ".join(f"{jnp.shape(leaf)} of {jnp.result_type(leaf)}" for leaf in jax.tree.leaves(x))
