"""What there is to filter with, found by the types that functions state: nothing is listed twice.

A public function that takes a :class:`~jaxnav.estimation.types.Model` and returns a
:class:`~jaxnav.estimation.types.Filter` is a filter, one that takes a filter is a wrapper, and one
that returns a :class:`~jaxnav.estimation.banks.rule.WeightRule` is a rule. They are looked for in
the folders ``filters`` and ``banks``, in modules that packages name under the entry points
``jaxnav.filters``, and in files that :func:`load` was given.

A module may state as ``IDLE`` by name with which parameters of its own a wrapper leaves the filter
inside as it is, which the tables of tests use.
"""

import ast
import difflib
import importlib
import importlib.util
import inspect
import pkgutil
import re
from collections.abc import Callable, Iterator
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, get_args, get_type_hints

from jaxnav.estimation.banks.rule import WeightRule
from jaxnav.estimation.types import Filter, Model

FILTER, WRAPPER, BANK, RULE = "filters", "wrappers", "banks", "weight rules"
KINDS = (FILTER, WRAPPER, BANK, RULE)
GROUP = "jaxnav.filters"
"""Entry points of other packages."""


class Entry(NamedTuple):
    """One of them.

    Attributes:
        name: Of the function.
        kind: Of :data:`KINDS`.
        make: The function.
        text: What it is, in plain words.
        idle: Own parameters with which a wrapper leaves the filter inside as it is, or ``()``.
    """

    name: str
    kind: str
    make: Callable[..., Any]
    text: str
    idle: Any


_loaded: dict[str, ModuleType] = {}


def load(path: Path) -> list[str]:
    """Run a Python file of filters, wrappers or rules of one's own, and return their names.

    Raises:
        ValueError: If it cannot be read or run, or has none of them; in one sentence.
    """
    name = f"jaxnav_from_{re.sub(r'[^0-9a-zA-Z]', '_', str(path.resolve()))}"
    if name not in _loaded:
        if not path.is_file():
            raise ValueError(f"{path} is no file; --from takes a Python file")
        spec = importlib.util.spec_from_file_location(name, path)
        if spec is None or spec.loader is None:
            raise ValueError(f"{path} is no Python file; --from takes one that ends in .py")
        module = importlib.util.module_from_spec(spec)
        try:
            spec.loader.exec_module(module)
            found = list(_entries_of(module, WRAPPER))
        except (Exception, SystemExit) as error:
            said = str(error).splitlines()[0] if str(error) else "no more is said"
            raise ValueError(f"{path} stops with {type(error).__name__}: {said}") from error
        if not found:
            raise ValueError(
                f"{path} has no filter, wrapper or rule: a public function whose types say that it "
                "takes a Model or a Filter and returns a Filter, or returns a WeightRule"
            )
        taken = entries()
        for entry in found:
            if entry.name in taken:
                raise ValueError(f"{path}: there is a {entry.name!r} already; take another name")
        _loaded[name] = module
        entries.cache_clear()
    return [entry.name for entry in _entries_of(_loaded[name], WRAPPER)]


@cache
def entries() -> dict[str, Entry]:
    """Return all of them by name."""
    found: dict[str, Entry] = {}
    for module, around in _modules():
        for entry in _entries_of(module, around):
            if entry.name in found:
                raise ValueError(f"{module.__name__}: there is a {entry.name!r} already")
            found[entry.name] = entry
    return found


def by_kind() -> dict[str, dict[str, Entry]]:
    """Return all of them by kind and name."""
    everything = entries()
    return {
        kind: {name: entry for name, entry in everything.items() if entry.kind == kind}
        for kind in KINDS
    }


def chain_of(expression: str) -> tuple[str, ...]:
    """Return the names of wrappers and filter in ``sage_husa(versoria(ekf))``, outermost first.

    Raises:
        ValueError: If it is not of this form, or a name is unknown or stands where it cannot.
    """
    known = by_kind()
    try:
        node: Any = ast.parse(expression.strip(), mode="eval").body
    except SyntaxError:
        node = None
    names = []
    while isinstance(node, ast.Call) and len(node.args) == 1 and not node.keywords:
        names.append(getattr(node.func, "id", ""))
        node = node.args[0]
    names.append(node.id if isinstance(node, ast.Name) else "")
    for i, name in enumerate(names):
        kind = FILTER if i == len(names) - 1 else WRAPPER
        other = next((of for of in KINDS if name in known[of]), None)
        if other is not None and other != kind:
            needed = f"{name}(ekf)" if other == WRAPPER else f"versoria({name})"
            where = "needs a filter inside" if other == WRAPPER else "can only stand innermost"
            raise ValueError(
                f"filter is {expression!r}, but {name} is one of the {other}"
                + (f"; it {where}, as {needed}" if other in (FILTER, WRAPPER) else "")
            )
        if name not in known[kind]:
            near = difflib.get_close_matches(name, known[kind], 1)
            hint = f", did you mean {near[0]!r}?" if near else ""
            said = f"there is none of {name!r}" if name else "it is not of that form"
            raise ValueError(
                f"filter is {expression!r}, but {said}{hint}; it must be one of "
                f"{', '.join(known[FILTER])}, or in wrappers, as versoria(ekf), of "
                f"{', '.join(known[WRAPPER])}"
            )
    return tuple(names)


def built(names: tuple[str, ...], model: Model) -> Filter:
    """Return the filter of a model that :func:`chain_of` named.

    Raises:
        ValueError: If one of them refuses it, stops, or returns something else.
    """
    made: Any
    known, made = entries(), model
    for name in reversed(names):
        try:
            made = known[name].make(made)
        except ValueError:
            raise
        except Exception as error:
            raise ValueError(f"{name} stops with {type(error).__name__}: {error}") from error
        if not isinstance(made, Filter):
            raise ValueError(f"{name} returns {type(made).__name__}; it must return a Filter")
    return made


def functions_of(package: str) -> Iterator[tuple[Callable[..., Any], dict[str, Any]]]:
    """Yield the public functions of a package's modules, with the types that they state."""
    for module in _inside(package):
        yield from _functions(module)


def plain(documentation: str | None) -> str:
    """Return the first line of a documentation without its marks and what it returns it as."""
    line = (documentation or "").strip().splitlines()[0] if documentation else ""
    line = re.sub(r":\w+:`~?(?:[\w.]*\.)?(\w+)`", r"\1", line.removeprefix("Return "))
    return re.sub(r", with parameters \w+\.$", "", line.replace("``", "").removesuffix(" "))


def _inside(package: str) -> Iterator[ModuleType]:
    for found in pkgutil.iter_modules(importlib.import_module(package).__path__):
        yield importlib.import_module(f"{package}.{found.name}")


def _modules() -> Iterator[tuple[ModuleType, str]]:
    """Yield modules, and what takes a filter in them."""
    for folder, around in (("filters", WRAPPER), ("banks", BANK)):
        for module in _inside(f"jaxnav.estimation.{folder}"):
            yield module, around
    for point in entry_points(group=GROUP):
        yield point.load(), WRAPPER
    for module in _loaded.values():
        yield module, WRAPPER


def _functions(module: ModuleType) -> Iterator[tuple[Callable[..., Any], dict[str, Any]]]:
    for name, function in vars(module).items():
        own = inspect.isfunction(function) and function.__module__ == module.__name__
        if own and not name.startswith("_"):
            try:
                yield function, get_type_hints(function)
            except Exception as error:
                raise ValueError(f"the types of {name} cannot be read: {error}") from error


def _entries_of(module: ModuleType, around: str) -> Iterator[Entry]:
    for function, types in _functions(module):
        kind = _kind(types, around)
        if kind is not None:
            idle = getattr(module, "IDLE", {}).get(function.__name__, ())
            yield Entry(function.__name__, kind, function, plain(function.__doc__), idle)


def _kind(types: dict[str, Any], around: str) -> str | None:
    """Return the kind of a function by its types, ``None`` if it is none."""
    returned = types.get("return")
    if returned is WeightRule:
        return RULE
    if returned is not Filter or not types:
        return None
    first = next(iter(types.values()))
    if first is Model:
        return FILTER
    return around if Filter in (first, *get_args(first)) else None
