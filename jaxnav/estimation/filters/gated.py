"""A gate: observations that the prediction rules out are refused, though not for ever."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.arguments import described
from jaxnav.estimation.checks import require_fields, require_filter
from jaxnav.estimation.filters.innovation import nis_of
from jaxnav.estimation.filters.wrapping import parted, require_wrapper
from jaxnav.estimation.types import (
    Filter,
    Flag,
    Gaussian,
    Info,
    Input,
    Model,
    Obs,
    Params,
    flags_of,
)


class Gate(NamedTuple):
    """Parameters of a gate.

    Attributes:
        false_alarm: Probability with which a group of channels is refused though the filter is
            right, in (0, 1); its complement would round to one in 32-bit floats.
        patience: Refusals in a row over which the gate opens by ``e`` in the square of an
            innovation, above zero; infinite, it never opens.
    """

    false_alarm: Array | float = 1e-7
    patience: Array | float = 5.0


IDLE = {"gated": Gate(false_alarm=1e-30)}
_DOMAINS = {"false_alarm": ("(0, 1)", 0.0, 1.0), "patience": ("(0, inf]", 0.0, jnp.inf)}


class Gated(NamedTuple):
    """Parameters of a bank behind a gate: its own, and those of the gate."""

    inner: Params
    gate: Gate = Gate()


class GatedState(NamedTuple):
    """The filter's state, and the refusals in a row of each group ``(G,)``."""

    inner: Any
    refused: Array


def gated(filter: Filter, groups: Sequence[str | Sequence[int]] | None = None) -> Filter:
    """Return a filter or bank that refuses what is not to be believed.

    Its own parameters are a :class:`Gate`; those of a gated bank are :class:`Gated`.

    A group of channels whose normalised innovation squared is less probable than the gate allows is
    left out of the update, with :attr:`Flag.REFUSED`. With every refusal in a row the gate opens,
    by ``e`` in ``patience`` of them: what goes on contradicting the filter is right in the end. The
    covariance is scaled by as much as the gate has opened before that update, since the filter was
    too sure by about so much; the flag is :attr:`Flag.REOPENED`.

    A bank is gated as a whole, by its mixture: members that refuse each for itself would be weighed
    by what they do not look at.

    Args:
        filter: What runs behind the gate.
        groups: What stands and falls together: channels of the model by name, or places in an
            observation. What is in no group always passes. The default is each of the model's
            channels, or all of an observation whose channels have no names.

    Raises:
        ValueError: If there is no group or an empty one, a channel is in two or is not the model's;
            in a run, for parameters of another filter.

    References:
        Bar-Shalom, Li, Kirubarajan (2001), section 5.4, for the gate; to open it again is usual in
        flight software.
    """
    require_filter(filter)
    places = _places(filter.model, groups)
    single = filter.on is not None

    def check(params: Any) -> None:
        if single and isinstance(params, Gated):
            raise ValueError(
                "params is Gated, of a bank; a gated filter takes FilterParams(model, initial, "
                "own=(Gate(...), the filter's own))"
            )
        if single:
            return filter.check(require_wrapper(params, Gate(), _DOMAINS))
        if not isinstance(params, Gated):
            raise ValueError(f"params is {described(params)}; a gated bank takes Gated(inner)")
        require_fields("gate", params.gate, Gate, _DOMAINS)
        return filter.check(params.inner)

    def split(params: Any) -> tuple[Gate, Params]:
        return parted(params, Gate()) if single else (params.gate, params.inner)

    def init(params: Params) -> GatedState:
        count = 1 if places is None else len(places)
        return GatedState(filter.init(split(params)[1]), jnp.zeros(count, jnp.int32))

    def predict(params: Params, state: GatedState, u: Input) -> GatedState:
        return state._replace(inner=filter.predict(split(params)[1], state.inner, u))

    def update(params: Params, state: GatedState, u: Input, obs: Obs) -> tuple[GatedState, Info]:
        gate, own = split(params)
        plain = filter.update(own, state.inner, u, obs)
        groups = [np.arange(obs.valid.shape[0])] if places is None else places
        found = _judged(gate, state.refused, plain[1], groups)
        left = obs._replace(valid=obs.valid & ~found.channels)
        reopened = jnp.any(found.reopened)

        def again(_: Any) -> tuple[Any, Info]:
            known = filter.estimate(state.inner)
            wider = filter.restart(state.inner, Gaussian(known.mean, found.excess * known.cov))
            chosen = jax.tree.map(lambda a, b: jnp.where(reopened, a, b), wider, state.inner)
            return filter.update(own, chosen, u, left)

        refused = jnp.any(found.refuse)
        inner, info = jax.lax.cond(refused | reopened, again, lambda _: plain, None)
        raised = flags_of({Flag.REFUSED: refused, Flag.REOPENED: reopened})
        # What a gate inside has refused stays so.
        info = info._replace(flags=info.flags | raised, refused=info.refused | found.channels)
        return GatedState(inner, found.in_a_row), info

    def estimate(state: GatedState) -> Any:
        return filter.estimate(state.inner)

    def restart(state: GatedState, estimate: Gaussian) -> GatedState:
        return state._replace(inner=filter.restart(state.inner, estimate))

    build, retract, local = filter.on, filter.retract, filter.local
    on = build and (lambda model: gated(build(model), groups))
    return Filter(init, predict, update, estimate, restart, retract, local, check, filter.model, on)


class _Judged(NamedTuple):
    """What a gate makes of an update: by group, and of the ``channels`` ``(m,)``.

    Attributes:
        refuse: ``(G,)`` groups that are left out.
        reopened: ``(G,)`` groups that pass though they contradict the filter.
        in_a_row: ``(G,)`` refusals since the last group that passed.
        channels: ``(m,)`` channels that are left out.
        excess: By how much the gate has opened, in squares; one where it has not.
    """

    refuse: Array
    reopened: Array
    in_a_row: Array
    channels: Array
    excess: Array


def _judged(gate: Gate, in_a_row: Array, info: Info, groups: list[np.ndarray]) -> _Judged:
    """Hold the innovations of an update against the gate, which refusals have opened."""
    beyond, width = max(int(group.max()) for group in groups), info.used.shape[0]
    if beyond >= width:
        raise ValueError(f"groups has the place {beyond}; the observation has {width} values")
    squares = jnp.stack([nis_of(info, group) for group in groups])
    count = jnp.stack([jnp.sum(info.used[group]) for group in groups])
    heard = count > 0
    opened = jnp.exp(-in_a_row.astype(squares.dtype) / gate.patience)
    improbable = _tail(squares, count) < gate.false_alarm
    refuse = heard & (_tail(squares * opened, count) < gate.false_alarm)
    reopened = heard & improbable & ~refuse
    channels = jnp.zeros(info.used.shape, bool)
    for i, group in enumerate(groups):
        channels = channels.at[group].set(refuse[i])
    again = jnp.where(refuse, in_a_row + 1, jnp.where(heard, 0, in_a_row))
    return _Judged(refuse, reopened, again, channels, jnp.max(jnp.where(reopened, 1 / opened, 1)))


def _places(
    model: Model | None, groups: Sequence[str | Sequence[int]] | None
) -> list[np.ndarray] | None:
    """Return the places of each group in an observation, ``None`` for one group of all."""
    if groups is None:
        groups = [name for name, _ in model.channels] if model is not None else []
        if not groups:
            return None
    if isinstance(groups, str) or not isinstance(groups, Sequence):
        raise ValueError(f"groups is {described(groups)}; it must be a list of names or of places")
    if not groups or not all(isinstance(group, Sequence) and len(group) for group in groups):
        raise ValueError(f"groups is {list(groups)}; a gate needs groups of one channel or more")
    width = sum(size for _, size in model.channels) if model is not None else 0
    places = []
    for group in groups:
        if isinstance(group, str):
            if model is None:
                raise ValueError(f"the filter has no model whose channel {group!r} could be meant")
            at = model.channel(group)
            group = range(at.start, at.stop)
        for place in group:
            if not isinstance(place, int | np.integer) or place < 0 or (width and place >= width):
                accepted = f"from 0 to {width - 1}" if width else "zero or above"
                raise ValueError(f"groups has the place {place!r}; it must be whole, {accepted}")
        places.append(np.array(list(group)))
    every = np.concatenate(places)
    if len(set(every.tolist())) != len(every):
        raise ValueError(f"groups is {list(groups)}; a channel can be in one group only")
    return places


def _tail(square: Array, count: Array) -> Array:
    """Return the probability that a chi-square variable of so many degrees exceeds a value."""
    freedom = jnp.maximum(count, 1).astype(square.dtype)
    return jax.scipy.special.gammaincc(0.5 * freedom, 0.5 * square)
