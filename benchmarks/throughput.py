"""How long does one filter step of one model take, in a bank of five, and how long elsewhere?

Microseconds per filter step and model: 15 states, 3 measurements, float64, a bank of five models over
16 and 128 Monte Carlo runs. The runs either share one covariance recursion, because their inputs are
the same, or each has its own. jaxnav's figure contains what makes the members a bank (weights,
mixture, per-run statistics); the peers run the members alone.
"""

import sys
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

if not __package__:
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from benchmarks import _common as common
from benchmarks._peers import CONTESTANTS, Contestant, Missing
from benchmarks._problem import (
    IMU_STEP,
    PERIOD,
    THETA,
    Dense,
    Problem,
    bank_params,
    dense,
    make_problem,
    oracle,
    own_inputs,
)
from jaxnav.estimation.banks.mixture import BankState, mmae
from jaxnav.estimation.filters.kalman import kf
from jaxnav.estimation.montecarlo import RunOutput, monte_carlo
from jaxnav.estimation.run import run
from jaxnav.estimation.types import Filter, Model, Obs
from jaxnav.navigation.models.sins_cns import LAYOUT, SinsCnsParams, sins_cns
from jaxnav.units import ARCSEC

RUNS = (16, 128)
CHECKED = 2
"""Number of runs that are compared with the oracle before the clock starts."""
CASES = {"shared": False, "own": True}
GOALS_US = {"shared": 0.12, "own": 0.6}
GOAL_RATIO = 4.0
DENSE_LANE_STEPS = 200_000
"""Filter steps of the dense path in one timed call, so that its matrices fit the memory."""


class Statistics(NamedTuple):
    """What is kept of a run: mean and mean square of the attitude over time, and its last value."""

    mean: Array
    square: Array
    last: Array


class Timed(NamedTuple):
    """One figure: seconds of the first call, microseconds per step and model, how it was spread."""

    first: float
    us: float
    spread: str


def _attitude(state: BankState, info: Any) -> Array:
    """Keep the bank's attitude alone: nobody asks for a covariance here."""
    del info
    return jnp.sum(jnp.exp(state.log_weights)[:, None] * state.members.x[:, LAYOUT.phi], axis=0)


@cache
def monte_carlo_run(bank: Filter, inputs_of: Callable[[Any, Array], Any]) -> Callable:
    """Return one run of ``bank`` as a function of its key, which finds its simulated data."""

    def run_one(key: Array, shared: Any) -> RunOutput:
        keys, z, source, params = shared
        index = jnp.argmax(jnp.all(keys == jax.random.key_data(key)[None], axis=-1))
        observations = Obs(z[index], jnp.ones(z.shape[1:], bool))
        inputs = inputs_of(source, index)
        attitude = run(bank, params, inputs, observations, record=_attitude).record
        return RunOutput(
            Statistics(jnp.mean(attitude, axis=0), jnp.mean(attitude**2, axis=0), attitude[-1])
        )

    return run_one


def same_inputs(source: Any, index: Array) -> Any:
    """Return the inputs that all runs share."""
    del index
    return source


def turned_inputs(source: Any, index: Array) -> Any:
    """Return the inputs of the run's own solution."""
    inputs, tilt = source
    return own_inputs(inputs, tilt[index])


def picked_inputs(source: Any, index: Array) -> Any:
    """Return the run's own entry of every array."""
    return jax.tree.map(lambda leaf: leaf[index], source)


def dense_model(H: Array) -> Model:
    """Return the model that knows no structure: its input is ``(F, Q0)``."""

    def noise(params: SinsCnsParams, x: Array, u: Any) -> Array:
        del x
        return params.noise_scale * u[1]

    return Model(
        transition=lambda params, x, u: u[0] @ x,
        process_noise=noise,
        observe=lambda params, x, u: H @ x,
        observation_noise=lambda params, x, u: params.star_noise**2,
    )


STRUCTURED = mmae(kf(sins_cns(PERIOD, IMU_STEP)))


def structured_call(problem: Problem, own: bool) -> Callable[[], Statistics]:
    """Return the Monte Carlo study of the library's model."""
    source = (problem.inputs, problem.tilt) if own else problem.inputs
    run_one = monte_carlo_run(STRUCTURED, turned_inputs if own else same_inputs)
    return _study(run_one, problem.z, source, bank_params(problem))


def dense_call(matrices: Dense) -> Callable[[], Statistics]:
    """Return the same study with the transition as a dense product, in the peers' units."""
    bank = mmae(kf(dense_model(jnp.asarray(matrices.H))))
    source = (jnp.asarray(matrices.F), jnp.asarray(matrices.Q))
    run_one = monte_carlo_run(bank, picked_inputs if matrices.own else same_inputs)
    none = jnp.zeros(3)
    star = jnp.asarray(np.sqrt(np.diag(matrices.R)))
    noise = SinsCnsParams(none, none, star, jnp.ones(()))
    z = jnp.asarray(matrices.z)
    bare: Any = None
    params = bank_params(Problem(noise, jnp.asarray(matrices.P0), bare, bare, z))
    return _study(run_one, z, source, params)


def _study(run_one: Any, z: Array, source: Any, params: Any) -> Callable[[], Statistics]:
    key, runs = jax.random.key(1), len(z)
    keys = jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, jnp.arange(runs, dtype=jnp.int32))
    shared = (jax.random.key_data(keys), z, source, params)
    return lambda: monte_carlo(run_one, key, runs, shared).rows


def check_statistics(name: str, rows: Statistics, matrices: Dense, unit: float) -> None:
    """Compare a study's statistics with those of the oracle's mixture."""
    for index in range(CHECKED):
        truth = oracle(matrices, index).mixture * unit
        expected = (truth.mean(axis=0), (truth**2).mean(axis=0), truth[-1])
        for label, value, reference in zip(rows._fields, rows, expected, strict=True):
            common.require_agreement(f"{name}, {label} of run {index}", value[index], reference)


def time_study(
    name: str, call: Callable[[], Statistics], matrices: Dense, unit: float, repeats: int
) -> Timed:
    """Check a study against the oracle, then time it."""
    first, _ = common.first_and_best(call, 1)
    check_statistics(name, call(), matrices, unit)
    _, best = common.first_and_best(call, repeats)
    lanes = matrices.z.shape[0] * matrices.z.shape[1] * len(THETA)
    return Timed(first, 1e6 * best / lanes, "devices")


def time_contestant(contestant: Contestant, matrices: Dense, repeats: int) -> Timed:
    """Check a contestant against the oracle and time it; the fastest of its ways counts."""
    runs = min(len(matrices.z), contestant.runs)
    part = shortened(matrices, runs, contestant.lane_steps // (runs * len(THETA)))
    truths = [oracle(part, index) for index in range(min(CHECKED, runs))]
    timed = []
    for spread, call in contestant.prepare(part).items():
        first, _ = common.first_and_best(call, 1)
        attitude, total = call()
        for index, truth in enumerate(truths):
            name = f"{contestant.name}, run {index}"
            wanted = np.moveaxis(truth.attitude, 1, 0)
            common.require_agreement(name, attitude[index], wanted, axis=1)
            common.require_agreement(name, total[index], truth.log_likelihood.sum(axis=0))
        _, best = common.first_and_best(call, repeats)
        lanes = runs * part.z.shape[1] * len(THETA)
        timed.append(Timed(first, 1e6 * best / lanes, spread))
    return min(timed, key=lambda one: one.us)


def shortened(matrices: Dense, runs: int, steps: int) -> Dense:
    """Return the first runs and steps of a problem."""
    F, G = (m[:runs, :steps] if matrices.own else m[:steps] for m in (matrices.F, matrices.G))
    return matrices._replace(F=F, G=G, z=matrices.z[:runs, :steps])


def jaxnav_rows(problem: Problem, case: str, repeats: int) -> dict[str, Timed]:
    """Time the library with and without the model's structure."""
    own = CASES[case]
    matrices = dense(problem, own)
    runs = len(matrices.z)
    part = shortened(matrices, runs, DENSE_LANE_STEPS // (runs * len(THETA)))
    structured = structured_call(problem, own)
    return {
        "jaxnav": time_study("jaxnav", structured, matrices, ARCSEC, repeats),
        "jaxnav, dense F": time_study("jaxnav, dense F", dense_call(part), part, 1.0, repeats),
    }


def measure(steps: int, repeats: int) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the rows of the table, and a note for each contestant that is missing."""
    rows, notes = [], {}
    for case in CASES:
        for runs in RUNS:
            problem = make_problem(steps, runs)
            timed = jaxnav_rows(problem, case, repeats)
            for contestant in CONTESTANTS:
                try:
                    matrices = dense(problem, CASES[case])
                    timed[contestant.name] = time_contestant(contestant, matrices, repeats)
                except Missing as reason:
                    notes[contestant.name] = f"{contestant.name} is left out: {reason}."
            rows += [
                {
                    "covariance": case,
                    "runs": runs,
                    "filter": name,
                    "us": one.us,
                    "spread": one.spread,
                    "first call, s": one.first,
                }
                for name, one in timed.items()
            ]
    return rows, list(notes.values())


def goals(rows: list[dict[str, Any]]) -> list[common.Goal]:
    """Hold the figures at the larger number of runs against what was promised."""
    peers = {contestant.name for contestant in CONTESTANTS if contestant.jax}
    found = []
    for case, limit in GOALS_US.items():
        mine = {
            r["filter"]: r["us"] for r in rows if (r["covariance"], r["runs"]) == (case, RUNS[-1])
        }
        fastest = min((us for name, us in mine.items() if name in peers), default=None)
        ratio = None if fastest is None else fastest / mine["jaxnav"]
        found.append(common.Goal(f"us, covariance {case}", mine["jaxnav"], limit))
        text = f"fastest JAX peer / jaxnav, covariance {case}"
        found.append(common.Goal(text, ratio, GOAL_RATIO, at_least=True))
    return found


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Run the benchmark and return what it measured."""
    args = common.arguments(__doc__, argv)
    common.setup()
    rows, notes = measure(500 if args.quick else 2000, 3 if args.quick else 7)
    title = "Microseconds per filter step and model (15 states, 3 measurements, 5 models)"
    return common.report(args, title, rows, goals(rows), notes)


if __name__ == "__main__":
    main()
