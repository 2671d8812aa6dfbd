"""How many filter steps a second does one GPU make, from 10^2 to 10^5 runs, here and in dynamax?

Microseconds per filter step and model of a bank of five models over independent runs, in float32
and float64: on the problem "vector" (15 states, 3 measurements) the extended and the unscented
filter, on its linear part the Kalman filter. dynamax runs the members alone.
The log-likelihood of the first run is compared with the NumPy filter first. The whole ends within
four minutes: what has not been reached by then is left out, and a note says so.

Without a GPU there is nothing to measure, which is said; ``--quick`` then runs a few steps on the
CPU, to see that the script works.
"""

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

if not __package__:
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from benchmarks import _common as common
from benchmarks._nonlinear import (
    ALPHA,
    BETA,
    KAPPA,
    PERIOD,
    STATES,
    Nonlinear,
    dynamax_series,
    make_nonlinear,
    nonlinear_model,
    nonlinear_params,
    oracle,
)
from benchmarks._peers import Missing
from jaxnav.compiling import compiled
from jaxnav.estimation.banks.mixture import BankParams, mmae
from jaxnav.estimation.filters.kalman import ekf, kf
from jaxnav.estimation.filters.sigma_point import ukf
from jaxnav.estimation.run import run
from jaxnav.estimation.types import Filter, Obs, replicate

RUNS = (100, 1_000, 10_000, 100_000)
MODELS = 5
STEPS = 20
BUDGET_S = 200.0
TURNS = 3
AGREEMENT = {"float64": 1e-8, "float32": 2e-3}
"""Largest relative error of a log-likelihood against the NumPy filter."""


class Contest(NamedTuple):
    """One row to be: a filter of a library on so many runs in one precision."""

    filter: str
    library: str
    dtype: str
    runs: int


def contests(runs: Sequence[int]) -> Iterator[Contest]:
    """Return all rows in the order in which they are measured: what matters most comes first."""
    for count, dtype in product(reversed(runs), AGREEMENT):
        for filter, library in product(("kf", "ekf", "ukf"), ("jaxnav", "dynamax")):
            yield Contest(filter, library, dtype, count)


def bank_of(filter: Filter, problem: Nonlinear, dtype: Any) -> Callable[[Array], Array]:
    """Return a number of the bank's last state for each of the runs ``(runs, T, 3)``."""
    alike = replicate(nonlinear_params(problem), MODELS)
    scale = np.arange(1, MODELS + 1).reshape(-1, 1, 1)
    members = alike._replace(model=alike.model._replace(Q=scale * np.asarray(alike.model.Q)))
    params = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), BankParams(members, ()))
    several = mmae(filter)

    def one(z: Array) -> Array:
        observations = Obs(z, jnp.ones(z.shape, bool))
        final = run(several, params, (), observations, record=lambda state, info: ()).final
        # All of the members are asked for, so that none is left out of the program.
        return jnp.sum(final.members.x) + jnp.sum(jnp.exp(final.log_weights))

    return compiled(jax.vmap(one))


def single_of(filter: Filter, problem: Nonlinear, dtype: Any) -> Callable[[Array], Array]:
    """Return the log-likelihood ``(runs,)`` of one filter, for the comparison with the oracle."""
    params = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), nonlinear_params(problem))

    def one(z: Array) -> Array:
        observations = Obs(z, jnp.ones(z.shape, bool))
        record = run(
            filter, params, (), observations, record=lambda state, info: info.log_likelihood
        )
        return jnp.sum(record.record)

    return compiled(jax.vmap(one))


def own_filter(name: str) -> Filter:
    """Return the library's filter by name."""
    model = nonlinear_model()
    if name == "kf":
        return kf(
            model._replace(
                transition=lambda p, x, u: x + PERIOD * (p.A @ x), observe=lambda p, x, u: p.H @ x
            )
        )
    if name == "ekf":
        return ekf(model)
    return ukf(model, alpha=ALPHA, beta=BETA, kappa=KAPPA)


def linear_oracle(problem: Nonlinear) -> float:
    """Return the first run's log-likelihood by the textbook's Kalman filter."""
    F = np.eye(STATES) + PERIOD * problem.A
    x, P, total = np.zeros(STATES), problem.P0, 0.0
    for z in problem.z[0]:
        x, P = F @ x, F @ P @ F.T + problem.Q
        nu, S = z - problem.H @ x, problem.H @ P @ problem.H.T + problem.R
        K = np.linalg.solve(S, problem.H @ P).T
        x, P = x + K @ nu, P - K @ S @ K.T
        nis = nu @ np.linalg.solve(S, nu)
        total -= 0.5 * (nis + np.log(np.linalg.det(2 * np.pi * S)))
    return total


def dynamax_linear(problem: Nonlinear) -> Callable[[Array], Array]:
    """Return the log-likelihood by dynamax's Kalman filter.

    Raises:
        Missing: If it is not installed.
    """
    try:
        from dynamax.linear_gaussian_ssm import inference  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise Missing("dynamax is not installed") from error
    A, H, Q, R, P0 = (jnp.asarray(m) for m in problem[:5])
    F = jnp.eye(STATES, dtype=A.dtype) + PERIOD * A
    P = F @ P0 @ F.T + Q
    params = inference.make_lgssm_params(jnp.zeros(STATES, A.dtype), P, F, Q, H, R)
    return lambda z: jnp.asarray(inference.lgssm_filter(params, z).marginal_loglik)


def dynamax_nonlinear(contest: Contest, problem: Nonlinear) -> Callable[[Array], Array]:
    """Return the log-likelihood by dynamax's extended or unscented filter; as the linear one."""
    series = dynamax_series(contest.filter)(problem)
    return lambda z: jnp.asarray(series(z)[1])


def check(contest: Contest, likelihood: Callable[[Array], Array], problem: Nonlinear) -> None:
    """Stop unless the first run's log-likelihood is the NumPy filter's."""
    z = jnp.asarray(problem.z[:2], contest.dtype)
    linear = contest.filter == "kf"
    expected = linear_oracle(problem) if linear else oracle(problem, 0, contest.filter)[1]
    name = f"{contest.library}, {contest.filter}, {contest.dtype}"
    found = np.asarray(likelihood(z))[:1]
    common.require_agreement(name, found, [expected], 0, AGREEMENT[contest.dtype])


def prepared(contest: Contest, problem: Nonlinear) -> Callable[[Array], Any]:
    """Return the checked call of a contest, from observations ``(runs, T, 3)``.

    Raises:
        Missing: If its library is not installed.
    """
    narrow = problem._replace(**{k: v.astype(contest.dtype) for k, v in problem._asdict().items()})
    if contest.library == "jaxnav":
        filter = own_filter(contest.filter)
        check(contest, single_of(filter, problem, contest.dtype), problem)
        return bank_of(filter, problem, contest.dtype)
    one = dynamax_linear(narrow) if contest.filter == "kf" else dynamax_nonlinear(contest, narrow)
    check(contest, jax.jit(jax.vmap(one)), problem)
    return jax.jit(jax.vmap(jax.vmap(one)))


def measure(contest: Contest, problem: Nonlinear) -> dict[str, Any]:
    """Return the row of a contest."""
    call = prepared(contest, problem)
    z = jnp.asarray(problem.z, contest.dtype)
    if contest.library != "jaxnav":
        z = jnp.broadcast_to(z, (MODELS, *z.shape)) + 0
    first = common.seconds(partial(call, z))
    best = min(common.seconds(partial(call, z)) for _ in range(TURNS))
    lanes = contest.runs * MODELS * STEPS
    return {**contest._asdict(), "us": 1e6 * best / lanes, "first call, s": first}


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Run the benchmark and return what it measured."""
    begin = time.perf_counter()
    args = common.arguments(__doc__, argv)
    common.setup()
    title = f"Microseconds per filter step and model on one GPU, {MODELS} models, {STEPS} steps"
    on_gpu = jax.devices()[0].platform == "gpu"
    if not on_gpu and not args.quick:
        return common.report(args, title, [], notes=["There is no GPU here: nothing was measured."])
    rows, notes, left_out = [], [], []
    for contest in contests(RUNS if on_gpu else (8,)):
        if time.perf_counter() - begin > BUDGET_S:
            left_out.append(" ".join(map(str, contest)))
            continue
        problem = make_nonlinear(STEPS, contest.runs)
        try:
            # dynamax refuses float32 where float64 is on.
            with jax.enable_x64(contest.dtype == "float64"):
                rows.append(measure(contest, problem))
        except Missing as reason:
            notes.append(f"{contest.library} is left out: {reason}.")
    if left_out:
        notes.append(f"Not reached within {BUDGET_S:g} s: {'; '.join(left_out)}.")
    if not on_gpu:
        notes.append("There is no GPU here: these are a few steps on the CPU.")
    return common.report(args, title, rows, notes=list(dict.fromkeys(notes)))


if __name__ == "__main__":
    main()
