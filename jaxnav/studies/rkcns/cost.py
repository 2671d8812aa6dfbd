"""What a step of each method costs: the paper's count of operations beside measured time."""

import jax

from jaxnav.studies.rkcns.config import RkcnsConfig
from jaxnav.studies.rkcns.methods import METHODS, filters, problem_of, setup_of, shared_of
from jaxnav.studies.rkcns.simulation import build_world, fly_run
from jaxnav.studies.timing import RUNS, microseconds_per_step


def step_costs(config: RkcnsConfig) -> dict[str, float]:
    """Return the time of each method by itself [us per filter step and run]."""
    setup = setup_of(config)
    shared = shared_of(config, build_world(config))
    keys = jax.random.split(jax.random.key(config.seed), RUNS)

    def flights(name: str) -> tuple:
        return jax.jit(
            jax.vmap(lambda key: problem_of(name, fly_run(key, shared.world, setup.timing), shared))
        )(keys)

    return {name: microseconds_per_step(filters(setup)[name], *flights(name)) for name in METHODS}


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
