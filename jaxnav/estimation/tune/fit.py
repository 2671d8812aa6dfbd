"""Descent: minimise a loss over parameters that live on their own domains."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import scipy.optimize
from jax import Array

from jaxnav.arguments import described, require_function, require_whole
from jaxnav.compiling import compiled
from jaxnav.estimation.tune.transforms import POSITIVE, Coordinates, coordinates

Progress = Callable[[int, int, float], None]


class Fit(NamedTuple):
    """The result of a fit.

    Attributes:
        params: The best parameters, like the start: those of the least validation loss, if there is
            one; else of the least loss, if all batches are the same; else the last.
        loss: The loss that chose them.
        history: ``(steps + 1,)`` the loss at each evaluation; NaN where it was rejected.
        rejected: Number of evaluations whose loss or gradient was not finite.
        validation: ``(checks, 2)`` step and validation loss of each check, from the start on.
        stopped: What ended the fit: "steps", "patience" or "converged".
    """

    params: Any
    loss: float
    history: np.ndarray
    rejected: int
    validation: np.ndarray
    stopped: str


class Validation(NamedTuple):
    """A loss on data that the fit does not see, for early stopping.

    Attributes:
        loss: ``(params, *data) -> scalar``.
        data: What it is given, beside the parameters.
        every: Steps between two checks.
        patience: Checks in a row without a new least loss that end the fit.
    """

    loss: Callable[..., Array]
    data: tuple[Any, ...] = ()
    every: int = 5
    patience: int = 5


class StartError(ValueError):
    """A fit cannot begin: the loss or its gradient is not finite at the start."""


class _Best(NamedTuple):
    point: Array
    loss: float
    check: int


def fit(
    loss: Callable[..., Array],
    start: Any,
    *,
    data: tuple[Any, ...] = (),
    transform: Any = POSITIVE,
    optimiser: optax.GradientTransformation | None = None,
    steps: int = 60,
    batches: Callable[[int], Any] | None = None,
    validation: Validation | None = None,
    mode: str = "reverse",
    progress: Progress | None = None,
) -> Fit:
    """Minimise a loss by gradient steps in unconstrained coordinates.

    A step to a point where the loss or its gradient is not finite is taken back, and tried again at
    half its length; the optimiser never sees it.

    Args:
        loss: ``(params, *data) -> scalar``, or ``(params, batch) -> scalar`` with ``batches``;
            differentiable in every parameter that is not fixed.
        start: Pytree of parameters to begin from.
        data: What the loss is given beside the parameters, at every evaluation the same.
        transform: One :class:`~jaxnav.estimation.tune.transforms.Transform` for all leaves, or a
            pytree of them like ``start``.
        optimiser: The default is Adam, with a rate of 0.1 decaying to zero by a cosine.
        steps: Number of gradient steps.
        batches: From the number of an evaluation, counted from 0, to its batch: simulated runs,
            windows of time. Every batch needs the same shapes.
        validation: Stops early, and chooses the parameters.
        mode: "reverse", or "forward", which needs no memory and, for few parameters, less time.
        progress: Called with (step, steps, loss) after each step, on the host.

    Returns:
        The fit.

    Raises:
        ValueError: If a starting value is outside its domain, or ``steps`` below 1.
        StartError: A ``ValueError``, if the loss there is not finite.
    """
    require_function("loss", loss)
    require_whole("steps", steps, 1)
    if not isinstance(data, tuple | list):
        raise ValueError(f"data is {described(data)}; it must be a tuple of what the loss is given")
    if not isinstance(optimiser, optax.GradientTransformation | None):
        raise ValueError(
            f"optimiser is {described(optimiser)}; it must be one of optax, as optax.adam(0.1)"
        )
    if not isinstance(validation, Validation | None):
        raise ValueError(f"validation is {described(validation)}; it must be Validation(...)")
    if batches is not None:
        require_function("batches", batches, "number")
    if progress is not None:
        require_function("progress", progress, "step", "steps", "loss")
    free = coordinates(start, transform)
    given = (lambda number: data) if batches is None else (lambda number: (batches(number),))
    evaluate = _evaluation(loss, free, given, mode)
    improve = _improvement(optimiser or optax.adam(optax.cosine_decay_schedule(0.1, steps)))
    check = None if validation is None else _check(validation, free)

    point = free.start
    value, gradient = evaluate(point, 0)
    _require_start(value, gradient, start)
    memory = improve.init(point)
    update, memory = improve.update(gradient, memory, point)
    checks = [] if check is None else [(0, check(point))]
    best = _Best(point, checks[0][1] if checks else value, len(checks))
    history, rejected, scale, stopped = [value], 0, 1.0, "steps"
    for step in range(1, steps + 1):
        candidate = point + scale * update
        value, gradient = evaluate(candidate, step)
        if _finite(value, gradient):
            point, scale = candidate, 1.0
            update, memory = improve.update(gradient, memory, point)
        else:
            rejected, scale, value = rejected + 1, 0.5 * scale, float("nan")
        history.append(value)
        if progress is not None:
            progress(step, steps, value)
        if check is not None and validation is not None:
            if step % validation.every == 0 or step == steps:
                checks.append((step, check(point)))
                best = _better(best, _Best(point, checks[-1][1], len(checks)))
                if len(checks) - best.check >= validation.patience:
                    stopped = "patience"
                    break
        elif batches is not None:
            best = _Best(point, value, 0) if np.isfinite(value) else best
        else:
            best = _better(best, _Best(point, value, 0))
    table = np.array(checks).reshape(-1, 2)
    return Fit(free.constrain(best.point), best.loss, np.array(history), rejected, table, stopped)


def _better(known: _Best, new: _Best) -> _Best:
    return new if new.loss < known.loss else known


class _Improvement(NamedTuple):
    init: Callable[[Array], Any]
    update: Callable[[Array, Any, Array], tuple[Array, Any]]


def _improvement(optimiser: optax.GradientTransformation) -> _Improvement:
    @compiled
    def update(gradient: Array, memory: Any, point: Array) -> tuple[Array, Any]:
        # optax mixes integer counts with floats, whatever the caller's promotion rules are.
        with jax.numpy_dtype_promotion("standard"):
            moved, memory = optimiser.update(gradient, memory, point)
        return jnp.asarray(moved), memory

    return _Improvement(optimiser.init, update)


def _evaluation(
    loss: Callable[..., Array],
    free: Coordinates,
    data: Callable[[int], tuple[Any, ...]],
    mode: str,
) -> Callable[[Array, int], tuple[float, Array]]:
    """Return the compiled loss and gradient at a point, on the data of an evaluation."""

    def at(point: Array, given: tuple[Any, ...]) -> Array:
        value = loss(free.constrain(point), *given)
        if not isinstance(value, float | Array | np.ndarray | np.generic) or not (
            jnp.shape(value) == () and jnp.issubdtype(jnp.result_type(value), jnp.floating)
        ):
            raise ValueError(
                f"loss returns {described(value)}; it must return one floating-point number"
            )
        return value

    graded = compiled(value_and_gradient(at, mode))

    def evaluate(point: Array, number: int) -> tuple[float, Array]:
        value, gradient = graded(point, data(number))
        return float(value), gradient

    return evaluate


def value_and_gradient(
    function: Callable[..., Array], mode: str = "reverse"
) -> Callable[..., tuple[Array, Array]]:
    """Return a function of a vector ``(d,)`` and more as its value and gradient ``(d,)``.

    Args:
        function: ``(point, *rest) -> scalar``.
        mode: "reverse"; or "forward", in which the ``d`` derivatives run along with the value: it
            keeps nothing of the past.

    Raises:
        ValueError: If the mode is neither.
    """
    if mode == "reverse":
        return jax.value_and_grad(function)
    if mode != "forward":
        raise ValueError(f"the mode is {mode!r}; it must be 'reverse' or 'forward'")

    def forward(point: Array, *rest: Any) -> tuple[Array, Array]:
        def along(direction: Array) -> tuple[Array, Array]:
            return jax.jvp(lambda p: function(p, *rest), (point,), (direction,))

        basis = jnp.eye(point.size, dtype=point.dtype)
        return jax.vmap(along, out_axes=(None, 0))(basis)

    return forward


def _check(validation: Validation, free: Coordinates) -> Callable[[Array], float]:
    program = compiled(lambda point, data: validation.loss(free.constrain(point), *data))
    return lambda point: float(program(point, validation.data))


def _require_start(value: float, gradient: Array, start: Any) -> None:
    if not _finite(value, gradient):
        raise StartError(f"the loss {value} or its gradient is not finite at {start}")


def _finite(value: float, gradient: Array) -> bool:
    return bool(np.isfinite(value) and np.all(np.isfinite(gradient)))


def fit_lbfgs(
    loss: Callable[..., Array],
    start: Any,
    *,
    data: tuple[Any, ...] = (),
    transform: Any = POSITIVE,
    steps: int = 60,
    mode: str = "reverse",
    progress: Progress | None = None,
) -> Fit:
    """Minimise a loss that is the same at every evaluation by L-BFGS, in the same coordinates.

    Fewer evaluations than :func:`fit` for a smooth loss of few parameters. A point where the loss
    or its gradient is not finite is shown to the line search as a wall, from which it steps back.

    Args:
        loss: ``(params, *data) -> scalar``.
        start: As for :func:`fit`; so are ``transform``, ``mode`` and ``progress``.
        data: What the loss is given, beside the parameters.
        transform: See above.
        steps: Largest number of evaluations.
        mode: See above.
        progress: See above.

    Raises:
        ValueError: As for :func:`fit`.

    References:
        Byrd, Lu, Nocedal, Zhu (1995), SIAM J. Sci. Comput. 16(5), in scipy's implementation.
    """
    free = coordinates(start, transform)
    evaluate = _evaluation(loss, free, lambda number: data, mode)
    value, gradient = evaluate(free.start, 0)
    _require_start(value, gradient, start)
    history: list[float] = []
    best = _Best(free.start, value, 0)

    def graded(point: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal best
        value, gradient = evaluate(jnp.asarray(point), len(history))
        good = _finite(value, gradient)
        history.append(value if good else float("nan"))
        if progress is not None and len(history) > 1:
            progress(len(history) - 1, steps, history[-1])
        if good:
            best = _better(best, _Best(jnp.asarray(point), value, 0))
            return value, np.asarray(gradient)
        away = point - np.asarray(best.point)
        return best.loss + 10 * abs(best.loss) + 10, away / max(float(np.linalg.norm(away)), 1e-12)

    # A mean per step differs by the inverse number of steps between what the data tell apart.
    options = {"maxfun": steps, "ftol": 1e-13, "gtol": 1e-9}
    found = scipy.optimize.minimize(
        graded, np.asarray(free.start), jac=True, method="L-BFGS-B", options=options
    )
    rejected = int(np.isnan(history).sum())
    stopped = "converged" if found.success else "steps"
    return Fit(
        free.constrain(best.point),
        best.loss,
        np.array(history),
        rejected,
        np.zeros((0, 2)),
        stopped,
    )
