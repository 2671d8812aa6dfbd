"""Options on the command line: every field of a configuration is a flag, also of a TOML file."""

import argparse
import shutil
from collections.abc import Mapping
from pathlib import Path
from types import NoneType
from typing import Any, Literal, NamedTuple, get_args, get_origin

from docstring_parser import parse as parse_docstring

from jaxnav.config import (
    Annotation,
    ConfigError,
    Setting,
    accepted,
    annotations,
    bounds,
    built,
    converted,
    from_table,
    near,
    read_toml,
    sole,
)
from jaxnav.noise_report.config import AllanConfig
from jaxnav.recorded.config import FilterConfig
from jaxnav.tuning.config import TuneConfig

STUDY = "study"
"""Table of a file, and begin of the flags, that are for what a tuning starts from."""


class Options(NamedTuple):
    """What a command was asked for; ``study`` is the configuration that a tuning starts from."""

    config: Any
    out: Path
    json: bool
    cache: bool
    study: Any = None


def parse_run(study: str, config: type, arguments: list[str]) -> Options | None:
    """Parse the options of ``jaxnav run STUDY``.

    Args:
        study: Name of the study.
        config: Its configuration class: every field is a flag.
        arguments: The arguments after the study's name.

    Returns:
        The options, or ``None`` if help was asked for and printed.

    Raises:
        ConfigError: With one sentence on what was wrong and what is accepted.
    """
    files = "summary.json, arrays.npz and the figures"
    return _parse(f"jaxnav run {study}", {"": config}, Path("results") / study, files, arguments)


def parse_allan(arguments: list[str]) -> Options | None:
    """Parse the options of ``jaxnav allan LOG``, those after the log; as :func:`parse_run`."""
    files = "summary.json, allan.npz and allan.png"
    out = Path("results") / "allan"
    return _parse("jaxnav allan LOG", {"": AllanConfig}, out, files, arguments)


def parse_filter(arguments: list[str]) -> Options | None:
    """Parse the options of ``jaxnav filter LOG``, those after the log; as :func:`parse_run`."""
    files = "summary.json, trajectory.csv, .npz and .kml, and the figures"
    out = Path("results") / "filter"
    return _parse("jaxnav filter LOG", {"": FilterConfig}, out, files, arguments)


def parse_tune(name: str, study: type, arguments: list[str]) -> Options | None:
    """Parse the options of ``jaxnav tune``, those after the study or the log; as :func:`parse_run`.

    Args:
        name: What stands for the study in the usage.
        study: The configuration class that the tuning starts from: every field is a flag that
            begins with ``--study.``, and ``--study.config`` is a file of them.
        arguments: The arguments after the study's name.
    """
    files = "summary.json, tuning.npz and the figures"
    out = Path("results") / "tune" / name.lower()
    return _parse(f"jaxnav tune {name}", {"": TuneConfig, STUDY: study}, out, files, arguments)


def _parse(
    program: str, parts: Mapping[str, type], out: Path, files: str, arguments: list[str]
) -> Options | None:
    """Parse the fields of configurations, their files, ``--out``, ``--json`` and ``--cache``."""
    parser = _parser(program, parts, out, files)
    words = _read(parser, _kinds(parts), arguments)
    if "help" in words:
        parser.print_help()
        return None
    configs = {name: _configured(name, kind, parts, words) for name, kind in parts.items()}
    out = converted("--out", Path, words.get("out", out))
    return Options(
        configs[""], out, words.get("json", False), words.get("cache", True), configs.get(STUDY)
    )


def _configured(part: str, kind: type, parts: Mapping[str, type], words: dict[str, Any]) -> Any:
    """Return the configuration of a part: flags, before its own file, before the whole one."""
    settings: dict[str, Setting] = {}
    whole = words.get("config")
    if whole is not None:
        table = read_toml(Path(whole))
        others = {name: table.pop(name, {}) for name in parts if name}
        own, file = (others[part], f"{whole}: [{part}]") if part else (table, whole)
        if not isinstance(own, dict):
            raise ConfigError(f"{whole}: {part} is {own!r}; it must be a table")
        settings |= from_table(kind, own, file)
    path = words.get(_dest(part, "config"))
    if part and path is not None:
        settings |= from_table(kind, read_toml(Path(path)), path)
    for name, annotation in annotations(kind).items():
        dest = _dest(part, name)
        if name == "config":
            settings[name] = Setting(path, _flag(dest))
        elif dest in words:
            settings[name] = Setting(_typed(_flag(dest), annotation, words[dest]), _flag(dest))
    return built(kind, settings)


def _typed(flag: str, annotation: Annotation, words: Any) -> Any:
    """Return what stands after a flag as the field's type.

    Raises:
        ConfigError: If it is of another type.
    """
    if NoneType in get_args(annotation.kind) and words in ("none", "None"):
        return None
    if words == ["none"]:
        return converted(flag, annotation.kind, [])
    if isinstance(words, list) and annotation.separator:
        words = [part.strip() for word in words for part in word.split(annotation.separator)]
        words = [word for word in words if word]
    kind = sole(annotation.kind)
    if isinstance(words, list):
        words = [_number(word, get_args(kind)[0]) for word in words]
    return converted(flag, annotation.kind, _number(words, kind))


def _number(word: Any, kind: Any) -> Any:
    """Return a text as a number where one is wanted, and it is one."""
    if kind not in (int, float):
        return word
    try:
        return kind(word)
    except ValueError:
        return word


def _dest(part: str, name: str) -> str:
    return f"{part}.{name}" if part else name


def _flag(dest: str) -> str:
    return "--" + dest.replace("_", "-")


def _kinds(parts: Mapping[str, type]) -> dict[str, Any]:
    """Return the type of each flag."""
    kinds: dict[str, Any] = {"out": Path, "json": bool, "cache": bool}
    for part, kind in parts.items():
        kinds[_dest(part, "config")] = Path
        kinds |= {_dest(part, name): note.kind for name, note in annotations(kind).items()}
    return {_flag(dest): kind for dest, kind in kinds.items()}


def _parser(
    program: str, parts: Mapping[str, type], out: Path, files: str
) -> argparse.ArgumentParser:
    """Return what collects the texts after each flag; what they mean is the configuration's."""
    parser = argparse.ArgumentParser(
        program,
        usage=f"{program} [options]",
        description=_first_line(parts[""]),
        formatter_class=_Formatter,
        argument_default=argparse.SUPPRESS,
        add_help=False,
        allow_abbrev=False,
        exit_on_error=False,
    )
    group = parser.add_argument_group("options")
    group.add_argument("-h", "--help", action="store_true", help="Show this message and end.")
    _add(group, "out", Path, f"Directory for {files}.", out)
    _add(group, "json", bool, "Print the summary as JSON instead of tables.", False)
    _add(group, "cache", bool, "Keep compiled programs for the next time.", True)
    for part, kind in parts.items():
        title = f"parameters of the {part}" if part else "parameters"
        group = parser.add_argument_group(title, _first_line(kind) if part else None)
        beside = f", and those of the {STUDY} in a table [{STUDY}]"
        about = f"TOML file with the names below{beside if not part and STUDY in parts else ''}"
        _add(group, _dest(part, "config"), Path, f"{about}; flags go before it.", None)
        texts = {
            p.arg_name: p.description or "" for p in parse_docstring(kind.__doc__ or "").params
        }
        for name, annotation in annotations(kind).items():
            if name != "config":
                dest, default = _dest(part, name), getattr(kind, name)
                _add(group, dest, annotation.kind, texts.get(name, ""), default, bounds(annotation))
    return parser


def _add(
    group: Any, dest: str, kind: Any, text: str, default: Any, domain: str | None = None
) -> None:
    """Add a flag to a group of the help."""
    shown = None if default in (None, ()) else f"default: {_shown(default)}"
    said = "; ".join(part for part in (domain, shown) if part)
    said = f" ({said})" if said else ""
    form = {"action": argparse.BooleanOptionalAction} if kind is bool else _values(kind)
    group.add_argument(_flag(dest), dest=dest, help=f"{text}{said}".replace("%", "%%"), **form)


def _read(
    parser: argparse.ArgumentParser, kinds: Mapping[str, Any], arguments: list[str]
) -> dict[str, Any]:
    """Return the texts after each flag that is there, by its field.

    Raises:
        ConfigError: If there is no such flag, or too few or too many texts after one.
    """
    # A number below zero is no flag; without the space -1e-3 would be taken for one.
    spaced = [f" {word}" if _is_negative(word) else word for word in arguments]
    try:
        words, rest = parser.parse_known_args(spaced)
    except argparse.ArgumentError as error:
        raise ConfigError(_miscounted(str(error.argument_name).split("/")[0], kinds)) from None
    if rest:
        word = rest[0].partition("=")[0].strip()
        hint = near(word, kinds).partition(";")[0]
        what = f"there is no flag {word!r}{hint}"
        if not word.startswith("--"):
            what = f"{word!r} belongs to no flag"
        raise ConfigError(f"{what}; `{parser.prog} --help` lists what is accepted")
    return {name: _stripped(value) for name, value in vars(words).items()}


def _miscounted(flag: str, kinds: Mapping[str, Any]) -> str:
    kind = kinds.get(flag, bool)
    if kind is bool:
        return f"{flag} is given a value; it must stand alone, as {flag} or --no-{flag[2:]}"
    several = isinstance(_values(kind).get("nargs"), int)
    few = "too few values" if several else "no value"
    return f"{flag} is given {few}; it must be {accepted(kind)}"


class _Formatter(argparse.HelpFormatter):
    def __init__(self, prog: str) -> None:
        width = min(shutil.get_terminal_size().columns, 100)
        super().__init__(prog, max_help_position=28, width=width)


def _first_line(kind: type) -> str:
    return (kind.__doc__ or "").splitlines()[0]


def _values(kind: Any) -> dict[str, Any]:
    """Return how many texts stand after the flag of a field, and what help calls them."""
    kind = sole(kind)
    if get_origin(kind) is Literal:
        return {"metavar": "{" + ",".join(get_args(kind)) + "}"}
    if get_origin(kind) is tuple:
        parts = get_args(kind)
        variadic = parts[-1] is Ellipsis
        return {"metavar": _METAVARS[parts[0]], "nargs": "+" if variadic else len(parts)}
    return {"metavar": _METAVARS[kind]}


_METAVARS = {int: "INT", float: "FLOAT", str: "TEXT", Path: "PATH"}


def _shown(default: Any) -> str:
    if isinstance(default, bool):
        return "yes" if default else "no"
    return " ".join(map(str, default)) if isinstance(default, tuple) else str(default)


def _is_negative(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return word.startswith("-")


def _stripped(words: Any) -> Any:
    if isinstance(words, list):
        return [word.strip() for word in words]
    return words.strip() if isinstance(words, str) else words
