"""How do time and memory of a whole study grow with the number of runs?

The study ``immae`` in its linear form: five models, the single filter and the informed one under
six weight rules, 600 s of flight at 20 Hz, with all statistics. Memory should not grow.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

if not __package__:
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import _common as common
from benchmarks._problem import Problem, dense, oracle
from jaxnav.estimation.montecarlo import Campaign, monte_carlo
from jaxnav.studies.immae.config import ImmaeConfig
from jaxnav.studies.immae.methods import BANKS, Shared, panel_params, run_one
from jaxnav.studies.immae.simulation import World, build_world, fly_linear, prior_sigma

RUNS = (1, 10, 100, 1000)
QUICK_RUNS = (1, 10)
FEW = 100
"""Up to so many runs a second, warm call is timed; above, the one call is mostly work."""


def study(config: ImmaeConfig, world: World, runs: int, keep: int = 0) -> Campaign:
    """Run the Monte Carlo part of the study."""
    run = run_one("linear", config.filter_period_s, config.imu_step, len(config.theta))
    shared = Shared(world, panel_params(config))
    return monte_carlo(run, jax.random.key(config.seed), runs, shared, keep=keep)


def check(config: ImmaeConfig, world: World) -> None:
    """Compare the weights of the MMAE in the first run with those of the oracle."""
    key = jax.random.fold_in(jax.random.key(config.seed), 0)
    flight = fly_linear(key, world, config.filter_period_s, config.imu_step)
    P0 = jnp.diag(prior_sigma(config) ** 2)
    problem = Problem(world.noise, P0, world.nominal, jnp.zeros((1, 3)), flight.z[None])
    expected = oracle(dense(problem, own=False), 0).weights
    weights = study(config, world, runs=1, keep=1).traces["weights"][0]
    common.require_agreement("weights of the MMAE", weights[:, BANKS.index("mmae")], expected)


def measure(config: ImmaeConfig, world: World, runs: int, turns: int) -> dict[str, Any]:
    """Time the study for a number of runs."""

    def call() -> Any:
        return study(config, world, runs).rows

    first = common.seconds(call)
    best = min(common.seconds(call) for _ in range(turns)) if runs <= FEW else first
    members = panel_params(config).members.told.shape[0]
    return {
        "runs": runs,
        "seconds": best,
        "first call, s": first,
        "us per run, step and model": 1e6 * best / (runs * config.steps * members),
        "peak memory so far, GiB": common.peak_gib(),
    }


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Run the benchmark and return what it measured."""
    args = common.arguments(__doc__, argv)
    common.setup()
    config = ImmaeConfig(chain="linear", duration_s=100.0 if args.quick else 600.0)
    world = jax.block_until_ready(build_world(config))
    check(config, world)
    start = common.now()
    rows = [measure(config, world, runs, 2) for runs in (QUICK_RUNS if args.quick else RUNS)]
    growth = np.ptp([row["peak memory so far, GiB"] for row in rows])
    notes = common.cores_elsewhere(start)
    notes += [f"From the smallest to the largest number of runs the peak grew by {growth:.2f} GiB."]
    title = f"The study immae, linear form, {config.steps} steps"
    return common.report(args, title, rows, notes=notes)


if __name__ == "__main__":
    main()
