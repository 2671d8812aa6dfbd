"""A damped oscillator under every filter and bank, as a loss by its noise and own parameters."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.estimation.banks.imm import uniform_switching
from jaxnav.estimation.banks.mixture import BankParams
from jaxnav.estimation.banks.reset import WindowedReset
from jaxnav.estimation.banks.weights import Penalty
from jaxnav.estimation.filters.adaptive import Adaptation
from jaxnav.estimation.filters.line_search import Search
from jaxnav.estimation.filters.robust import Correntropy, Versoria
from jaxnav.estimation.filters.sage_husa import SageHusa
from jaxnav.estimation.tune.losses import negative_log_likelihood
from jaxnav.estimation.types import FilterParams, Gaussian, Model, Obs, replicate
from jaxnav.numerics.sigma import unscented
from tests.cases import Noise, cases


def oscillator(observe: Callable[[Array], Array]) -> Model:
    """A damped oscillator of two states that is pushed; its noise is of rank one."""
    return Model(
        transition=lambda p, x, u: jnp.stack([x[0] + 0.5 * x[1], 0.8 * x[1] - 0.1 * x[0] + u]),
        process_noise=lambda p, x, u: p.q * jnp.diag(jnp.array([0.0, 1.0])),
        observe=lambda p, x, u: observe(x[:1]),
        observation_noise=lambda p, x, u: p.r * jnp.ones(1),
    )


PARAMS = FilterParams(
    Noise(jnp.array(1.0), jnp.array(1.0)), Gaussian(jnp.zeros(2), jnp.diag(jnp.array([2.0, 1.0])))
)
CASES = cases(oscillator(lambda x: x), PARAMS, 1, oscillator(lambda x: x + 0.3 * jnp.sin(x)))


def searched(v: Array) -> Search:
    """Return a smooth search: a hard one is a decision, across which there is no derivative."""
    return Search(v[0], v[1], temperature=v[2])


UNSCENTED = (0.8,), lambda p, v: p._replace(own=unscented(2, alpha=v[0]))
SEARCH = (0.7, 0.9, 0.5), lambda p, v: p._replace(own=searched(v))
OWN: dict[str, tuple[tuple[float, ...], Callable[[Any, Array], Any]]] = {
    "ukf": UNSCENTED,
    "square_root_ukf": UNSCENTED,
    "iterated_ekf": ((0.9, 0.5), lambda p, v: p._replace(own=Search(1.0, v[0], 1e-4, v[1]))),
    "iterated_ckf": SEARCH,
    "modified_iterated_ckf": SEARCH,
    "versoria": ((0.1, 2.0), lambda p, v: p._replace(own=Versoria(v[0], v[1]))),
    "correntropy": ((3.0,), lambda p, v: p._replace(own=Correntropy(v[0]))),
    "innovation_adaptive": (
        (20.0,),
        lambda p, v: p._replace(own=Adaptation(v[0], 0.01, 1e2)),
    ),
    "sage_husa": ((0.95, 5.0), lambda p, v: p._replace(own=SageHusa(v[0], v[1], 0.1, 1e2))),
    "immae, smooth": (
        (5.0, 0.9, 0.05),
        lambda p, v: p._replace(rule=((), WindowedReset(v[0], v[1], v[2]))),
    ),
    "floor": ((1e-3,), lambda p, v: p._replace(rule=((), v[0]))),
    "forget": ((0.95,), lambda p, v: p._replace(rule=(v[0], ()))),
    "markov": ((0.05,), lambda p, v: p._replace(rule=(v[0], ()))),
    "penalty": ((0.5, 0.15, 9.0, 0.1, 1.0), lambda p, v: p._replace(rule=Penalty(*v))),
    "imm": ((0.05,), lambda p, v: p._replace(rule=uniform_switching(3, v[0]))),
    "mmae of iterated_ckf": (
        (0.7, 0.9, 0.5),
        lambda p, v: p._replace(members=p.members._replace(own=replicate(searched(v), 3))),
    ),
}
"""Parameters beside the noise, at which the gradient is taken, and how they enter."""


class Data(NamedTuple):
    """The push at each step and what was observed."""

    inputs: Array
    observations: Obs


def data(steps: int) -> Data:
    """Draw a run of the oscillator that is observed bent, a fifth of it missing."""
    rng = np.random.default_rng(12)
    push, v = rng.normal(size=(2, steps))
    w, x, z = 1.5 * rng.normal(size=steps), np.zeros(2), np.zeros((steps, 1))
    for k in range(steps):
        x = np.array([x[0] + 0.5 * x[1], 0.8 * x[1] - 0.1 * x[0] + push[k] + w[k]])
        z[k] = x[0] + 0.15 * np.sin(x[0]) + v[k]
    return Data(jnp.array(push), Obs(jnp.array(z), jnp.array(rng.uniform(size=(steps, 1)) > 0.2)))


def log_factors(name: str, steps: int, segment: int = 0) -> Callable[[Array], Array]:
    """Return the loss of a case by the logarithms of factors on its noise and own parameters."""
    filter, params, _ = CASES[name]
    own, enter = OWN.get(name, ((), lambda p, v: p))
    inputs, observations = data(steps)

    def loss(theta: Array) -> Array:
        factors = jnp.exp(theta)
        moved = enter(params, jnp.array(own) * factors[2:])
        inner = moved.members if isinstance(moved, BankParams) else moved
        noise = Noise(inner.model.q * factors[0], inner.model.r * factors[1])
        inner = inner._replace(model=noise)
        moved = moved._replace(members=inner) if isinstance(moved, BankParams) else inner
        return negative_log_likelihood(filter, moved, inputs, observations, segment=segment)

    return loss


def start(name: str) -> np.ndarray:
    return np.append([0.1, -0.2], np.zeros(len(OWN.get(name, ((),))[0])))
