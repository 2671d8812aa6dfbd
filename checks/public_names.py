"""The public names of jaxnav: writes ``jaxnav/__init__.pyi``, the one list of them.

Usage: python checks/public_names.py

Filters, wrappers, banks and weight rules are those that ``jaxnav.estimation.register`` finds by
their types. What else is public stands here, by its home. The package reads its names from the
stub, and so do type checkers; a test fails when the stub is not what this script writes.
"""

from pathlib import Path

from jaxnav.estimation.register import entries

STUB = Path(__file__).parents[1] / "jaxnav" / "__init__.pyi"
OTHERS = {
    "estimation.banks.imm": ("imm_params", "uniform_switching"),
    "estimation.banks.mixture": ("BankParams",),
    "estimation.banks.reset": ("WindowedReset",),
    "estimation.banks.rule": ("WeightRule",),
    "estimation.banks.weights": ("Penalty",),
    "estimation.bounds": ("linearised_at_truth", "oracle"),
    "estimation.carried": ("CarriedParams", "carrying", "with_carried"),
    "estimation.filters.gated": ("Gate", "Gated"),
    "estimation.models": ("Channel", "ModelParams", "Process", "observing"),
    "estimation.montecarlo": ("RunOutput", "monte_carlo"),
    "estimation.run": ("run", "simulate"),
    "estimation.tune.fit": ("fit",),
    "estimation.tune.losses": ("negative_log_likelihood",),
    "estimation.types": (
        "Filter",
        "FilterParams",
        "Flag",
        "Gaussian",
        "Info",
        "Model",
        "Obs",
        "SureObs",
        "observed",
        "replicate",
    ),
    "numerics.discretise": ("discretise",),
}
"""Public names that are of no kind of the register, by the module below ``jaxnav``."""


def registered() -> dict[str, str]:
    """Return the home of each function of this package that the register finds, by its name."""
    homes = {name: entry.make.__module__ for name, entry in entries().items()}
    return {
        name: home.removeprefix("jaxnav.")
        for name, home in homes.items()
        if home.startswith("jaxnav.")
    }


def stub() -> str:
    """Return the text of the stub."""
    by_hand = ((home, name) for home, names in OTHERS.items() for name in names)
    found = ((home, name) for name, home in registered().items())
    lines = [f"from .{home} import {name} as {name}" for home, name in sorted({*by_hand, *found})]
    written = "# Written by `python checks/public_names.py`, not by hand."
    return "\n".join([written, *lines, "", "__all__: list[str]", "__version__: str", ""])


if __name__ == "__main__":
    STUB.write_text(stub())
    print(f"{STUB}: {stub().count(' as ')} names")
