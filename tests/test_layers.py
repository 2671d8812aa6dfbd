"""The order of dependence: a module imports only from the layers below it."""

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import jaxnav

ROOT = Path(jaxnav.__file__).parent

# From the ground up; a module may import from layers before its own and from its own folder's rank.
ORDER = (
    "units",
    "compiling",
    "program_cache",
    "numerics.products",
    "numerics.linalg",
    "numerics.conditioning",
    "numerics.roots",
    "numerics.lie",
    "numerics.se23",
    "numerics.sigma",
    "numerics.ode",
    "numerics.masks",
    "numerics.sequences",
    "numerics.discretise",
    "estimation.types",
    "estimation.models",
    "estimation.carried",
    "estimation.sampling",
    "estimation.checks",
    "estimation.debugging",
    "estimation.filters.innovation",
    "estimation.filters.linearise",
    "estimation.filters.wrapping",
    "estimation.filters.kalman",
    "estimation.filters.square_root",
    "estimation.filters.cloud",
    "estimation.filters.sigma_point",
    "estimation.filters.line_search",
    "estimation.filters.whitened",
    "estimation.filters.iterated",
    "estimation.filters.robust",
    "estimation.filters.adaptive",
    "estimation.filters.sage_husa",
    "estimation.filters.gated",
    "estimation.banks.log_weights",
    "estimation.banks.rule",
    "estimation.banks.weights",
    "estimation.banks.reset",
    "estimation.banks.mixture",
    "estimation.banks.imm",
    "estimation.register",
    "estimation.run",
    "estimation.montecarlo",
    "estimation.metrics",
    "estimation.bounds",
    "estimation.mismatch",
    "estimation.tune.transforms",
    "estimation.tune.losses",
    "estimation.tune.fit",
    "estimation.tune.inspect",
    "navigation.earth",
    "navigation.atmosphere",
    "navigation.limb",
    "navigation.stars",
    "navigation.strapdown.base",
    "navigation.strapdown.increments",
    "navigation.strapdown.launch_inertial",
    "navigation.strapdown.local_level",
    "navigation.alignment",
    "navigation.trajectory.base",
    "navigation.trajectory.rocket",
    "navigation.trajectory.boost",
    "navigation.trajectory.level",
    "navigation.trajectory.arc",
    "navigation.trajectory.vehicle",
    "navigation.sensors.imu",
    "navigation.sensors.allan",
    "navigation.sensors.noise_fit",
    "navigation.states",
    "navigation.channels.star",
    "navigation.channels.gnss",
    "navigation.channels.refraction",
    "navigation.channels.steered",
    "navigation.channels.wheel",
    "navigation.channels.rest",
    "navigation.channels.baseline",
    "navigation.channels.barometer",
    "navigation.channels.ground",
    "navigation.channels.magnetometer",
    "navigation.channels.ranges",
    "navigation.channels.free_fall",
    "navigation.models.kinematic",
    "navigation.models.sins_cns",
    "navigation.models.sins_total",
    "navigation.models.sins_rkcns",
    "navigation.models.sins_gnss",
    "navigation.models.vehicle",
    "navigation.sense",
    "datasets.base",
    "datasets.table",
    "datasets.plausible",
    "datasets.stamps",
    "datasets.inertial",
    "datasets.track",
    "datasets.rtklib",
    "datasets.drive",
    "datasets.rtk_drive",
    "datasets.comma2k19",
    "datasets.drive_csv",
    "datasets.formats",
    "datasets.stars",
    "datasets.make_stars",
    "findings",
    "studies.base",
    "studies",
    "plotting",
    "studies.tuned",
    "studies.attitude",
    "studies.attitude_figures",
    "studies.timing",
    "studies.immae.config",
    "studies.immae.simulation",
    "studies.immae.methods",
    "studies.immae.tuning",
    "studies.immae.claims",
    "studies.immae.study",
    "studies.immae.figures",
    "studies.mmae_ukf.config",
    "studies.mmae_ukf.simulation",
    "studies.mmae_ukf.methods",
    "studies.mmae_ukf.tuning",
    "studies.mmae_ukf.cost",
    "studies.mmae_ukf.sweep",
    "studies.mmae_ukf.claims",
    "studies.mmae_ukf.study",
    "studies.mmae_ukf.figures",
    "studies.rkcns.config",
    "studies.rkcns.simulation",
    "studies.rkcns.methods",
    "studies.rkcns.tuning",
    "studies.rkcns.cost",
    "studies.rkcns.ablations",
    "studies.rkcns.claims",
    "studies.rkcns.study",
    "studies.rkcns.figures",
    "studies.arekf.config",
    "studies.arekf.simulation",
    "studies.arekf.methods",
    "studies.arekf.tuning",
    "studies.arekf.sweep",
    "studies.arekf.analysis",
    "studies.arekf.cost",
    "studies.arekf.claims",
    "studies.arekf.study",
    "studies.arekf.figures",
    "studies.sage_husa.config",
    "studies.sage_husa.simulation",
    "studies.sage_husa.methods",
    "studies.sage_husa.tuning",
    "studies.sage_husa.claims",
    "studies.sage_husa.study",
    "studies.sage_husa.figures",
    "studies.gnss_track.config",
    "studies.gnss_track.study",
    "studies.gnss_track.tuning",
    "studies.gnss_track.figures",
    "results",
    "noise_report.config",
    "noise_report.rest",
    "noise_report.analysis",
    "noise_report.figures",
    "tuning.config",
    "tuning.selection",
    "tuning.analysis",
    "tuning.figures",
    "recorded.carry",
    "recorded.config",
    "recorded.motion",
    "recorded.start",
    "recorded.preparation",
    "recorded.methods",
    "recorded.scoring",
    "recorded.experiments",
    "recorded.turning",
    "recorded.offset",
    "recorded.audit",
    "recorded.tuning",
    "recorded.analysis",
    "recorded.outputs",
    "recorded.figures",
    "options",
    "report.console",
    "report.study",
    "report.tuning",
    "report.noise",
    "report.drive",
    "report.catalogue",
    "doctor",
    "cli",
    "__main__",
)
EDGES = {"matplotlib", "rich", "tyro"}
EDGE_MODULES = {"plotting", "report", "doctor", "options"}


@cache
def modules() -> dict[str, Path]:
    """Every module with code, by its dotted name below jaxnav."""
    found = {}
    for path in sorted(ROOT.rglob("*.py")):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        if name != "__init__":
            found[name] = path
    return found


@cache
def imports(path: Path) -> set[str]:
    """The modules a file imports, wherever in the file."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module}
            if node.module.startswith("jaxnav"):
                below = {f"{node.module}.{alias.name}" for alias in node.names}
                names |= {name for name in below if name.removeprefix("jaxnav.") in modules()}
    return names


def inside(path: Path) -> set[str]:
    return {name.removeprefix("jaxnav.") for name in imports(path) if name.startswith("jaxnav.")}


def only_documents(path: Path) -> bool:
    return len(ast.parse(path.read_text()).body) <= 1


def test_every_module_has_its_place() -> None:
    with_code = {name for name, path in modules().items() if not only_documents(path)}
    assert with_code == set(ORDER)


def test_modules_import_only_from_below() -> None:
    for name, path in modules().items():
        if name not in ORDER:
            continue
        allowed = set(ORDER[: ORDER.index(name)])
        packages = {other for other in modules() if other not in ORDER}
        late = inside(path) - allowed - packages
        # the catalogue names what the package holds, the registry loads its studies by name
        assert not late, f"{name} imports {sorted(late)}"


PHYSICS_SEES = {f"estimation.{part}" for part in ("types", "models", "carried")}


def test_the_wings_meet_in_what_models_are_made_of() -> None:
    for name, path in modules().items():
        seen = inside(path)
        if name.startswith("estimation"):
            assert not {other for other in seen if other.startswith("navigation")}, name
        if name.startswith("navigation"):
            crossing = {other for other in seen if other.startswith("estimation.")}
            assert crossing <= PHYSICS_SEES, name


def test_only_the_edges_touch_the_outside() -> None:
    for name, path in modules().items():
        outside = {other.split(".")[0] for other in imports(path)}
        if name not in EDGE_MODULES and not name.startswith("report."):
            assert not outside & EDGES, f"{name} imports {outside & EDGES}"


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
