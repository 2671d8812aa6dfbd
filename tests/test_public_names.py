"""One list of public names, written from the register, read by the package and type checkers."""

import subprocess
import sys
from pathlib import Path

import pytest

import jaxnav
from checks import public_names
from jaxnav.estimation.register import entries

ROOT = Path(jaxnav.__file__).parent
BY_HAND = [name for names in public_names.OTHERS.values() for name in names]


def in_a_new_process(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-500:]
    return done.stdout


def test_the_stub_is_what_the_script_writes() -> None:
    assert public_names.STUB.read_text() == public_names.stub(), "python checks/public_names.py"
    assert (ROOT / "__init__.pyi").read_text() == public_names.stub()


def test_what_the_register_finds_is_public_and_not_stated_again() -> None:
    found = public_names.registered()
    assert {"ekf", "gated", "imm", "switch"} <= set(found)
    assert set(found) <= set(jaxnav.__all__)
    assert not set(found) & set(BY_HAND)
    for name in found:
        assert getattr(jaxnav, name) is entries()[name].make


def test_public_names_exist_and_are_few() -> None:
    assert 20 <= len(BY_HAND) <= 35
    assert set(BY_HAND) < set(jaxnav.__all__)
    for name in jaxnav.__all__:
        assert getattr(jaxnav, name) is not None


def test_no_public_name_is_that_of_a_module() -> None:
    """Else importing the module would put it where the name was."""
    modules = {path.stem for path in ROOT.iterdir() if path.is_dir() or path.suffix == ".py"}
    assert {"estimation", "units"} <= modules
    assert not modules & set(jaxnav.__all__)


def test_modules_inside_are_reached_as_of_any_package() -> None:
    code = (
        "import jaxnav as jn; from jaxnav import estimation, units\n"
        "import jaxnav.estimation.run\n"
        "assert jn.estimation is estimation and jn.units is units\n"
        "assert jn.run is jn.estimation.run.run and jn.fit.__name__ == 'fit'\n"
        "import jaxnav.estimation.tune.fit\n"
        "assert callable(jn.run) and callable(jn.fit)\n"
    )
    in_a_new_process(code)


@pytest.mark.parametrize("statement", ["import jaxnav", "import jaxnav; jaxnav.__version__"])
def test_importing_the_package_waits_for_no_array_library(statement: str) -> None:
    code = f"{statement}\nimport sys; print({{'jax', 'numpy', 'scipy'}} & set(sys.modules))"
    assert in_a_new_process(code).strip() == "set()"


def test_a_star_import_brings_them_all() -> None:
    code = "from jaxnav import *; import jaxnav; print(set(jaxnav.__all__) - set(globals()))"
    assert in_a_new_process(code).strip() == "set()"
