"""Configurations: bounds at the field, one sentence a fault, whatever the values come from."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pytest
from docstring_parser import parse
from msgspec import Meta

from jaxnav.config import (
    ConfigError,
    FieldError,
    Positive,
    PositiveAxes,
    Positives,
    Share,
    annotations,
    bounds,
    check_fields,
    near,
    plain,
)
from jaxnav.noise_report.config import AllanConfig
from jaxnav.options import parse_allan, parse_filter, parse_run, parse_tune
from jaxnav.recorded.config import FilterConfig
from jaxnav.studies import STUDIES
from jaxnav.tuning.config import TuneConfig

CLASSES = [
    *(study.load("config") for study in STUDIES.values()),
    *(FilterConfig, TuneConfig, AllanConfig),
]


@dataclass(frozen=True)
class Example:
    """An example of each kind of field."""

    name: Literal["one", "two"] = "one"
    on: bool = False
    count: Annotated[int, Meta(ge=1, le=9)] = 1
    least: Annotated[int, Meta(ge=2)] = 2
    length: Positive = 1.0
    share: Share = 0.5
    below: Annotated[float, Meta(lt=3)] = 0.0
    maybe: Positive | None = None
    free: float = 0.0
    many: Positives = (1.0,)
    axes: PositiveAxes = (1.0, 1.0, 1.0)
    pair: tuple[float, float] = (0.0, 1.0)
    texts: tuple[str, ...] = ()
    path: Path | None = None

    def __post_init__(self) -> None:
        check_fields(self)


REFUSED = {
    "another choice": ({"name": "three"}, "name is three; it must be one of one, two"),
    "a number for yes": ({"on": 1}, "on is 1; it must be true or false"),
    "half a count": ({"count": 1.5}, "count is 1.5; it must be a whole number"),
    "a yes for a number": ({"length": True}, "length is True; it must be a number"),
    "text for a number": ({"length": "1"}, "length is '1'; it must be a number"),
    "above": ({"count": 10}, "count is 10; it must be from 1 to 9"),
    "under the least": ({"least": 1}, "least is 1; it must be at least 2"),
    "zero": ({"length": 0.0}, "length is 0.0; it must be positive"),
    "not a number": ({"length": float("nan")}, "length is nan; it must be positive"),
    "infinite": ({"length": float("inf")}, "length is inf; it must be finite"),
    "above one": ({"share": 1.5}, "share is 1.5; it must be in (0, 1]"),
    "at an open end": ({"below": 3.0}, "below is 3.0; it must be below 3"),
    "negative, if at all": ({"maybe": -1.0}, "maybe is -1.0; it must be positive"),
    "infinite without bounds": ({"free": -np.inf}, "free is -inf; it must be finite"),
    "nothing for a number": ({"free": None}, "free is None; it must be a number"),
    "one entry negative": (
        {"many": (1.0, -1.0)},
        "many is (1.0, -1.0); it must be one or more numbers, each positive",
    ),
    "no entry": ({"many": ()}, "many is (); it must be one or more numbers, each positive"),
    "a number for a list": ({"many": 1.0}, "many is 1.0; it must be a list of numbers"),
    "two of three": ({"axes": (1.0, 1.0)}, "axes is (1.0, 1.0); it must be three numbers"),
    "a negative axis": (
        {"axes": (1.0, 1.0, -1.0)},
        "axes is (1.0, 1.0, -1.0); it must be three numbers, each positive",
    ),
    "an infinite entry": ({"pair": (0.0, np.inf)}, "pair is (0.0, inf); it must be finite"),
    "one text": ({"texts": "a"}, "texts is 'a'; it must be a list of texts"),
    "a number for a path": ({"path": 3}, "path is 3; it must be a path"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_value_out_of_bounds_is_one_sentence(case: str) -> None:
    changes, sentence = REFUSED[case]
    with pytest.raises(FieldError) as caught:
        Example(**changes)
    assert str(caught.value) == sentence
    assert [caught.value.field] == list(changes)


def test_values_become_what_the_field_is() -> None:
    given = Example(
        length=2,
        many=[1, 2.5],  # pyright: ignore[reportArgumentType]
        axes=np.ones(3),  # pyright: ignore[reportArgumentType]
        count=np.int64(3),  # pyright: ignore[reportArgumentType]
        maybe=np.float32(0.5),  # pyright: ignore[reportArgumentType]
        path="a/b",  # pyright: ignore[reportArgumentType]
    )
    same = Example(length=2.0, many=(1.0, 2.5), count=3, maybe=0.5, path=Path("a/b"))
    assert given == same
    assert [type(value) for value in plain(given).values()] == [
        type(value) for value in plain(same).values()
    ]


@pytest.mark.parametrize("kind", CLASSES)
def test_every_field_says_what_it_is_and_takes_its_default(kind: type) -> None:
    texts = {entry.arg_name: entry.description for entry in parse(kind.__doc__ or "").params}
    assert list(texts) == list(annotations(kind))
    assert all(texts.values())
    assert plain(kind()) == {name: getattr(kind, name) for name in annotations(kind)}
    words = [bounds(annotation) for annotation in annotations(kind).values()]
    assert any(words)


def toml_of(value: Any) -> str:
    """A value as TOML writes it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(map(toml_of, value))}]"
    return repr(str(value)) if isinstance(value, str | Path) else repr(value)


def table(config: Any) -> list[str]:
    """The lines of a file that says all of a configuration."""
    values = plain(config).items()
    return [f"{name} = {toml_of(value)}" for name, value in values if value is not None]


@pytest.mark.parametrize("name", STUDIES)
def test_a_file_says_what_flags_say(name: str, write: Callable[..., Path]) -> None:
    kind = STUDIES[name].load("config")
    changed = replace(kind(), seed=7)
    path = write(*table(changed), name="all.toml")
    parsed = parse_run(name, kind, ["--config", str(path)])
    assert parsed is not None
    assert parsed.config == changed
    parsed = parse_run(name, kind, ["--seed", "8", "--config", str(path)])
    assert parsed is not None
    assert parsed.config == replace(changed, seed=8)
    path = write("steps = 3", "[study]", *table(changed), name="tune.toml")
    for flags in (("--config", str(path)), ("--config", str(path), "--study.seed", "7")):
        parsed = parse_tune(name, kind, list(flags))
        assert parsed is not None
        assert parsed.config == TuneConfig(steps=3)
        assert parsed.study == changed
    path = write(*table(changed), name="study.toml")
    parsed = parse_tune(name, kind, ["--study.config", str(path), "--params", "a, b", "c"])
    assert parsed is not None
    assert parsed.config == TuneConfig(params=("a", "b", "c"))
    assert parsed.study == changed


def test_flags_take_numbers_below_zero_lists_and_none(write: Callable[..., Path]) -> None:
    path = write("rate_hz = 20", "gate = false", "carry = ['time-offset']", name="bank.toml")
    flags = "--axle-m -1e-3 2 -.5 --time-offset-s=-1e-2 --carry lever-arm,mounting --carry=mounting"
    parsed = parse_filter([*flags.split(), "--rate-hz", "none", "--config", str(path)])
    assert parsed is not None
    expected = FilterConfig(
        config=path,
        axle_m=(-0.001, 2.0, -0.5),
        time_offset_s=-0.01,
        carry=("mounting",),
        gate=False,
    )
    assert parsed.config == expected
    assert (parsed.out, parsed.json, parsed.cache) == (Path("results/filter"), False, True)
    parsed = parse_filter(["--config", str(path), "--carry", "none"])
    assert parsed is not None
    assert parsed.config.carry == ()
    parsed = parse_allan(["--out", "there", "--json", "--no-cache", "--end-s", "9"])
    assert parsed is not None
    assert parsed.config == AllanConfig(end_s=9.0)
    assert (parsed.out, parsed.json, parsed.cache) == (Path("there"), True, False)


FILES = {
    "a name with a slip": ("confidense = 0.9", "there is no 'confidense', did you mean 'confide"),
    "out of bounds": ("confidence = 2", "one.toml: confidence is 2.0; it must be between 0 and 1"),
    "another type": ("per_octave = '3'", "one.toml: per_octave is '3'; it must be a whole number"),
    "several at once": ("start_s = 9.0\nend_s = 3", "one.toml: end_s is 3.0; it must be after sta"),
    "a table": ("[study]\nseed = 1", "one.toml: there is no 'study'; it must be one of start_s"),
}


@pytest.mark.parametrize("case", FILES)
def test_a_fault_of_a_file_names_file_and_key(case: str, write: Callable[..., Path]) -> None:
    line, sentence = FILES[case]
    path = write(*line.splitlines(), name="one.toml")
    with pytest.raises(ConfigError) as caught:
        parse_allan(["--config", str(path)])
    assert sentence in str(caught.value)
    assert str(caught.value).startswith(str(path))


FLAGS = {
    "a slip": ("--confidense 0.9", "there is no flag '--confidense', did you mean '--confidence';"),
    "no value": ("--confidence", "--confidence is given no value; it must be a number"),
    "two values": ("--confidence 0.9 0.8", "'0.8' belongs to no flag; `jaxnav allan LOG --help`"),
    "a value for a switch": ("--json=3", "--json is given a value; it must stand alone, as --json"),
    "part of a flag": ("--conf 0.9", "there is no flag '--conf'"),
    "of several at once": ("--start-s 9 --end-s 3", "--end-s is 3.0; it must be after start_s"),
}


def test_a_list_without_entries_is_no_default() -> None:
    """``--params`` alone would tune all of them."""
    kind = STUDIES["immae"].load("config")
    for flags, sentence in (
        (["--params"], "--params is given no value; it must be a list of texts"),
        (["--study.theta", "--steps", "3"], "--study.theta is given no value; it must be a list"),
        (["--study.initial-misalignment-arcsec", "1"], "is given too few values; it must be three"),
    ):
        with pytest.raises(ConfigError, match=sentence):
            parse_tune("immae", kind, flags)


@pytest.mark.parametrize("case", FLAGS)
def test_a_fault_of_a_flag_names_it(case: str) -> None:
    flags, sentence = FLAGS[case]
    with pytest.raises(ConfigError) as caught:
        parse_allan(flags.split())
    assert str(caught.value).startswith(sentence)
    assert "\n" not in str(caught.value)


def test_a_table_of_a_study_must_be_one(write: Callable[..., Path]) -> None:
    kind = STUDIES["immae"].load("config")
    for line, sentence in (
        ("study = 3", "study is 3; it must be a table"),
        ("[study]\nruns = 0", r"\[study\]: runs is 0; it must be from 1 to 1000000000"),
    ):
        path = write(*line.splitlines(), name="tune.toml")
        with pytest.raises(ConfigError, match=sentence):
            parse_tune("immae", kind, ["--config", str(path)])


def test_the_nearest_name_is_told() -> None:
    names = ("mmae-ukf", "immae")
    assert near("MMAE_UKF", names) == ", did you mean 'mmae-ukf'; it must be one of mmae-ukf, immae"
    assert near("zebra", names) == "; it must be one of mmae-ukf, immae"
