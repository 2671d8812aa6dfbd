"""The state of the installation, as ``jaxnav doctor`` prints it."""

from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import jax
from rich.console import Console
from rich.table import Table

from jaxnav import program_cache
from jaxnav.compiling import OPTIONS, accepted_options, cores
from jaxnav.results import provenance


def print_doctor() -> None:
    """Print versions, devices, precision, compiler options and the cache of compiled programs."""
    console = Console()
    table = Table(title="jaxnav doctor", show_header=False)
    for name, value in provenance().items():
        table.add_row(name, ", ".join(value) if isinstance(value, list) else str(value))
    table.add_row("cores", str(cores()))
    accepted = accepted_options()
    for name, value in OPTIONS.items():
        shown = str(value) if name in accepted else "not known to this jaxlib, left out"
        table.add_row(f"compiler option {name}", shown)
    kept = jax.config.values["jax_compilation_cache_dir"]
    if kept and jax.config.values["jax_enable_compilation_cache"]:
        count, size = program_cache.size(Path(kept))
        table.add_row("compiled programs", str(kept))
        limit = f"at most {program_cache.LIMIT_BYTES / 2**20:.0f} MiB"
        table.add_row("", f"{count} of them, {size / 2**20:.1f} MiB; {limit}")
    else:
        table.add_row("compiled programs", "not kept")
    table.add_row("peers for benchmarks", _peers())
    console.print(table)


def _peers() -> str:
    found = []
    for name in ("cuthbert", "dynamax", "filterpy", "smcx"):
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return ", ".join(found) or "none installed (jaxnav[peers])"
