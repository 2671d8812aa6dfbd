"""Options on the command line, made from configuration classes by tyro."""

import contextlib
import io
import re
from dataclasses import field, make_dataclass
from pathlib import Path
from typing import Any, NamedTuple

import tyro

from jaxnav.noise_report.config import AllanConfig
from jaxnav.recorded.config import FilterConfig, from_toml
from jaxnav.studies.base import ConfigError
from jaxnav.tuning.config import TuneConfig


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
    return _parse(f"jaxnav run {study}", config, Path("results") / study, files, arguments)


def parse_allan(arguments: list[str]) -> Options | None:
    """Parse the options of ``jaxnav allan LOG``, those after the log; as :func:`parse_run`."""
    files = "summary.json, allan.npz and allan.png"
    return _parse("jaxnav allan LOG", AllanConfig, Path("results") / "allan", files, arguments)


def parse_filter(arguments: list[str]) -> Options | None:
    """Parse the options of ``jaxnav filter LOG``, those after the log; as :func:`parse_run`.

    The values of the file behind ``--config`` stand where no flag is given.
    """
    files = "summary.json, trajectory.csv, .npz and .kml, and the figures"
    path = _value_of("--config", arguments)
    default = FilterConfig() if path is None else from_toml(Path(path))
    program, out = "jaxnav filter LOG", Path("results") / "filter"
    return _parse(program, FilterConfig, out, files, arguments, default)


def parse_tune(name: str, study: type, arguments: list[str]) -> Options | None:
    """Parse the options of ``jaxnav tune``, those after the study or the log; as :func:`parse_run`.

    Args:
        name: What stands for the study in the usage.
        study: The configuration class that the tuning starts from: every field is a flag that
            begins with ``--study.``, and of a recorded log ``--study.config`` is a file of them.
        arguments: The arguments after the study's name.
    """
    files = "summary.json, tuning.npz and the figures"
    program, out = f"jaxnav tune {name}", Path("results") / "tune" / name.lower()
    path = _value_of("--study.config", arguments) if study is FilterConfig else None
    given = study() if path is None else from_toml(Path(path))
    return _parse(program, TuneConfig, out, files, arguments, study=given)


def spread(arguments: list[str], flag: str) -> list[str]:
    """Return arguments with the values of a flag that stand between commas apart."""
    found, listing = [], False
    for argument in arguments:
        if argument.startswith(f"{flag}="):
            found += [flag, *_apart(argument.removeprefix(f"{flag}="))]
        elif listing and not argument.startswith("-"):
            found += _apart(argument)
        else:
            found.append(argument)
            listing = argument == flag
    return found


def _apart(listed: str) -> list[str]:
    return [name.strip() for name in listed.split(",") if name.strip()]


def _value_of(flag: str, arguments: list[str]) -> str | None:
    """Return the last value of a flag, as ``--flag value`` or ``--flag=value``."""
    found = None
    for i, argument in enumerate(arguments):
        if argument == flag and i + 1 < len(arguments):
            found = arguments[i + 1]
        elif argument.startswith(f"{flag}="):
            found = argument.removeprefix(f"{flag}=")
    return found


def _parse(
    program: str,
    config: type,
    out: Path,
    files: str,
    arguments: list[str],
    default: Any = None,
    study: Any = None,
) -> Options | None:
    """Parse the fields of a configuration, ``--out``, ``--json``, ``--cache``, and a study's.

    ``default`` and ``study`` hold the values where no flag is given.
    """
    given = config() if default is None else default
    parts: list[Any] = [
        ("config", tyro.conf.OmitArgPrefixes[config], field(default=given)),
        ("out", Path, field(default=out)),
        ("json", bool, field(default=False)),
        ("cache", bool, field(default=True)),
    ]
    if study is not None:
        parts.append(("study", type(study), field(default=study)))
    options = make_dataclass("Options", parts, frozen=True)
    options.__doc__ = (
        f"{(config.__doc__ or program).splitlines()[0]}\n\n"
        "Attributes:\n"
        "    config: Parameters.\n"
        f"    out: Directory for {files}.\n"
        "    json: Print the summary as JSON instead of tables.\n"
        "    cache: Keep compiled programs for the next time.\n"
        "    study: What the tuning starts from.\n"
    )
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            parsed: Any = tyro.cli(options, prog=program, args=arguments)
    except SystemExit as stop:
        if not stop.code:
            print(said.getvalue(), end="")
            return None
        raise ConfigError(_sentence(said.getvalue(), program)) from None
    return Options(
        parsed.config, parsed.out, parsed.json, parsed.cache, getattr(parsed, "study", None)
    )


def _sentence(box: str, program: str) -> str:
    """Return the message inside tyro's error box as one sentence."""
    lines = [line.strip("│╭╮╰╯ ") for line in box.splitlines()]
    body = [line for line in lines if line][1:]
    # On a terminal without box characters the title has a rule of hyphens under it.
    rules = [i for i, line in enumerate(body) if set(line) <= set("─-")]
    body = body[1:] if rules[:1] == [0] else body
    end = next((i for i, line in enumerate(body) if set(line) <= set("─-")), len(body))
    text = " ".join(body[:end]).rstrip(".")
    flag = re.match(r"Error parsing (--[\w-]+): .*?'([^']*)'$", text)
    if flag:
        kind = re.search(rf"{flag[1]} ([^ ]+)", " ".join(body[end:]))
        return f"{flag[1]} is {flag[2]!r}; it must be of type {kind[1] if kind else 'number'}"
    text = re.sub(r"^Error parsing \w+: ", "", text)
    if text.startswith("Unrecognized options"):
        return f"{text[0].lower()}{text[1:]}; `{program} --help` lists what is accepted"
    return text
