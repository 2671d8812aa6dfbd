"""The order of dependence, and what else holds of every file.

Who may import whom is stated in ``pyproject.toml`` as contracts, by folder.
"""

import ast
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

from importlinter.api import read_configuration
from importlinter.cli import lint_imports

import jaxnav

ROOT = Path(jaxnav.__file__).parent
CONTRACTS = Path(__file__).parents[1] / "pyproject.toml"


@cache
def modules() -> dict[str, Path]:
    """Every module with code, by its dotted name below jaxnav."""
    found = {}
    for path in sorted(ROOT.rglob("*.py")):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        if name != "__init__":
            found[name] = path
    return found


def only_documents(path: Path) -> bool:
    return len(ast.parse(path.read_text()).body) <= 1


# An import that each contract of pyproject.toml refuses, by the file that gets it.
REFUSED = {
    "units": "jaxnav.numerics.lie",
    "estimation/types": "jaxnav.estimation.filters.kalman",
    "estimation/run": "jaxnav.navigation.earth",
    "navigation/earth": "jaxnav.navigation.sense",
    "navigation/stars": "jaxnav.estimation.metrics",
    "studies/__init__": "jaxnav.studies.base",
    "studies/immae/config": "jaxnav.studies.immae.study",
    "studies/arekf/methods": "jaxnav.studies.rkcns.config",
    "tuning/config": "jaxnav.tuning.figures",
    "numerics/masks": "matplotlib.pyplot",
    "numerics/products": "jaxnav.numerics.lie",
    "datasets/base": "jaxnav",
}


def test_imports_keep_to_the_contracts() -> None:
    assert lint_imports(str(CONTRACTS), no_cache=True, no_logo=True) == 0, "see the output"


def test_each_contract_refuses_something(tmp_path: Path) -> None:
    """Also where the import stands in a function."""
    shutil.copytree(ROOT, tmp_path / "jaxnav", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(CONTRACTS, tmp_path)
    for name, refused in REFUSED.items():
        with (tmp_path / "jaxnav" / f"{name}.py").open("a") as file:
            file.write(f"\n\ndef late():\n    import {refused}\n")
    code = "from importlinter.cli import lint_imports; lint_imports(no_cache=True, no_logo=True)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path
    )
    contracts = len(read_configuration(str(CONTRACTS))["contracts_options"])
    assert f"Contracts: 0 kept, {contracts} broken." in done.stdout, done.stdout + done.stderr


def test_folders_only_document_themselves() -> None:
    """Else importing one file of a folder would import the others, whatever their order."""
    folders = {name for name, path in modules().items() if path.stem == "__init__"}
    assert "estimation" in folders
    assert {name for name in folders if not only_documents(modules()[name])} == {"studies"}


def test_jit_appears_where_time_or_runs_are_driven() -> None:
    drivers = (
        "estimation.run",
        "estimation.montecarlo",
        "estimation.tune",
        "navigation.trajectory",
        "navigation.atmosphere",
        "navigation.limb",
        "numerics.linalg",  # the home of `kernel`
    )
    for name, path in modules().items():
        if name.startswith(("numerics", "estimation", "navigation")) and not name.startswith(
            drivers
        ):
            text = path.read_text()
            assert "jax.jit" not in text, name
            assert "import compiled" not in text, name


def test_the_library_leaves_the_configuration_of_jax_alone() -> None:
    for name, path in modules().items():
        calls = [
            ast.unparse(node.func)
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.Call)
        ]
        assert name == "cli" or "jax.config.update" not in calls, name


def test_imports_start_no_backend_and_make_no_array() -> None:
    """Else 64 bits that are switched on after an import would find arrays of 32."""
    names = [name for name in modules() if not name.endswith("__main__")]
    code = (
        "import importlib, sys; from jax._src import xla_bridge\n"
        "for name in sys.argv[1:]:\n"
        "    importlib.import_module(f'jaxnav.{name}')\n"
        "    assert not xla_bridge.backends_are_initialized(), name\n"
    )
    done = subprocess.run([sys.executable, "-c", code, *names], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-500:]


def test_files_stay_within_four_hundred_lines() -> None:
    for name, path in modules().items():
        assert len(path.read_text().splitlines()) <= 400, name
