"""What there is to filter with is found, not listed; so is what a file of one's own adds."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from jaxnav.cli import BAD_INPUT, OK, main
from jaxnav.config import ConfigError
from jaxnav.estimation import register
from jaxnav.estimation.register import BANK, FILTER, RULE, WRAPPER, by_kind, chain_of, load
from jaxnav.navigation.models.kinematic import constant_velocity
from jaxnav.recorded.config import ALIASES, FilterConfig, parts_of

ROOT = Path(__file__).parents[1]
OWN = ROOT / "examples" / "own_wrapper.py"


@pytest.fixture(autouse=True)
def only_the_library(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Files that a test loads are gone after it, and those of the command line before it."""
    monkeypatch.setattr(register, "_loaded", {})
    register.entries.cache_clear()
    yield
    monkeypatch.undo()
    register.entries.cache_clear()


def test_all_is_found_by_its_types() -> None:
    known = {kind: set(found) for kind, found in by_kind().items()}
    assert known[FILTER] == {
        *("kf", "ekf", "ukf", "ckf", "square_root_kf", "square_root_ekf", "square_root_ukf"),
        *("square_root_ckf", "iterated_ekf", "iterated_ckf", "modified_iterated_ckf"),
    }
    assert known[WRAPPER] == {
        *("versoria", "correntropy", "innovation_adaptive", "sage_husa", "gated")
    }
    assert known[BANK] == {"bank", "mmae", "immae", "imm", "panel"}
    assert known[RULE] == {
        *("fixed", "bayes", "penalty", "floor", "forget", "markov", "switch", "windowed_reset"),
        "chain",
    }
    for entries in by_kind().values():
        for entry in entries.values():
            assert entry.text
            assert "`" not in entry.text
            assert "FilterParams" not in entry.text


def test_every_filter_of_the_library_may_be_asked_for() -> None:
    """By its name, in wrappers, and by the short names that there were."""
    for name in by_kind()[FILTER]:
        assert parts_of(name) == (name,)
        for wrapper in by_kind()[WRAPPER]:
            assert parts_of(f"{wrapper}({name})") == (wrapper, name)
    assert parts_of("sage_husa( versoria(ekf) )") == ("sage_husa", "versoria", "ekf")
    for name, meant in ALIASES.items():
        assert parts_of(name) == chain_of(meant)
    assert parts_of(FilterConfig().filter) == ("ekf",)


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("ekff", "filter is 'ekff', but there is none of 'ekff', did you mean 'ekf'?"),
        ("versorai(ekf)", "there is none of 'versorai', did you mean 'versoria'?"),
        ("ekf(ekf)", "ekf is one of the filters; it can only stand innermost, as versoria(ekf)"),
        ("versoria", "versoria is one of the wrappers; it needs a filter inside, as versoria(ekf)"),
        ("mmae", "but mmae is one of the banks"),
        ("versoria(ekf, 3)", "it is not of that form"),
        ("versoria(iterations=3)", "it is not of that form"),
        ("ekf)", "it is not of that form"),
        ("", "it is not of that form"),
        ("__import__('os')", "there is none of '__import__'"),
    ],
)
def test_other_names_are_refused(name: str, sentence: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parts_of(name)
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_of_ones_own_is_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list"]) == OK
    assert "fading" not in capsys.readouterr().out
    assert main(["list", "--from", str(OWN)]) == OK
    assert "fading" in capsys.readouterr().out
    assert parts_of("fading(versoria(ekf))") == ("fading", "versoria", "ekf")


FILES = {
    "no file": (None, "is no file; --from takes a Python file"),
    "not Python": ("def (", "stops with SyntaxError"),
    "fails": ("1 / 0\n", "stops with ZeroDivisionError: division by zero"),
    "nothing in it": ("def helper(x: int) -> int:\n    return x\n", "has no filter, wrapper or"),
    "an exit": ("raise SystemExit(3)\n", "stops with SystemExit"),
    "types that are not there": (
        "def half(filter: 'Nothing') -> 'Nothing':\n    return filter\n",
        "the types of half cannot be read: name 'Nothing' is not defined",
    ),
    "a name that is taken": (
        "from jaxnav.estimation.types import Filter\n\n\n"
        "def versoria(filter: Filter) -> Filter:\n    return filter\n",
        "there is a 'versoria' already",
    ),
}


@pytest.mark.parametrize("case", FILES)
def test_files_that_cannot_be_used_are_refused(
    case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text, sentence = FILES[case]
    path = tmp_path / "own.py"
    if text is not None:
        path.write_text(text)
    assert main(["list", f"--from={path}"]) == BAD_INPUT
    said = capsys.readouterr().err
    assert sentence in said
    assert said.count("\n") == 1
    assert "versoria" in by_kind()[WRAPPER]


def test_what_makes_no_filter_is_named(tmp_path: Path) -> None:
    path = tmp_path / "own.py"
    head = "from jaxnav.estimation.types import Filter\n\n\n"
    path.write_text(
        head
        + "def nothing(filter: Filter) -> Filter:\n    pass\n\n\n"
        + "def needs(filter: Filter, *, k: int) -> Filter:\n    return filter\n"
    )
    assert load(path) == ["nothing", "needs"]
    model = constant_velocity(1)
    with pytest.raises(ValueError, match=r"^nothing returns NoneType; it must return a Filter$"):
        register.built(("nothing", "ekf"), model)
    with pytest.raises(ValueError, match=r"^needs stops with TypeError: needs"):
        register.built(("needs", "ekf"), model)


def test_a_file_is_loaded_once() -> None:
    assert load(OWN) == ["fading"] == load(OWN)


@pytest.mark.slow
def test_a_wrapper_of_ones_own_is_held_to_the_laws_of_all() -> None:
    options = ["--from", str(OWN), "-k", "fading", "-q", "tests/test_contracts.py"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-2000:]
    assert "passed" in done.stdout


@pytest.mark.slow
def test_a_sensor_of_ones_own_holds_the_height() -> None:
    """The example runs as it stands, in sixty lines."""
    path = ROOT / "examples" / "own_sensor.py"
    assert len(path.read_text().splitlines()) <= 60
    done = subprocess.run([sys.executable, str(path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    used, off = (float(line.split("off by ")[1].split()[0]) for line in done.stdout.splitlines())
    assert used < 0.5 * off
