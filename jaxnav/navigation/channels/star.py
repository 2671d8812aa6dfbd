"""Star tracker: the attitude with a small isotropic error.

As a channel it is the rotation vector of C_ib with the residual ``log(C_z C_pred')``, which is
linear in the attitude's error, or pitch, yaw and roll with their differences wrapped to +-pi, which
are not.
"""

from collections.abc import Callable
from typing import Literal

import jax
from jax import Array

from jaxnav.estimation.models import Channel
from jaxnav.estimation.types import Input, NonAdditive, Params, Point
from jaxnav.navigation.states import LAYOUT
from jaxnav.numerics.lie import (
    euler_error_from_rotation,
    euler_from_dcm,
    so3_exp,
    so3_local,
    so3_log,
    so3_retract,
    wrapped_angle,
)
from jaxnav.numerics.linalg import matmul, rotated_diagonal

StarForm = Literal["rotation-vector", "euler"]


def tracker(form: StarForm = "rotation-vector") -> Channel:
    """Return the channel of a star tracker for states with an attitude ``dcm``.

    Its parameters have ``star_noise``, ``(3,) [rad]`` standard deviations in inertial axes.

    Args:
        form: How the attitude is written.

    Returns:
        The channel; its noise adds to the values, to first order in its size.

    Raises:
        ValueError: If ``form`` is neither.
    """
    if form not in _FORMS:
        raise ValueError(f"star is {form!r}; it must be one of {', '.join(_FORMS)}")
    return _FORMS[form]()


def turned_by_noise(channel: Channel) -> Channel:
    """Return the channel of rotation vectors with the noise where it arises: it turns the attitude.

    For filters that augment the state with the noise.
    """

    def disturbed(params: Params, x: Point, v: Array, u: Input) -> Array:
        del params, u
        return so3_log(so3_retract(x.dcm, v))

    return channel._replace(noisy=NonAdditive(disturbed, channel.noise))


def _rotation_vector() -> Channel:
    return Channel(
        3,
        lambda params, x, u: so3_log(x.dcm),
        _star_variance,
        lambda z, z_pred: so3_local(so3_exp(z_pred), so3_exp(z)),
        lambda params, x, u: lambda d: d[LAYOUT.phi],
    )


def _euler() -> Channel:
    def noise(params: Params, x: Point, u: Input) -> Array:
        del u
        return rotated_diagonal(euler_error_from_rotation(x.dcm), params.star_noise**2)

    def differential(params: Params, x: Point, u: Input) -> Callable[[Array], Array]:
        del params, u
        M = euler_error_from_rotation(x.dcm)
        return lambda d: matmul(M, d[LAYOUT.phi])

    return Channel(
        3, lambda params, x, u: euler_from_dcm(x.dcm), noise, wrapped_angle, differential
    )


_FORMS = {"rotation-vector": _rotation_vector, "euler": _euler}


def misalignment() -> Channel:
    """Return the channel of a star tracker for the error state of :data:`LAYOUT`, linear in it.

    It observes ``phi``; its parameters have ``star_noise``, as :func:`tracker` has.
    """
    return Channel(3, lambda params, x, u: x[LAYOUT.phi], _star_variance)


def _star_variance(params: Params, x: Point, u: Input) -> Array:
    del x, u
    return params.star_noise**2


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
