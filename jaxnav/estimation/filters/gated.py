"""A gate: observations that the prediction rules out are refused, though not for ever."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.estimation.checks import described, require_fields
from jaxnav.estimation.filters.innovation import nis_of
from jaxnav.estimation.types import Filter, Flag, Gaussian, Info, Input, Obs, Params


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


class Gated(NamedTuple):
    """Parameters of a filter behind a gate: its own, and those of the gate."""

    inner: Params
    gate: Gate = Gate()


class GatedState(NamedTuple):
    """The filter's state, and the refusals in a row of each group ``(G,)``."""

    inner: Any
    refused: Array


def gated(filter: Filter, groups: Sequence[Sequence[int]]) -> Filter:
    """Return a filter or bank that refuses what is not to be believed; parameters :class:`Gated`.

    A group of channels whose normalised innovation squared is less probable than the gate allows is
    left out of the update, with :attr:`Flag.REFUSED`. With every refusal in a row the gate opens,
    by ``e`` in ``patience`` of them: what goes on contradicting the filter is right in the end. The
    covariance is scaled by as much as the gate has opened before that update, since the filter was
    too sure by about so much; the flag is :attr:`Flag.REOPENED`.

    A bank is gated as a whole, by its mixture: members that refuse each for itself would be weighed
    by what they do not look at.

    Args:
        filter: What runs behind the gate.
        groups: Channels of each group, which stand and fall together; a channel that is in none
            always passes.

    Raises:
        ValueError: If a channel is in two groups; in a run, for parameters of another filter.

    References:
        Bar-Shalom, Li, Kirubarajan (2001), section 5.4, for the gate; to open it again is usual in
        flight software.
    """
    members = [channel for group in groups for channel in group]
    if len(set(members)) != len(members):
        raise ValueError(f"groups is {list(groups)}; a channel can be in one group only")

    def check(params: Gated) -> None:
        if not isinstance(params, Gated):
            raise ValueError(f"params is {described(params)}; a gated filter takes Gated(inner)")
        domains = {
            "false_alarm": ("(0, 1)", 0.0, 1.0),
            "patience": ("(0, inf]", 0.0, jnp.inf),
        }
        require_fields("gate", params.gate, Gate, domains)
        filter.check(params.inner)

    def init(params: Gated) -> GatedState:
        return GatedState(filter.init(params.inner), jnp.zeros(len(groups), jnp.int32))

    def predict(params: Gated, state: GatedState, u: Input) -> GatedState:
        return state._replace(inner=filter.predict(params.inner, state.inner, u))

    def update(params: Gated, state: GatedState, u: Input, obs: Obs) -> tuple[GatedState, Info]:
        plain = filter.update(params.inner, state.inner, u, obs)
        squares = jnp.stack([nis_of(plain[1], group) for group in groups])
        used = plain[1].used
        count = jnp.stack([jnp.sum(used[np.array(group)]) for group in groups])
        heard = count > 0
        dtype = squares.dtype
        opened = jnp.exp(-state.refused.astype(dtype) / params.gate.patience)
        improbable = _tail(squares, count) < params.gate.false_alarm
        refuse = heard & (_tail(squares * opened, count) < params.gate.false_alarm)
        reopened = heard & improbable & ~refuse
        channels = jnp.zeros(obs.valid.shape, bool)
        for i, group in enumerate(groups):
            channels = channels.at[np.array(group)].set(refuse[i])
        left = obs._replace(valid=obs.valid & ~channels)
        excess = jnp.max(jnp.where(reopened, 1 / opened, 1))

        def again(_: Any) -> tuple[Any, Info]:
            known = filter.estimate(state.inner)
            wider = filter.restart(state.inner, Gaussian(known.mean, excess * known.cov))
            chosen = jax.tree.map(
                lambda a, b: jnp.where(jnp.any(reopened), a, b), wider, state.inner
            )
            return filter.update(params.inner, chosen, u, left)

        inner, info = jax.lax.cond(jnp.any(refuse | reopened), again, lambda _: plain, None)
        raised = jnp.where(jnp.any(refuse), int(Flag.REFUSED), 0)
        raised = raised | jnp.where(jnp.any(reopened), int(Flag.REOPENED), 0)
        refused = jnp.where(refuse, state.refused + 1, jnp.where(heard, 0, state.refused))
        flags = info.flags | raised.astype(jnp.int32)
        return GatedState(inner, refused), info._replace(flags=flags, refused=channels)

    def estimate(state: GatedState) -> Any:
        return filter.estimate(state.inner)

    def restart(state: GatedState, given: Gaussian) -> GatedState:
        return state._replace(inner=filter.restart(state.inner, given))

    return Filter(init, predict, update, estimate, restart, filter.retract, filter.local, check)


def _tail(square: Array, count: Array) -> Array:
    """Return the probability that a chi-square variable of so many degrees exceeds a value."""
    freedom = jnp.maximum(count, 1).astype(square.dtype)
    return jax.scipy.special.gammaincc(0.5 * freedom, 0.5 * square)
