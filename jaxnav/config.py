"""What every configuration shares: bounds stated at the field, one sentence a fault, TOML files.

A configuration is a frozen dataclass whose annotations say what its fields take, with the types
below or bounds of their own, and whose ``__post_init__`` begins with :func:`check_fields`; what
concerns several fields at once follows with :func:`require`. No JAX is needed for any of it.
"""

import difflib
import math
import sys
import tomllib
from collections.abc import Collection, Iterable, Mapping
from dataclasses import fields
from functools import cache
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta

MOST_RUNS = 10**9
"""Most runs of a study, whose rows are all kept."""

Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]
Probability = Annotated[float, Meta(gt=0, lt=1)]
Share = Annotated[float, Meta(gt=0, le=1)]
Latitude = Annotated[float, Meta(ge=-90, le=90)]
Count = Annotated[int, Meta(ge=1)]
Runs = Annotated[int, Meta(ge=1, le=MOST_RUNS)]
Seed = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Positives = Annotated[tuple[Positive, ...], Meta(min_length=1)]
PositiveAxes = tuple[Positive, Positive, Positive]
Names = Annotated[tuple[str, ...], Meta(extra={"separator": ","})]
"""Texts that a command line may also give between commas."""


class ConfigError(ValueError):
    """A parameter outside what is accepted; the message says which, its value and the range."""


class FieldError(ConfigError):
    """A field's value outside what is accepted.

    Attributes:
        field: Name of the field, or what it was given by.
        value: What it was, as it is to be shown.
        accepted: What it must be.
    """

    def __init__(self, field: str, value: object, accepted: str) -> None:
        """Make one sentence of the three."""
        super().__init__(f"{field} is {value}; it must be {accepted}")
        self.field, self.value, self.accepted = field, value, accepted


class Setting(NamedTuple):
    """A value, and the name of where it stands: a flag, or a file and a key."""

    value: Any
    source: str


def require(condition: bool, name: str, value: object, accepted: str) -> None:
    """Raise :class:`FieldError` with one sentence unless the condition holds."""
    if not condition:
        raise FieldError(name, value, accepted)


def require_different(config: Any, *names: str) -> None:
    """Require that no two entries of fields are equal."""
    for name in names:
        value = getattr(config, name)
        require(len(set(value)) == len(value), name, value, "different in every entry")


def check_fields(config: Any) -> None:
    """Hold every field of a configuration against its annotation, and make it of that type.

    A list becomes a tuple, a whole number in the place of another one a float, a text a path; what
    is a number is to be finite. What JAX traces stays as it is, so that a program may differentiate
    by a field.

    Raises:
        FieldError: With one sentence naming the field, its value and what is accepted.
    """
    for name, (kind, bounded) in annotations(type(config)).items():
        value = getattr(config, name)
        if _is_traced(value):
            continue
        value = converted(name, kind, value)
        if _fits(value, bounded):
            entries = value if isinstance(value, tuple) else (value,)
            finite = all(math.isfinite(entry) for entry in entries if isinstance(entry, float))
            require(finite, name, value, "finite")
        else:
            raise FieldError(name, value, _bounds(bounded))
        object.__setattr__(config, name, value)


def converted(name: str, kind: Any, value: Any) -> Any:
    """Return a value as the type of a field, bounds apart.

    Raises:
        FieldError: If it is of another type.
    """
    try:
        return msgspec.convert(_native(value), kind, dec_hook=_path)
    except msgspec.ValidationError:
        shown = value if get_origin(sole(kind)) is Literal else repr(value)
        raise FieldError(name, shown, accepted(kind)) from None


def sole(kind: Any) -> Any:
    """Return the type beside ``None``."""
    others = [part for part in get_args(kind) if part is not NoneType]
    return others[0] if NoneType in get_args(kind) else kind


def accepted(kind: Any) -> str:
    """Return in words what a type takes, bounds apart."""
    kind = sole(kind)
    if get_origin(kind) is Literal:
        return "one of " + ", ".join(get_args(kind))
    if get_origin(kind) is tuple:
        parts = get_args(kind)
        if parts[-1] is Ellipsis:
            return f"a list of {_ENTRIES[parts[0]]}"
        return f"{_COUNTS[len(parts)]} {_ENTRIES[parts[0]]}"
    return _KINDS[kind]


def bounds(annotation: "Annotation") -> str | None:
    """Return in words the bounds of a field, if it has any."""
    free = annotation.kind == annotation.bounded or annotation.separator is not None
    return None if free else _bounds(annotation.bounded)


def built(kind: type, settings: Mapping[str, Setting]) -> Any:
    """Return a configuration with fields as set, and the others at their defaults.

    Raises:
        FieldError: For a value that is not accepted, named by its source.
    """
    try:
        return kind(**{name: setting.value for name, setting in settings.items()})
    except FieldError as error:
        if error.field not in settings:
            raise
        source = settings[error.field].source
        raise FieldError(source, error.value, error.accepted) from None


def read_toml(path: Path) -> dict[str, Any]:
    """Return what a TOML file holds.

    Raises:
        ConfigError: If it cannot be read, or is no TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise ConfigError(f"{path}: {reason}; it must be a readable TOML file") from None
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        said = str(error).splitlines()[0]
        raise ConfigError(f"{path} is not TOML: {said}; it must be a TOML file") from None


def from_table(kind: type, table: Mapping[str, Any], file: str) -> dict[str, Setting]:
    """Return what a table of a file sets of a configuration, of its fields' types.

    Args:
        kind: The class of the configuration.
        table: Its entries by name.
        file: What stands before a name in a sentence.

    Raises:
        ConfigError: If there is no such field, or a value is of another type.
    """
    known = annotations(kind)
    names = [name for name in known if name != "config"]
    settings = {}
    for name, value in table.items():
        if name not in names:
            raise ConfigError(f"{file}: there is no {name!r}{near(name, names)}")
        source = f"{file}: {name}"
        settings[name] = Setting(converted(source, known[name].kind, value), source)
    return settings


def near(name: str, names: Collection[str]) -> str:
    """Return how a sentence about an unknown name goes on: the nearest one, and all there are."""
    folded = {known.casefold().replace("_", "-"): known for known in names}
    close = difflib.get_close_matches(name.casefold().replace("_", "-"), folded, 1)
    hint = f", did you mean {folded[close[0]]!r}" if close else ""
    return f"{hint}; it must be {either(names)}"


def either(names: Iterable[str]) -> str:
    """Return names as a choice in words."""
    return "one of " + ", ".join(names)


def plain(config: Any) -> dict[str, Any]:
    """Return a configuration as a dictionary of plain values."""
    return {f.name: getattr(config, f.name) for f in fields(config)}


class Annotation(NamedTuple):
    """What a field takes: its type, and its type with bounds."""

    kind: Any
    bounded: Any

    @property
    def separator(self) -> str | None:
        """What may stand between the entries of one text, if anything."""
        for note in getattr(self.bounded, "__metadata__", ()):
            if note.extra:
                return note.extra.get("separator")
        return None


@cache
def annotations(kind: type) -> dict[str, Annotation]:
    """Return what each field of a configuration takes, in order."""
    kinds, bounded = get_type_hints(kind), get_type_hints(kind, include_extras=True)
    return {f.name: Annotation(kinds[f.name], bounded[f.name]) for f in fields(kind)}


_KINDS = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "a text",
    Path: "a path",
}
_ENTRIES = {float: "numbers", int: "whole numbers", str: "texts"}
_COUNTS = {2: "two", 3: "three"}


def _native(value: Any) -> Any:
    """Return scalars and arrays of NumPy as Python's numbers and lists."""
    if isinstance(value, tuple | list):
        return [_native(entry) for entry in value]
    return value.tolist() if hasattr(value, "tolist") else value


def _is_traced(value: Any) -> bool:
    core = sys.modules.get("jax.core")
    entries = value if isinstance(value, tuple | list) else (value,)
    return core is not None and any(isinstance(entry, core.Tracer) for entry in entries)


def _path(kind: type, value: Any) -> Any:
    if kind is Path and isinstance(value, str | Path):
        return Path(value)
    raise TypeError(f"no path: {value!r}")


def _fits(value: Any, bounded: Any) -> bool:
    try:
        msgspec.convert(value, bounded, dec_hook=_path)
    except msgspec.ValidationError:
        return False
    return True


def _bounds(hint: Any) -> str:
    """Return in words the bounds of a type, which has some."""
    hint = sole(hint)
    if get_origin(hint) is Annotated and get_origin(get_args(hint)[0]) is not tuple:
        return _range(get_args(hint)[1])
    parts = get_args(get_args(hint)[0] if get_origin(hint) is Annotated else hint)
    count = "one or more" if parts[-1] is Ellipsis else _COUNTS[len(parts)]
    if get_origin(parts[0]) is not Annotated:
        return f"{count} {_ENTRIES[parts[0]]}"
    kind, note = get_args(parts[0])
    return f"{count} {_ENTRIES[kind]}, each {_range(note)}"


def _range(note: Meta) -> str:
    """Return the interval of a number in words."""
    low, high = (note.gt if note.ge is None else note.ge), (note.lt if note.le is None else note.le)
    if high is None and low == 0:
        return "positive" if note.ge is None else "zero or more"
    if high is None:
        return f"{'above' if note.ge is None else 'at least'} {low:g}"
    if low is None:
        return f"{'below' if note.le is None else 'at most'} {high:g}"
    if note.ge is None and note.le is None:
        return f"between {low:g} and {high:g}"
    if note.ge is not None and note.le is not None:
        return f"from {low} to {high}"
    left, right = "(" if note.ge is None else "[", ")" if note.le is None else "]"
    return f"in {left}{low:g}, {high:g}{right}"
