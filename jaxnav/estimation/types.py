"""The contracts of the algebra: models, filters, weight rules and what they exchange.

A filter is a ``NamedTuple`` of pure functions; its parameters are one pytree that travels as an
argument and is never closed over. So a bank is a ``vmap`` over parameters, a Monte Carlo study a
``vmap`` over keys, and tuning a ``grad`` through both.
"""

from collections.abc import Callable, Mapping
from difflib import get_close_matches
from enum import IntFlag
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxnav.arguments import require_array, require_leaves, require_real, require_whole
from jaxnav.numerics.linalg import normalised_square

Vector = Float[Array, " n"]
Matrix = Float[Array, "n n"]
Scalar = Float[Array, ""]
Mask = Bool[Array, " m"]
LinearMap = Array | Callable[[Array], Array]
Params = Any
Point = Any
Input = Any


class Flag(IntFlag):
    """Health bits of one update, combined in :attr:`Info.flags`.

    Attributes:
        NO_OBSERVATION: No channel was valid: the step was a prediction only.
        NOT_POSITIVE_DEFINITE: The innovation covariance could not be factored: the update was
            skipped.
        ILL_CONDITIONED: The factorisation kept fewer than about three digits; the update was made.
        ALL_MODELS_VETOED: No member of a bank had a finite likelihood: the weights were kept.
        INDEFINITE: A covariance (the prior, the process noise, that of the state) was not symmetric
            and positive semi-definite when it was needed; a root of it was made by the nearest
            factor at hand.
        NOT_FINITE: A channel that was said to be valid had a value that is not finite: it was left
            out as if it were missing.
        INVALID_NOISE: The observation noise was no covariance, having a negative variance
            or a correlation beyond one, and was used as it was; or was not a number: the channel
            was left out, and the update counts as failed.
        NO_WEIGHTS: A weight rule gave no probabilities, as with parameters outside their domain:
            the bank's estimate means nothing from here on.
        REFUSED: A gate left channels out that contradict the prediction.
        REOPENED: A gate let channels pass that still contradict it, after having refused many.
    """

    NO_OBSERVATION = 1
    NOT_POSITIVE_DEFINITE = 2
    ILL_CONDITIONED = 4
    ALL_MODELS_VETOED = 8
    INDEFINITE = 16
    NOT_FINITE = 32
    INVALID_NOISE = 64
    NO_WEIGHTS = 128
    REFUSED = 256
    REOPENED = 512


def flags_of(raised: dict[Flag, Array]) -> Array:
    """Return the sum of the flags that are raised."""
    return sum(
        (jnp.where(on, int(flag), 0).astype(jnp.int32) for flag, on in raised.items()),
        jnp.zeros((), jnp.int32),
    )


class Gaussian(NamedTuple):
    """A mean (a point of the state's manifold) and a covariance ``(n, n)`` in its tangent space."""

    mean: Point
    cov: Matrix


class Obs(NamedTuple):
    """An observation: values ``z`` ``(m,)`` and which channels arrived, ``valid`` ``(m,)``.

    A missing channel is a ``False``; its value is never used, not even in a product with zero. A
    channel whose noise has an infinite variance is missing too. One that is valid and has a value
    that is not finite is left out and raises :attr:`Flag.NOT_FINITE`.
    """

    z: Float[Array, " m"]
    valid: Mask


class SureObs(Obs):
    """An :class:`Obs` of which it is sure that every valid value is finite, as in a simulation.

    Which channels count then depends on ``valid`` alone, so that runs with one mask share their
    covariance recursion under ``vmap``. A value that is not finite after all spoils its run.
    """

    __slots__ = ()


class Info(NamedTuple):
    """What one update tells a human; the shapes do not depend on which channels were valid.

    Attributes:
        innovation: ``(m,)`` measured minus predicted; zero in invalid channels.
        innovation_cov: ``(m, m)``; an invalid channel has the row of the identity.
        log_likelihood: Log-density of the valid channels given the past [nats]; ``-inf`` if the
            update failed, which rules a member of a bank out for good, and for a bank all of whose
            members failed.
        nis: Normalised innovation squared, chi-square with ``sum(valid)`` degrees of freedom.
        iterations: Number of iterations of the update.
        flags: Sum of :class:`Flag`.
        used: ``(m,)`` channels that took part in the update; of a bank, in that of any member.
        refused: ``(m,)`` channels that a gate left out, having contradicted the prediction.
    """

    innovation: Float[Array, " m"]
    innovation_cov: Float[Array, "m m"]
    log_likelihood: Scalar
    nis: Scalar
    iterations: Int[Array, ""]
    flags: Int[Array, ""]
    used: Mask
    refused: Mask


class ChannelInfo(NamedTuple):
    """What an update tells of one channel of size ``m``; see :class:`Info`.

    Attributes:
        innovation: ``(..., m)``.
        innovation_cov: ``(..., m, m)``.
        nis: ``(...)`` chi-square with ``sum(used)`` degrees of freedom.
        used: ``(..., m)``.
        refused: ``(..., m)``.
    """

    innovation: Array
    innovation_cov: Array
    nis: Array
    used: Array
    refused: Array

    @property
    def sigma(self) -> Array:
        """Standard deviations ``(..., m)`` that the innovations should have."""
        return jnp.sqrt(jnp.diagonal(self.innovation_cov, axis1=-2, axis2=-1))


def difference(z: Array, z_pred: Array) -> Array:
    """Return ``z - z_pred``: the ``residual`` of values that just subtract."""
    return z - z_pred


def add(x: Array, dx: Array) -> Array:
    """Return ``x + dx``: the ``retract`` of a vector space."""
    return x + dx


def subtract(x: Array, y: Array) -> Array:
    """Return ``y - x``: the ``local`` of a vector space."""
    return y - x


class NonAdditive(NamedTuple):
    """An observation equation ``z = h(x, v)`` whose noise does not just add.

    Attributes:
        observe: ``(params, x, v, u) -> (m,)`` with ``observe(params, x, 0, u)`` the model's own.
        noise: ``(params, x, u) -> (k, k)`` or ``(k,)``, the covariance of ``v`` or its diagonal.
    """

    observe: Callable[[Params, Point, Array, Input], Array]
    noise: Callable[[Params, Point, Input], Array]


class Model(NamedTuple):
    """A state-space model on a manifold; every function is pure and takes the parameters first.

    Write ``transition`` with multiply-adds over blocks (:func:`~jaxnav.numerics.linalg.matmul`)
    rather than as one dense product: the linear filters never form the transition matrix, they push
    the columns of the covariance through this function, so its structure is what they pay for. Of a
    nonlinear model the same holds for ``jacobians``.

    Attributes:
        transition: ``(params, x, u) -> x`` over one step; ``u`` holds the inputs of the step.
        process_noise: ``(params, x, u) -> (n, n)`` discrete covariance in tangent coordinates.
        observe: ``(params, x, u) -> (m,)`` the stacked channels of all sensors.
        observation_noise: ``(params, x, u) -> (m, m)`` or ``(m,)``, a covariance or its diagonal.
        residual: ``(z, z_pred) -> (m,)``; the default subtracts. One that wraps angles or takes the
            logarithm of a rotation makes the observation live on a manifold too.
        retract: ``(x, dx) -> x``; the default adds.
        local: ``(x, y) -> dx`` with ``retract(x, dx) == y``; the default subtracts.
        jacobians: ``(params, x, u) -> (Phi, H)`` in tangent coordinates, each a matrix or, for
            structure that a matrix would hide, the linear function it stands for; ``None``, or a
            ``None`` in its place, for automatic differentiation.
        noisy: The observation with noise that does not just add, for filters that augment the state
            with it; ``observation_noise`` is then its covariance in the channels, to first order.
        channels: Name and size of each sensor's part of the observation, in order, as
            :func:`~jaxnav.estimation.models.observing` has them; ``()`` where they have no names.
        carried: Name and size of each state that :func:`~jaxnav.estimation.carried.carrying` added;
            the last coordinates of the tangent space, in order.
    """

    transition: Callable[[Params, Point, Input], Point]
    process_noise: Callable[[Params, Point, Input], Matrix]
    observe: Callable[[Params, Point, Input], Array]
    observation_noise: Callable[[Params, Point, Input], Array]
    residual: Callable[[Array, Array], Array] = difference
    retract: Callable[[Point, Array], Point] = add
    local: Callable[[Point, Point], Array] = subtract
    jacobians: (
        Callable[[Params, Point, Input], tuple[LinearMap | None, LinearMap | None]] | None
    ) = None
    noisy: NonAdditive | None = None
    channels: tuple[tuple[str, int], ...] = ()
    carried: tuple[tuple[str, int], ...] = ()

    def channel(self, name: str) -> slice:
        """Return where a channel is in an observation.

        Raises:
            ValueError: If the model has none of that name.
        """
        first = 0
        for own, size in self.channels:
            if own == name:
                return slice(first, first + size)
            first += size
        names = [own for own, _ in self.channels]
        near = get_close_matches(name, names, 1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        have = ", ".join(names) or "not named"
        raise ValueError(f"the model has no channel {name!r}; its channels are {have}{hint}")

    def width(self, channels: int | None = None) -> int:
        """Return the number of values of an observation; ``channels`` where they have no names.

        Raises:
            ValueError: If it is neither given nor known, or what is given is not what is known.
        """
        known = sum(size for _, size in self.channels) or None
        if channels is None and known is None:
            raise ValueError("the model's channels have no names; give their number, channels=m")
        if channels is not None:
            channels = require_whole("channels", channels, 1)
        if channels is not None and known is not None and channels != known:
            raise ValueError(f"channels is {channels}; those of the model have {known} values")
        return known or channels or 0

    def stack(self, values: Mapping[str, Any], valid: Mapping[str, Any] | None = None) -> Obs:
        """Return the observations of some channels by name; the others are missing.

        Args:
            values: Measurements ``(..., m)`` of each channel, with the same leading axes.
            valid: Which of them arrived, ``(..., m)`` or ``(...)`` by name; the default is those
                that are finite.

        Raises:
            ValueError: If a name is unknown, a measurement has not its channel's size, leading axes
                differ, or there is no measurement.
        """
        # What is NumPy's stays there until the end, so that a log's length compiles nothing.
        lib: Any = jnp if any(isinstance(v, jax.Array) for v in values.values()) else np
        arrays = {name: lib.asarray(value) for name, value in values.items()}
        marks = {name: lib.asarray(mark) for name, mark in (valid or {}).items()}
        leading = None
        for name, z in arrays.items():
            size = dict(self.channels).get(name) or self.channel(name)
            if z.ndim == 0 or z.shape[-1] != size:
                raise ValueError(
                    f"the values of channel {name!r} are {z.shape}; the last axis must be {size}"
                )
            if leading not in (None, z.shape[:-1]):
                raise ValueError(
                    f"the values of channel {name!r} have the leading axes {z.shape[:-1]}, others "
                    f"{leading}; all must have the same"
                )
            leading = z.shape[:-1]
        if leading is None:
            raise ValueError("there are no values to stack; give those of one channel or more")
        for name in marks:
            if name not in arrays:
                raise ValueError(f"valid names channel {name!r}, which has no values")
        z, known = [], []
        for name, size in self.channels:
            value = arrays.get(name, lib.full((*leading, size), np.nan))
            finite = lib.isfinite(value)
            if name in marks:
                mark = marks[name]
                wide = mark[..., None] if mark.ndim == len(leading) else mark
                finite = lib.broadcast_to(wide, value.shape)
            z.append(lib.where(finite, value, 0))
            known.append(finite)
        both = lib.concatenate(z, axis=-1), lib.concatenate(known, axis=-1)
        return Obs(*map(jnp.asarray, both))

    def part(self, info: Info, name: str) -> ChannelInfo:
        """Return what an update, or a record of updates, tells of one channel.

        Args:
            info: Of this model's filter or bank; leaves may have leading axes.
            name: Of the channel, or ``ValueError``.
        """
        at = self.channel(name)
        nu, S = info.innovation[..., at], info.innovation_cov[..., at, at]
        square = jnp.vectorize(normalised_square, signature="(m),(m,m)->()")
        return ChannelInfo(nu, S, square(nu, S), info.used[..., at], info.refused[..., at])


def accept(*given: Any) -> None:
    """Take any parameters: the check of a filter or rule that has none."""
    del given


class FilterParams(NamedTuple):
    """The parameters of a single filter: what may differ between members of a bank, or be tuned.

    Attributes:
        model: The parameters of the :class:`Model`'s functions.
        initial: Mean and covariance at t0.
        own: The filter's own: a :class:`~jaxnav.numerics.sigma.SigmaRule` of a sigma-point filter,
            a :class:`~jaxnav.estimation.filters.iterated.Search` of an iterated one. Of a wrapper
            it is ``(its own, the inner filter's own)``, or its own alone, which leaves the inner
            filter's as they are. ``()`` is what the filter was built with.
    """

    model: Params
    initial: Gaussian
    own: Any = ()


class Filter(NamedTuple):
    """A recursive estimator as pure functions; a bank of filters is one too.

    Attributes:
        init: ``(params) -> state`` at t0.
        predict: ``(params, state, u) -> state`` over one step.
        update: ``(params, state, u, obs) -> (state, info)`` with the same step's input.
        estimate: ``(state) -> Gaussian``.
        restart: ``(state, Gaussian) -> state`` with another estimate and all else as it was, which
            is how the members of an interacting bank exchange what they know.
        retract: That of the estimate's manifold, as in :class:`Model`.
        local: That of the estimate's manifold, as in :class:`Model`.
        check: ``(params)`` raises ``ValueError`` for parameters that are not those of this filter:
            by their types and shapes, and by their values where these are concrete. A run asks it.
        model: The model that it filters; of a bank, that of its members.
        on: ``(model) -> Filter``, the same filter of another model, by which wrappers hand noise to
            it; ``None`` for what is no single filter.
    """

    init: Callable[[Params], Any]
    predict: Callable[[Params, Any, Input], Any]
    update: Callable[[Params, Any, Input, Obs], tuple[Any, Any]]
    estimate: Callable[[Any], Any]
    restart: Callable[[Any, Gaussian], Any]
    retract: Callable[[Point, Array], Point] = add
    local: Callable[[Point, Point], Array] = subtract
    check: Callable[[Params], None] = accept
    model: Model | None = None
    on: "Callable[[Model], Filter] | None" = None


def observed(z: Array) -> Obs:
    """Return observations ``(..., m)`` in which every channel with a finite value is valid.

    For recorded data, where NaN or an infinity marks a lost channel. The mask then depends on the
    data, so a batch of runs cannot share its covariance recursion; simulations that lose no data
    should build :class:`SureObs` with one mask for all runs.
    """
    require_real("z", require_array("z", z))
    finite = jnp.isfinite(z)
    return Obs(jnp.where(finite, z, 0), finite)


def replicate(params: Params, count: int) -> Params:
    """Return ``params`` with a leading model axis of length ``count`` on every leaf.

    Leaves that are numbers or NumPy arrays stay with NumPy, which has nothing to compile.
    """
    count = require_whole("count", count, 1)
    require_leaves("params", params)

    def widened(leaf: Any) -> Any:
        by = jnp if isinstance(leaf, Array) else np
        return by.broadcast_to(leaf, (count, *jnp.shape(leaf)))

    return jax.tree.map(widened, params)
