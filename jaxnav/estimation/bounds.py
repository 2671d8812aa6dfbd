"""Bounds: what a filter that knew the truth would reach."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.arguments import described, require_function
from jaxnav.estimation.checks import require_filter, require_model
from jaxnav.estimation.filters.innovation import masked_innovation
from jaxnav.estimation.filters.kalman import KalmanState, ekf
from jaxnav.estimation.types import (
    Filter,
    FilterParams,
    Info,
    Input,
    Model,
    Obs,
    Params,
    Point,
    accept,
)
from jaxnav.numerics.linalg import matmul


def oracle(filter: Filter, informed: Callable[[Params, Input], Params]) -> Filter:
    """Return the filter that is told the true parameters at every step.

    For a linear model with Gaussian noise it has the least mean square error of all estimators, so
    no adaptive filter can do better on average; the distance to it is what adaptation could gain.

    Args:
        filter: The filter to inform.
        informed: ``(params, u) -> params`` with the truth of the step, which the input carries.

    Returns:
        A filter with the same parameters and state.
    """
    require_filter(filter)
    require_function("informed", informed, "params", "u")
    single = filter.on is not None

    def parameters(params: Params, u: Input) -> Params:
        found = informed(params, u)
        if single and not isinstance(found, FilterParams):
            raise ValueError(
                f"informed returns {described(found)}; it must return the filter's parameters, "
                "FilterParams(model, initial)"
            )
        return found

    def init(params: Params) -> Any:
        if single and not hasattr(params, "initial"):
            raise ValueError(
                f"params is {described(params)}; an oracle's has the filter's prior, as "
                "FilterParams(model, initial)"
            )
        return filter.init(params)

    def predict(params: Params, state: Any, u: Input) -> Any:
        return filter.predict(parameters(params, u), state, u)

    def update(params: Params, state: Any, u: Input, obs: Obs) -> tuple[Any, Any]:
        return filter.update(parameters(params, u), state, u, obs)

    # What is told may be of any kind: the parameters need no more than the filter's prior.
    return filter._replace(init=init, predict=predict, update=update, check=accept)


def linearised_at_truth(model: Model, truth: Callable[[Input], tuple[Point, Point]]) -> Filter:
    """Return the Kalman filter of a nonlinear model linearised at the true states.

    With additive Gaussian noise its covariance is the posterior Cramer-Rao bound along that
    trajectory, and its error reaches it: what is left to a filter that has to linearise elsewhere
    is to come close. Parameters, masks and flags are those of the
    :func:`~jaxnav.estimation.filters.kalman.ekf`.

    Args:
        model: The model.
        truth: ``(u) -> (x, y)`` the true states at the start and the end of the step, which the
            input carries.

    References:
        Taylor (1979), IEEE Trans. Automatic Control 24(2); Tichavsky, Muravchik, Nehorai (1998),
        IEEE Trans. Signal Processing 46(5).
    """
    require_model(model)
    require_function("truth", truth, "u")

    def known(u: Input) -> tuple[Point, Point]:
        pair = truth(u)
        if not isinstance(pair, tuple | list) or len(pair) != 2:
            found = f"{len(pair)} values" if isinstance(pair, tuple | list) else described(pair)
            raise ValueError(
                f"truth returns {found}; it must return two states, at the start and at the end of "
                "the step"
            )
        return pair[0], pair[1]

    def moved(params: Params, dx: Array, u: Input) -> Array:
        before, after = known(u)
        return model.local(after, model.transition(params, model.retract(before, dx), u))

    def seen(params: Params, dx: Array, u: Input) -> Array:
        _, after = known(u)
        z = model.observe(params, after, u)
        return model.residual(model.observe(params, model.retract(after, dx), u), z)

    def jacobians(params: Params, dx: Array, u: Input) -> tuple[Array, Array]:
        zero = jnp.zeros_like(dx)
        return jax.jacfwd(moved, 1)(params, zero, u), jax.jacfwd(seen, 1)(params, zero, u)

    def transition(params: Params, dx: Array, u: Input) -> Array:
        Phi, _ = jacobians(params, dx, u)
        return moved(params, jnp.zeros_like(dx), u) + matmul(Phi, dx)

    def observe(params: Params, dx: Array, u: Input) -> Array:
        _, H = jacobians(params, dx, u)
        return matmul(H, dx)

    errors = ekf(
        Model(
            transition,
            lambda params, dx, u: model.process_noise(params, known(u)[0], u),
            observe,
            lambda params, dx, u: model.observation_noise(params, known(u)[1], u),
            jacobians=jacobians,
        )
    )

    def predict(params: FilterParams, state: KalmanState, u: Input) -> KalmanState:
        before, after = known(u)
        own, given = (jax.tree.map(jnp.shape, point) for point in (state.x, before))
        if own != given:
            raise ValueError(f"truth returns states {given}; they must be {own}, as the filter's")
        error = errors.predict(params, state._replace(x=model.local(before, state.x)), u)
        return error._replace(x=model.retract(after, error.x))

    def update(
        params: FilterParams, state: KalmanState, u: Input, obs: Obs
    ) -> tuple[KalmanState, Info]:
        _, after = known(u)
        nu = masked_innovation(model, obs, model.observe(params.model, after, u))
        at = state._replace(x=model.local(after, state.x))
        error, info = errors.update(params, at, u, obs._replace(z=nu))
        return error._replace(x=model.retract(after, error.x)), info

    return ekf(model)._replace(predict=predict, update=update)
