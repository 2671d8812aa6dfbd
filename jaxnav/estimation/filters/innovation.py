"""What every update shares: masked channels, the verdict on an innovation, checks of shapes."""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.arguments import require_array
from jaxnav.estimation.checks import ROUNDING
from jaxnav.estimation.debugging import check_covariance
from jaxnav.estimation.types import Flag, Info, Model, Obs, SureObs, flags_of
from jaxnav.numerics.conditioning import Solved, log_volume, solved, squared
from jaxnav.numerics.linalg import Cholesky, kernel, log_det, normalised_square, solve_lower
from jaxnav.numerics.roots import semidefinite_root

ILL_CONDITIONED_EPS = 1e3
"""Multiple of the machine epsilon below which a Cholesky pivot is called ill-conditioned."""


class Measurement(NamedTuple):
    """What an update takes of an observation.

    Attributes:
        obs: The observation; valid are the channels that can be used.
        noise: Covariance ``(m, m)`` of its noise, the identity in the channels that are not.
        failed: Whether noise is not a number: the update then counts as failed.
        flags: Sum of :class:`Flag`.
    """

    obs: Obs
    noise: Array
    failed: Array
    flags: Array

    def upon(self, info: Info) -> Info:
        """Return the info of an update of what can be used with what could not be."""
        likelihood = jnp.where(self.failed, -jnp.inf, info.log_likelihood)
        return info._replace(log_likelihood=likelihood, flags=info.flags | self.flags)


def measured_with(R: Array, obs: Obs) -> Measurement:
    """Return the channels of an observation that can be used, and their noise.

    A channel of infinite variance is missing; one of which the value is not finite is left out with
    a flag. Noise that is no covariance stays, with a flag. Where it is not a number the channel is
    left out and the likelihood is that of a failed update: leaving it out alone would speak for a
    member of a bank.

    Args:
        R: Covariance ``(m, m)`` or its diagonal ``(m,)``.
        obs: The observation.

    Raises:
        ValueError: If ``R`` has another size.
    """
    m = obs.valid.shape[0]
    require_array("the model's observation noise", R)
    if R.shape not in ((m,), (m, m)):
        raise ValueError(
            f"the model's observation noise is {R.shape} and the observation has {m} channels; "
            f"for these the noise must be ({m}, {m}) or ({m},)"
        )
    variance = R if R.ndim == 1 else jnp.diag(R)
    known = obs.valid & (variance != jnp.inf)
    check_covariance("the observation noise", lambda: mask_noise(R, known))
    broken = jnp.zeros(m, bool) if isinstance(obs, SureObs) else ~jnp.isfinite(obs.z)
    unknown = jnp.isnan(variance)
    if R.ndim == 2:
        unknown = jnp.any(jnp.isnan(R) & known[:, None] & known[None], axis=1)
    unknown = unknown & known & ~broken
    valid = known & ~broken & ~unknown
    improper = valid & (variance < 0)
    if R.ndim == 2:
        # A pair's bound is taken in roots: a product of two variances can leave the range.
        sigma = jnp.sqrt(jnp.where(variance > 0, variance, 0))
        both = valid[:, None] & valid[None]
        slack = 1 + 1e3 * jnp.finfo(R.dtype).eps
        beyond = jnp.abs(R) > slack * sigma[:, None] * sigma[None]
        improper = improper | jnp.any(both & beyond, axis=1)
    failed = jnp.any(unknown)
    raised = {
        Flag.NOT_FINITE: jnp.any(known & broken),
        Flag.INVALID_NOISE: jnp.any(improper) | failed,
    }
    return Measurement(obs._replace(valid=valid), mask_noise(R, valid), failed, flags_of(raised))


def masked_innovation(model: Model, obs: Obs, z_pred: Array) -> Array:
    """Return the residual ``(m,)``, zero where no value arrived, whatever the value says.

    Raises:
        ValueError: If the observation and the model's prediction of it differ in shape.
    """
    require_channels(obs, require_array("the model's observation", z_pred).shape)
    z = jnp.where(obs.valid, obs.z, z_pred)
    return jnp.where(obs.valid, model.residual(z, z_pred), 0)


def require_channels(obs: Obs, observed: tuple[int, ...]) -> None:
    """Raise ``ValueError`` unless the observation has the shape that the model observes."""
    if obs.z.shape != observed or obs.valid.shape != observed:
        raise ValueError(
            f"the observation has z {obs.z.shape} and valid {obs.valid.shape}; "
            f"the model observes {observed}"
        )


def measurement_of(model: Model, params: Any, x: Any, u: Any, obs: Obs) -> Measurement:
    """Return what can be used of an observation, with a model's noise at a state.

    Raises:
        ValueError: If observation, model and noise do not fit together.
    """
    seen = require_array("the model's observation", jax.eval_shape(model.observe, params, x, u))
    require_channels(obs, seen.shape)
    return measured_with(model.observation_noise(params, x, u), obs)


@kernel
def mask_noise(R: Array, valid: Array) -> Array:
    """Return the noise covariance ``(m, m)`` with the identity in channels that are not valid.

    Args:
        R: Covariance ``(m, m)`` or its diagonal ``(m,)``.
        valid: ``(m,)`` bool.
    """
    m = valid.shape[0]
    dense = jnp.diag(R) if R.ndim == 1 else R
    both = valid[:, None] & valid[None, :]
    return jnp.where(both, dense, jnp.eye(m, dtype=R.dtype))


def nis_of(info: Info, channels: Sequence[int] | np.ndarray) -> Array:
    """Return the normalised innovation squared of some channels of an update.

    One that was not used counts nothing: its innovation is zero and its row that of the identity.
    """
    at = np.array(channels)
    return normalised_square(info.innovation[at], info.innovation_cov[at][:, at])


@kernel
def is_covariance(P: Array) -> Array:
    """Return whether a matrix ``(n, n)`` is symmetric and positive semi-definite, to rounding."""
    sigma = jnp.sqrt(jnp.maximum(jnp.diag(P), 0))
    rounding = max(ROUNDING, 1e3 * float(jnp.finfo(P.dtype).eps)) * sigma[:, None] * sigma[None]
    symmetric = jnp.all(jnp.abs(P - P.T) <= rounding)
    return symmetric & semidefinite_root(P).semidefinite


def require_step(model: Model, x: Any, moved: Any, Q: Array) -> None:
    """Raise ``ValueError`` unless a transition keeps the shape and its noise fits the tangent."""
    before, after = ([jnp.shape(leaf) for leaf in jax.tree.leaves(tree)] for tree in (x, moved))
    if before != after:
        raise ValueError(
            f"the transition takes a state of shape {_shapes(before)} to {_shapes(after)}; "
            "it must keep the shape"
        )
    n = jax.eval_shape(model.local, x, moved).shape[0]
    require_array("the process noise", Q)
    if Q.shape != (n, n):
        raise ValueError(f"the process noise is {Q.shape}; it must be ({n}, {n}), as the state")
    check_covariance("the process noise", lambda: Q)


def _shapes(shapes: list[tuple[int, ...]]) -> str:
    return ", ".join(map(str, shapes))


@partial(kernel, static_argnames="rooted")
def innovation_info(
    nu: Array,
    S: Array,
    root: Cholesky,
    measurement: Measurement,
    indefinite: Array,
    *,
    rooted: bool = False,
    solution: Solved | None = None,
) -> Info:
    """Judge an innovation ``(m,)`` against its covariance ``(m, m)`` and its factor, all masked.

    Args:
        nu: Innovation.
        S: Its covariance.
        root: The factor of ``S``.
        measurement: What was used of the observation.
        indefinite: Whether a covariance was not positive semi-definite in this step.
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
    valid = measurement.obs.valid
    channels = jnp.sum(valid).astype(S.dtype)
    log_likelihood = -0.5 * (nis + volume + channels * math.log(2 * math.pi))
    few_digits = root.reciprocal_pivot < ILL_CONDITIONED_EPS * jnp.finfo(S.dtype).eps
    raised = {
        Flag.NO_OBSERVATION: ~jnp.any(valid),
        Flag.NOT_POSITIVE_DEFINITE: ~usable,
        Flag.ILL_CONDITIONED: usable & few_digits,
        Flag.INDEFINITE: indefinite,
    }
    info = Info(
        innovation=nu,
        innovation_cov=S,
        log_likelihood=jnp.where(usable, log_likelihood, -jnp.inf),
        nis=nis,
        iterations=jnp.ones((), jnp.int32),
        flags=flags_of(raised),
        used=valid,
        refused=jnp.zeros_like(valid),
    )
    return measurement.upon(info)
