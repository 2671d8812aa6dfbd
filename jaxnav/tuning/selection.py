"""Which parameters of a problem are tuned, where they start, and within what bounds."""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxnav.config import ConfigError, require
from jaxnav.estimation.tune.transforms import FIXED, Transform, between, coordinates
from jaxnav.studies.tuned import Parameter, Problem
from jaxnav.tuning.config import TuneConfig, parse_bounds, parse_start

EDGE = 1e-9
"""Share of a span by which its ends are moved inwards before they are held against a domain, so
that a bound may be the end of an open domain."""


class Selection(NamedTuple):
    """Starting values and transforms by name; what is not tuned is fixed."""

    start: dict[str, Any]
    transforms: dict[str, Transform]


def select(problem: Problem, config: TuneConfig) -> Selection:
    """Return what a configuration selects of a problem's parameters.

    Raises:
        ConfigError: If a name is not one of them, or a value or a bound is outside the domain.
    """
    parameters = problem.parameters
    given, bounds = parse_start(config.start), parse_bounds(config.bounds)
    for names in (config.params, given, bounds):
        _require_known(names, parameters)
    chosen = config.params or tuple(parameters)
    start, transforms = {}, {}
    for name, parameter in parameters.items():
        start[name] = _started(name, parameter, given.get(name))
        transforms[name] = parameter.transform
        if name in bounds:
            transforms[name] = _bounded(name, parameter.transform, bounds[name])
        _require_inside(name, start[name], transforms[name])
        if name not in chosen:
            transforms[name] = FIXED
    return Selection(start, transforms)


def _require_known(names: Iterable[str], parameters: Mapping[str, Parameter]) -> None:
    for name in names:
        if name not in parameters:
            known = ", ".join(parameters)
            raise ConfigError(f"there is no parameter {name!r}; it must be one of {known}")


def _started(name: str, parameter: Parameter, given: tuple[float, ...] | None) -> Any:
    start = jnp.asarray(parameter.start, float)
    if given is None:
        return start
    count = len(given)
    accepted = f"{start.size} numbers" if start.ndim else "one number"
    require(count == start.size, f"start of {name}", ",".join(map(str, given)), accepted)
    return jnp.array(given).reshape(start.shape)


def _bounded(name: str, domain: Transform, bounds: tuple[float, float]) -> Transform:
    low, high = bounds
    for value in (low + EDGE * (high - low), high - EDGE * (high - low)):
        if not np.isfinite(domain.unconstrain(jnp.asarray(value, float))):
            accepted = f"{domain.domain}, both ends"
            require(False, f"bounds of {name}", f"{low:g}:{high:g}", accepted)
    return between(low, high)


def _require_inside(name: str, value: Any, transform: Transform) -> None:
    try:
        coordinates({name: value}, {name: transform})
    except ValueError as error:
        if "every parameter is fixed" not in str(error):
            raise ConfigError(f"start of {error}") from None
