"""Tuning by gradient: optimise a loss over parameters that live on their own domains."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from jaxnav.estimation.run import run
from jaxnav.estimation.types import Filter, Info, Input, Obs, Params


class Transform(NamedTuple):
    """A smooth one-to-one map between the real line and a parameter's domain.

    Attributes:
        constrain: From the real line to the domain.
        unconstrain: Back; not finite outside the domain.
    """

    constrain: Callable[[Array], Array]
    unconstrain: Callable[[Array], Array]


POSITIVE = Transform(jnp.exp, jnp.log)
"""Positive parameters, by their logarithm."""
UNIT = Transform(jax.nn.sigmoid, lambda p: jnp.log(p) - jnp.log1p(-p))
"""Parameters between 0 and 1, by their log-odds."""


class Fit(NamedTuple):
    """The result of :func:`fit`.

    Attributes:
        params: The parameters with the least finite loss, like the start.
        loss: The loss there.
        history: ``(steps + 1,)`` the loss at each evaluation; NaN where it was rejected.
        rejected: Number of evaluations whose loss or gradient was not finite.
    """

    params: Any
    loss: float
    history: np.ndarray
    rejected: int


def negative_log_likelihood(
    filter: Filter, params: Params, inputs: Input, observations: Obs, *, segment: int = 0
) -> Array:
    """Return the negative log-likelihood of the innovations per step [nats].

    For a bank it is that of the predictive mixture. ``segment`` is that of
    :func:`~jaxnav.estimation.run.run`; about the root of the number of steps keeps the memory of
    the gradient small.
    """
    trace = run(filter, params, inputs, observations, record=_log_likelihood, segment=segment)
    return -jnp.mean(trace.record)


def _log_likelihood(state: Any, info: Info) -> Array:
    del state
    return info.log_likelihood


def fit(
    loss: Callable[[Any], Array],
    start: Any,
    *,
    transform: Any = POSITIVE,
    optimiser: optax.GradientTransformation | None = None,
    steps: int = 60,
    progress: Callable[[int, int, float], None] | None = None,
) -> Fit:
    """Minimise a loss by gradient steps in unconstrained coordinates.

    A step to a point where the loss or its gradient is not finite is taken back, and tried again at
    half its length; the optimiser never sees it.

    Args:
        loss: ``(params) -> scalar``; differentiable in every leaf of ``start``.
        start: Pytree of parameters to begin from.
        transform: One :class:`Transform` for all leaves, or a pytree of them like ``start``.
        optimiser: The default is Adam, with a rate of 0.1 decaying to zero by a cosine.
        steps: Number of gradient steps.
        progress: Called with (step, steps, loss) after each step, on the host.

    Returns:
        The fit.

    Raises:
        ValueError: If a starting value is outside its domain, or the loss there is not finite.
    """
    if isinstance(transform, Transform):
        transform = jax.tree.map(lambda leaf: transform, start)
    chosen = optimiser or optax.adam(optax.cosine_decay_schedule(0.1, steps))
    point = _map_leaves(lambda t, leaf: t.unconstrain(jnp.asarray(leaf)), transform, start)
    if not _finite(point):
        raise ValueError(f"the start {start} is outside the domain of its transform")

    @jax.jit
    def evaluate(point: Any) -> tuple[Array, Any]:
        return jax.value_and_grad(lambda p: loss(_constrain(transform, p)))(point)

    @jax.jit
    def improve(gradient: Any, memory: Any, point: Any) -> tuple[Any, Any]:
        # optax mixes integer counts with floats, whatever the caller's promotion rules are.
        with jax.numpy_dtype_promotion("standard"):
            return chosen.update(gradient, memory, point)

    value, gradient = evaluate(point)
    if not (_finite(value) and _finite(gradient)):
        raise ValueError(f"the loss {float(value)} or its gradient is not finite at {start}")
    best = _Point(point, float(value))
    history, rejected, scale = [float(value)], 0, 1.0
    update, memory = improve(gradient, chosen.init(point), point)
    for step in range(steps):
        candidate = jax.tree.map(lambda p, d, s=scale: p + s * d, point, update)
        value, gradient = evaluate(candidate)
        if _finite(value) and _finite(gradient):
            point, scale = candidate, 1.0
            update, memory = improve(gradient, memory, point)
            best = min(best, _Point(point, float(value)), key=lambda known: known.loss)
            history.append(float(value))
        else:
            rejected, scale = rejected + 1, 0.5 * scale
            history.append(float("nan"))
        if progress is not None:
            progress(step + 1, steps, history[-1])
    return Fit(_constrain(transform, best.point), best.loss, np.array(history), rejected)


class _Point(NamedTuple):
    point: Any
    loss: float


def _is_transform(node: Any) -> bool:
    return isinstance(node, Transform)


def _map_leaves(function: Callable[[Transform, Any], Array], transform: Any, params: Any) -> Any:
    return jax.tree.map(function, transform, params, is_leaf=_is_transform)


def _constrain(transform: Any, point: Any) -> Any:
    return _map_leaves(lambda t, leaf: t.constrain(leaf), transform, point)


def _finite(tree: Any) -> bool:
    return all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(tree))
