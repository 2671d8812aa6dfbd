"""Star tracker: the attitude with a small isotropic error."""

import jax
from jax import Array

from jaxnav.numerics.lie import so3_exp
from jaxnav.numerics.linalg import matmul


def observe_attitude(key: Array, dcm: Array, noise: Array) -> Array:
    """Return the attitudes a star tracker reports, ``exp([v]x) C_ib`` with white ``v``.

    Args:
        key: Random key.
        dcm: ``(K, 3, 3)`` true attitudes C_ib.
        noise: ``(3,) [rad]`` standard deviations of ``v``, in inertial axes.

    Returns:
        ``(K, 3, 3)`` measured attitudes.
    """
    v = noise[None] * jax.random.normal(key, (dcm.shape[0], 3), dcm.dtype)
    return jax.vmap(lambda e, C: matmul(so3_exp(e), C))(v, dcm)
