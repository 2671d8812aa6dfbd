"""Adaptive filters: noise that is estimated from the innovations as they come."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.arguments import POSITIVE, require_switch
from jaxnav.estimation.checks import require_ordered
from jaxnav.estimation.filters.innovation import measurement_of
from jaxnav.estimation.filters.wrapping import (
    Builder,
    parted,
    require_wrapper,
    with_given_noise,
    with_noise,
    wrapped,
)
from jaxnav.estimation.types import Filter, FilterParams, Gaussian, Info, Input, Model, Obs

LARGEST_RATIO = 10.0
"""Largest ratio of a squared innovation to its variance that counts."""
MEAN_RATIO = 0.9970879
"""Mean of that ratio, bounded so, for a consistent filter: of a chi-square variable of one degree
of freedom, ``1 - 2 sqrt(b) pdf(sqrt(b)) - (1 - b) erfc(sqrt(b / 2))`` with the normal density."""


class Adaptation(NamedTuple):
    """Parameters of :func:`innovation_adaptive`.

    Attributes:
        memory: Updates over which an excess of one moves the factor by ``e``, at least one.
        low: Smallest factor on the process noise.
        high: Largest factor.
        temperature: Width of the smooth bounds, on a ratio and on the logarithm of the factor; not
            used by the hard ones.
    """

    memory: Array | float = 20.0
    low: Array | float = 1e-2
    high: Array | float = 1e4
    temperature: Array | float = 0.02


IDLE = {"innovation_adaptive": Adaptation(low=1.0, high=1.0)}
_DOMAINS = {
    "memory": ("[1, inf)", 1.0, jnp.inf),
    "low": POSITIVE,
    "high": POSITIVE,
    "temperature": POSITIVE,
}


class AdaptiveState(NamedTuple):
    """The filter's state, and the logarithm of the factor on its process noise."""

    inner: Any
    log_factor: Array


def softly_clamped(
    x: Array, low: Array | float, high: Array | float, temperature: Array | float
) -> Array:
    """Return ``x`` kept within bounds by softplus functions of a width, the temperature.

    At a distance of several temperatures inside it is ``x``, outside the bound; on a bound it is
    within the temperature times log 2. It leaves the bounds by rounding alone.
    """
    above, below = ((x - bound) / temperature for bound in (low, high))
    # softplus(y) = y + softplus(-y): far out the two would cancel and leave their rounding.
    beyond = (high - low) / temperature + jax.nn.softplus(-above) - jax.nn.softplus(-below)
    within = jax.nn.softplus(above) - jax.nn.softplus(below)
    return low + temperature * jnp.where(below > 0, beyond, within)


def innovation_adaptive(
    filter: Filter | Builder, model: Model | None = None, *, smooth: bool = False
) -> Filter:
    """Return a filter that scales its process noise until its innovations are as large as expected.

        log s = log s + mean(min(nu^2 / S, 10) - c) / W,   Q = s Q_model,   s in [low, high]

    with the mean over the channels that arrived, and ``c`` what the ratio is on average when the
    filter is consistent, so that nothing drifts then; otherwise it is a step up the innovations'
    likelihood. The bound keeps one outlier from deciding; a thousandth of good data reach it.
    Without data the factor stays. Outliers that come often are taken for process noise. Parameters
    are :class:`~jaxnav.estimation.types.FilterParams` whose ``own`` is ``(Adaptation(...), the
    filter's own)``, or the :class:`Adaptation` alone.

    One factor for the whole Q is what a few channels can tell; the full matrix ``K C K'`` of
    Mohamed and Schwarz is of their rank and loses the structure of the model. The ratio of traces
    that Ding et al. scale Q by is that of two small numbers where measurement noise dominates.

    Args:
        filter: The filter to make adaptive: any single one, wrapped or not.
        model: Its model, where ``filter`` is what builds it, as it used to be.
        smooth: Bound ratio and factor by softplus functions, for gradients.

    Raises:
        ValueError: If the filter is a bank.

    References:
        Mehra (1972), IEEE Trans. Automatic Control 17(5); Mohamed and Schwarz (1999), Journal of
        Geodesy 73(4); Ding, Wang, Rizos, Kinlyside (2007), Journal of Navigation 60(3).
    """
    require_switch("smooth", smooth)
    inside = wrapped(filter, model, "innovation_adaptive")
    own_model = inside.model
    base = inside.on(with_given_noise(own_model))

    def check(params: FilterParams) -> None:
        base.check(require_wrapper(params, Adaptation(), _DOMAINS))
        own, _ = parted(params, Adaptation())
        require_ordered(own.low, own.high, "Adaptation")

    def init(params: FilterParams) -> AdaptiveState:
        _, inner = parted(params, Adaptation())
        return AdaptiveState(base.init(inner), jnp.zeros((), params.initial.cov.dtype))

    def predict(params: FilterParams, state: AdaptiveState, u: Input) -> AdaptiveState:
        _, inner = parted(params, Adaptation())
        scaled = with_noise(inner, jnp.exp(state.log_factor), 0.0)
        return state._replace(inner=base.predict(scaled, state.inner, u))

    def update(
        params: FilterParams, state: AdaptiveState, u: Input, obs: Obs
    ) -> tuple[AdaptiveState, Info]:
        own, params = parted(params, Adaptation())
        measurement = measurement_of(
            own_model, params.model, base.estimate(state.inner).mean, u, obs
        )
        inner, info = base.update(
            with_noise(params, 1.0, measurement.noise), state.inner, u, measurement.obs
        )
        moved = moved_log_factor(own, state.log_factor, info, measurement.obs, smooth=smooth)
        return AdaptiveState(inner, moved), measurement.upon(info)

    def estimate(state: AdaptiveState) -> Gaussian:
        return base.estimate(state.inner)

    def restart(state: AdaptiveState, estimate: Gaussian) -> AdaptiveState:
        return state._replace(inner=base.restart(state.inner, estimate))

    def on(other: Model) -> Filter:
        return innovation_adaptive(inside.on(other), smooth=smooth)

    retract, local = own_model.retract, own_model.local
    return Filter(init, predict, update, estimate, restart, retract, local, check, own_model, on)


def moved_log_factor(
    own: Adaptation, log_factor: Array, info: Info, obs: Obs, *, smooth: bool = False
) -> Array:
    """Return the logarithm of the factor on the process noise after an update.

    Args:
        own: Parameters of the adaptation.
        log_factor: Before.
        info: Of the update.
        obs: Its observation.
        smooth: Whether the bounds are smooth.
    """
    S = jnp.diag(info.innovation_cov)
    used = obs.valid & (S > 0)
    ratio = info.innovation**2 / jnp.where(used, S, 1)
    bounded = jnp.minimum(ratio, LARGEST_RATIO)
    if smooth:
        room = (LARGEST_RATIO - ratio) / own.temperature
        bounded = LARGEST_RATIO - own.temperature * jax.nn.softplus(room)
    excess = jnp.where(used, bounded - MEAN_RATIO, 0)
    channels = jnp.maximum(jnp.sum(used), 1).astype(S.dtype)
    step = jnp.sum(excess) / channels / own.memory
    low, high = jnp.log(own.low), jnp.log(own.high)
    if smooth:
        soft = softly_clamped(log_factor + step, low, high, own.temperature)
        # Applied without data too, the smooth clamp would move the factor step by step.
        return jnp.where(jnp.any(used), soft, log_factor).astype(S.dtype)
    return jnp.clip(log_factor + step, low, high).astype(S.dtype)
