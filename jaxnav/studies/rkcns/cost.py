"""What a step of each method costs: the paper's count of operations beside measured time."""

from functools import partial

import jax

from jaxnav.compiling import compiled
from jaxnav.studies.rkcns.config import RkcnsConfig
from jaxnav.studies.rkcns.methods import filters, problem_of, setup_of, shared_of
from jaxnav.studies.rkcns.simulation import build_world, fly_run
from jaxnav.studies.timing import RUNS, microseconds_per_step

TIMED = ("conventional", "ckf", "iterated-ckf", "modified-iterated-ckf")
"""The paper's methods."""


def step_costs(config: RkcnsConfig) -> dict[str, float]:
    """Return the time of each method by itself [us per filter step and run]."""
    setup = setup_of(config)
    shared = shared_of(config, build_world(config))
    keys = jax.random.split(jax.random.key(config.seed), RUNS)
    flights = compiled(jax.vmap(partial(fly_run, world=shared.world, timing=setup.timing)))(keys)

    def timed(name: str) -> float:
        given = compiled(jax.vmap(lambda flight: problem_of(name, flight, shared)))(flights)
        return microseconds_per_step(filters(setup)[name], *given)

    return {name: timed(name) for name in TIMED}


def flops(states: int, channels: int, iterations: int) -> dict[str, float]:
    """Return the paper's counts of floating-point operations of one cycle.

    Args:
        states: n.
        channels: m.
        iterations: L.

    References:
        Shi, Chen, Wang (2023), Eqs. (29)-(31), as printed.
    """
    n, m, L = float(states), float(channels), float(iterations)
    plain = (
        20 / 3 * n**3 + 10 * n**2 + 10 * n**2 * m + 8 * n * m**2 + 2 * n * m + m**3 + 3 * m**2 + m
    )
    iterated = (
        (19 + 4 * L) / 3 * n**3
        + (7 + 2 * L + 2 * m + 10 * L * m) * n**2
        + (2 + 6 * L) * m**2 * n
        + (4 * L * m - m + 2 * L) * n
        + L * m**3
        + 3 * L * m**2
        + L * m
    )
    modified = (
        (19 + 4 * L) / 3 * n**3
        + (7 + 3 * L + 2 * m + 14 * L * m) * n**2
        + (6 * m**2 - m + L * (26 * m**2 + 14 * m + 2)) * n
        + (49 / 3 * L + 4) * m**3
        + (10 * L - 1) * m**2
        + 5 * L * m
    )
    return {"ckf": plain, "iterated-ckf": iterated, "modified-iterated-ckf": modified}
