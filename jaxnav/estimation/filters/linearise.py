"""A model's functions as linear maps of tangent vectors: automatic, or as the model gives them.

A map is applied to the columns of a covariance or of its root. One that the model gives as a
function costs what its blocks cost; an automatic one is formed as a matrix once and then multiplied
with, since the derivative of a nonlinear function costs more than the product. A linear model is
its own derivative (:func:`with_itself_as_jacobians`): its maps do not depend on the point, and
``vmap`` over runs shares what they make.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.interpreters import partial_eval

from jaxnav.estimation.checks import require_model
from jaxnav.estimation.types import Input, LinearMap, Model, Params, Point
from jaxnav.numerics.linalg import matmul

ColumnMap = Callable[[Array], Array]
"""A linear map of columns ``(n, k)``."""


def transition_map(
    model: Model, params: Params, x: Point, u: Input, n: int
) -> tuple[Point, ColumnMap]:
    """Return ``f(x)`` and the map ``Phi`` of columns ``(n, k)`` from ``x`` to ``f(x)``."""
    y = model.transition(params, x, u)
    own = None if model.jacobians is None else model.jacobians(params, x, u)[0]
    if own is not None:
        return y, _columns(own)

    def moved(dx: Array) -> Array:
        return model.local(y, model.transition(params, model.retract(x, dx), u))

    return y, _derivative(moved, x, n)


def observation_map(
    model: Model, params: Params, x: Point, u: Input, n: int
) -> tuple[Array, ColumnMap]:
    """Return ``h(x)`` ``(m,)`` and the map ``H`` of columns ``(n, k)`` to residuals ``(m, k)``."""
    z = model.observe(params, x, u)
    own = None if model.jacobians is None else model.jacobians(params, x, u)[1]
    if own is not None:
        return z, _columns(own)

    def seen(dx: Array) -> Array:
        return model.residual(model.observe(params, model.retract(x, dx), u), z)

    return z, _derivative(seen, x, n)


def with_itself_as_jacobians(model: Model) -> Model:
    """Return a linear model whose Jacobians are its own functions, free of matrices.

    Raises:
        ValueError: If the model has slots that a linear filter does not use; in a run, if a
            derivative depends on the state (:func:`is_affine`).
    """
    require_model(model)
    unused = ("retract", "local", "jacobians")
    own = [name for name in unused if getattr(model, name) is not Model._field_defaults[name]]
    if own:
        raise ValueError(
            f"the model has its own {', '.join(own)}; a linear filter takes models with a vector "
            "as state and no Jacobians, the ekf takes all"
        )

    def jacobians(params: Params, x: Array, u: Input) -> tuple[LinearMap, LinearMap]:
        def pushed(name: str) -> Callable[[Array], Array]:
            function = getattr(model, name)

            def push(dx: Array) -> Array:
                if not is_affine(lambda x: function(params, x, u), x):
                    raise ValueError(
                        f"the derivative of the model's {name} depends on the state; a linear "
                        "filter needs one that does not and no rounding, the ekf takes all (and so "
                        "it does where a loop of unknown length hides that it does not)"
                    )
                return jax.jvp(lambda x: function(params, x, u), (x,), (dx,))[1]

            return push

        return pushed("transition"), pushed("observe")

    return model._replace(jacobians=jacobians)


def is_affine(function: Callable[[Array], Array], x: Array) -> bool:
    """Return whether the derivative of a function is the same at every point.

    That is read off the operations and not off values: it costs tracing alone, holds under any
    transformation, and takes a derivative that depends on the point in form alone for one that
    does, as that of a product with what turns out to be one, or of a ``while`` loop. An operation
    whose derivative is zero by decree, as rounding, is none of an affine function.

    Args:
        function: Of a vector ``(n,)``.
        x: A vector, of which shape and type matter.
    """
    point = jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x))
    traced = jax.make_jaxpr(lambda x, dx: jax.jvp(function, (x,), (dx,))[1])(point, point).jaxpr
    _, used = partial_eval.dce_jaxpr(traced, [True] * len(traced.outvars))
    return not used[0] and not _steps(jax.make_jaxpr(function)(point).jaxpr)


_ZERO_DERIVATIVE = {"round", "floor", "ceil", "sign", "stop_gradient", "argmax", "argmin"}


def _steps(traced: Any, given: Sequence[bool] | None = None) -> bool:
    """Return whether what depends on the inputs goes through an operation of no derivative.

    Args:
        traced: A jaxpr.
        given: Which of its inputs count; the default is all.
    """
    moving = {
        var
        for var, on in zip(traced.invars, given or [True] * len(traced.invars), strict=True)
        if on
    }
    for step in traced.eqns:
        # a literal cannot be hashed, and moves with nothing
        inputs = [not hasattr(var, "val") and var in moving for var in step.invars]
        if not any(inputs):
            continue
        if step.primitive.name in _ZERO_DERIVATIVE:
            return True
        for inner in jax.tree.leaves(
            list(step.params.values()), is_leaf=lambda part: hasattr(part, "eqns")
        ):
            body = getattr(inner, "jaxpr", inner)
            if hasattr(body, "eqns"):
                same = len(body.invars) == len(inputs)
                if _steps(body, inputs if same else None):
                    return True
        moving |= set(step.outvars)
    return False


def jacobians(model: Model, params: Params, x: Point, u: Input, n: int) -> tuple[Array, Array]:
    """Return ``Phi`` ``(n, n)`` and ``H`` ``(m, n)`` at a point, as the filters see them.

    Args:
        model: The model; its own ``jacobians`` are used where it has them, so
            ``model._replace(jacobians=None)`` gives the automatic ones.
        params: Its parameters.
        x: Where to linearise both functions.
        u: Input of the step.
        n: Number of tangent coordinates.
    """
    one = jnp.eye(n, dtype=jax.tree.leaves(x)[0].dtype)
    return (
        transition_map(model, params, x, u, n)[1](one),
        observation_map(model, params, x, u, n)[1](one),
    )


def _derivative(function: Callable[[Array], Array], x: Point, n: int) -> ColumnMap:
    """Return the derivative at zero of a function of a tangent vector ``(n,)`` at ``x``."""
    zero = jnp.zeros(n, jax.tree.leaves(x)[0].dtype)
    return _columns(jax.jacfwd(function)(zero))


def _columns(jacobian: LinearMap) -> ColumnMap:
    if not callable(jacobian):
        return lambda columns: matmul(jacobian, columns)
    return jax.vmap(jacobian, in_axes=1, out_axes=1)
