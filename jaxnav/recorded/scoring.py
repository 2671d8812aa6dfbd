"""Errors of a run: against fixes, against a reference, and whether it diverged."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.spatial.transform import Rotation

from jaxnav.compiling import compiled
from jaxnav.datasets.drive import DriveLog
from jaxnav.estimation.types import Model
from jaxnav.navigation.earth import displaced
from jaxnav.navigation.models.vehicle import FIXES, VehicleInput
from jaxnav.numerics.masks import runs_of
from jaxnav.recorded.methods import Kept
from jaxnav.recorded.motion import offsets, since_start
from jaxnav.recorded.preparation import Drive
from jaxnav.units import DEG

DIVERGED_M = 100.0
DIVERGED_S = 10.0
"""A filter has diverged that is farther than so much from all fixes it got for so long."""
REFERENCE_S = 20.0
"""First part of a drive from which the constant angles to the reference's axes are taken."""
MOUNTING_S = 60.0
SETTLED_S = 5.0
MOUNTING_SPEED = 5.0
MOUNTING_RATE = 3 * DEG
MOUNTING_SIGMA = (1 * DEG, 2 * DEG)
"""The mounting is from what is driven above 18 km/h and straight on. Its heading is from when that
of the sensors is known to the first of these: on a straight start its error would be taken for the
mounting. Its pitch is from when the tilt is known to the second, the least that an accelerometer's
bias allows."""


class ReferenceErrors(NamedTuple):
    """Errors against a reference at its R times after the first 20 s.

    Attributes:
        time: ``(R,) [s]`` since the first inertial sample.
        offset: East, north, up ``(R, 3) [m]``.
        angles: Roll, pitch, heading ``(R, 3) [rad]``, less the constant angles.
        constant: Rotation vector ``(3,) [rad]`` from the reference's axes to the sensors'.
        receiver_time: ``(F,) [s]`` of the fixes in that time.
        receiver_offset: Of the fixes ``(F, 3) [m]``.
    """

    time: np.ndarray
    offset: np.ndarray
    angles: np.ndarray
    constant: np.ndarray
    receiver_time: np.ndarray
    receiver_offset: np.ndarray


def fix_errors(model: Model, params: Any, drive: Drive, mean: Any) -> dict[str, np.ndarray]:
    """Return what the estimates are off from the fixes: "velocity" [m/s] and "position" [m].

    Each ``(F, 3)``, east, north, up, computed minus measured, of the antenna at the time of the
    fix; NaN where the fix has no entry.

    Args:
        model: The model.
        params: Its parameters, those of any member of a bank.
        drive: The drive.
        mean: Estimates with what they carry, leading axis T.
    """
    at = jnp.asarray(drive.fix_step)
    given = (mean, drive.inputs, drive.seen_by(model))
    x, u, obs = jax.tree.map(lambda leaf: leaf[at], given)
    off = _against(model, params, x, u, obs.z)
    known = {name: np.asarray(obs.valid)[:, model.channel(name)] for name in FIXES}
    return {name: np.where(known[name], np.asarray(off[name]), np.nan) for name in FIXES}


@compiled(static_argnums=0)
def _against(model: Model, params: Any, x: Any, u: VehicleInput, z: Array) -> dict[str, Array]:
    def one(x: Any, u: VehicleInput, z: Array) -> dict[str, Array]:
        off = -model.residual(z, model.observe(params, x, u))
        return {name: off[model.channel(name)] for name in FIXES}

    return jax.vmap(one)(x, u, z)


def horizontal(offset: np.ndarray) -> np.ndarray:
    """Return the horizontal distances of offsets ``(..., 3)`` east, north, up."""
    return np.hypot(offset[..., 0], offset[..., 1])


def diverged(kept: Kept, drive: Drive) -> bool:
    """Return whether a run diverged.

    It has if an estimate or its covariance is not finite, or if for ten seconds on end each fix
    that the filter got was more than 100 m from its prediction.
    """
    leaves = jax.tree.leaves((kept.mean, kept.sigma))
    if not all(np.isfinite(np.asarray(leaf)).all() for leaf in leaves):
        return True
    step = drive.fix_step[drive.arrived("position")]
    far = horizontal(np.asarray(kept.parts["position"].innovation)[step]) > DIVERGED_M
    lasted = (drive.time[step[end - 1]] - drive.time[step[begin]] for begin, end in runs_of(far))
    return any(seconds >= DIVERGED_S for seconds in lasted)


def mounting(kept: Kept, drive: Drive) -> np.ndarray:
    """Return the rotation vector ``(3,) [rad]`` from the sensors' axes to the vehicle's.

    It turns the mean direction of motion, in the sensors' axes, to forward by a heading and a
    pitch; there is no roll to be seen. Either is zero where nothing shows it.
    """
    v = np.einsum("nji,nj->ni", np.asarray(kept.mean.dcm), np.asarray(kept.mean.velocity))
    since = drive.time - drive.time[0]
    rate = np.asarray(drive.inputs.inertial.rate - kept.mean.drift)[:, 2]
    # Over a second: engines shake the gyros by more than a bend turns the car.
    width = max(1, round(1 / float(np.median(np.asarray(drive.inputs.inertial.dt)))))
    smooth = np.convolve(rate, np.full(width, 1 / width), "same")
    straight = np.abs(smooth) < MOUNTING_RATE
    driven = (since > SETTLED_S) & straight & (v[:, 0] > MOUNTING_SPEED)
    sigma, (heading, tilt) = np.asarray(kept.sigma), MOUNTING_SIGMA
    known = (sigma[:, 2] < heading, np.all(sigma[:, :2] < tilt, axis=1))
    headed, level = (np.sum(v[driven & good], axis=0) for good in known)
    yaw = -np.arctan2(headed[1], headed[0])
    pitch = np.arctan2(level[2], np.hypot(level[0], level[1]))
    return Rotation.from_euler("zy", [yaw, pitch]).as_rotvec()


def against_reference(log: DriveLog, drive: Drive, kept: Kept, offset_s: float) -> ReferenceErrors:
    """Return the errors of a run, and those of the fixes, against the log's reference.

    Args:
        log: The drive; it has a reference.
        drive: The prepared drive.
        kept: The run.
        offset_s: Added to the times of the fixes, as the filter had it.
    """
    reference = log.reference
    assert reference is not None
    time = since_start(reference.time_ns, log)
    inside = (time >= drive.time[0]) & (time <= drive.time[-1])
    later = time[inside] > drive.time[0] + REFERENCE_S
    step = np.clip(np.searchsorted(drive.time, time[inside]), 0, len(drive.time) - 1)
    mean = jax.tree.map(lambda leaf: np.asarray(leaf)[step], kept.mean)
    ahead = (time[inside] - drive.time[step])[:, None] * mean.velocity
    estimate = _displaced(jnp.asarray(mean.position), jnp.asarray(ahead))
    offset = offsets(reference.geodetic[inside], np.asarray(estimate))
    angles, constant = np.full((len(later), 3), np.nan), np.full(3, np.nan)
    if reference.dcm is not None and not later.all():
        angles, constant = _attitude_errors(reference.dcm[inside], mean.dcm, ~later)
    fix_time = since_start(log.fixes.time_ns, log) + offset_s
    among = (fix_time > drive.time[0] + REFERENCE_S) & (fix_time <= min(time[-1], drive.time[-1]))
    true = np.stack([np.interp(fix_time[among], time, p) for p in reference.geodetic.T], axis=1)
    receiver = offsets(true, log.fixes.geodetic[among])
    return ReferenceErrors(
        time[inside][later], offset[later], angles[later], constant, fix_time[among], receiver
    )


_displaced = compiled(jax.vmap(displaced))


def _attitude_errors(
    reference: np.ndarray, estimate: np.ndarray, first: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return errors of roll, pitch, heading ``(R, 3)``, and the constant rotation vector.

    The constant is the mean of ``C_ref' C_est`` over the first part.
    """
    between = np.einsum("nji,njk->nik", reference[first], estimate[first])
    constant = Rotation.from_matrix(between).mean()
    turned = (Rotation.from_matrix(reference) * constant).as_matrix()
    off = attitude_angles(estimate) - attitude_angles(turned)
    return np.remainder(off + np.pi, 2 * np.pi) - np.pi, constant.as_rotvec()


def attitude_angles(dcm: np.ndarray) -> np.ndarray:
    """Return roll, pitch (nose up) and heading (from north by east) ``(N, 3) [rad]`` of C_nb.

    Body axes are forward, left, up.
    """
    ahead, left, up = (dcm[:, 2, i] for i in range(3))
    roll = np.arctan2(left, up)
    pitch = np.arctan2(ahead, np.hypot(left, up))
    return np.stack([roll, pitch, np.arctan2(dcm[:, 0, 0], dcm[:, 1, 0])], axis=1)


def rms(values: Any) -> float:
    """Return the root of the mean square of what is known; NaN of nothing."""
    known = np.asarray(values)[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")
