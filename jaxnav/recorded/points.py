"""The trajectory of another point of the vehicle than its inertial sensors."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.compiling import compiled
from jaxnav.datasets.drive import DriveLog
from jaxnav.navigation.channels.gnss import antenna_motion
from jaxnav.navigation.earth import earth_rate, offset_between
from jaxnav.navigation.states import LAYOUT, STATES, SinsLevel, error_form
from jaxnav.numerics.linalg import matmul
from jaxnav.recorded.config import FilterConfig
from jaxnav.recorded.methods import Kept
from jaxnav.recorded.preparation import Drive


def at_point(kept: Kept, log: DriveLog, drive: Drive, config: FilterConfig) -> Kept:
    """Return a run with velocity, position and their standard deviations those of a point.

    An antenna whose lever arm is carried is where the filter finds it at each step, and what it
    does not know of the arm counts. The measured rate is taken as exact, but for the gyro drift.

    Args:
        kept: The run, with its covariances unless the point is that of the sensors.
        log: The drive as it was recorded.
        drive: The drive.
        config: Says which point.
    """
    if config.point == "sensors":
        return kept
    block = np.arange(STATES)
    arm: Any = log.lever_arm if config.point == "antenna" else config.axle_m
    carried = config.point == "antenna" and "lever_arm" in kept.carried
    if carried:
        arm = kept.carried["lever_arm"]
        before = sorted(kept.carried)[: sorted(kept.carried).index("lever_arm")]
        first = STATES + sum(kept.carried[name].shape[1] for name in before)
        block = np.append(block, np.arange(first, first + 3))
    arms = jnp.broadcast_to(jnp.asarray(arm, float), (len(drive.time), 3))
    cov = jnp.asarray(kept.cov)[:, block[:, None], block]
    velocity, position, sigma = _moved(kept.mean, drive.inputs.inertial.rate, arms, cov)
    whole = jnp.asarray(kept.sigma).at[:, LAYOUT.dv].set(sigma[:, :3])
    return kept._replace(
        mean=kept.mean._replace(velocity=velocity, position=position),
        sigma=whole.at[:, LAYOUT.dr].set(sigma[:, 3:]),
    )


@compiled
def _moved(x: SinsLevel, rate: Array, arm: Array, cov: Array) -> tuple[Array, Array, Array]:
    """Return velocities, positions ``(T, 3)`` and standard deviations of both ``(T, 6)``."""
    form = error_form("additive", jnp.zeros(3))

    def motion(x: SinsLevel, rate: Array, arm: Array) -> tuple[Array, Array]:
        turning = rate - x.drift - matmul(x.dcm.T, earth_rate(x.position[0]))
        return antenna_motion(x.dcm, x.velocity, x.position, turning, arm)

    def one(x: SinsLevel, rate: Array, arm: Array, cov: Array) -> tuple[Array, Array, Array]:
        velocity, position = motion(x, rate, arm)

        def displacement(d: Array) -> Array:
            own = d[STATES:] if len(d) > STATES else jnp.zeros(3)
            v, p = motion(form.retract(x, d[:STATES]), rate, arm + own)
            return jnp.concatenate([v - velocity, offset_between(position, p)])

        J = jax.jacfwd(displacement)(jnp.zeros(cov.shape[0]))
        variance = jnp.sum(matmul(J, cov) * J, axis=1)
        return velocity, position, jnp.sqrt(jnp.maximum(variance, 0))

    return jax.vmap(one)(x, rate, arm, cov)
