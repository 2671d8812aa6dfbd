"""Command line: ``jaxnav list | run | tune | filter | allan | doctor``.

Imports of JAX and the studies wait until a command needs them, so that help is immediate.
"""

import os
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from jaxnav.config import ConfigError, either, near, plain
from jaxnav.datasets.base import DataError
from jaxnav.findings import faults
from jaxnav.studies import STUDIES
from jaxnav.studies.base import StudyResult, require_x64

OK, BAD_INPUT, DIVERGED, FAULT, INTERRUPTED = 0, 2, 3, 4, 130

USAGE = """\
usage: jaxnav COMMAND [options]

A differentiable filter bank for aided inertial navigation.

commands:
  list          studies with their scenarios, filters, weight rules
  run STUDY     run a study; `jaxnav run STUDY --help` lists its parameters
  tune STUDY    tune a study's filters by gradient and judge them on runs held out; also a LOG
  filter LOG    a recorded drive through a filter or a bank; `jaxnav filter --help` lists options
  allan LOG     noise coefficients of an inertial sensor from a log at rest
  doctor        versions, devices, 64-bit floats, compilation cache

list, filter and tune take --from FILE: a Python file with filters or wrappers of your own.
run, tune, filter and allan take --config FILE.toml: their flags by name.

`jaxnav --version` prints the version.

exit codes: 0 done, 2 bad input, 3 some runs diverged, 4 a fault under --strict, 130 interrupted
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Args:
        argv: Arguments without the program's name; the default is those of the process.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        return _dispatch(arguments)
    except (ConfigError, DataError) as error:
        print(f"jaxnav: {error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("jaxnav: interrupted", file=sys.stderr)
        return INTERRUPTED


def _dispatch(arguments: list[str]) -> int:
    if arguments == ["--version"]:
        print(f"jaxnav {version('jaxnav')}")
        return OK
    if not arguments or arguments[0] in ("-h", "--help"):
        print(USAGE, end="")
        return OK if arguments else BAD_INPUT
    command, rest = arguments[0], arguments[1:]
    commands: dict[str, Callable[[list[str]], int]] = {
        "list": _list,
        "run": _run,
        "tune": _tune,
        "filter": _filter,
        "allan": _allan,
        "doctor": _doctor,
    }
    if command not in commands:
        raise ConfigError(f"there is no command {command!r}{near(command, commands)}")
    return commands[command](rest)


def _no_options(command: str, rest: list[str]) -> bool:
    """Return whether help was asked for; refuse anything else."""
    if rest and rest != ["--help"] and rest != ["-h"]:
        raise ConfigError(f"`jaxnav {command}` takes no options, not {' '.join(rest)!r}")
    return bool(rest)


def _with_own(rest: list[str]) -> list[str]:
    """Load the files behind ``--from``, and return the other arguments.

    Raises:
        ConfigError: If one is missing, or cannot be used.
    """
    others, paths = [], []
    waiting = iter(rest)
    for argument in waiting:
        if argument == "--from":
            paths.append(next(waiting, ""))
        elif argument.startswith("--from="):
            paths.append(argument.removeprefix("--from="))
        else:
            others.append(argument)
    for path in paths:
        from jaxnav.estimation.register import load

        try:
            load(Path(path))
        except ValueError as error:
            raise ConfigError(str(error)) from error
    return others


def _list(rest: list[str]) -> int:
    rest = _with_own(rest)
    if _no_options("list", rest):
        print("usage: jaxnav list [--from FILE]")
        return OK
    from jaxnav.report.catalogue import print_catalogue

    print_catalogue()
    return OK


def _doctor(rest: list[str]) -> int:
    if _no_options("doctor", rest):
        print("usage: jaxnav doctor")
        return OK
    configure_jax()
    from jaxnav.doctor import print_doctor

    print_doctor()
    return OK


def _run(rest: list[str]) -> int:
    if not rest or rest[0] in ("-h", "--help"):
        print(f"usage: jaxnav run STUDY [options]; STUDY is {either(STUDIES)}")
        return OK if rest else BAD_INPUT
    name, options = rest[0], rest[1:]
    if name not in STUDIES:
        raise ConfigError(f"there is no study {name!r}{near(name, STUDIES)}")
    study = STUDIES[name]
    from jaxnav.options import parse_run

    parsed = parse_run(name, study.load("config"), options)
    if parsed is None:
        return OK
    configure_jax(cache=parsed.cache)
    from jaxnav.report.console import Progress
    from jaxnav.report.study import print_json, print_result
    from jaxnav.results import claim_directory, write

    study.load("check")(parsed.config)
    directory = claim_directory(parsed.out)
    with Progress(quiet=parsed.json) as progress:
        results: list[StudyResult] = study.load("entry")(parsed.config, progress)
    draw = study.load("figures")
    for result in results:
        target = directory
        if len(results) > 1:
            target = claim_directory(directory / result.scenario)
        write(result, target)
        figures = draw(result, target)
        if not parsed.json:
            print_result(result, target, figures)
    if parsed.json:
        print_json(results)
    if any(result.diverged for result in results):
        return DIVERGED
    strict = getattr(parsed.config, "strict", False)
    return FAULT if strict and any(faults(result.audit) for result in results) else OK


def _tune(rest: list[str]) -> int:
    rest = _with_own(rest)
    if not rest or rest[0] in ("-h", "--help"):
        print(f"usage: jaxnav tune STUDY|LOG [options]; STUDY is {either(STUDIES)}")
        return OK if rest else BAD_INPUT
    name, options = rest[0], rest[1:]
    recorded = name not in STUDIES
    if recorded and not Path(name).exists():
        raise ConfigError(
            f"there is no study or log {name!r}{near(name, STUDIES)} or a recorded drive"
        )
    from jaxnav.options import parse_tune
    from jaxnav.recorded.config import FilterConfig

    study = None if recorded else STUDIES[name]
    parsed = parse_tune(
        name if study else "LOG", study.load("config") if study else FilterConfig, options
    )
    if parsed is None:
        return OK
    configure_jax(cache=parsed.cache)
    from jaxnav.report.console import Progress, print_document
    from jaxnav.report.tuning import print_parameters, print_tuning
    from jaxnav.results import claim_directory, finite_or_null, write_arrays, write_document
    from jaxnav.tuning.analysis import tune
    from jaxnav.tuning.figures import draw
    from jaxnav.tuning.selection import select

    require_x64()
    problem = study.load("tuning")(parsed.study) if study else _log_problem(name, parsed.study)
    if parsed.config.list:
        select(problem, parsed.config)
        print_parameters(problem.parameters)
        return OK
    directory = claim_directory(parsed.out)
    with Progress(quiet=parsed.json, unit="steps") as progress:
        report = tune(name, plain(parsed.study), problem, parsed.config, progress)
    write_arrays(report.arrays, directory / "tuning.npz")
    figures = draw(report, directory)
    write_document(report.document, directory / "summary.json")
    if parsed.json:
        print_document(finite_or_null(report.document))
    else:
        print_tuning(report.document, directory, figures)
    if report.document["diverged"]:
        return DIVERGED
    strict = getattr(parsed.study, "strict", False)
    return FAULT if strict and report.document["faults"] else OK


def _log_problem(path: str, config: Any) -> Any:
    from jaxnav.datasets.formats import load_drive
    from jaxnav.recorded.config import check
    from jaxnav.recorded.tuning import problem

    check(config)
    return problem(load_drive(Path(path)), config)


def _options_after_log(command: str, rest: list[str]) -> list[str] | None:
    """Return the arguments after the log, or those that ask for help; ``None`` if there are none.

    Raises:
        ConfigError: If an option stands where the log should.
    """
    if not rest:
        print(f"usage: jaxnav {command} LOG [options]; `jaxnav {command} --help` lists them")
        return None
    asked = rest[0] in ("-h", "--help")
    if rest[0].startswith("-") and not asked:
        raise ConfigError(f"the log is not given; it must come before the options, not {rest[0]!r}")
    return rest if asked else rest[1:]


def _filter(rest: list[str]) -> int:
    rest = _with_own(rest)
    options = _options_after_log("filter", rest)
    if options is None:
        return BAD_INPUT
    from jaxnav.options import parse_filter

    parsed = parse_filter(options)
    if parsed is None:
        return OK
    configure_jax(cache=parsed.cache)
    from jaxnav.datasets.formats import load_drive
    from jaxnav.recorded.analysis import analyse
    from jaxnav.recorded.config import check
    from jaxnav.recorded.figures import draw
    from jaxnav.recorded.outputs import write_trajectory
    from jaxnav.report.console import Progress, print_document
    from jaxnav.report.drive import print_filter
    from jaxnav.results import claim_directory, finite_or_null, write_document

    require_x64()
    check(parsed.config)
    log = load_drive(Path(rest[0]))
    directory = claim_directory(parsed.out)
    with Progress(quiet=parsed.json, unit="parts") as progress:
        report = analyse(log, parsed.config, progress)
    write_trajectory(report.drive, report.trajectory, report.members, log.source, directory)
    figures = draw(report, log, directory)
    write_document(report.document, directory / "summary.json")
    if parsed.json:
        print_document(finite_or_null(report.document))
    else:
        print_filter(report.document, directory, figures)
    if report.document["diverged"]:
        return DIVERGED
    return FAULT if parsed.config.strict and report.document["faults"] else OK


def _allan(rest: list[str]) -> int:
    options = _options_after_log("allan", rest)
    if options is None:
        return BAD_INPUT
    from jaxnav.options import parse_allan

    parsed = parse_allan(options)
    if parsed is None:
        return OK
    configure_jax(cache=parsed.cache)
    from jaxnav.noise_report.analysis import analyse, load
    from jaxnav.noise_report.figures import draw
    from jaxnav.report.console import print_document
    from jaxnav.report.noise import print_allan
    from jaxnav.results import claim_directory, finite_or_null, write_arrays, write_document

    require_x64()
    log = load(Path(rest[0]), parsed.config)
    directory = claim_directory(parsed.out)
    document, arrays = analyse(log, parsed.config)
    write_arrays(arrays, directory / "allan.npz")
    draw(arrays, parsed.config.confidence, directory / "allan.png")
    write_document(document, directory / "summary.json")
    if parsed.json:
        print_document(finite_or_null(document))
    else:
        print_allan(document, directory)
    return OK


def configure_jax(*, cache: bool = True) -> None:
    """Set JAX up for a process of our own: 64-bit floats and a cache of compiled programs.

    An explicit ``JAX_ENABLE_X64=0`` is left alone, so that a study can refuse it.

    Args:
        cache: Whether compiled programs are kept for the next process.
    """
    import jax

    from jaxnav import program_cache

    if "JAX_ENABLE_X64" not in os.environ:
        jax.config.update("jax_enable_x64", True)
    # Every result is waited for anyhow, and a single step need not wait for another thread.
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    folder = program_cache.prepared() if cache else None
    jax.config.update("jax_enable_compilation_cache", folder is not None)
    if folder is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        # Most programs take less than the second below which JAX keeps none, and are hundreds.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


def entry() -> None:
    """Console script: exit with the code of :func:`main`."""
    sys.exit(main())
