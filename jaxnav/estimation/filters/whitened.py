"""One update of an iterated filter as a problem in whitened coordinates, and its linearisations.

The state is ``retract(x-, L xi)`` with ``P- = L L'``, and noise that is iterated on is whitened
likewise and comes after it. What is seen of a point, and how far a point's prediction is from the
measurement or from another's, is all that the iterations ask.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.filters.innovation import Measurement, masked_innovation
from jaxnav.estimation.filters.line_search import Search
from jaxnav.estimation.types import Input, Model, Obs, Params, Point, difference
from jaxnav.numerics.roots import semidefinite_root


class Slope(NamedTuple):
    """The observation about an iterate, in whitened coordinates; masked channels are zero.

    Attributes:
        innovation: ``(m,)`` what the mean about the iterate leaves to be explained.
        A: ``(m, n)`` derivative with respect to the state.
        G: ``(m, k)`` derivative with respect to the noise in the state; k is 0 if it is not there.
        R: ``(m, m)`` covariance of the noise.
        spread_noise: ``(m, m)`` what the linearisation leaves unexplained.
    """

    innovation: Array
    A: Array
    G: Array
    R: Array
    spread_noise: Array


class Problem(NamedTuple):
    """One update in ``size`` whitened coordinates: the ``states``, then those of augmented noise.

    ``predicted`` maps a point to the observation ``(m,)``, ``noise`` is the covariance that adds;
    ``sound`` tells whether that of the augmented noise has a root. ``added`` is the noise in the
    state where it adds to the residual and not to the values, ``None`` elsewhere.
    """

    predicted: Callable[[Array], Array]
    noise: Array
    states: int
    size: int
    sound: Array
    added: Callable[[Array], Array] | None = None


def additive(
    model: Model, params: Params, x: Point, L: Array, u: Input, measurement: Measurement
) -> Problem:
    """Return the update over the state alone."""
    n = L.shape[0]
    sound = jnp.array(True)
    return Problem(
        lambda at: model.observe(params, model.retract(x, L @ at), u),
        measurement.noise,
        n,
        n,
        sound,
    )


def augmented(
    model: Model, params: Params, x: Point, L: Array, u: Input, measurement: Measurement
) -> Problem:
    """Return the update over the state and the noise of its observation."""
    n = L.shape[0]
    plain = lambda params, x, v, u: model.observe(params, x, u)  # noqa: E731
    adds = lambda params, x, v, u: plain(params, x, v, u) + v  # noqa: E731
    in_values = model.residual is difference
    if model.noisy is None:
        # The noise has the units of the residual: metres, where values are latitudes in radians.
        observe, given = adds if in_values else plain, measurement.noise
    else:
        observe, given = model.noisy.observe, model.noisy.noise(params, x, u)
        # What is infinite belongs to a channel that is missing.
        given = jnp.where(jnp.isfinite(given), given, 0)
    root = semidefinite_root(jnp.diag(given) if given.ndim == 1 else given)
    factor = jnp.where(root.semidefinite, root.factor, 0)

    def predicted(at: Array) -> Array:
        return observe(params, model.retract(x, L @ at[:n]), factor @ at[n:], u)

    none = jnp.zeros(measurement.obs.valid.shape, L.dtype)
    added = None if model.noisy is not None or in_values else lambda at: factor @ at[n:]
    return Problem(predicted, none, n, n + factor.shape[0], root.semidefinite, added)


def misfit(model: Model, problem: Problem, obs: Obs, point: Array) -> Array:
    """Return what is measured less what is predicted at a point, masked ``(m,)``."""
    nu = masked_innovation(model, obs, problem.predicted(point))
    return nu if problem.added is None else nu - jnp.where(obs.valid, problem.added(point), 0)


def apart(model: Model, problem: Problem, obs: Obs, point: Array) -> Callable[[Array], Array]:
    """Return what is predicted elsewhere less what is predicted at a point, masked ``(m,)``."""
    reference, added = problem.predicted(point), problem.added

    def seen(at: Array) -> Array:
        residual = model.residual(problem.predicted(at), reference)
        if added is not None:
            residual = residual + added(at) - added(point)
        return jnp.where(obs.valid, residual, 0)

    return seen


def cubature(
    model: Model, problem: Problem, obs: Obs, point: Array, search: Search
) -> tuple[Array, Array, Array]:
    """Statistical linearisation by the cubature rule, whose points lie on the axes."""
    reach = search.spread * problem.size**0.5
    offsets = reach * jnp.eye(problem.size, dtype=point.dtype)
    from_here = apart(model, problem, obs, point)
    seen = jax.vmap(lambda offset: from_here(point + offset))
    ahead, behind = jnp.split(seen(jnp.concatenate([offsets, -offsets])), 2)
    even = 0.5 * (ahead + behind)
    mean = jnp.mean(even, axis=0)
    scatter = even - mean[None]
    return mean, (ahead - behind).T / (2 * reach), scatter.T @ scatter / problem.size


def derivative(
    model: Model, problem: Problem, obs: Obs, point: Array, search: Search
) -> tuple[Array, Array, Array]:
    """Linearisation by the derivative."""
    del search
    seen = apart(model, problem, obs, point)
    m = obs.valid.shape[0]
    return jnp.zeros(m, point.dtype), jax.jacfwd(seen)(point), jnp.zeros((m, m), point.dtype)
