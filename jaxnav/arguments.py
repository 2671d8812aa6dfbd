"""What a caller hands over, held against what is accepted, in the words of the caller.

Here is what needs no filter and no model; :mod:`jaxnav.estimation.checks` has the rest. Types and
shapes are looked at always, values where they are concrete.
"""

import inspect
import operator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

Domain = tuple[str, float, float]
POSITIVE: Domain = ("(0, inf]", 0.0, np.inf)
NOT_NEGATIVE: Domain = ("[0, inf)", 0.0, np.inf)
FINITE: Domain = ("(-inf, inf)", -np.inf, np.inf)
"""Domains of :func:`require_number`: an interval in words, its lower and its upper end."""


def described(value: Any) -> str:
    """Return what a value is, for a message: an array by its shape and type, others by class."""
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        return f"an array {np.shape(value)} of {value.dtype}"
    if isinstance(value, bool | int | float | str | type(None)):
        return repr(value)
    if value == ():
        return "()"
    if isinstance(value, type) or (callable(value) and hasattr(value, "__name__")):
        return f"the {'class' if isinstance(value, type) else 'function'} {value.__name__}"
    name = type(value).__name__
    return f"{'an' if name[0] in 'AEIOaeio' else 'a'} {name}"


def known(value: Any) -> np.ndarray | None:
    """Return a value as an array if it is concrete, or ``None``."""
    return None if isinstance(value, Tracer | jax.ShapeDtypeStruct) else np.asarray(value)


def require_number(name: str, value: Any, domain: str, low: float, high: float) -> None:
    """Raise ``ValueError`` unless a value is one number within a domain.

    Args:
        name: Of the value, for the message.
        value: The value.
        domain: The domain as an interval, for the message; a round bracket leaves the end out.
        low: Its lower end.
        high: Its upper end.
    """
    if not _is_number(value):
        raise ValueError(f"{name} is {described(value)}; it must be a number in {domain}")
    given = known(value)
    if given is None:
        return
    above = given > low if domain.startswith("(") else given >= low
    below = given < high if domain.endswith(")") else given <= high
    if not (above and below):
        raise ValueError(f"{name} is {given:g}; it must be in {domain}")


def _is_number(value: Any) -> bool:
    if isinstance(value, bool | str) or not isinstance(
        value, int | float | np.generic | np.ndarray | jax.Array | jax.ShapeDtypeStruct
    ):
        return False
    return np.shape(value) == ()


def require_array(name: str, value: Any) -> Any:
    """Return an array, or raise ``ValueError`` for what is none: a list, a number."""
    if not isinstance(value, jax.Array | np.ndarray | np.generic | jax.ShapeDtypeStruct):
        raise ValueError(f"{name} is {described(value)}; it must be an array")
    return value


def as_array(name: str, value: Any) -> jax.Array:
    """Return numbers as an array, or raise ``ValueError`` for what has none."""
    try:
        if isinstance(value, str):
            raise TypeError("a text, which NumPy may take for the name of a type")
        return jnp.asarray(value)
    except (TypeError, ValueError):
        raise ValueError(
            f"{name} is {described(value)}; it must be a number, an array or rows of one length"
        ) from None


def require_floating(name: str, value: Any) -> Any:
    """Return an array of floating-point numbers, or raise ``ValueError``."""
    array = require_array(name, value)
    if not jnp.issubdtype(array.dtype, jnp.floating):
        raise ValueError(
            f"{name} is of {array.dtype}; it must be of floating-point numbers, as float64"
        )
    return array


def require_whole(name: str, value: Any, least: int) -> int:
    """Return a whole number, or raise ``ValueError`` for what is none or too small."""
    try:
        whole = None if isinstance(value, bool) else operator.index(value)
    except TypeError:
        whole = None
    if whole is None or whole < least:
        raise ValueError(f"{name} is {described(value)}; it must be at least {least}, and whole")
    return whole


def require_switch(name: str, value: Any) -> None:
    """Raise ``ValueError`` unless a value is true or false: a word would count as true."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} is {described(value)}; it must be True or False")


def require_function(name: str, value: Any, *arguments: str) -> None:
    """Raise ``ValueError`` unless a value can be called with so many arguments.

    Args:
        name: Of the value, for the message.
        value: The value.
        *arguments: Names of what it is called with; none if their number is not known.
    """
    accepted = f"a function of ({', '.join(arguments)})" if arguments else "a function"
    if not callable(value):
        raise ValueError(f"{name} is {described(value)}; it must be {accepted}")
    if not arguments:
        return
    try:
        # What a decorator has wrapped may take other arguments than the whole does.
        signature = inspect.signature(value, follow_wrapped=False)
    except (TypeError, ValueError):
        return
    try:
        signature.bind(*arguments)
    except TypeError:
        raise ValueError(f"{name} takes {signature}; it must be {accepted}") from None


def require_leaves(name: str, tree: Any) -> None:
    """Raise ``ValueError`` unless every leaf of a pytree is a number or an array."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        own = jax.tree_util.keystr(path, simple=True, separator=".")
        place = f"{name}.{own}" if own else name
        numeric = isinstance(leaf, int | float | complex | np.generic | np.ndarray)
        if isinstance(leaf, np.generic | np.ndarray):
            numeric = leaf.dtype.kind not in "OSU"
        if not numeric and not isinstance(leaf, jax.Array | jax.ShapeDtypeStruct):
            raise ValueError(
                f"{place} is {described(leaf)}; it must be a number, an array or a tree of them"
            )


def require_real(name: str, array: Any) -> None:
    """Raise ``ValueError`` unless an array is of real numbers, whole ones and bool among them."""
    if not (jnp.issubdtype(array.dtype, jnp.number) or array.dtype == bool) or jnp.issubdtype(
        array.dtype, jnp.complexfloating
    ):
        raise ValueError(f"{name} is of {array.dtype}; it must be of real numbers")
