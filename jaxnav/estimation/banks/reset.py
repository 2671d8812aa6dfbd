"""The windowed reset: weights start anew where a short memory disagrees with the long one."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.arguments import POSITIVE, require_switch
from jaxnav.estimation.banks.log_weights import active, normalise, uniform
from jaxnav.estimation.banks.rule import WeightRule
from jaxnav.estimation.banks.weights import bayes_step, stay
from jaxnav.estimation.checks import require_fields
from jaxnav.estimation.types import Info


class WindowedReset(NamedTuple):
    """Parameters of :func:`windowed_reset`.

    Attributes:
        period: Steps between two assessments, at least one.
        threshold: Weight in (0, 1] above which the leading model is put to the test.
        temperature: Width of the smooth threshold; not used by the hard rule.
    """

    period: Array | float
    threshold: Array | float
    temperature: Array | float = 0.05


def windowed_reset(*, smooth: bool = False) -> WeightRule:
    """Return the reset of IMMAE: start anew when a short memory disagrees with the long one.

    A second set of weights starts uniform every ``period`` steps. At the end of a period, if the
    largest weight exceeds ``threshold`` and the second set prefers another model, the weights are
    made uniform; the second set always is.

    With ``smooth=True`` every step has a gradient: the second set forgets with the time constant
    ``period`` instead of starting anew, and a share
    ``sigmoid((max w - threshold) / temperature) (1 - <w, w2>) / period`` of the weights is replaced
    by the uniform ones. As the temperature falls the threshold becomes hard, and it alone: a
    restart at multiples of the period has by the period a gradient of nothing but peaks, which grow
    with ``k``, so a share in each step stands for it. The maximum is as it is, with a kink where
    two weights of at most 1/2 lead alike.

    References:
        Si, Wang, Niu, Eq. (16) and step (5). As printed, Eqs. (15) and (16) are the same recursion;
        they can differ only if the second set starts anew every period whether or not the first is
        reset, which is what is done here. The paper gives neither period nor threshold.
    """
    require_switch("smooth", smooth)
    return WeightRule(_window_init, stay, _smooth_reset if smooth else _hard_reset, _check_reset)


def _check_reset(params: WindowedReset, count: int) -> None:
    del count
    domains = {
        "period": ("[1, inf)", 1, jnp.inf),
        "threshold": ("(0, 1]", 0, 1),
        "temperature": POSITIVE,
    }
    require_fields("the parameter of windowed_reset", params, WindowedReset, domains)


def _window_init(params: WindowedReset, log_weights: Array) -> Array:
    del params
    return uniform(log_weights)


def _hard_reset(
    params: WindowedReset, state: Array, log_weights: Array, info: Info, k: Array
) -> tuple[Array, Array]:
    window = bayes_step(state, info)
    even = uniform(log_weights)
    assess = jnp.mod(k.astype(log_weights.dtype), params.period) < 1
    confident = jnp.max(log_weights) > jnp.log(params.threshold)
    mismatch = jnp.argmax(log_weights) != jnp.argmax(window)
    reset = assess & confident & mismatch
    return jnp.where(assess, even, window), jnp.where(reset, even, log_weights)


def _smooth_reset(
    params: WindowedReset, state: Array, log_weights: Array, info: Info, k: Array
) -> tuple[Array, Array]:
    del k
    members = active(log_weights)
    fading = 1 - 1 / params.period
    faded = jnp.where(members, fading * jnp.where(members, state, 0), -jnp.inf)
    window = bayes_step(faded, info)
    w = jnp.exp(log_weights)
    confident = jax.nn.sigmoid((jnp.max(w) - params.threshold) / params.temperature)
    mismatch = 1 - jnp.sum(w * jnp.exp(window))
    share = confident * jnp.maximum(mismatch, jnp.finfo(w.dtype).eps) / params.period
    even = jnp.where(members, jnp.log(share) + uniform(log_weights), -jnp.inf)
    kept = jnp.log1p(-share) + jnp.where(members, log_weights, 0)
    mixed = jnp.logaddexp(kept, jnp.where(members, even, 0))
    return window, normalise(jnp.where(members, mixed, -jnp.inf))
