"""Models put together: a process, and the channels that observe it by name.

A sensor is a :class:`Channel`, how the state moves is a :class:`Process`, and :func:`observing`
makes a :class:`~jaxnav.estimation.types.Model` of them in which every channel keeps its name:

    model = observing(process, {"position": position(), "barometer": barometer()})
    obs = model.stack({"position": z, "barometer": h})
    nis = model.part(info, "barometer").nis
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.arguments import described, require_function, require_whole
from jaxnav.estimation.types import (
    Input,
    LinearMap,
    Model,
    NonAdditive,
    Params,
    Point,
    add,
    difference,
    subtract,
)

PROCESS = "process"
"""What a model's parameters of its process go by; no channel can have this name."""

Differential = Callable[[Array], Array]
Parts = Callable[[Params, str], Params]


class Channel(NamedTuple):
    """What one sensor measures; every function is pure and takes the parameters first.

    Attributes:
        size: Number of values ``m`` of a measurement; an attitude is a rotation vector there.
        observe: ``(params, x, u) -> (m,)``.
        noise: ``(params, x, u) -> (m, m)`` or ``(m,)``, a covariance or its diagonal.
        residual: ``(z, z_pred) -> (m,)``; the default subtracts. One that wraps angles or takes the
            logarithm of a rotation makes the measurement live on a manifold.
        differential: ``(params, x, u) -> H``, the derivative of ``observe`` in the tangent space of
            ``x`` as a matrix ``(m, n)`` or a function of a tangent vector; ``None`` for an
            automatic one. The columns of states that are carried are automatic in any case.
        noisy: The measurement with noise that does not just add, for filters that augment the state
            with it; ``noise`` is then its covariance in the values, to first order.
    """

    size: int
    observe: Callable[[Params, Point, Input], Array]
    noise: Callable[[Params, Point, Input], Array]
    residual: Callable[[Array, Array], Array] = difference
    differential: Callable[[Params, Point, Input], LinearMap | None] | None = None
    noisy: NonAdditive | None = None


class Process(NamedTuple):
    """How a state moves, on its manifold; every function is pure and takes the parameters first.

    Attributes:
        transition: ``(params, x, u) -> x`` over one step.
        noise: ``(params, x, u) -> (n, n)`` discrete covariance in tangent coordinates.
        retract: ``(x, dx) -> x``; the default adds.
        local: ``(x, y) -> dx`` with ``retract(x, dx) == y``; the default subtracts.
        differential: ``(params, x, u) -> Phi``, the derivative of ``transition`` in tangent
            coordinates as a matrix ``(n, n)`` or a function; ``None`` for an automatic one.
        carried: Name and size of each state that :func:`~jaxnav.estimation.carried.carrying` added.
    """

    transition: Callable[[Params, Point, Input], Point]
    noise: Callable[[Params, Point, Input], Array]
    retract: Callable[[Point, Array], Point] = add
    local: Callable[[Point, Point], Array] = subtract
    differential: Callable[[Params, Point, Input], LinearMap | None] | None = None
    carried: tuple[tuple[str, int], ...] = ()


class ModelParams(NamedTuple):
    """Parameters of a model of :func:`observing`: those of its process, and of each channel.

    Where channels were added to a model, its own parameters stand for those of the process.
    """

    process: Params
    channels: Mapping[str, Params]


def by_name(params: Params, name: str) -> Params:
    """Return the part of :class:`ModelParams` that a channel, or the process, goes by.

    Raises:
        ValueError: If these are no :class:`ModelParams`, or have none of that name.
    """
    if not isinstance(params, ModelParams):
        raise ValueError(
            f"the model's parameters are {described(params)}; a model that was put together "
            "takes ModelParams(process, {channel: its parameters})"
        )
    if name == PROCESS:
        return params.process
    if not isinstance(params.channels, Mapping):
        raise ValueError(
            f"channels of ModelParams is {described(params.channels)}; it must be a mapping of "
            "names to parameters"
        )
    if name not in params.channels:
        raise ValueError(f"the model's parameters have none of channel {name!r}")
    return params.channels[name]


def shared(params: Params, name: str) -> Params:
    """Return all of a model's parameters, for parts that read what is theirs."""
    del name
    return params


_Part = TypeVar("_Part", Model, Process, Channel)


def process_of(model: Model) -> Process:
    """Return how a model's state moves, with the model's parameters."""
    both = model.jacobians
    return Process(
        model.transition,
        model.process_noise,
        model.retract,
        model.local,
        both and (lambda params, x, u: both(params, x, u)[0]),
        model.carried,
    )


def channel_of(model: Model) -> Channel:
    """Return all that a model observes as one channel, with the model's parameters."""
    both = model.jacobians
    return Channel(
        model.width(),
        model.observe,
        model.observation_noise,
        model.residual,
        both and (lambda params, x, u: both(params, x, u)[1]),
        model.noisy,
    )


def observing(
    process: Process | Model, *channels: Mapping[str, Channel], parts: Parts = by_name
) -> Model:
    """Return the model of a process that is seen by channels, stacked in the order given.

    Args:
        process: How the state moves, or a model whose channels come first and go on as they are.
        *channels: What observes it, by name; no name twice.
        parts: ``(params, name) -> params`` of that channel, or of the process for
            :data:`PROCESS`. The default takes :class:`ModelParams`, :func:`shared` gives all of
            them to each, and a model with parameters of its own says here who gets which.

    Returns:
        The model. It has Jacobians if the process or any channel has a differential; those that are
        missing are automatic. Its observation noise is a diagonal if that of every channel is.

    Raises:
        ValueError: If there is no channel, a name is used twice or is :data:`PROCESS`, a size is
            below one, or the channels of a model have no names; in a run, if what a channel gives
            has not its size.
    """
    if not isinstance(process, Process | Model):
        raise ValueError(
            f"process is {described(process)}; observing takes a Process, or a Model to whose "
            "channels others are added"
        )
    if isinstance(process, Model) and not process.channels:
        raise ValueError(
            "process is a Model whose channels have no names; observing takes a Process, as "
            "process_of(model) is, or a Model of its own"
        )
    require_function("parts", parts, "params", "name")
    before: tuple[tuple[str, int], ...] = ()
    blocks: dict[str, Channel] = {}
    if isinstance(process, Model):
        before, blocks[PROCESS] = process.channels, channel_of(process)
        process = process_of(process)
    named = _merged(channels, {name for name, _ in before})
    blocks.update(named)
    laid_out, total = [], 0
    for name, channel in blocks.items():
        laid_out.append((name, channel, slice(total, total + channel.size)))
        total += channel.size

    def stacked(params: Params, x: Point, u: Input) -> Array:
        return _joined(
            [_sized(name, c, c.observe(parts(params, name), x, u)) for name, c, _ in laid_out]
        )

    def noise(params: Params, x: Point, u: Input) -> Array:
        return _block_diagonal(
            [
                _sized(name, c, c.noise(parts(params, name), x, u), covariance=True)
                for name, c, _ in laid_out
            ]
        )

    def residual(z: Array, z_pred: Array) -> Array:
        return _joined([c.residual(z[at], z_pred[at]) for _, c, at in laid_out])

    def jacobians(params: Params, x: Point, u: Input) -> tuple[LinearMap | None, LinearMap | None]:
        of_process, maps = None, None
        if process.differential is not None:
            of_process = process.differential(parts(params, PROCESS), x, u)
        if any(c.differential is not None for _, c, _ in laid_out):
            each = [_differential(c, process, parts(params, name), x, u) for name, c, _ in laid_out]
            maps = lambda dx: _joined([one(dx) for one in each])  # noqa: E731
        return of_process, maps

    given = (process, *blocks.values())
    return Model(
        transition=lambda params, x, u: process.transition(parts(params, PROCESS), x, u),
        process_noise=lambda params, x, u: process.noise(parts(params, PROCESS), x, u),
        observe=stacked,
        observation_noise=noise,
        residual=difference if all(c.residual is difference for c in blocks.values()) else residual,
        retract=process.retract,
        local=process.local,
        jacobians=jacobians if any(part.differential is not None for part in given) else None,
        noisy=_noisy(laid_out, parts),
        channels=(*before, *((name, channel.size) for name, channel in named.items())),
        carried=process.carried,
    )


def disturbed(residual: Callable[[Array, Array], Array], z: Array, v: Array) -> Array:
    """Return values ``(m,)`` with noise added, not a number where it cannot just be added.

    That is where the residual of the sum against the values is not the noise, to 1e-6: noise in
    metres on latitudes in radians, say, but not where angles wrap.
    """
    moved = z + v
    if residual is difference:
        return moved
    off = residual(moved, z) - v
    return jnp.where(jnp.all(jnp.abs(off) <= 1e-6 * (jnp.abs(v) + jnp.abs(z))), moved, jnp.nan)


def adapted(
    part: _Part,
    params: Callable[[Params], Params] | None = None,
    u: Callable[[Input], Input] | None = None,
) -> _Part:
    """Return a model, process or channel that takes its parameters or input out of wider ones.

    Args:
        part: A :class:`~jaxnav.estimation.types.Model`, :class:`Process` or :class:`Channel`.
        params: Its parameters as a part of the wider ones; the default is all of them.
        u: Its input as a part of the wider one; the default is all of it.
    """
    own = params or (lambda params: params)
    sensed = u or (lambda u: u)

    def narrowed(function: Callable | None) -> Callable | None:
        return function and (lambda p, x, u: function(own(p), x, sensed(u)))

    def disturbed(noisy: NonAdditive | None) -> NonAdditive | None:
        return noisy and NonAdditive(
            lambda p, x, v, u: noisy.observe(own(p), x, v, sensed(u)),
            lambda p, x, u: noisy.noise(own(p), x, sensed(u)),
        )

    change = {
        name: disturbed(value) if name == "noisy" else narrowed(value)
        for name, value in part._asdict().items()
        if name in _OF_PARAMETERS
    }
    return part._replace(**change)


_OF_PARAMETERS = {
    *("transition", "noise", "differential", "observe", "noisy"),
    *("process_noise", "observation_noise", "jacobians"),
}
"""Fields of models, processes and channels that take parameters, state and input."""


def _merged(channels: tuple[Mapping[str, Channel], ...], taken: set[str]) -> dict[str, Channel]:
    named: dict[str, Channel] = {}
    for several in channels:
        if not isinstance(several, Mapping):
            raise ValueError(
                f"the channels are {described(several)}; they must be a mapping of names to "
                "channels"
            )
        for name, channel in several.items():
            if not isinstance(channel, Channel):
                raise ValueError(f"channel {name!r} is {described(channel)}; it must be a Channel")
            if name in named or name in taken:
                raise ValueError(f"there are two channels {name!r}; each needs a name of its own")
            if name == PROCESS:
                raise ValueError(f"a channel is named {PROCESS!r}, as the process itself")
            if not isinstance(name, str):
                raise ValueError(f"the name of a channel is {described(name)}; it must be a string")
            require_whole(f"the size of channel {name!r}", channel.size, 1)
            for part in ("observe", "noise"):
                function = getattr(channel, part)
                require_function(f"{part} of channel {name!r}", function, "params", "x", "u")
            named[name] = channel
    if not named:
        raise ValueError("there is no channel; a model needs one or more")
    return named


def _sized(name: str, channel: Channel, value: Array, *, covariance: bool = False) -> Array:
    m = channel.size
    accepted = ((m,), (m, m)) if covariance else ((m,),)
    if jnp.shape(value) not in accepted:
        what = "noise" if covariance else "observation"
        either = " or ".join(map(str, accepted))
        raise ValueError(
            f"the {what} of channel {name!r} is {jnp.shape(value)}; by its size it must be {either}"
        )
    return value


def _joined(parts: list[Array]) -> Array:
    return parts[0] if len(parts) == 1 else jnp.concatenate(parts)


def _block_diagonal(blocks: list[Array]) -> Array:
    """Return the covariance of independent parts, a diagonal ``(m,)`` if that of each is one."""
    if all(block.ndim == 1 for block in blocks):
        return _joined(blocks)
    dense = [block if block.ndim == 2 else jnp.diag(block) for block in blocks]
    return dense[0] if len(dense) == 1 else jax.scipy.linalg.block_diag(*dense)


def _differential(
    channel: Channel, process: Process, params: Params, x: Point, u: Input
) -> Differential:
    """Return the derivative of a channel as a function, automatic where it has none of its own."""
    own = None if channel.differential is None else channel.differential(params, x, u)
    n = jax.eval_shape(process.local, x, x).shape[0]
    carried = sum(size for _, size in process.carried)
    first = 0 if own is None else n - carried
    if own is not None and not carried:
        return own if callable(own) else partial(jnp.matmul, own)
    z = channel.observe(params, x, u)

    def seen(dx: Array) -> Array:
        moved = process.retract(x, jnp.concatenate([jnp.zeros(first, dx.dtype), dx]))
        return channel.residual(channel.observe(params, moved, u), z)

    H = jax.jacfwd(seen)(jnp.zeros(n - first, z.dtype))
    if own is None:
        return lambda dx: H @ dx
    # The carried columns of its own derivative, if it has them, would count twice.
    known = own if callable(own) else partial(jnp.matmul, own)
    return lambda dx: known(dx.at[first:].set(0)) + H @ dx[first:]


def _noisy(laid_out: list[tuple[str, Channel, slice]], parts: Parts) -> NonAdditive | None:
    """Return the stacked observation with noise that does not just add, if that of any does not."""
    if all(channel.noisy is None for _, channel, _ in laid_out):
        return None

    def sources(params: Params, x: Point, u: Input) -> list[Array]:
        return [
            (c.noise if c.noisy is None else c.noisy.noise)(parts(params, name), x, u)
            for name, c, _ in laid_out
        ]

    def observe(params: Params, x: Point, v: Array, u: Input) -> Array:
        seen, first = [], 0
        for (name, c, _), source in zip(
            laid_out, jax.eval_shape(sources, params, x, u), strict=True
        ):
            own, here = parts(params, name), v[first : first + source.shape[0]]
            first += source.shape[0]
            value = (
                disturbed(c.residual, c.observe(own, x, u), here)
                if c.noisy is None
                else c.noisy.observe(own, x, here, u)
            )
            seen.append(_sized(name, c, value))
        return _joined(seen)

    return NonAdditive(observe, lambda params, x, u: _block_diagonal(sources(params, x, u)))
