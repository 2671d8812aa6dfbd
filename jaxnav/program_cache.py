"""The compiled programs that are kept between processes: where, how many, and what spoils them.

JAX keeps programs in a folder if it is given one, by default only those that took a second to
compile, and without a bound. A study has many that take less: here all are kept, in a folder of
their own for each jax, jaxlib and kind of processor. When a process begins, what is longest without
use goes: programs while that folder takes more than :data:`LIMIT_BYTES`, and folders of other
versions while all together take more than :data:`TOTAL_BYTES`. JAX could hold the bound at all
times, but looks at every file of the folder whenever it adds one: with the thousands of a few
studies that takes longer than to compile.
"""

import hashlib
import os
import platform
import shutil
import sys
import tempfile
import warnings
from importlib.metadata import version
from pathlib import Path
from typing import Any

LIMIT_BYTES = 256 * 2**20
"""What the programs of one version and processor may take on disk."""
TOTAL_BYTES = 2 * LIMIT_BYTES
"""What those of all together may take."""
_SPOILED = "Error reading persistent compilation cache entry for"


def root() -> Path:
    """Return the folder that holds the programs of all versions and processors."""
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return home / "jaxnav" / "xla"


def folder() -> Path:
    """Return the folder for this jax, jaxlib and processor."""
    versions = "-".join(f"{name}-{version(name)}" for name in ("jax", "jaxlib"))
    return root() / f"{versions}-{platform.machine()}-{_processor()}"


def _processor() -> str:
    """Return a short name for the instructions that a program compiled here may use."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        features = next(line for line in lines if line.lower().startswith(("flags", "features")))
    except (OSError, StopIteration):
        features = platform.processor()
    return hashlib.sha256(features.encode()).hexdigest()[:8]


def prepared() -> Path | None:
    """Return the folder for JAX to keep programs in, which it was told of or :func:`folder`.

    A folder that cannot be written is warned of on standard error, and programs are then compiled
    anew. From here on, an entry that cannot be read is told of, removed and compiled anew.

    Returns:
        The folder, or ``None`` if there is none to write to.
    """
    given = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    chosen = Path(given) if given else folder()
    try:
        chosen.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=chosen):
            pass
        if not given:
            prune(chosen, LIMIT_BYTES, TOTAL_BYTES)
    except OSError as error:
        _tell(f"compiled programs cannot be kept in {chosen} ({error.strerror}), so each")
        return None
    _remove_spoiled_entries(chosen)
    return chosen


def size(top: Path) -> tuple[int, int]:
    """Return the number of programs below a folder and what they take [bytes]."""
    sizes = [path.stat().st_size for path in top.glob("**/*-cache")]
    return len(sizes), sum(sizes)


def prune(kept: Path, limit_bytes: int, total_bytes: int) -> None:
    """Remove what is longest without use until folders take no more than they may.

    Args:
        kept: The folder in use, which stays and loses programs.
        limit_bytes: What it may take.
        total_bytes: What all may take; other folders go whole.
    """
    stats = {path: path.stat() for path in kept.glob("*-cache")}
    taken = sum(stat.st_size for stat in stats.values())
    for path, stat in sorted(stats.items(), key=lambda item: _used(item[1])):
        if taken <= limit_bytes:
            break
        taken -= stat.st_size
        path.unlink(missing_ok=True)
    others = [path for path in root().iterdir() if path.is_dir() and path != kept]
    total = size(root())[1]
    for path in sorted(others, key=lambda path: path.stat().st_mtime):
        if total <= total_bytes:
            return
        total -= size(path)[1]
        shutil.rmtree(path, ignore_errors=True)


def _used(stat: os.stat_result) -> float:
    """Return when a file was last read, which some systems do not note, or written."""
    return max(stat.st_atime, stat.st_mtime)


def _remove_spoiled_entries(chosen: Path) -> None:
    """Remove an entry when JAX warns that it cannot be read: it would never write it anew."""
    show = warnings.showwarning

    def removing(message: Warning | str, *details: Any, **more: Any) -> None:
        text = str(message)
        if not text.startswith(_SPOILED):
            show(message, *details, **more)
            return
        name = text.removeprefix(_SPOILED).split("'")[1]
        for path in chosen.glob(f"{name}-*-cache"):
            path.unlink(missing_ok=True)
        _tell(f"a damaged program, {name}, was removed from {chosen} and")

    warnings.showwarning = removing


def _tell(what: str) -> None:
    print(f"jaxnav: warning: {what} is compiled anew", file=sys.stderr)
