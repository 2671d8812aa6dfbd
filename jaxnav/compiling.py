"""How programs are compiled: compiler options where this jaxlib takes them, and the cores at hand.

Building a program is work that a user waits for. The options below halve it and leave the result
about as fast (jax 0.10). A jaxlib that does not know an option refuses to compile with it, so each
is tried once, on a program of one operation, and left out where it is refused.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial, wraps
from typing import Any

import jax
import numpy as np
from jax.extend.core import get_opaque_trace_state

host: Any = np
"""NumPy, for the numbers that a program is given: to make them compiles nothing. Typed as anything,
since its arrays stand where annotations name those of JAX."""
OPTIONS: dict[str, Any] = {"xla_cpu_use_fusion_emitters": False}
"""Options of the compiler that are taken where they exist."""


def accepted_options() -> dict[str, Any]:
    """Return those of :data:`OPTIONS` that the jaxlib at hand takes; starts the backend."""
    return {name: value for name, value in OPTIONS.items() if _is_accepted(name, value)}


@cache
def _is_accepted(name: str, value: Any) -> bool:
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
    def outermost(*accepted: tuple[str, Any]) -> Callable[..., Any]:
        return jax.jit(function, compiler_options=dict(accepted), **options)

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        chosen = outermost(*accepted_options().items()) if _at_top_level() else inner
        return chosen(*args, **kwargs)

    return call


@cache
def _top_level() -> Any:
    # The first call may come from within a trace; a thread of its own is outside of any.
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(get_opaque_trace_state).result()


def _at_top_level() -> bool:
    """Return whether no transformation is being traced."""
    return get_opaque_trace_state() == _top_level()


def cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
