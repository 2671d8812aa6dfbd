"""What a caller hands over, held against what is accepted, in the words of the caller.

Types and shapes are looked at always, values where they are concrete: under ``jit``, ``vmap`` and
``grad`` they are not, and what is wrong with them then shows in :class:`Flag`. What needs neither
filter nor model is in :mod:`jaxnav.arguments`.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxnav.arguments import (
    Domain,
    described,
    known,
    require_array,
    require_floating,
    require_function,
    require_number,
    require_real,
)
from jaxnav.estimation.types import Filter, FilterParams, Gaussian, Model, Obs

SUM_TOLERANCE = 1e-6
"""How far from one probabilities may sum: rounding, and matrices kept in float32."""
ROUNDING = 1e-6
"""Relative asymmetry, and share of the variances by which an eigenvalue may be negative."""


def require_filter(filter: Any) -> None:
    """Raise ``ValueError`` unless it is a filter, and not what builds one."""
    if not isinstance(filter, Filter):
        raise ValueError(
            f"filter is {described(filter)}; it must be a Filter, as jaxnav.ekf(model) or "
            "jaxnav.bank(jaxnav.ekf(model), jaxnav.bayes()) make it"
        )


def require_model(model: Any) -> None:
    """Raise ``ValueError`` unless it is a model, made of functions."""
    if not isinstance(model, Model):
        raise ValueError(
            f"model is {described(model)}; it must be a Model, as jaxnav.Model(transition, "
            "process_noise, observe, observation_noise) or jaxnav.observing make it"
        )
    for name in ("transition", "process_noise", "observe", "observation_noise"):
        require_function(f"{name} of the model", getattr(model, name), "params", "x", "u")


def require_steps(**given: Any) -> int:
    """Return the length of the leading time axis that pytrees share, or raise ``ValueError``."""
    steps = set()
    for name, tree in given.items():
        for leaf in jax.tree.leaves(tree):
            if not np.shape(leaf):
                raise ValueError(
                    f"{name} has {described(leaf)} in it; every leaf needs a leading time axis"
                )
            steps.add(np.shape(leaf)[0])
    if len(steps) != 1:
        *first, last = given
        raise ValueError(
            f"{', '.join(first)} and {last} have {sorted(steps)} steps; every leaf needs the same "
            "leading time axis"
        )
    return steps.pop()


def require_observations(observations: Any) -> None:
    """Raise ``ValueError`` unless it is an :class:`Obs` of a run, ``(T, m)`` twice."""
    if not isinstance(observations, Obs):
        raise ValueError(
            f"observations is {described(observations)}; it must be Obs(z, valid), which "
            "jaxnav.observed(z) makes of an array"
        )
    z, valid = (
        require_array(f"observations.{name}", getattr(observations, name)) for name in Obs._fields
    )
    if z.ndim != 2 or valid.shape != z.shape:
        raise ValueError(
            f"observations has z {z.shape} and valid {valid.shape}; both must be (T, m)"
        )
    require_real("observations.z", z)
    if valid.dtype != bool:
        raise ValueError(f"observations.valid is of {valid.dtype}; it must be of bool")


def require_filter_params(model: Model, params: Any, own: type | None = None) -> None:
    """Raise ``ValueError`` unless parameters are those of a single filter of a model.

    Args:
        model: The model.
        params: The parameters.
        own: The class of the filter's own, if it has any.
    """
    require_single(params)
    require_own(params.own, own)
    require_prior(model, params.initial)


def require_single(params: Any) -> None:
    """Raise ``ValueError`` unless parameters are those of a single filter."""
    if not isinstance(params, FilterParams):
        raise ValueError(
            f"params is {described(params)}; a single filter takes FilterParams(model, initial)"
        )


def require_prior(model: Model, initial: Any) -> None:
    """Raise ``ValueError`` unless a prior is a Gaussian on a model's manifold."""
    if not isinstance(initial, Gaussian):
        raise ValueError(f"initial is {described(initial)}; it must be Gaussian(mean, cov)")
    leaves = jax.tree.leaves(initial.mean, is_leaf=lambda node: isinstance(node, list))
    for leaf in leaves:
        require_floating("the initial mean", leaf)
    cov = require_floating("the initial covariance", initial.cov)
    tangent = jax.eval_shape(model.local, initial.mean, initial.mean).shape
    if len(tangent) != 1:
        raise ValueError(
            f"the initial mean is {np.shape(leaves[0])}; it must be a vector (n,), or a point of "
            "the manifold of the model's local"
        )
    (n,) = tangent
    if cov.shape != (n, n):
        raise ValueError(
            f"the initial covariance is {cov.shape}; the initial mean has {n} tangent "
            f"coordinates, so it must be ({n}, {n})"
        )
    require_covariance("the initial covariance", cov)


def require_covariance(name: str, value: Any) -> None:
    """Raise ``ValueError`` if a concrete matrix ``(n, n)`` is no covariance, beyond rounding."""
    P = known(value)
    if P is None:
        return
    P = P.astype(float)
    if not np.all(np.isfinite(P)):
        raise ValueError(f"{name} has an entry that is not finite")
    variance = np.diag(P)
    if np.any(variance < 0):
        i = int(np.argmin(variance))
        raise ValueError(f"{name} has the variance {variance[i]:g} at {i}; none may be negative")
    sigma = np.sqrt(np.where(variance > 0, variance, 1))
    relative = P / sigma[:, None] / sigma[None]
    if np.max(np.abs(relative - relative.T), initial=0) > ROUNDING:
        i, j = np.unravel_index(np.argmax(np.abs(relative - relative.T)), P.shape)
        raise ValueError(
            f"{name} is not symmetric: {P[i, j]:g} at ({i}, {j}) and {P[j, i]:g} at ({j}, {i})"
        )
    lowest = np.linalg.eigvalsh(relative).min(initial=0)
    if lowest < -ROUNDING * len(P):
        raise ValueError(
            f"{name} is not positive semi-definite: with variances scaled to one its least "
            f"eigenvalue is {lowest:.3g}"
        )


def require_members(check: Any, members: Any) -> int:
    """Raise ``ValueError`` unless parameters have a leading model axis; return its length.

    Args:
        check: That of the members' filter.
        members: Its parameters with the axis on every leaf.
    """
    paths = jax.tree_util.tree_leaves_with_path(members)
    counts: dict[int, str] = {}
    for path, leaf in paths:
        name = f"members{jax.tree_util.keystr(path)}"
        if np.ndim(leaf) == 0:
            raise ValueError(
                f"{name} is one number; in a bank every leaf of the members' parameters needs a "
                "leading model axis, which jaxnav.replicate(params, count) gives"
            )
        counts.setdefault(np.shape(leaf)[0], name)
    if not counts:
        raise ValueError("the members' parameters have no arrays, so that their number is unknown")
    if len(counts) > 1:
        (a, first), (b, second) = list(counts.items())[:2]
        raise ValueError(
            f"{first} has {a} entries along the model axis and {second} has {b}; every leaf of the "
            "members' parameters needs the same, which jaxnav.replicate(params, count) gives"
        )
    (count,) = counts
    shapes = jax.tree.map(_one_of, members)
    check(shapes)
    if not any(isinstance(leaf, Tracer) for _, leaf in paths):
        arrays = jax.tree.map(np.asarray, members)
        for i in range(count):
            try:
                check(jax.tree.map(lambda leaf, i=i: leaf[i], arrays))
            except ValueError as error:
                raise ValueError(f"member {i}: {error}") from error
    return count


def _one_of(leaf: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(np.shape(leaf)[1:], jnp.result_type(leaf))


def require_log_prior(log_prior: Any, count: int) -> None:
    """Raise ``ValueError`` unless log-weights ``(count,)`` leave a member something."""
    if log_prior is None:
        return
    if np.shape(log_prior) != (count,):
        raise ValueError(
            f"log_prior is {np.shape(log_prior)}; a bank of {count} members needs ({count},)"
        )
    values = known(log_prior)
    if values is None:
        return
    if np.any(np.isnan(values)) or np.any(values == np.inf) or not np.any(values > -np.inf):
        raise ValueError(
            f"log_prior is {values.tolist()}; it must be log-weights of which at least one is "
            "finite and none is infinite or not a number"
        )


def require_fields(name: str, value: Any, kind: type, domains: Mapping[str, Domain]) -> None:
    """Raise ``ValueError`` unless a value is of a class and its fields are within their domains.

    Args:
        name: Of the value, for the message.
        value: The value.
        kind: The class.
        domains: What :func:`require_number` takes of each field.
    """
    if not isinstance(value, kind):
        raise ValueError(f"{name} is {described(value)}; it must be {kind.__name__}(...)")
    for field, domain in domains.items():
        require_number(f"{field} of {kind.__name__}", getattr(value, field), *domain)


def require_own(own: Any, kind: type | None, domains: Mapping[str, Domain] | None = None) -> None:
    """Raise ``ValueError`` unless what a filter is given as its own parameters is its own.

    Args:
        own: The parameters; ``()`` is what the filter was built with.
        kind: The class that the filter takes; ``None`` if it has none of its own.
        domains: As for :func:`require_fields`.
    """
    if type(own) is tuple and not own:
        return
    if kind is None:
        raise ValueError(f"own is {described(own)}; this filter has no parameters of its own")
    if not isinstance(own, kind):
        raise ValueError(
            f"own is {described(own)}; it must be {kind.__name__}(...), or () for what the filter "
            "was built with"
        )
    require_fields("own", own, kind, domains or {})


def require_ordered(low: Any, high: Any, of: str) -> None:
    """Raise ``ValueError`` if a lower bound that is concrete is above its upper one."""
    below, above = known(low), known(high)
    if below is not None and above is not None and np.any(below > above):
        raise ValueError(f"low of {of} is {below:g} and high {above:g}; low must not be above high")


def require_transition_matrix(matrix: Any, count: int) -> None:
    """Raise ``ValueError`` unless a matrix holds the switching probabilities of a bank."""
    if not isinstance(matrix, jax.Array | np.ndarray) or np.shape(matrix) != (count, count):
        shape = np.shape(matrix) if isinstance(matrix, jax.Array | np.ndarray) else None
        raise ValueError(
            f"the transition matrix is {described(matrix) if shape is None else shape}; "
            f"a bank of {count} members needs ({count}, {count})"
        )
    values = known(matrix)
    if values is None:
        return
    if not np.all(values >= 0):
        raise ValueError(
            f"the transition matrix has the entry {values.min():g}; none may be negative"
        )
    sums = values.sum(axis=1)
    worst = int(np.argmax(np.abs(sums - 1)))
    if not abs(sums[worst] - 1) <= SUM_TOLERANCE:
        raise ValueError(
            f"row {worst} of the transition matrix sums to {sums[worst]:g}; each must sum to 1"
        )
