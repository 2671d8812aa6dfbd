"""How programs are compiled: compiler options where this jaxlib takes them, and the cores at hand.

Building a program is work that a user waits for. The options below halve it and leave the result
about as fast (jax 0.10). A jaxlib that does not know an option refuses to compile with it, so each
is tried once, on a program of one operation, and left out where it is refused.
"""

import os
from collections.abc import Callable
from functools import cache, partial, wraps
from typing import Any

import jax
from jax.extend.core import get_opaque_trace_state

OPTIONS = {"xla_cpu_use_fusion_emitters": False}
"""Options of the compiler that are taken where they exist."""


@cache
def accepted_options() -> dict[str, bool]:
    """Return those of :data:`OPTIONS` that the jaxlib at hand takes; starts the backend."""
    return {name: value for name, value in OPTIONS.items() if _is_accepted(name, value)}


def _is_accepted(name: str, value: bool) -> bool:
    try:
        jax.jit(lambda x: x, compiler_options={name: value}).lower(0.0).compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True


def compiled(function: Callable[..., Any] | None = None, **options: Any) -> Callable[..., Any]:
    """Return ``jax.jit(function)`` with :func:`accepted_options` where it is the outermost one.

    A ``jit`` inside another takes part in its program and must not have options of its own, so
    within a trace the plain one is called.

    Args:
        function: What to compile; left out, a decorator is returned.
        **options: Those of ``jax.jit``.
    """
    if function is None:
        return partial(compiled, **options)
    inner = jax.jit(function, **options)

    @cache
    def outermost() -> Callable[..., Any]:
        return jax.jit(function, compiler_options=accepted_options(), **options)

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        return (outermost() if _at_top_level() else inner)(*args, **kwargs)

    return call


# Taken on import: the first call may come from within a trace.
_TOP_LEVEL = get_opaque_trace_state()


def _at_top_level() -> bool:
    """Return whether no transformation is being traced."""
    return get_opaque_trace_state() == _TOP_LEVEL


def cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
