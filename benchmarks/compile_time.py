"""How long does it take to trace and to compile a run of each filter, for 16 runs at once?

A study waits for this once, and a user at the prompt each time a shape changes. Nothing is cached
between the filters; the number of steps has no part in it.
"""

import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

if not __package__:
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from benchmarks import _common as common
from benchmarks._problem import (
    IMU_STEP,
    PERIOD,
    Filtered,
    Problem,
    bank_params,
    dense,
    make_problem,
    oracle,
)
from jaxnav.estimation.banks.mixture import immae, mmae, panel
from jaxnav.estimation.banks.reset import WindowedReset
from jaxnav.estimation.filters.kalman import kf
from jaxnav.estimation.filters.square_root import square_root_kf
from jaxnav.estimation.run import run
from jaxnav.estimation.types import Filter, FilterParams, Gaussian, Obs
from jaxnav.navigation.models.sins_cns import sins_cns
from jaxnav.studies.immae.methods import RULES
from jaxnav.units import ARCSEC

RUNS = 16
STEPS = 100

Case = tuple[Filter, Any, Callable[[Any], Array], Callable[[Filtered], np.ndarray]]


def cases(problem: Problem) -> dict[str, Case]:
    """Return the filters, their parameters, and which of the oracle's numbers they should give."""
    model = sins_cns(PERIOD, IMU_STEP)
    # The reset does not come within the flight: IMMAE is then the oracle's bank, step by step.
    reset = ((), WindowedReset(jnp.array(2.0 * STEPS), jnp.array(0.9)))
    rules = {
        "kf": (),
        "mmae": (),
        "immae": reset,
        "floor": ((), jnp.array(1e-6)),
        "markov": (jnp.array(1e-4), ()),
        "oracle": (),
    }
    single = FilterParams(problem.noise, Gaussian(jnp.zeros(15), problem.P0))

    def bank(rule: Any) -> Any:
        return bank_params(problem.noise, problem.P0, rule)

    def own(info: Any) -> Array:
        return info.log_likelihood

    def first(answer: Filtered) -> np.ndarray:
        return answer.log_likelihood[:, 0]

    def mixture(answer: Filtered) -> np.ndarray:
        return answer.evidence

    return {
        "kf": (kf(model), single, own, first),
        "square_root_kf": (square_root_kf(model), single, own, first),
        "mmae": (mmae(kf(model)), bank(()), own, mixture),
        "immae": (immae(kf(model)), bank(reset), own, mixture),
        f"panel of {len(RULES)} rules": (
            panel(kf(model), RULES),
            bank(rules),
            lambda info: info["mmae"].log_likelihood,
            mixture,
        ),
    }


def measure(name: str, case: Case, problem: Problem, expected: Filtered) -> dict[str, Any]:
    """Trace, compile and run one filter; its answer is checked."""
    chosen, params, pick, wanted = case

    def one(z: Array, inputs: Any, params: Any) -> Any:
        # The default record: what a user gets who asks for nothing.
        return run(chosen, params, inputs, Obs(z, jnp.ones(z.shape, bool)))

    start = time.perf_counter()
    lowered = jax.jit(jax.vmap(one, in_axes=(0, None, None))).lower(
        problem.z, problem.inputs, params
    )
    traced = time.perf_counter()
    compiled = lowered.compile()
    end = time.perf_counter()
    info = compiled(problem.z, problem.inputs, params).record[1]
    value = np.asarray(pick(info))[0] + 3 * np.log(ARCSEC)
    common.require_agreement(name, value, wanted(expected))
    return {
        "filter": name,
        "trace, s": traced - start,
        "compile, s": end - traced,
        "total, s": end - start,
        "lines of HLO": len((compiled.as_text() or "").splitlines()),
    }


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Run the benchmark and return what it measured; it has no quick form, being quick."""
    args = common.arguments(__doc__, argv)
    common.setup()
    problem = make_problem(STEPS, RUNS)
    expected = oracle(dense(problem, own=False), 0)
    start = common.now()
    rows = [measure(name, case, problem, expected) for name, case in cases(problem).items()]
    notes = common.cores_elsewhere(start)
    title = f"Seconds until a run of {RUNS} at once can start"
    return common.report(args, title, rows, notes=notes)


if __name__ == "__main__":
    main()
