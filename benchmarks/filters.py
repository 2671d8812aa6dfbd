"""What does a step of each filter cost, and what does it cost elsewhere?

Microseconds per filter step and model: 15 states, 3 measurements, float64, 16 and 64 Monte Carlo
runs, each with its own covariance; kept are the means of all steps and the log-likelihood. The
problem "vector" has dense matrices and a sine in both functions, and other libraries filter it too.
The problem "sins_total" is the library's own navigation model on its manifold, at 20 Hz. The
contestants of a problem take turns on the clock; the best turn counts.

On "vector" everybody is compared with a plain NumPy filter. On "sins_total" the forms are compared
with each other: analytic with automatic Jacobians, square roots with covariances, ten equal models
of the interacting bank with one filter, and the rules with each other to first order.
"""

import sys
from collections.abc import Callable, Sequence
from functools import partial
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
    PEERS,
    Answer,
    Nonlinear,
    Peer,
    make_nonlinear,
    nonlinear_model,
    nonlinear_params,
    oracle,
)
from benchmarks._ours import run_index, run_keys
from benchmarks._peers import Missing
from jaxnav.estimation.banks.imm import imm, imm_params, uniform_switching
from jaxnav.estimation.banks.mixture import BankParams
from jaxnav.estimation.filters.kalman import ekf
from jaxnav.estimation.filters.sigma_point import ckf, square_root_ckf, square_root_ukf, ukf
from jaxnav.estimation.filters.square_root import square_root_ekf
from jaxnav.estimation.montecarlo import RunOutput, monte_carlo
from jaxnav.estimation.run import run
from jaxnav.estimation.types import Filter, FilterParams, Gaussian, Obs, replicate
from jaxnav.navigation.models.sins_total import sins_total
from jaxnav.navigation.states import local_total
from jaxnav.studies.mmae_ukf.config import MmaeUkfConfig
from jaxnav.studies.mmae_ukf.methods import model_factors
from jaxnav.studies.mmae_ukf.simulation import (
    build_world,
    fly,
    launch_radius,
    noise_of,
    prior_sigma,
)

RUNS = (16, 64)
CHECKED = 2
"""Number of runs that are compared with the NumPy filter before the clock starts."""
MODELS = 10
"""Members of the interacting bank."""
FIRST_ORDER = 1e-4
"""Largest difference of extended, unscented and cubature filter on "sins_total", in prior sigmas:
its angles are of some arc seconds, so the filters differ, but not by much."""
LANE_STEPS = 64_000
"""Filter steps in one timed call, over all runs and models, at most."""
GOALS = (
    ("ekf", "dynamax", 1.8),
    ("ukf", "dynamax", 4.2),
    ("square_root_ekf", "cuthbert", 1.3),
)
"""Filters, libraries, and the least ratio of their time to that of jaxnav."""


class Flights(NamedTuple):
    """What the runs see, a leading run axis on every leaf.

    Attributes:
        start: State that the filters start from.
        inputs: Inputs of the model, then a time axis.
        z: ``(runs, T, 3)``.
    """

    start: Any
    inputs: Any
    z: Array

    def shortened(self, runs: int, steps: int) -> "Flights":
        """Return the first steps of the first runs."""
        start = jax.tree.map(lambda leaf: leaf[:runs], self.start)
        return Flights(start, *jax.tree.map(lambda leaf: leaf[:runs, :steps], self[1:]))


class Entry(NamedTuple):
    """A checked call that waits for its turn on the clock.

    Attributes:
        name: Of the library.
        method: Of the filter.
        spread: How the work is spread over the machine.
        call: What is timed.
        lane_steps: Filter steps in it, over all runs and models.
        first: Seconds of the first call, which compiles.
    """

    name: str
    method: str
    spread: str
    call: Callable[[], Any]
    lane_steps: int
    first: float


class Own(NamedTuple):
    """A filter of the library.

    Attributes:
        method: Its name.
        filter: The filter or bank.
        rule: Which of the oracle's answers it should give, or of the other filters'.
        models: Number of members.
    """

    method: str
    filter: Filter
    rule: str
    models: int = 1


def study(own: Own, flights: Flights) -> Callable[[Any], Answer]:
    """Return the Monte Carlo study of a filter as a function of its parameters."""
    key, runs = jax.random.key(1), len(flights.z)
    keys = run_keys(key, runs)

    def kept(state: Any, info: Any) -> Any:
        return own.filter.estimate(state).mean, info.log_likelihood

    def run_one(key: Array, shared: Any) -> RunOutput:
        keys, flights, params = shared
        index = run_index(keys, key)
        start, inputs, z = jax.tree.map(lambda leaf: leaf[index], flights)
        observations = Obs(z, jnp.ones(z.shape, bool))
        trace = run(own.filter, started(params, start), inputs, observations, record=kept)
        return RunOutput(trace.record)

    def call(params: Any) -> Answer:
        return monte_carlo(run_one, key, runs, (keys, flights, params)).rows

    return call


def started(params: Any, start: Any) -> Any:
    """Return the parameters of a filter or of a bank, starting from one state."""
    if isinstance(params, BankParams):
        count = jax.tree.leaves(params.members)[0].shape[0]
        initial = params.members.initial._replace(mean=replicate(start, count))
        return params._replace(members=params.members._replace(initial=initial))
    return params._replace(initial=params.initial._replace(mean=start))


def own_entry(
    own: Own, flights: Flights, params: Any, check: Callable[[Answer], None], checked: Any
) -> Entry:
    """Return a filter's entry after a check of its answer.

    Args:
        own: The filter.
        flights: What the runs see.
        params: Parameters that are timed.
        check: Stops the benchmark if an answer is wrong.
        checked: Parameters that are checked, of the same shapes.
    """
    runs, steps = flights.z.shape[:2]
    part = flights.shortened(runs, min(steps, max(LANE_STEPS // (runs * own.models), 1)))
    call = study(own, part)
    first = common.seconds(lambda: call(checked))
    check(call(checked))
    lanes = part.z.shape[0] * part.z.shape[1] * own.models
    return Entry("jaxnav", own.method, "threads", lambda: call(params), lanes, first)


class Truths:
    """The oracle's answers to one problem, each worked out once for all its steps."""

    def __init__(self, problem: Nonlinear) -> None:
        """Keep the problem."""
        self.problem = problem
        self.known: dict[tuple[str, int, int], tuple[np.ndarray, float]] = {}

    def require(self, name: str, rule: str, answer: Answer) -> None:
        """Stop the benchmark unless the first runs of an answer are the oracle's."""
        means, total = (np.asarray(part) for part in answer)
        total = total.reshape(len(total), -1).sum(axis=1)
        for index in range(min(CHECKED, len(total))):
            asked = (rule, index, means.shape[1])
            if asked not in self.known:
                problem = self.problem._replace(z=self.problem.z[:, : means.shape[1]])
                self.known[asked] = oracle(problem, index, rule)
            wanted, wanted_total = self.known[asked]
            common.require_agreement(f"{name}, means of run {index}", means[index], wanted)
            common.require_agreement(
                f"{name}, log-likelihood of run {index}", total[index, None], [wanted_total]
            )


def peer_entries(peer: Peer, problem: Nonlinear, truths: Truths) -> list[Entry]:
    """Compare each way a peer has through the problem with the oracle."""
    part = problem.shortened(min(len(problem.z), peer.runs), peer.lane_steps)
    entries = []
    for spread, call in peer.prepare(part).items():
        first = common.seconds(call)
        truths.require(f"{peer.name}, {peer.method}", peer.rule, call())
        lanes = part.z.shape[0] * part.z.shape[1]
        entries.append(Entry(peer.name, peer.method, spread, call, lanes, first))
    return entries


def vector_entries(steps: int, runs: int) -> tuple[list[Entry], list[str]]:
    """Return all contestants on the problem "vector", and a note for each that is missing."""
    problem, model = make_nonlinear(steps, runs), nonlinear_model()
    truths, params = Truths(problem), nonlinear_params(problem)
    unscented, square_root_unscented = (
        build(model, alpha=ALPHA, beta=BETA, kappa=KAPPA) for build in (ukf, square_root_ukf)
    )
    filters = (
        Own("ekf", ekf(model), "ekf"),
        Own("square_root_ekf", square_root_ekf(model), "ekf"),
        Own("ukf", unscented, "ukf"),
        Own("square_root_ukf", square_root_unscented, "ukf"),
        Own("ckf", ckf(model), "ckf"),
        Own("square_root_ckf", square_root_ckf(model), "ckf"),
        Own("ckf, redraw=False", ckf(model, redraw=False), "ckf-kept"),
    )
    flights = Flights(jnp.zeros((runs, *params.initial.mean.shape)), (), jnp.asarray(problem.z))
    entries, notes = [], []
    for own in filters:
        check = partial(truths.require, f"jaxnav, {own.method}", own.rule)
        entries.append(own_entry(own, flights, params, check, params))
    for peer in PEERS:
        try:
            entries += peer_entries(peer, problem, truths)
        except Missing as reason:
            notes.append(f"{peer.name}, {peer.method} is left out: {reason}.")
    return entries, notes


def manifold_entries(steps: int, runs: int) -> tuple[list[Entry], list[str]]:
    """Return the library's filters on the problem "sins_total"."""
    config = MmaeUkfConfig(duration_s=steps * MmaeUkfConfig.filter_period_s, models=MODELS)
    period, imu_step = config.filter_period_s, config.imu_step
    world = build_world(config)
    model = sins_total(period, imu_step, launch_radius(config), config.star_form)

    @jax.jit
    @jax.vmap
    def fly_one(key: Array) -> Flights:
        flight = fly(key, world, period, imu_step, config.star_form)
        return Flights(flight.start, flight.inputs, flight.z)

    flights = fly_one(jax.random.split(jax.random.key(0), runs))
    start = jax.tree.map(lambda leaf: leaf[0], flights.start)
    noise = noise_of(config)
    single = FilterParams(noise, Gaussian(start, jnp.diag(prior_sigma(config) ** 2)))
    switching = uniform_switching(MODELS, config.switching)
    equal = imm_params(replicate(single, MODELS), switching)
    scale = jnp.asarray(model_factors(config))
    several = equal.members.model._replace(
        gyro_noise=scale[:, :1] * noise.gyro_noise, accel_noise=scale[:, 1:] * noise.accel_noise
    )
    bank = equal._replace(members=equal.members._replace(model=several))
    unscented, square_root_unscented = (
        build(model, alpha=config.alpha, beta=config.beta, kappa=config.kappa)
        for build in (ukf, square_root_ukf)
    )
    automatic = ekf(model._replace(jacobians=None))
    filters = (
        Own("ekf", ekf(model), "ekf"),
        Own("ekf, automatic Jacobians", automatic, "ekf"),
        Own("square_root_ekf", square_root_ekf(model), "ekf"),
        Own("ukf", unscented, "ukf"),
        Own("square_root_ukf", square_root_unscented, "ukf"),
        Own("ckf", ckf(model), "ckf"),
        Own(f"imm of ukf, {MODELS} models", imm(unscented), "ukf", MODELS),
    )
    alike = Alike(prior_sigma(config))
    entries = []
    for own in filters:
        check = partial(alike.require, own.method, own.rule)
        params, checked = (bank, equal) if own.models > 1 else (single, single)
        entries.append(own_entry(own, flights, params, check, checked))
    return entries, []


class Alike:
    """Holds the answers on "sins_total" against each other."""

    def __init__(self, sigma: Array) -> None:
        """Keep the prior's standard deviations ``(15,)``, the units of the differences."""
        self.sigma = sigma
        self.known: dict[str, Answer] = {}

    def require(self, name: str, rule: str, answer: Answer) -> None:
        """Stop the benchmark unless an answer is that of the first filter of its rule.

        The first of another rule need be near the first of all only.
        """
        nearest = self.known.get(rule, next(iter(self.known.values()), answer))
        tolerance = common.TOLERANCE if rule in self.known else FIRST_ORDER
        steps = answer[1].shape[1]
        means, log_likelihood = jax.tree.map(lambda leaf: leaf[:, :steps], nearest)
        apart = jax.vmap(jax.vmap(local_total))(means, answer[0]) / self.sigma
        error = max(
            float(jnp.max(jnp.abs(apart))),
            float(np.max(np.abs(answer[1] - log_likelihood)) / np.max(np.abs(log_likelihood))),
        )
        if not error <= tolerance:
            raise SystemExit(
                f"sins_total, {name} differs from another form by {error:.1e} prior sigmas, "
                f"{tolerance:.0e} is allowed: nothing was timed."
            )
        self.known.setdefault(rule, answer)


PROBLEMS = {"vector": vector_entries, "sins_total": manifold_entries}


def measure(problem: str, steps: int, runs: int, turns: int) -> tuple[list[dict], list[str]]:
    """Return the rows of the table for one problem, the fastest way of each filter, and notes."""
    entries, notes = PROBLEMS[problem](steps, runs)
    start = common.now()
    best = common.best_in_turn([entry.call for entry in entries], turns)
    notes += [f"Problem {problem}, {runs} runs: {note}" for note in common.cores_elsewhere(start)]
    fastest: dict[tuple[str, str], dict[str, Any]] = {}
    for entry, seconds in zip(entries, best, strict=True):
        us = 1e6 * seconds / entry.lane_steps
        which = (entry.method, entry.name)
        if which not in fastest or us < fastest[which]["us"]:
            fastest[which] = {
                "problem": problem,
                "runs": runs,
                "filter": entry.method,
                "library": entry.name,
                "us": us,
                "spread": entry.spread,
                "first call, s": entry.first,
            }
    return list(fastest.values()), notes


def goals(rows: list[dict[str, Any]]) -> list[common.Goal]:
    """Hold the figures at the larger number of runs against what was promised."""
    us = {
        (row["filter"], row["library"]): row["us"]
        for row in rows
        if (row["problem"], row["runs"]) == ("vector", RUNS[-1])
    }
    found = []
    for method, library, limit in GOALS:
        theirs = us.get((method, library))
        ratio = None if theirs is None else theirs / us[method, "jaxnav"]
        found.append(common.Goal(f"{library} / jaxnav, {method}", ratio, limit, at_least=True))
    ratio = us["square_root_ukf", "jaxnav"] / us["ukf", "jaxnav"]
    found.append(common.Goal("square_root_ukf / ukf", ratio, 1.5))
    return found


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Run the benchmark and return what it measured."""
    args = common.arguments(__doc__, argv)
    common.setup()
    steps, turns = (200, 3) if args.quick else (1000, 5)
    rows: list[dict[str, Any]] = []
    notes: list[str] = []
    for problem in PROBLEMS:
        for runs in RUNS:
            found, missing = measure(problem, steps, runs, turns)
            rows += found
            notes += [note for note in missing if note not in notes]
    title = "Microseconds per filter step and model (15 states, 3 measurements)"
    return common.report(args, title, rows, goals(rows), notes)


if __name__ == "__main__":
    main()
