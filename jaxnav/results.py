"""Results on disk: JSON (schema 1) and arrays, each complete or not there; the view as xarray."""

import json
import math
import os
import platform
import tempfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.config import ConfigError
from jaxnav.findings import document_of, faults
from jaxnav.studies.base import StudyResult

SCHEMA = 1


def summary(result: StudyResult) -> dict[str, Any]:
    """Return the contents of ``summary.json``: numbers that are not finite become ``null``."""
    return finite_or_null(
        {
            "schema": SCHEMA,
            "study": result.study,
            "scenario": result.scenario,
            "runs": result.runs,
            "seed": result.seed,
            "config": result.config,
            "provenance": provenance(),
            "methods": result.methods,
            "published": result.published,
            "claims": [vars(claim) for claim in result.claims],
            "audit": document_of(result.audit),
            "faults": faults(result.audit),
            "notes": result.notes,
        }
    )


def provenance() -> dict[str, Any]:
    """Return the versions and the machine a result comes from."""
    import jax

    packages = ("jaxnav", "jax", "jaxlib", "numpy", "scipy", "optax")
    return {
        **{name: version(name) for name in packages},
        "python": platform.python_version(),
        "machine": platform.machine(),
        "devices": [str(device) for device in jax.local_devices()],
        "x64": jax.numpy.result_type(float) == "float64",
    }


def finite_or_null(value: Any) -> Any:
    """Return a document as plain data, numbers that are not finite replaced by ``None``."""
    if isinstance(value, dict):
        return {str(key): finite_or_null(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite_or_null(item) for item in value]
    if isinstance(value, np.ndarray):
        return finite_or_null(value.tolist())
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def claim_directory(directory: Path) -> Path:
    """Create the output directory and prove that it can be written, before any work is done.

    Raises:
        ConfigError: If it cannot be created or written.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            pass
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise ConfigError(
            f"the output directory {directory} is not usable ({reason}); "
            "it must be a directory that can be written"
        ) from error
    return directory


def write(result: StudyResult, directory: Path) -> Path:
    """Write ``summary.json`` and ``arrays.npz``; each file is complete or not there.

    Returns:
        The path of ``summary.json``.
    """
    document = summary(result)
    write_arrays(result.arrays, directory / "arrays.npz")
    return write_document(document, directory / "summary.json")


def write_document(document: dict[str, Any], path: Path) -> Path:
    """Write a document as JSON; the file is complete or not there. Return its path."""
    return write_text(json.dumps(finite_or_null(document), indent=2, allow_nan=False) + "\n", path)


def write_text(text: str, path: Path) -> Path:
    """Write a text in UTF-8; the file is complete or not there. Return its path."""
    return _replace(path, lambda beside: beside.write_text(text, encoding="utf-8"))


def write_arrays(arrays: dict[str, Any], path: Path) -> Path:
    """Write arrays by name as compressed ``.npz``, complete or not there. Return the path."""
    return _replace(path, lambda beside: _save_arrays(beside, arrays))


def _save_arrays(path: Path, arrays: dict[str, Any]) -> None:
    with path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def _replace(path: Path, save: Any) -> Path:
    """Write beside the target and move over it, so that a reader never sees half a file."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        save(temporary)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    return path


def to_xarray(result: StudyResult) -> Any:
    """Return the arrays of a result as an ``xarray.Dataset`` with named axes.

    Needs the extra ``jaxnav[xarray]``.

    Raises:
        ModuleNotFoundError: If xarray is not installed.
    """
    try:
        import xarray
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "xarray is not installed; install jaxnav[xarray] for to_xarray"
        ) from error
    named = {name: (dims, result.arrays[name]) for name, dims in result.dims.items()}
    axes = {axis for dims in result.dims.values() for axis in dims}
    coordinates = {axis: result.arrays[axis] for axis in axes if axis in result.arrays}
    variables = {name: entry for name, entry in named.items() if name not in coordinates}
    attributes = {"study": result.study, "scenario": result.scenario, "runs": result.runs}
    return xarray.Dataset(variables, coords=coordinates, attrs=attributes)
