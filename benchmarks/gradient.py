"""What does the gradient of the likelihood cost, in time and in memory, next to the value?

The negative log-likelihood of the innovations of 16 runs of 12,000 steps, and its derivative with
respect to the logarithms of the three noise levels: of one Kalman filter and of a bank of five. The
runs share the covariance, and the scan keeps states at the ends of segments of 110 steps only. The
derivative is taken in reverse and in forward mode; one goal is judged on the cheaper of the two,
another on reverse mode, whose cost does not grow with the number of parameters.
"""

import sys
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
from benchmarks._problem import IMU_STEP, PERIOD, Problem, bank_params, dense, make_problem, oracle
from jaxnav.estimation.banks.mixture import mmae
from jaxnav.estimation.filters.kalman import kf
from jaxnav.estimation.run import run
from jaxnav.estimation.tune.fit import value_and_gradient
from jaxnav.estimation.types import Filter, FilterParams, Gaussian, Obs
from jaxnav.navigation.models.sins_cns import SinsCnsParams, sins_cns
from jaxnav.units import ARCSEC

RUNS = 16
SEGMENT = 110
CHECK_STEPS = 150
MODES = ("reverse", "forward")
GOAL_RATIO = 4.0
GOAL_REVERSE = 4.5
"""For many parameters there is no other mode."""
GOAL_GIB = 3.0
DIFFERENCE = 1e-4
"""Step of the oracle's central differences; their error is what the gradient's tolerance allows."""
GRADIENT_TOLERANCE = 1e-5


def scaled(noise: SinsCnsParams, logs: Any) -> SinsCnsParams:
    """Return the noise with each level multiplied by the exponential of its entry ``(3,)``."""
    gyro, accel, star = (jnp.exp(jnp.asarray(log)) for log in logs)
    return noise._replace(
        gyro_noise=gyro * noise.gyro_noise,
        accel_noise=accel * noise.accel_noise,
        star_noise=star * noise.star_noise,
    )


def kf_params(noise: SinsCnsParams, P0: Array) -> FilterParams:
    """Return the parameters of one filter at factor one."""
    return FilterParams(noise, Gaussian(jnp.zeros(15), P0))


FILTERS: dict[str, tuple[Callable[[], Filter], Callable]] = {
    "kf": (lambda: kf(sins_cns(PERIOD, IMU_STEP)), kf_params),
    "mmae, 5 models": (lambda: mmae(kf(sins_cns(PERIOD, IMU_STEP))), bank_params),
}


def make_loss(name: str) -> Callable[[Array, Problem], Array]:
    """Return the negative log-likelihood of all runs as a function of the log noise levels."""
    build, params_of = FILTERS[name]
    chosen = build()

    def likelihood(logs: Array, problem: Problem) -> Array:
        params = params_of(scaled(problem.noise, logs), problem.P0)

        def one(z: Array) -> Array:
            observations = Obs(z, jnp.ones(z.shape, bool))
            trace = run(
                chosen,
                params,
                problem.inputs,
                observations,
                record=lambda state, info: info.log_likelihood,
                segment=SEGMENT,
            )
            return jnp.sum(trace.record)

        return -jnp.sum(jax.vmap(one)(problem.z))

    return likelihood


def oracle_loss(name: str, logs: np.ndarray, problem: Problem) -> float:
    """Return the oracle's value; its attitude is in arc seconds, a density has the inverse unit."""
    matrices = dense(problem._replace(noise=scaled(problem.noise, logs)), own=False)
    total = 0.0
    for index in range(len(matrices.z)):
        answer = oracle(matrices, index)
        total += np.sum(answer.log_likelihood[:, 0] if name == "kf" else answer.evidence)
    return -total + matrices.z.size * np.log(ARCSEC)


def check(name: str) -> None:
    """Compare value and gradients with the oracle and its central differences, on a short run."""
    problem = make_problem(CHECK_STEPS, 2)
    logs = np.array([0.3, -0.2, 0.1])
    expected = oracle_loss(name, logs, problem)
    steps = DIFFERENCE * np.eye(3)
    slopes = [
        (oracle_loss(name, logs + h, problem) - oracle_loss(name, logs - h, problem))
        / (2 * DIFFERENCE)
        for h in steps
    ]
    for mode in MODES:
        graded = jax.jit(value_and_gradient(make_loss(name), mode))
        value, gradient = graded(jnp.asarray(logs), problem)
        what = f"{name}, {mode} mode"
        common.require_agreement(f"{what}, value", np.array([value]), np.array([expected]))
        common.require_agreement(f"{what}, gradient", gradient, slopes, 0, GRADIENT_TOLERANCE)


def measure(name: str, steps: int, turns: int) -> dict[str, Any]:
    """Time value and gradient of one filter at full length."""
    check(name)
    problem = make_problem(steps, RUNS)
    loss = make_loss(name)
    logs = jnp.zeros(3)
    functions = [jax.jit(loss), *(jax.jit(value_and_gradient(loss, mode)) for mode in MODES)]
    calls = [lambda function=function: function(logs, problem) for function in functions]
    first = [common.seconds(call) for call in calls]
    value_s, *both_s = common.best_in_turn(calls, turns)
    row: dict[str, Any] = {"filter": name, "value, s": value_s}
    for mode, seconds, first_s in zip(MODES, both_s, first[1:], strict=True):
        row[f"{mode}, s"] = seconds
        row[f"{mode}, ratio"] = seconds / value_s
        row[f"{mode}, first call, s"] = first_s
    row["cheaper"] = min(MODES, key=lambda mode: row[f"{mode}, s"])
    row["peak memory so far, GiB"] = common.peak_gib()
    return row


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Run the benchmark and return what it measured."""
    args = common.arguments(__doc__, argv)
    common.setup()
    steps, turns = (2000, 2) if args.quick else (12000, 4)
    start = common.now()
    rows = [measure(name, steps, turns) for name in FILTERS]
    notes = common.cores_elsewhere(start)
    goals = [
        common.Goal(
            f"ratio, {row['filter']}, {row['cheaper']} mode",
            row[f"{row['cheaper']}, ratio"],
            GOAL_RATIO,
        )
        for row in rows
    ]
    goals += [
        common.Goal(f"ratio, {row['filter']}, reverse mode", row["reverse, ratio"], GOAL_REVERSE)
        for row in rows
    ]
    goals.append(common.Goal("peak memory, GiB", common.peak_gib(), GOAL_GIB))
    title = f"Value and gradient of the log-likelihood, {steps} steps, {RUNS} runs"
    return common.report(args, title, rows, goals, notes)


if __name__ == "__main__":
    main()
