"""Sage-Husa filters: measurement noise that is estimated from the innovations as they come.

The estimate forgets: with the factor ``b`` the sample of step ``k`` enters with

    d_k = (1 - b) / (1 - b^(k + 1 + c)),   R <- (1 - d_k) R + d_k sample,

where ``c`` counts samples that the start is worth. With the model's ``R = L L'`` what is estimated
is ``N`` in ``L N L'``, one at the start: a receiver that grades its fixes is believed in
proportion, and with a constant ``R`` in the model the recursion is the papers'.
"""

import math
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.arguments import POSITIVE, require_switch
from jaxnav.estimation.checks import require_ordered
from jaxnav.estimation.filters.adaptive import softly_clamped
from jaxnav.estimation.filters.innovation import mask_noise, masked_innovation, measurement_of
from jaxnav.estimation.filters.wrapping import (
    Builder,
    parted,
    require_additive,
    require_wrapper,
    with_given_noise,
    with_noise,
    wrapped,
)
from jaxnav.estimation.types import Filter, FilterParams, Flag, Gaussian, Info, Input, Model, Obs
from jaxnav.numerics.linalg import cholesky, matmul, solve_lower, symmetrise

NoiseForm = Literal["clamped", "residual", "printed"]
FORMS: tuple[NoiseForm, ...] = ("clamped", "residual", "printed")


class SageHusa(NamedTuple):
    """Parameters of :func:`sage_husa`.

    Attributes:
        forgetting: ``b`` in (0, 1]; with one, all samples count alike.
        prior_count: ``c``, zero or more: samples that the model's own noise counts for at the
            start. Zero is the papers' choice, whose first sample replaces it; infinite makes
            ``d = 1 - b`` from the start.
        low: Smallest variance of a channel over the model's own, above zero; of the clamped form.
        high: Largest.
        temperature: Width of the smooth clamp, in the same unit; not used by the hard one.
    """

    forgetting: Array | float = 0.97
    prior_count: Array | float = 10.0
    low: Array | float = 0.1
    high: Array | float = 100.0
    temperature: Array | float = 0.02


IDLE = {"sage_husa": SageHusa(1.0, prior_count=math.inf)}
_DOMAINS = {
    "forgetting": ("(0, 1]", 0.0, 1.0),
    "prior_count": ("[0, inf]", 0.0, jnp.inf),
    "low": POSITIVE,
    "high": POSITIVE,
    "temperature": POSITIVE,
}


class SageHusaState(NamedTuple):
    """State of the filter and of its noise estimate.

    Attributes:
        inner: That of the wrapped filter.
        noise: ``(m, m)`` the estimated ``N``.
        samples: ``(m,)`` observations of each channel.
    """

    inner: Any
    noise: Array
    samples: Array


def sage_husa(
    filter: Filter | Builder,
    model: Model | None = None,
    *,
    channels: int | None = None,
    form: NoiseForm = "clamped",
    current: bool = False,
    smooth: bool = False,
) -> Filter:
    """Return a filter that estimates its measurement noise, a wrapper of any other.

    Its own parameters are a :class:`SageHusa`. That the process noise is estimated too takes
    :func:`~jaxnav.estimation.filters.adaptive.innovation_adaptive` inside.

    The samples, with innovation ``nu`` of covariance ``S = H P H' + R``:

    * "printed": ``nu nu' - H P H'``, which is indefinite more often than not, and so may ``R``
      become: :attr:`~jaxnav.estimation.types.Flag.INDEFINITE` is raised when it is, and an update
      with it is skipped if ``S`` is not positive definite either.
    * "clamped": its diagonal, and the estimate kept in ``[low, high]`` times the model's.
    * "residual": ``e e' + H P+ H'`` with the residual ``e = z - h(x+)`` after the update; a sum of
      squares, so that ``R`` stays positive definite.

    Channels that did not arrive keep their noise, and so do all if the update fails. A channel that
    arrives alone is averaged at its own pace, by ``R <- a R a + s sample s`` with
    ``a = diag(sqrt(1 - d))``, ``s = diag(sqrt(d))``, which keeps ``R`` positive definite too; ``L``
    is that of the channels that arrived. A model's ``R`` that has no such factor is used as it is
    and nothing is learnt in the step.

    Args:
        filter: The filter to make adaptive: any single one, wrapped or not.
        model: Its model, where ``filter`` is what builds it, as it used to be.
        channels: Number of values ``m`` of the model's observation; of a model with named channels
            it is known.
        form: The sample.
        current: Update with the noise that has seen the innovation of the step, as the paper does;
            the default is that of the step before. The info is that of the update: with
            ``current`` its likelihood is not that of the data given the past, which
            tuning by likelihood needs.
        smooth: Clamp by softplus functions, for gradients.

    Raises:
        ValueError: If there is no such form, the residual one is asked to be ``current``, the
            filter is a bank, its model has noise that does not just add, or ``channels`` is missing
            or not the model's.

    References:
        Sage and Husa (1969); Song et al. (2022), Sensors 22:5976, Eqs. (20)-(22).
        ``d_0 = 1`` of the paper, which throws the start away, is ``prior_count = 0``. Eq. (22)
        takes ``H`` at the updated state; it is that of the predicted one, by ``S - R``.
    """
    if form not in FORMS:
        raise ValueError(f"form is {form!r}; it must be one of {', '.join(FORMS)}")
    require_switch("current", current)
    require_switch("smooth", smooth)
    if current and form == "residual":
        raise ValueError("the residual form knows the noise only after the update: current is off")
    inside = wrapped(filter, model, "sage_husa")
    own_model = inside.model
    require_additive(own_model, "a filter that estimates measurement noise")
    base, width = inside.on(with_given_noise(own_model)), own_model.width(channels)

    def check(params: FilterParams) -> None:
        base.check(require_wrapper(params, SageHusa(), _DOMAINS))
        own, _ = parted(params, SageHusa())
        require_ordered(own.low, own.high, "SageHusa")

    def init(params: FilterParams) -> SageHusaState:
        dtype = params.initial.cov.dtype
        unit, none = jnp.eye(width, dtype=dtype), jnp.zeros((width,), dtype)
        return SageHusaState(base.init(parted(params, SageHusa())[1]), unit, none)

    def predict(params: FilterParams, state: SageHusaState, u: Input) -> SageHusaState:
        _, inner = parted(params, SageHusa())
        return state._replace(inner=base.predict(with_noise(inner, 1.0, 0.0), state.inner, u))

    def update(
        params: FilterParams, state: SageHusaState, u: Input, obs: Obs
    ) -> tuple[SageHusaState, Info]:
        own, params = parted(params, SageHusa())
        measurement = measurement_of(
            own_model, params.model, base.estimate(state.inner).mean, u, obs
        )
        obs, nominal = measurement.obs, measurement.noise
        if obs.z.shape != (width,):
            raise ValueError(
                f"channels is {width}; it must be {obs.z.shape[0]}, the values of the observation"
            )
        root = cholesky(nominal)
        L, scalable = root.factor, root.positive_definite

        def updated(noise: Array) -> tuple[Any, Info]:
            scaled = symmetrise(matmul(matmul(L, mask_noise(noise, obs.valid)), L.T))
            R = jnp.where(scalable, scaled, nominal)
            return base.update(with_noise(params, 1.0, R), state.inner, u, obs)

        inner, info = updated(state.noise)
        e = info.innovation
        if form == "residual":
            after = own_model.observe(params.model, base.estimate(inner).mean, u)
            e = masked_innovation(own_model, obs, after)
        sample = _sample(form, L, mask_noise(state.noise, obs.valid), e, info.innovation_cov)
        used = obs.valid & scalable & jnp.isfinite(info.log_likelihood)
        noise = _averaged(own, state, sample, used)
        if form == "clamped":
            # Applied to what did not arrive too, the smooth clamp would move it step by step.
            variance = jnp.diag(noise)
            noise = jnp.diag(jnp.where(used, _clamped(own, variance, smooth), variance))
        if current:
            inner, info = updated(noise)
        if form == "printed":
            applied = cholesky(mask_noise(noise if current else state.noise, obs.valid))
            lost = ~applied.positive_definite
            info = info._replace(
                flags=info.flags | jnp.where(lost, int(Flag.INDEFINITE), 0).astype(jnp.int32)
            )
        samples = state.samples + used.astype(state.samples.dtype)
        return SageHusaState(inner, noise, samples), measurement.upon(info)

    def estimate(state: SageHusaState) -> Gaussian:
        return base.estimate(state.inner)

    def restart(state: SageHusaState, estimate: Gaussian) -> SageHusaState:
        return state._replace(inner=base.restart(state.inner, estimate))

    def on(other: Model) -> Filter:
        return sage_husa(
            inside.on(other), channels=width, form=form, current=current, smooth=smooth
        )

    retract, local = own_model.retract, own_model.local
    return Filter(init, predict, update, estimate, restart, retract, local, check, own_model, on)


def averaging(forgetting: Array | float, count: Array) -> Array:
    """Return ``d = (1 - b) / (1 - b^(n + 1))`` for ``n`` earlier samples, ``1 / (n + 1)`` at one.

    Args:
        forgetting: ``b`` in (0, 1].
        count: ``n``, of any shape; infinite gives ``1 - b``.
    """
    b = jnp.asarray(forgetting, count.dtype)
    fades = b < 1
    rate = jnp.log(jnp.where(fades, b, 0.5))
    # At an infinite count the derivative of the power would be zero times infinity.
    endless = jnp.isinf(count)
    worn = jnp.where(endless, -1, jnp.expm1((jnp.where(endless, 0, count) + 1) * rate))
    faded = jnp.expm1(rate) / worn
    return jnp.where(fades, faded, 1 / (count + 1))


def _sample(form: NoiseForm, L: Array, N: Array, e: Array, S: Array) -> Array:
    """Return the sample ``(m, m)`` in units of the model's noise.

    Args:
        form: Which.
        L: Factor of the model's noise.
        N: The noise that was used, masked.
        e: Innovation, or the residual after the update.
        S: Covariance of the innovation.
    """
    S = symmetrise(_whitened(L, _whitened(L, S).T))
    e = solve_lower(L, e)
    spread = S - N
    if form == "residual":
        A = _whitened(cholesky(S).factor, N)
        spread = symmetrise(matmul(A.T, A) - N)  # H P+ H' = N - N inv(S) N
    return e[:, None] * e[None, :] - spread


def _averaged(own: SageHusa, state: SageHusaState, sample: Array, used: Array) -> Array:
    """Return the noise estimate with a sample ``(m, m)`` in the channels that told something."""
    share = averaging(own.forgetting, state.samples + own.prior_count)
    d = jnp.where(used, share, 0)
    kept = jnp.where(d < 1, jnp.sqrt(jnp.where(d < 1, 1 - d, 1)), 0)
    root = jnp.where(used, jnp.sqrt(jnp.where(used, share, 1)), 0)
    known = jnp.where(used[:, None] & used[None, :], sample, 0)
    return kept[:, None] * state.noise * kept[None, :] + root[:, None] * known * root[None, :]


def _clamped(own: SageHusa, variance: Array, smooth: bool) -> Array:
    if not smooth:
        return jnp.clip(variance, own.low, own.high)
    return softly_clamped(variance, own.low, own.high, own.temperature)


def _whitened(L: Array, A: Array) -> Array:
    """Return ``inv(L) A`` of a matrix."""
    return jax.vmap(solve_lower, in_axes=(None, 1), out_axes=1)(L, A)
