"""What every update shares: masked channels, the verdict on an innovation, checks of shapes."""

import math
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.estimation.types import Flag, Gaussian, Info, Model, Obs
from jaxnav.numerics.conditioning import Solved, log_volume, solved, squared
from jaxnav.numerics.linalg import Cholesky, log_det, solve_lower

ILL_CONDITIONED_EPS = 1e3
"""Multiple of the machine epsilon below which a Cholesky pivot is called ill-conditioned."""


def masked_innovation(model: Model, obs: Obs, z_pred: Array) -> Array:
    """Return the residual ``(m,)``, zero where no value arrived, whatever the value says.

    Raises:
        ValueError: If the observation and the model's prediction of it differ in shape.
    """
    require_channels(obs, z_pred.shape)
    z = jnp.where(obs.valid, obs.z, z_pred)
    return jnp.where(obs.valid, model.residual(z, z_pred), 0)


def require_channels(obs: Obs, observed: tuple[int, ...]) -> None:
    """Raise ``ValueError`` unless the observation has the shape that the model observes."""
    if obs.z.shape != observed or obs.valid.shape != observed:
        raise ValueError(
            f"the observation has z {obs.z.shape} and valid {obs.valid.shape}; "
            f"the model observes {observed}"
        )


def noise_of_channels(model: Model, params: Any, x: Any, u: Any, obs: Obs) -> Array:
    """Return a model's noise covariance ``(m, m)`` at a state, masked as by :func:`mask_noise`.

    Raises:
        ValueError: If observation, model and noise do not fit together.
    """
    require_channels(obs, jax.eval_shape(model.observe, params, x, u).shape)
    return mask_noise(model.observation_noise(params, x, u), obs.valid)


def mask_noise(R: Array, valid: Array) -> Array:
    """Return the noise covariance ``(m, m)`` with the identity in channels that are not valid.

    Args:
        R: Covariance ``(m, m)`` or its diagonal ``(m,)``.
        valid: ``(m,)`` bool.

    Raises:
        ValueError: If ``R`` has another size.
    """
    m = valid.shape[0]
    if R.shape not in ((m,), (m, m)):
        raise ValueError(
            f"the observation noise is {R.shape}; with {m} channels it must be ({m}, {m}) or ({m},)"
        )
    dense = jnp.diag(R) if R.ndim == 1 else R
    both = valid[:, None] & valid[None, :]
    return jnp.where(both, dense, jnp.eye(m, dtype=R.dtype))


def require_prior(model: Model, initial: Gaussian) -> None:
    """Raise ``ValueError`` unless the covariance at t0 has the size of the tangent space."""
    n = jax.eval_shape(model.local, initial.mean, initial.mean).shape[0]
    if jnp.shape(initial.cov) != (n, n):
        raise ValueError(
            f"the initial covariance is {jnp.shape(initial.cov)}; the initial mean has {n} tangent "
            f"coordinates, so it must be ({n}, {n})"
        )


def require_step(model: Model, x: Any, moved: Any, Q: Array) -> None:
    """Raise ``ValueError`` unless a transition keeps the shape and its noise fits the tangent."""
    before, after = ([jnp.shape(leaf) for leaf in jax.tree.leaves(tree)] for tree in (x, moved))
    if before != after:
        raise ValueError(
            f"the transition takes a state of shape {_shapes(before)} to {_shapes(after)}; "
            "it must keep the shape"
        )
    n = jax.eval_shape(model.local, x, moved).shape[0]
    if Q.shape != (n, n):
        raise ValueError(f"the process noise is {Q.shape}; it must be ({n}, {n}), as the state")


def _shapes(shapes: list[tuple[int, ...]]) -> str:
    return ", ".join(map(str, shapes))


def innovation_info(
    nu: Array,
    S: Array,
    root: Cholesky,
    valid: Array,
    indefinite: Array | None = None,
    *,
    rooted: bool = False,
    solution: Solved | None = None,
) -> Info:
    """Judge an innovation ``(m,)`` against its covariance ``(m, m)`` and its factor, all masked.

    Args:
        nu: Innovation.
        S: Its covariance.
        root: The factor of ``S``.
        valid: ``(m,)`` bool.
        indefinite: Whether a covariance had to be mended in this step.
        rooted: Whether the factor was computed and ``S`` is its square, which has half the digits:
            the derivative is then taken through the factor, else through ``S`` at less cost.
        solution: What :func:`~jaxnav.numerics.conditioning.solved` gave, where it is at hand.
    """
    if rooted:
        whitened = solve_lower(root.factor, nu)
        distance, volume = jnp.sum(whitened * whitened), log_det(root.factor)
    else:
        known = solved(S, root, nu) if solution is None else solution
        root = known.root
        distance = squared(S, nu, root.factor, known.weighed)
        volume = log_volume(S, root.factor, known.inverse)
    usable = root.positive_definite
    nis = jnp.where(usable, distance, 0)
    channels = jnp.sum(valid).astype(S.dtype)
    log_likelihood = -0.5 * (nis + volume + channels * math.log(2 * math.pi))
    few_digits = root.reciprocal_pivot < ILL_CONDITIONED_EPS * jnp.finfo(S.dtype).eps
    raised = {
        Flag.NO_OBSERVATION: ~jnp.any(valid),
        Flag.NOT_POSITIVE_DEFINITE: ~usable,
        Flag.ILL_CONDITIONED: usable & few_digits,
    }
    if indefinite is not None:
        raised[Flag.INDEFINITE] = indefinite
    return Info(
        innovation=nu,
        innovation_cov=S,
        log_likelihood=jnp.where(usable, log_likelihood, -jnp.inf),
        nis=nis,
        iterations=jnp.ones((), jnp.int32),
        flags=_flags(raised),
    )


def _flags(raised: dict[Flag, Array]) -> Array:
    return sum(
        (jnp.where(on, int(flag), 0).astype(jnp.int32) for flag, on in raised.items()),
        jnp.zeros((), jnp.int32),
    )
