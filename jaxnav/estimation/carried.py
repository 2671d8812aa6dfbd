"""States that a process carries besides its own: biases, scales and arms, each seen by name.

    process = carrying(own, {"barometer_bias": gauss_markov(1)}, period=lambda u: u.dt)
    x.position, x.barometer_bias          # a state of its own, and one that is carried
    start = with_carried(start, {"barometer_bias": (zeros(1), variance)})

Carried states move by laws of their own. The tangent space has the coordinates of the process, then
those of the carried states in the order of their names.
"""

import keyword
from collections.abc import Callable, Mapping
from difflib import get_close_matches
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.arguments import (
    as_array,
    described,
    known,
    require_array,
    require_function,
    require_number,
    require_real,
    require_whole,
)
from jaxnav.estimation.checks import require_covariance
from jaxnav.estimation.models import PROCESS, Differential, Process
from jaxnav.estimation.types import Gaussian, Input, Params, Point


class Carried(NamedTuple):
    """A state with what it carries; the fields of either are attributes of the whole.

    Attributes:
        own: The state of the process.
        carried: The carried states ``(k,)`` by name.
    """

    own: Any
    carried: dict[str, Array]

    def __getattr__(self, name: str) -> Any:
        """Return a carried state, or a field of the process's state, by name."""
        if name in self.carried:
            return self.carried[name]
        # An array's attributes stay hidden, or the whole would be taken for an array.
        if name in getattr(self.own, "_fields", ()) or isinstance(self.own, Carried):
            return getattr(self.own, name)
        raise AttributeError(f"the state has no {name!r}, nor does it carry one")


class Law(NamedTuple):
    """How a carried state ``(size,)`` moves, each entry alone; see :func:`gauss_markov`.

    Attributes:
        size: Number of entries.
        keep: ``(params, dt) -> (size,)`` or ``()``: the factor on the state over ``dt`` seconds.
        variance: ``(params, dt) -> (size,)`` or ``()``: of the noise that is added.
    """

    size: int
    keep: Callable[[Params, Array], Array]
    variance: Callable[[Params, Array], Array]


class GaussMarkov(NamedTuple):
    """Parameters of :func:`gauss_markov`: stationary sigma and correlation time [s]."""

    sigma: Array
    time: Array


def gauss_markov(size: int) -> Law:
    """Return a first-order Gauss-Markov process; its parameters are :class:`GaussMarkov`.

        x+ = e^(-dt / time) x + w,   var w = sigma^2 (1 - e^(-2 dt / time))

    References:
        Bar-Shalom, Li, Kirubarajan (2001), section 8.2.3.
    """
    return Law(
        size,
        lambda params, dt: jnp.exp(-dt / params.time),
        lambda params, dt: params.sigma**2 * -jnp.expm1(-2 * dt / params.time),
    )


def random_walk(size: int) -> Law:
    """Return a random walk with ``var w = q^2 dt``; its parameter is ``q`` [unit/sqrt(s)]."""
    return Law(size, lambda params, dt: jnp.ones_like(dt), lambda params, dt: params**2 * dt)


def constant(size: int) -> Law:
    """Return a state that does not change; its parameters are ``()``."""
    return Law(size, lambda params, dt: jnp.ones_like(dt), lambda params, dt: jnp.zeros_like(dt))


class CarriedParams(NamedTuple):
    """Parameters of the process, and of each carried state's law by name."""

    own: Params
    carried: Mapping[str, Params]


def own_params(params: CarriedParams, name: str) -> Params:
    """Return the part of a name, as channels that read the parameters of the process take it.

    For :func:`~jaxnav.estimation.models.observing` around a process that carries states.
    """
    return params if name == PROCESS else params.own


def carrying(
    process: Process,
    states: Mapping[str, Law],
    *,
    period: float | Callable[[Input], Array],
    inputs: Callable[[Mapping[str, Array], Input], Input] | None = None,
) -> Process:
    """Return a process that carries more states than its own.

    A channel reads them by name, as ``x.name``, beside the fields of the process's state. Of a
    model that is not in parts, :func:`~jaxnav.estimation.models.process_of` is the process.

    Args:
        process: What to add states to; it may carry some already.
        states: Their laws by name.
        period: Length of a step [s], or ``(u) -> dt``.
        inputs: ``(carried, u) -> u`` as the process is to see them: less a scale factor, say.

    Returns:
        The process, with :class:`Carried` states and :class:`CarriedParams`. Its differential,
        where the process has one, is that of the process, and automatic in how ``inputs`` lets
        carried states in.

    Raises:
        ValueError: If there is no state, one is carried twice, its name is no name for an attribute
            or its size is below one; in a run, if the process has a state of that name itself.
    """
    if not isinstance(process, Process):
        raise ValueError(
            f"process is {described(process)}; carrying takes a Process, of a model "
            "process_of(model)"
        )
    _check_names(process, states)
    if callable(period):
        require_function("period", period, "u")
    else:
        require_number("period", period, "[0, inf]", 0, jnp.inf)
    if inputs is not None:
        require_function("inputs", inputs, "carried", "u")
    # As a tree of JAX has them: then no order in which they are named can be a wrong one.
    states = dict(sorted(states.items()))
    total = sum(law.size for law in states.values())
    step = period if callable(period) else lambda u: jnp.asarray(period)
    corrected = inputs or (lambda carried, u: u)
    split, flat = partial(_split, states), partial(_flat, states)

    def laws(params: CarriedParams, u: Input, what: str) -> Array:
        return _of_laws(states, params, jnp.maximum(step(u), 0), what)

    def moved_own(params: CarriedParams, x: Carried, u: Input) -> Point:
        _check_params(params, states)
        taken = _fields_of(x.own) & set(states)
        if taken:
            raise ValueError(f"the process has a state {min(taken)!r} itself; carry another name")
        return process.transition(params.own, x.own, corrected(x.carried, u))

    def transition(params: CarriedParams, x: Carried, u: Input) -> Carried:
        return Carried(moved_own(params, x, u), split(laws(params, u, "keep") * flat(x.carried)))

    def noise(params: CarriedParams, x: Carried, u: Input) -> Array:
        own = process.noise(params.own, x.own, corrected(x.carried, u))
        return jax.scipy.linalg.block_diag(own, jnp.diag(laws(params, u, "variance")))

    def retract(x: Carried, dx: Array) -> Carried:
        rest = dx.shape[0] - total
        return Carried(process.retract(x.own, dx[:rest]), split(flat(x.carried) + dx[rest:]))

    def local(x: Carried, y: Carried) -> Array:
        _check_state(x, states)
        return jnp.concatenate([process.local(x.own, y.own), flat(y.carried) - flat(x.carried)])

    def differential(params: CarriedParams, x: Carried, u: Input) -> Differential | None:
        by = process.differential
        own = by and by(params.own, x.own, corrected(x.carried, u))
        if own is None:
            return None
        keep = laws(params, u, "keep")
        let_in = None if inputs is None else _by_carried(moved_own, process, params, x, u, split)

        def moved(dx: Array) -> Array:
            rest = dx.shape[0] - total
            ahead = own(dx[:rest]) if callable(own) else own @ dx[:rest]
            if let_in is not None:
                ahead = ahead + let_in @ dx[rest:]
            return jnp.concatenate([ahead, keep * dx[rest:]])

        return moved

    return Process(
        transition,
        noise,
        retract,
        local,
        None if process.differential is None else differential,
        (*process.carried, *((name, law.size) for name, law in states.items())),
    )


def _split(states: Mapping[str, Law], flat: Array) -> dict[str, Array]:
    """Return by name what is laid out as in the tangent space."""
    parts, first = {}, 0
    for name, law in states.items():
        parts[name] = flat[first : first + law.size]
        first += law.size
    return parts


def _flat(states: Mapping[str, Law], carried: Mapping[str, Array]) -> Array:
    """Return carried states laid out as in the tangent space."""
    return jnp.concatenate([carried[name] for name in states])


def _of_laws(states: Mapping[str, Law], params: CarriedParams, dt: Array, what: str) -> Array:
    """Return a property of all laws over ``dt`` seconds, laid out as in the tangent space."""
    found = [
        jnp.broadcast_to(getattr(law, what)(params.carried[name], dt), (law.size,))
        for name, law in states.items()
    ]
    return jnp.concatenate(found)


def with_carried(initial: Gaussian, states: Mapping[str, tuple[Array, Array]]) -> Gaussian:
    """Return what is known at the start with that of carried states, which are independent of it.

    Args:
        initial: Of the process.
        states: Mean ``(k,)`` and variance, a covariance ``(k, k)`` or its diagonal ``(k,)``, by
            name.

    Raises:
        ValueError: If a mean is no vector, its variance has another size, or either is no such.
    """
    if not isinstance(initial, Gaussian):
        raise ValueError(f"initial is {described(initial)}; it must be Gaussian(mean, cov)")
    require_array("the initial covariance", initial.cov)
    if not isinstance(states, Mapping):
        raise ValueError(
            f"states is {described(states)}; it must be a mapping of names to (mean, variance)"
        )
    for name, entry in states.items():
        if not isinstance(entry, tuple | list) or len(entry) != 2:
            raise ValueError(
                f"{name!r} of states is {described(entry)}; it must be (mean, variance)"
            )
    states = {name: _known_before(name, *entry) for name, entry in sorted(states.items())}
    wide = [cov if jnp.ndim(cov) == 2 else jnp.diag(cov) for _, cov in states.values()]
    mean = Carried(initial.mean, {name: value for name, (value, _) in states.items()})
    return Gaussian(mean, jax.scipy.linalg.block_diag(initial.cov, *wide))


def check_carried(states: Mapping[str, Law], known: Mapping[str, int]) -> None:
    """Check states that a model is to carry against those that it makes use of.

    Args:
        states: Their laws by name.
        known: Sizes of those that the model knows by name; others are for channels to come.

    Raises:
        ValueError: If one that is known has another size, or an unknown name is nearly a known one.
    """
    if not isinstance(states, Mapping):
        raise ValueError("carry must be a mapping of names to laws, as {'lever_arm': constant(3)}")
    for name, law in states.items():
        near = get_close_matches(name, known, 1, cutoff=0.8)
        if name not in known and near:
            raise ValueError(f"the model makes no use of {name!r}; did you mean {near[0]!r}?")
        if known.get(name, law.size) != law.size:
            raise ValueError(
                f"the carried state {name!r} has the size {law.size}; it must be {known[name]}"
            )


def carried_or(x: Any, name: str, size: int, default: Any) -> Any:
    """Return a state that is carried under a name, or a default where none is.

    Raises:
        ValueError: If it is carried with another size.
    """
    found = getattr(x, name, None)
    if found is None:
        return default
    if jnp.shape(found) != (size,):
        raise ValueError(f"the carried state {name!r} is {jnp.shape(found)}; it must be ({size},)")
    return found


def _known_before(name: str, mean: Any, variance: Any) -> tuple[Array, Array]:
    mean = _floating(f"the mean of {name!r}", mean)
    variance = _floating(f"the variance of {name!r}", variance)
    k = mean.shape[0] if mean.ndim == 1 else 0
    if k == 0:
        raise ValueError(f"the mean of {name!r} is {mean.shape}; it must be (k,)")
    if variance.shape not in ((k,), (k, k)):
        raise ValueError(
            f"the variance of {name!r} is {variance.shape}; it must be ({k},) or ({k}, {k})"
        )
    spread = known(variance)
    if spread is not None:
        cov = np.diag(spread) if spread.ndim == 1 else spread
        require_covariance(f"the variance of {name!r}", cov)
    return mean, variance


def _floating(name: str, value: Any) -> Array:
    """Return an array in the precision that it has, whole numbers in the usual one."""
    array = as_array(name, value)
    require_real(name, array)
    return array if jnp.issubdtype(array.dtype, jnp.floating) else array.astype(float)


def _fields_of(x: Any) -> set[str]:
    """Return the names by which parts of a state are seen."""
    if isinstance(x, Carried):
        return set(x.carried) | _fields_of(x.own)
    return set(getattr(x, "_fields", ()))


def _check_params(params: Any, states: Mapping[str, Law]) -> None:
    if not isinstance(params, CarriedParams):
        raise ValueError(
            f"the parameters are {described(params)}; a process that carries states takes "
            "CarriedParams(own, {name: parameters of its law})"
        )
    for name in states:
        if name not in params.carried:
            raise ValueError(f"there are no parameters of the carried state {name!r}")
    for name in params.carried:
        if name not in states:
            raise ValueError(f"there are parameters of {name!r}, which is not carried")


def _check_state(x: Any, states: Mapping[str, Law]) -> None:
    if not isinstance(x, Carried):
        raise ValueError(
            f"the state is {described(x)}; one that carries {', '.join(states)} is "
            "Carried(own, {name: state}), as with_carried makes the initial one"
        )
    for name, law in states.items():
        if name not in x.carried:
            raise ValueError(f"the state lacks the carried {name!r}")
        if jnp.shape(x.carried[name]) != (law.size,):
            raise ValueError(
                f"the carried state {name!r} is {jnp.shape(x.carried[name])}; it must be "
                f"({law.size},)"
            )


def _check_names(process: Process, states: Mapping[str, Law]) -> None:
    before = {name for name, _ in process.carried}
    if not isinstance(states, Mapping):
        raise ValueError(f"states is {described(states)}; it must be a mapping of names to laws")
    if not states:
        raise ValueError("there is no state to carry; name one or more, with its law")
    for name, law in states.items():
        if not isinstance(law, Law):
            raise ValueError(
                f"the law of {name!r} is {described(law)}; it must be a Law, as constant(3) is"
            )
        if name in before:
            raise ValueError(f"the state {name!r} is carried twice; carry each once")
        if (
            not isinstance(name, str)
            or not name.isidentifier()
            or keyword.iskeyword(name)
            or hasattr(Carried, name)
        ):
            raise ValueError(f"{name!r} cannot be the name of a carried state; take an attribute's")
        require_whole(f"the size of the carried state {name!r}", law.size, 1)


def _by_carried(
    moved_own: Callable, process: Process, params: Params, x: Carried, u: Input, split: Callable
) -> Array:
    """Return the derivative ``(n, k)`` of the process's next state by the carried ones."""
    ahead = moved_own(params, x, u)

    def by(d: Array) -> Array:
        disturbed = {name: x.carried[name] + part for name, part in split(d).items()}
        return process.local(ahead, moved_own(params, Carried(x.own, disturbed), u))

    size = sum(value.shape[0] for value in x.carried.values())
    return jax.jacfwd(by)(jnp.zeros(size, next(iter(x.carried.values())).dtype))
