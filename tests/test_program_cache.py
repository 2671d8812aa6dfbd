"""Compiled programs are kept between processes, within a bound, and nothing there is a failure."""

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from jaxnav import program_cache

PROGRAM = """
    import jax
    from jaxnav.cli import configure_jax
    seen = []
    jax.monitoring.register_event_listener(lambda event, **details: seen.append(event))
    configure_jax({options})
    import jax.numpy as jnp
    print(float(jax.jit(lambda x: jnp.sin(x) + 1)(2.0)))
    print(sum(event.endswith("cache_hits") for event in seen))
"""


def compute(home: Path, options: str = "") -> tuple[int, str]:
    """Compute in a process of its own; return how many programs it found, and what it warned of."""
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(PROGRAM.format(options=options))],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "XDG_CACHE_HOME": str(home)},
    )
    value, hits = done.stdout.split()
    assert float(value) == pytest.approx(1.9092974268)
    return int(hits), done.stderr


def entries(home: Path) -> list[Path]:
    return sorted((home / "jaxnav" / "xla").glob("*/*-cache"))


def test_small_programs_are_found_again_and_a_damaged_one_is_mended(tmp_path: Path) -> None:
    assert compute(tmp_path) == (0, "")
    kept = entries(tmp_path)
    assert len(kept) >= 1
    hits, told = compute(tmp_path)
    assert hits == len(kept)
    assert told == ""
    kept[0].write_bytes(kept[0].read_bytes()[:50])
    hits, told = compute(tmp_path)
    assert hits == len(kept) - 1
    assert "a damaged program" in told
    assert told.count("\n") == 1
    assert compute(tmp_path) == (len(kept), "")


def test_without_a_cache_nothing_is_written(tmp_path: Path) -> None:
    assert compute(tmp_path, "cache=False") == (0, "")
    assert entries(tmp_path) == []


def test_a_folder_that_cannot_be_written_is_a_warning(tmp_path: Path) -> None:
    (tmp_path / "jaxnav").write_text("a file where the folder should be")
    hits, told = compute(tmp_path)
    assert hits == 0
    assert "warning: compiled programs cannot be kept in" in told
    assert told.count("\n") == 1


def test_folders_of_other_versions_go_before_this_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    names = ("this", "older", "oldest")
    for age, name in enumerate(names):
        folder = program_cache.root() / name
        folder.mkdir(parents=True)
        (folder / "jit_f-cache").write_bytes(bytes(100))
        os.utime(folder, (1e9 - age, 1e9 - age))
    this = program_cache.root() / "this"
    program_cache.prune(this, 250, 250)
    assert [path.parent.name for path in entries(tmp_path)] == ["older", "this"]
    assert program_cache.size(program_cache.root()) == (2, 200)
    program_cache.prune(this, 250, 0)
    assert [path.parent.name for path in entries(tmp_path)] == ["this"]


def test_programs_longest_without_use_go_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    this = program_cache.root() / "this"
    this.mkdir(parents=True)
    for name, (read, written) in {"a": (30, 10), "b": (5, 20), "c": (10, 10)}.items():
        path = this / f"{name}-cache"
        path.write_bytes(bytes(100))
        os.utime(path, (1e9 + read, 1e9 + written))
    program_cache.prune(this, 300, 300)
    assert len(entries(tmp_path)) == 3
    program_cache.prune(this, 299, 300)
    assert [path.name for path in entries(tmp_path)] == ["a-cache", "b-cache"]
    program_cache.prune(this, 100, 300)
    assert [path.name for path in entries(tmp_path)] == ["a-cache"]
