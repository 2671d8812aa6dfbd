"""What an optimum is worth: its gradient against differences, its profiles, its covariance."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.estimation.tune.fit import value_and_gradient
from jaxnav.estimation.tune.transforms import POSITIVE, Coordinates, coordinates


class GradientCheck(NamedTuple):
    """A gradient beside central differences, by real coordinate.

    Attributes:
        labels: ``d`` names of the coordinates.
        gradient: ``(d,)`` by automatic differentiation.
        difference: ``(d,)`` by central differences.
        error: Largest deviation, relative to the largest entry of the difference.
    """

    labels: tuple[str, ...]
    gradient: np.ndarray
    difference: np.ndarray
    error: float


def check_gradient(
    loss: Callable[..., Array],
    params: Any,
    *,
    data: tuple[Any, ...] = (),
    transform: Any = POSITIVE,
    step: float = 1e-4,
    mode: str = "reverse",
) -> GradientCheck:
    """Compare the gradient of a loss with central differences, in unconstrained coordinates.

    The differences err by the square of the step and by the rounding of the loss over the step.

    Args:
        loss: ``(params, *data) -> scalar``.
        params: Where.
        data: What the loss is given, beside the parameters.
        transform: As for :func:`~jaxnav.estimation.tune.fit.fit`; so is ``mode``.
        step: Half the distance of the differences.
        mode: See above.
    """
    free = coordinates(params, transform)
    graded = _graded(loss, free, data, mode)
    gradient = np.asarray(graded(free.start)[1])
    offsets = step * np.eye(free.start.size)
    difference = np.array(
        [
            float(graded(free.start + offset)[0] - graded(free.start - offset)[0]) / (2 * step)
            for offset in offsets
        ]
    )
    largest = np.max(np.abs(difference))
    error = float(np.max(np.abs(gradient - difference)) / largest) if largest > 0 else 0.0
    return GradientCheck(free.labels, gradient, difference, error)


def _graded(
    loss: Callable[..., Array], free: Coordinates, data: tuple[Any, ...], mode: str
) -> Callable[[Array], tuple[Array, Array]]:
    program = compiled(
        value_and_gradient(lambda point, data: loss(free.constrain(point), *data), mode)
    )
    return lambda point: program(point, data)


class Profile(NamedTuple):
    """A loss along each real coordinate, the others held.

    Attributes:
        labels: ``d`` names of the coordinates.
        offset: ``(points,)`` in the coordinate: a step of 0.1 in a logarithm is 10 %.
        value: ``(d, points)`` the parameter's own value there, as in
            :class:`~jaxnav.estimation.tune.transforms.Coordinates`.
        loss: ``(d, points)``.
    """

    labels: tuple[str, ...]
    offset: np.ndarray
    value: np.ndarray
    loss: np.ndarray


def profile(
    loss: Callable[..., Array],
    params: Any,
    *,
    data: tuple[Any, ...] = (),
    transform: Any = POSITIVE,
    width: float = 1.0,
    points: int = 9,
) -> Profile:
    """Evaluate a loss along each parameter, within ``width`` of its real coordinate.

    Args:
        loss: ``(params, *data) -> scalar``.
        params: The middle.
        data: What the loss is given, beside the parameters.
        transform: As for :func:`~jaxnav.estimation.tune.fit.fit`.
        width: Largest offset in the coordinate, a factor of e for a positive parameter.
        points: Number of offsets; odd, so that the middle is one of them.
    """
    free = coordinates(params, transform)
    offset = np.linspace(-width, width, points)
    program = compiled(lambda point, data: loss(free.constrain(point), *data))
    behind = compiled(free.values)
    directions = np.eye(free.start.size)
    around = [[free.start + o * d for o in offset] for d in directions]
    losses = np.array([[float(program(point, data)) for point in row] for row in around])
    values = np.array([[behind(point)[i] for point in row] for i, row in enumerate(around)])
    return Profile(free.labels, offset, values, losses)


class Uncertainty(NamedTuple):
    """How well a likelihood knows the parameters of its optimum.

    Attributes:
        labels: ``d`` names of the coordinates.
        covariance: ``(d, d)`` of the real coordinates.
        sigma: Pytree like the parameters: their standard deviations, to first order.
    """

    labels: tuple[str, ...]
    covariance: np.ndarray
    sigma: Any


def fisher(
    loss: Callable[..., Array],
    params: Any,
    samples: int,
    *,
    data: tuple[Any, ...] = (),
    transform: Any = POSITIVE,
    step: float = 1e-3,
    mode: str = "reverse",
) -> Uncertainty:
    """Return the covariance of a maximum-likelihood fit by the observed Fisher information.

    The information is the Hessian of the negative log-likelihood at its optimum, by central
    differences of the gradient. It holds for the right model and a smooth optimum inside the
    domain.

    Args:
        loss: ``(params, *data) -> scalar``, the mean negative log-likelihood per sample [nats].
        params: The optimum.
        samples: Number of samples the mean is over: steps times runs.
        data: What the loss is given, beside the parameters.
        transform: As for :func:`~jaxnav.estimation.tune.fit.fit`; so is ``mode``.
        step: Half the distance of the differences, in the real coordinates.
        mode: See above.

    Raises:
        ValueError: If the Hessian there is not positive definite: the point is no optimum, or the
            data say nothing about a combination of the parameters.
    """
    free = coordinates(params, transform)
    graded = _graded(loss, free, data, mode)
    offsets = step * np.eye(free.start.size)
    rows = [
        np.asarray(graded(free.start + offset)[1] - graded(free.start - offset)[1]) / (2 * step)
        for offset in offsets
    ]
    information = samples * 0.5 * (np.array(rows) + np.array(rows).T)
    if not np.all(np.linalg.eigvalsh(information) > 0):
        raise ValueError(
            "the likelihood has no maximum here: its Hessian is not positive definite in "
            + ", ".join(free.labels)
        )
    covariance = np.linalg.inv(information)
    slope = compiled(jax.jacfwd(free.constrain))(free.start)
    sigma = jax.tree.map(lambda J: np.sqrt(np.einsum("...i,ij,...j->...", J, covariance, J)), slope)
    return Uncertainty(free.labels, covariance, sigma)
