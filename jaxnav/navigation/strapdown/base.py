"""What every mechanisation shares: the navigation state, and its check of whole periods."""

from typing import NamedTuple

from jax import Array


class NavState(NamedTuple):
    """Navigation state, in the frame of the mechanisation.

    Attributes:
        dcm: ``(3, 3)`` from body axes to the frame's: C_ib launch-inertial, C_nb local level.
        velocity: ``(3,) [m/s]`` in the frame's axes; local level, against the Earth.
        position: ``(3,) [m]`` from the launch point; local level, geodetic latitude and longitude
            [rad] and ellipsoidal height [m].
    """

    dcm: Array
    velocity: Array
    position: Array


def require_periods(count: int, every: int) -> None:
    """Raise ``ValueError`` unless so many increments divide into periods of ``every``."""
    if count % every:
        raise ValueError(f"{count} increments do not divide into periods of {every}")
