"""Checks of covariances while a filter runs, which cost nothing unless a run asks for them."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import jax.numpy as jnp
from jax import Array
from jax.experimental import checkify

from jaxnav.estimation.checks import ROUNDING

_STEP: ContextVar[Array | None] = ContextVar("step", default=None)


@contextmanager
def checking(step: Array | None) -> Iterator[None]:
    """Have covariances checked in what is traced within; ``None`` leaves it.

    Args:
        step: Index ``()`` of the step, for the message.
    """
    token = _STEP.set(step)
    try:
        yield
    finally:
        _STEP.reset(token)


def check_covariance(name: str, value: Callable[[], Array]) -> None:
    """Check a matrix ``(n, n)`` to be finite, symmetric and positive semi-definite, to rounding.

    Within :func:`checking` alone, and then under ``checkify``.

    Args:
        name: Of the matrix, for the message.
        value: Returns it.
    """
    step = _STEP.get()
    if step is None:
        return
    P = value()
    finite = jnp.all(jnp.isfinite(P))
    checkify.check(finite, f"{name} is not finite at step {{step}}", step=step)
    variance = jnp.diag(P)
    least = jnp.min(variance)
    negative = f"{name} has the variance {{least}} at step {{step}}; none may be negative"
    checkify.check(least >= 0, negative, least=least, step=step)
    sigma = jnp.sqrt(jnp.where(variance > 0, variance, 1))
    relative = jnp.where(finite, P / sigma[:, None] / sigma[None], jnp.eye(len(P), dtype=P.dtype))
    off = jnp.max(jnp.abs(relative - relative.T))
    asymmetric = f"{name} is not symmetric at step {{step}}: two entries differ by {{off}} sigmas"
    checkify.check(off <= ROUNDING, asymmetric, off=off, step=step)
    lowest = jnp.min(jnp.linalg.eigvalsh(relative))
    indefinite = (
        f"{name} is not positive semi-definite at step {{step}}: with variances scaled to one its "
        "least eigenvalue is {lowest}"
    )
    checkify.check(lowest >= -ROUNDING * len(P), indefinite, lowest=lowest, step=step)
