"""Strict settings for the whole suite: float64, no silent promotion, two host devices."""

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import pytest

from jaxnav import compiling
from jaxnav.cli import configure_jax
from jaxnav.datasets.base import DataError
from jaxnav.estimation.register import load

OPTIMISED = dict(compiling.OPTIONS)
QUICK = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 2)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Filters and wrappers of a file join the tables of laws: `pytest --from FILE`."""
    parser.addoption("--from", action="append", default=[], dest="own_files", metavar="FILE")


def pytest_configure(config: pytest.Config) -> None:
    """Share compiled programs within this run, a worker and its commands; not with another.

    Two workers that write one entry at once read halves of it.
    """
    worker = getattr(config, "workerinput", None)
    if worker is not None:
        os.environ["XDG_CACHE_HOME"] += f"/{worker['workerid']}"
    else:
        folder = tempfile.mkdtemp(prefix="jaxnav-tests-")
        config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))
        os.environ["XDG_CACHE_HOME"] = folder
    configure_jax()
    for path in config.getoption("own_files") or []:
        load(Path(path))


@pytest.fixture(autouse=True, scope="session")
def default_options() -> Iterator[None]:
    """Leave the optimiser out: a third of the time to compile, three times that to run.

    For the whole session, since what a module shares is made before any fixture of a test.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiling, "OPTIONS", OPTIMISED | QUICK)
        yield


@pytest.fixture
def optimised_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Asked for by tests of what rounding does, and by those that run more than they compile."""
    monkeypatch.setattr(compiling, "OPTIONS", OPTIMISED)


@pytest.fixture(scope="module")
def optimised_module() -> Iterator[None]:
    """The same for all of a module, what its tests share included."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiling, "OPTIONS", OPTIMISED)
        yield


@pytest.fixture(autouse=True, scope="module")
def programs_end_with_their_module() -> Iterator[None]:
    """Drop the compiled programs of a module after its last test.

    Each program on a CPU holds several memory mappings, and a process may hold 65,530 of them
    (`vm.max_map_count`): past that the compiler dies of a segmentation fault.
    """
    yield
    jax.clear_caches()


@pytest.fixture
def key() -> jax.Array:
    """A fixed random key."""
    return jax.random.key(20260101)


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Write lines to a file and return its path."""

    def to_file(*lines: str, name: str = "log.txt") -> Path:
        path = tmp_path / name
        path.write_text("\n".join(lines) + "\n")
        return path

    return to_file


@pytest.fixture
def refusal_by(write: Callable[..., Path]) -> Callable[..., Callable[..., str]]:
    """Return, for a reader, what writes a file, has it read and returns the refusal's sentence."""

    def by(load: Callable[[Path], Any]) -> Callable[..., str]:
        def of(*lines: str) -> str:
            path = write(*lines)
            with pytest.raises(DataError) as caught:
                load(path)
            message = str(caught.value)
            assert message.startswith(str(path))
            assert "accepted" in message
            assert "\n" not in message
            return message

        return of

    return by
