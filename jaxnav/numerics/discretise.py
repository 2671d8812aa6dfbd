"""From a linear system in continuous time to one over a step.

    Phi = e^(F dt),   Q = int_0^dt e^(F t) G Qc G' e^(F' t) dt

The series of both over a small fraction of the step are doubled up to the whole: what is zero by
the structure of ``F`` stays exactly zero, ``Q`` stays a covariance, and no inverse or growing mode
is formed, as it is by the exponential of Van Loan's matrix for a system that decays fast.

References:
    Van Loan (1978), IEEE Trans. Automatic Control 23(3), for the integrals, and the doubling of his
    Eqs. (1.1)-(1.3); Brown and Hwang (2012), section 3.9.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.core import Tracer
from jax.typing import ArrayLike

from jaxnav.arguments import as_array

DOUBLINGS, ORDER = 12, 10
LARGEST = 0.25 * 2**DOUBLINGS
"""Largest ``|F| dt``, the row sum norm, for which the result is right to rounding."""


class Discrete(NamedTuple):
    """A system over a step: transition ``Phi`` ``(n, n)`` and covariance ``Q`` ``(n, n)``."""

    Phi: Array
    Q: Array


def discretise(F: ArrayLike, G: ArrayLike | None, Qc: ArrayLike, dt: ArrayLike) -> Discrete:
    """Return transition and process noise over a step of ``dx/dt = F x + G w``.

    Args:
        F: Dynamics ``(n, n) [1/s]``.
        G: How the noise enters ``(n, k)``; ``None`` for ``k = n`` and the identity.
        Qc: Power spectral density of the noise ``(k, k)``, or its diagonal ``(k,)``.
        dt: Length of the step [s].

    Returns:
        ``Phi`` and ``Q``; not a number where ``|F| dt`` is above :data:`LARGEST`.

    Raises:
        ValueError: If shapes do not fit together, something is complex, or ``dt`` or a variance is
            known to be negative.
    """
    known = {"F": F, "Qc": Qc, "dt": dt, **({} if G is None else {"G": G})}
    given = {name: as_array(name, value) for name, value in known.items()}
    _require_real(given)
    # Whole numbers would make the fractions of a step zero.
    A = given["F"]
    A = A if jnp.issubdtype(A.dtype, jnp.floating) else A.astype(float)
    density = given["Qc"].astype(A.dtype)
    n = A.shape[0] if A.ndim else 0
    if A.shape != (n, n) or n == 0:
        raise ValueError(f"F is {A.shape}; it must be square, (n, n)")
    B = jnp.eye(n, dtype=A.dtype) if G is None else given["G"].astype(A.dtype)
    if B.ndim != 2 or B.shape[0] != n:
        raise ValueError(f"G is {B.shape}; with F {A.shape} it must be ({n}, k)")
    k = B.shape[1]
    if density.shape not in ((k,), (k, k)):
        raise ValueError(f"Qc is {density.shape}; with G {B.shape} it must be ({k}, {k}) or ({k},)")
    density = (B * density[None]) @ B.T if density.ndim == 1 else B @ density @ B.T
    h = jnp.asarray(dt, A.dtype) / 2**DOUBLINGS
    # The departure from the identity is kept apart: added to it, it would lose its digits.
    power, term = h * A, h * density
    X, Q = power, term
    for i in range(2, ORDER + 1):
        power = h / i * A @ power
        term = h / i * (A @ term + term @ A.T)
        X, Q = X + power, Q + term

    def doubled(_: int, now: tuple[Array, Array]) -> tuple[Array, Array]:
        X, Q = now
        moved = Q + X @ Q
        return 2 * X + X @ X, Q + moved + moved @ X.T

    X, Q = jax.lax.fori_loop(0, DOUBLINGS, doubled, (X, Q))
    sound = jnp.max(jnp.sum(jnp.abs(A), axis=1)) * jnp.abs(h) * 2**DOUBLINGS <= LARGEST
    Phi = jnp.eye(n, dtype=A.dtype) + X
    return Discrete(*(jnp.where(sound, value, jnp.nan) for value in (Phi, 0.5 * (Q + Q.T))))


def _require_real(given: dict[str, Array]) -> None:
    """Raise ``ValueError`` for what is complex, several steps, and a negative step or noise."""
    for name, value in given.items():
        if jnp.iscomplexobj(value):
            raise ValueError(f"{name} is complex; it must be of real numbers")
    dt, Qc = given["dt"], given["Qc"]
    if dt.ndim:
        raise ValueError(f"dt is {dt.shape}; it must be one number")
    variances = jnp.diag(Qc) if Qc.ndim == 2 else Qc
    for name, value in {"dt": dt, "a variance of Qc": variances}.items():
        if not isinstance(value, Tracer) and value.size and not float(jnp.min(value)) >= 0:
            raise ValueError(f"{name} is {float(jnp.min(value)):g}; it must not be negative")
    if Qc.ndim == 2 and not isinstance(Qc, Tracer) and Qc.shape[0] == Qc.shape[1]:
        off = float(jnp.max(jnp.abs(Qc - Qc.T), initial=0.0))
        if off > 1e-6 * float(jnp.max(jnp.abs(Qc), initial=0.0)):
            raise ValueError(f"Qc and its transpose differ by {off:g}; it must be symmetric")
