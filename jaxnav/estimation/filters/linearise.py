"""A model's functions as linear maps of tangent vectors: automatic, or as the model gives them.

Neither the transition nor the observation matrix is formed: the maps are applied to the columns of
a covariance or of its root, so that a model written in blocks costs what its blocks cost. For a
linear model the maps do not depend on the point, and ``vmap`` over runs shares what they make.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.types import Input, LinearMap, Model, Params, Point
from jaxnav.numerics.linalg import matmul

ColumnMap = Callable[[Array], Array]
"""A linear map of columns ``(n, k)``."""


def transition_map(
    model: Model, params: Params, x: Point, u: Input, n: int
) -> tuple[Point, ColumnMap]:
    """Return ``f(x)`` and the map ``Phi`` of columns ``(n, k)`` from ``x`` to ``f(x)``."""
    y = model.transition(params, x, u)
    if model.jacobians is not None:
        return y, _columns(model.jacobians(params, x, u)[0])

    def moved(dx: Array) -> Array:
        return model.local(y, model.transition(params, model.retract(x, dx), u))

    return y, _derivative(moved, n)


def observation_map(
    model: Model, params: Params, x: Point, u: Input, n: int
) -> tuple[Array, ColumnMap]:
    """Return ``h(x)`` ``(m,)`` and the map ``H`` of columns ``(n, k)`` to residuals ``(m, k)``."""
    z = model.observe(params, x, u)
    if model.jacobians is not None:
        return z, _columns(model.jacobians(params, x, u)[1])

    def seen(dx: Array) -> Array:
        return model.residual(model.observe(params, model.retract(x, dx), u), z)

    return z, _derivative(seen, n)


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


def require_vector_space(model: Model) -> None:
    """Raise ``ValueError`` if a model has slots that the linear filters do not use."""
    unused = ("retract", "local", "jacobians")
    own = [name for name in unused if getattr(model, name) is not Model._field_defaults[name]]
    if own:
        raise ValueError(
            f"the model has its own {', '.join(own)}; a linear filter takes models with a vector "
            "as state and no Jacobians, the ekf takes all"
        )


def _derivative(function: Callable[[Array], Array], n: int) -> ColumnMap:
    """Return the derivative at zero of a function of a tangent vector ``(n,)``."""

    def push(columns: Array) -> Array:
        zero = jnp.zeros(n, columns.dtype)

        def along(column: Array) -> Array:
            return jax.jvp(function, (zero,), (column,))[1]

        return jax.vmap(along, in_axes=1, out_axes=1)(columns)

    return push


def _columns(jacobian: LinearMap) -> ColumnMap:
    if callable(jacobian):
        return jax.vmap(jacobian, in_axes=1, out_axes=1)
    return lambda columns: matmul(jacobian, columns)
