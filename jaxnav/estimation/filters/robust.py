"""Robust filters: an update whose measurement noise grows where residuals are out of the ordinary.

With ``R = L L'``, the whitened residual at an estimate ``x`` is ``e = inv(L) (z - h(x))``. Each
channel gets the weight ``w(e)`` of a kernel, and the update is made anew from the same prior with
``R = L diag(1 / w) L'``, a fixed number of times. The first estimate is that of the plain update:
with the prior's, as in the papers, a good measurement that corrects a poor prior would look like an
outlier and be thrown away. An outlier is then told from good data only while the prior is not much
wider than the noise: where ``H P- H'`` is some 25 times ``R``, the plain update has followed it,
and takes five iterations instead of two to be taken back; at a hundred times it is believed.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.arguments import NOT_NEGATIVE, POSITIVE, Domain, require_whole
from jaxnav.estimation.filters.innovation import masked_innovation, measurement_of
from jaxnav.estimation.filters.wrapping import (
    Builder,
    Wrapped,
    parted,
    require_additive,
    require_wrapper,
    with_given_noise,
    with_noise,
    wrapped,
)
from jaxnav.estimation.types import Filter, FilterParams, Info, Input, Model, Obs
from jaxnav.numerics.linalg import cholesky, matmul, solve_lower

LEAST_WEIGHT = 1e-8
"""Smallest weight of a channel: it is then as good as not there, and its noise still finite.

It has no smooth form: the derivative of a weight by the logarithm of its kernel's parameters, which
it cuts off, is then below 1e-6.
"""


class Versoria(NamedTuple):
    """Parameters of :func:`versoria`.

    Attributes:
        width: ``tau``, zero or above; with zero all weights are one.
        power: ``p``, above zero: how fast weights fall.
    """

    width: Array | float = 0.05
    power: Array | float = 2.0


class Correntropy(NamedTuple):
    """Parameters of :func:`correntropy`.

    Attributes:
        bandwidth: Width of the Gaussian kernel in standard deviations; infinite, all weights are
            one.
    """

    bandwidth: Array | float = 3.0


IDLE = {"versoria": Versoria(width=0.0), "correntropy": Correntropy(math.inf)}


def versoria(
    filter: Filter | Builder, model: Model | None = None, *, iterations: int = 2
) -> Filter:
    """Return a filter under the maximum Versoria criterion, ``w = 1 / (1 + tau |e|^p)^2``.

    For ``p = 2`` that is the derivative of ``V = 1 / (1 + tau e^2)`` over ``e``, up to a factor;
    another power changes the weight itself, since the derivative of ``V`` would then be singular
    or vanish at zero. Parameters are :class:`~jaxnav.estimation.types.FilterParams` whose ``own``
    is ``(Versoria(...), the filter's own)``, or the :class:`Versoria` alone.

    Args:
        filter: The filter to make robust: any single one, wrapped or not.
        model: Its model, where ``filter`` is what builds it, as it used to be.
        iterations: Number of reweighted updates.

    Raises:
        ValueError: If there is no iteration, the filter is a bank, or the model has ``noisy``,
            noise that does not just add, which a filter would use in place of the reweighted one.

    References:
        Huang, Zhang, Xu, Wu, Chambers (2017) for reweighting by fixed-point iteration; Zhao et al.
        (2022), as cited by Yang et al. (2025), for the criterion. Both also reweigh the prior,
        which is not done here.
    """
    domains = {"width": NOT_NEGATIVE, "power": POSITIVE}
    inside = wrapped(filter, model, "versoria")
    on = partial(_built, versoria, inside, iterations)
    return _reweighted(inside, _versoria_weight, Versoria(), domains, iterations, on)


def correntropy(
    filter: Filter | Builder, model: Model | None = None, *, iterations: int = 2
) -> Filter:
    """Return a filter under the maximum correntropy criterion, ``w = exp(-e^2 / (2 sigma^2))``.

    Its own parameters are a :class:`Correntropy`; arguments and errors are those of
    :func:`versoria`.

    References:
        Chen, Liu, Zhao, Principe (2017), Automatica 76, who also reweigh the prior.
    """
    domains = {"bandwidth": POSITIVE}
    inside = wrapped(filter, model, "correntropy")
    on = partial(_built, correntropy, inside, iterations)
    return _reweighted(inside, _correntropy_weight, Correntropy(), domains, iterations, on)


def _built(wrap: Callable, inside: Wrapped, iterations: int, model: Model) -> Filter:
    return wrap(inside.on(model), iterations=iterations)


def _versoria_weight(kernel: Versoria, squared: Array) -> Array:
    somewhere = squared > 0
    powered = jnp.exp(0.5 * kernel.power * jnp.log(jnp.where(somewhere, squared, 1)))
    return (1 + kernel.width * jnp.where(somewhere, powered, 0)) ** -2


def _correntropy_weight(kernel: Correntropy, squared: Array) -> Array:
    return jnp.exp(-0.5 * squared / jnp.asarray(kernel.bandwidth, squared.dtype) ** 2)


def _reweighted(
    inside: Wrapped,
    weight: Callable[[Any, Array], Array],
    default: Any,
    domains: dict[str, Domain],
    iterations: int,
    on: Builder,
) -> Filter:
    """Return a filter whose update is made anew with weights from its own residuals.

    The info is that of the plain update, so that its likelihood and NIS tell of the data as the
    model has them; flags of the reweighted updates are added.
    """
    require_whole("iterations", iterations, 1)
    model = inside.model
    require_additive(model, "a robust filter")
    base = inside.on(with_given_noise(model))

    def check(params: FilterParams) -> None:
        base.check(require_wrapper(params, default, domains))

    def init(params: FilterParams) -> Any:
        return base.init(parted(params, default)[1])

    def predict(params: FilterParams, state: Any, u: Input) -> Any:
        return base.predict(with_noise(parted(params, default)[1], 1.0, 0.0), state, u)

    def update(params: FilterParams, state: Any, u: Input, obs: Obs) -> tuple[Any, Info]:
        kernel, params = parted(params, default)
        measurement = measurement_of(model, params.model, base.estimate(state).mean, u, obs)
        obs = measurement.obs
        L = cholesky(measurement.noise).factor

        def updated(R: Array, _: None) -> tuple[Array, tuple[Any, Info]]:
            moved, info = base.update(with_noise(params, 1.0, R), state, u, obs)
            seen = model.observe(params.model, base.estimate(moved).mean, u)
            e = solve_lower(L, masked_innovation(model, obs, seen))
            w = jnp.maximum(weight(kernel, e * e), LEAST_WEIGHT)
            return matmul(L / w[None], L.T), (moved, info)

        # The plain update and those after it are one body in a loop: a third of it to compile.
        _, (states, infos) = jax.lax.scan(updated, measurement.noise, None, length=iterations + 1)
        moved = jax.tree.map(lambda leaf: leaf[-1], states)
        info = jax.tree.map(lambda leaf: leaf[0], infos)
        flags = jax.lax.reduce(infos.flags, jnp.zeros((), jnp.int32), jax.lax.bitwise_or, (0,))
        info = info._replace(iterations=info.iterations + iterations, flags=flags)
        return moved, measurement.upon(info)

    return base._replace(init=init, predict=predict, update=update, check=check, model=model, on=on)
