"""Does a descent ever end in a failed bank? From fifty random starts, many of them failed banks.

Usage: python checks/failed_banks.py

The bank's members have a factor on their noise that is negative where they fail, and the descent is
free to go there. Every start must be refused, or end where the score is finite. Writes
``failed_banks.json`` beside this script; the exit code is 1 if one ended in failure. Takes five
minutes on two cores.
"""

import json
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxnav as jn
from jaxnav.estimation.tune.transforms import REAL

RECORD = Path(__file__).with_suffix(".json")
STEPS = 12
STARTS = 50
SEED = 1


def score(noise: Array, probability: Array) -> Array:
    """Return the negative log-likelihood of a bank of two, which fails for noise below about -1.

    Args:
        noise: Factor on the variance of both channels; none is kept from being negative.
        probability: To switch per step.
    """
    model = jn.Model(
        transition=lambda p, x, u: jnp.array([[1.0, 0.1], [0.0, 1.0]]) @ x,
        process_noise=lambda p, x, u: 0.01 * jnp.eye(2),
        observe=lambda p, x, u: x,
        observation_noise=lambda p, x, u: p * jnp.ones(2),
    )
    bank = jn.bank(jn.kf(model), jn.chain(jn.markov(), jn.bayes()))
    prior = jn.Gaussian(jnp.zeros(2), jnp.eye(2))
    members = jn.FilterParams(noise * jnp.array([1.0, 2.0]), jn.replicate(prior, 2))
    z = np.random.default_rng(0).normal(size=(STEPS, 2))
    observations = jn.Obs(jnp.array(z), jnp.ones((STEPS, 2), bool))
    params = jn.BankParams(members, (probability, ()))
    return jn.negative_log_likelihood(bank, params, jnp.zeros(STEPS), observations)


def descend(start: Array) -> float | None:
    """Return the score at the end of a descent from ``(noise, logit)``; ``None`` if refused."""

    def loss(point: Array) -> Array:
        return score(point[0], jax.nn.sigmoid(point[1]))

    try:
        found = jn.fit(loss, start, transform=REAL, steps=20)
    except ValueError as error:
        if "not finite" not in str(error):
            raise
        return None
    return float(loss(found.params))


def main() -> int:
    """Descend from every start and write what came of it."""
    starts = np.random.default_rng(SEED).uniform([-3.0, -4.0], [5.0, 4.0], (STARTS, 2))
    ends = [descend(jnp.array(start)) for start in starts]
    sound = [end for end in ends if end is not None]
    result = {
        "starts": STARTS,
        "seed": SEED,
        "refused": STARTS - len(sound),
        "ended in failure": int(np.sum(~np.isfinite(sound))),
        "largest score at an end": float(np.max(sound)),
    }
    RECORD.write_text(json.dumps(result, indent=2) + "\n")
    print(RECORD.read_text())
    return int(result["ended in failure"] > 0)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sys.exit(main())
