"""Rotations: the group SO(3), its logarithm, and Euler angles at the edges.

Small angles take a Taylor branch, and the argument of the closed form is replaced before the
division and the root, so that both branches are finite and so are their gradients.
"""

import jax.numpy as jnp
from jax import Array


def _taylor_angle(dtype: jnp.dtype) -> float:
    """Angle [rad] below which the series are exact to rounding."""
    return 1e-2 if dtype == jnp.float64 else 2e-1


def skew(v: Array) -> Array:
    """Return the cross-product matrix ``[v]x`` ``(3, 3)``: ``skew(v) @ w == cross(v, w)``."""
    zero = jnp.zeros((), v.dtype)
    return jnp.stack(
        [
            jnp.stack([zero, -v[2], v[1]]),
            jnp.stack([v[2], zero, -v[0]]),
            jnp.stack([-v[1], v[0], zero]),
        ]
    )


def _exp_coefficients(squared: Array) -> tuple[Array, Array, Array]:
    """Return sin(a)/a, (1-cos(a))/a^2 and (a-sin(a))/a^3 from ``a^2`` [rad^2]."""
    small = squared < _taylor_angle(squared.dtype) ** 2
    safe = jnp.where(small, 1, squared)
    angle = jnp.sqrt(safe)
    s = squared
    sinc = jnp.where(small, 1 - s / 6 * (1 - s / 20 * (1 - s / 42)), jnp.sin(angle) / angle)
    half = jnp.where(small, 0.5 - s / 24 * (1 - s / 30 * (1 - s / 56)), (1 - jnp.cos(angle)) / safe)
    cubic = jnp.where(
        small, 1 / 6 - s / 120 * (1 - s / 42 * (1 - s / 72)), (angle - jnp.sin(angle)) / angle**3
    )
    return sinc, half, cubic


def so3_exp(phi: Array) -> Array:
    """Return the rotation matrix ``(3, 3)`` of the rotation vector ``phi`` ``(3,) [rad]``.

    ``exp([phi]x) = I + sin(a)/a [phi]x + (1 - cos(a))/a^2 [phi]x^2``, ``a = |phi|`` (Rodrigues).
    """
    sinc, half, _ = _exp_coefficients(jnp.sum(phi * phi))
    K = skew(phi)
    return jnp.eye(3, dtype=phi.dtype) + sinc * K + half * (K @ K)


def so3_left_jacobian(phi: Array) -> Array:
    """Return ``J`` ``(3, 3)`` with ``exp(phi + d) = exp(J d) exp(phi)`` to first order in ``d``.

    ``J = I + (1 - cos(a))/a^2 [phi]x + (a - sin(a))/a^3 [phi]x^2``. The right Jacobian is
    ``so3_left_jacobian(-phi)``.
    """
    _, half, cubic = _exp_coefficients(jnp.sum(phi * phi))
    K = skew(phi)
    return jnp.eye(3, dtype=phi.dtype) + half * K + cubic * (K @ K)


def so3_log(C: Array) -> Array:
    """Return the rotation vector ``(3,) [rad]`` of a rotation matrix ``(3, 3)``, norm at most pi.

    Goes through the unit quaternion with its largest component divided out (Shepperd, 1978), which
    keeps full precision up to and at the angle pi, where the direction is unique up to sign.
    """
    q = _largest_component_quaternion(C)
    q = jnp.where(q[0] < 0, -q, q)
    w, v = q[0], q[1:]
    squared = jnp.sum(v * v)
    small = squared < 1e-4
    safe = jnp.where(small, 1, squared)
    norm = jnp.sqrt(safe)
    # 2 atan(t)/t with t^2 = s/w^2, expanded where |v| is small; w is then near one.
    t2 = squared / jnp.where(small, w, 1) ** 2
    series = 2 / jnp.where(small, w, 1) * (1 - t2 * (1 / 3 - t2 * (1 / 5 - t2 * (1 / 7 - t2 / 9))))
    return v * jnp.where(small, series, 2 * jnp.arctan2(norm, w) / norm)


def _largest_component_quaternion(C: Array) -> Array:
    """Return the unit quaternion ``(4,)``, scalar first, of a rotation matrix."""
    xx, yy, zz = C[0, 0], C[1, 1], C[2, 2]
    squares = jnp.stack([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz])
    wx, wy, wz = C[2, 1] - C[1, 2], C[0, 2] - C[2, 0], C[1, 0] - C[0, 1]
    xy, xz, yz = C[0, 1] + C[1, 0], C[0, 2] + C[2, 0], C[1, 2] + C[2, 1]
    rows = jnp.stack(
        [
            jnp.stack([squares[0], wx, wy, wz]),
            jnp.stack([wx, squares[1], xy, xz]),
            jnp.stack([wy, xy, squares[2], yz]),
            jnp.stack([wz, xz, yz, squares[3]]),
        ]
    )
    largest = jnp.argmax(squares)
    return rows[largest] / (2 * jnp.sqrt(squares[largest]))


def dcm_from_euler(pitch: Array, yaw: Array, roll: Array) -> Array:
    """Return ``C_ib`` ``(3, 3)`` for pitch about z, then yaw about y, then roll about x [rad].

    ``C_ib = Rz(pitch) Ry(yaw) Rx(roll)``: with x downrange, y up and z right, a vertical vehicle
    has pitch pi/2 and the sequence is regular there; it is singular at a yaw of +-pi/2.

    References:
        Zhao, Chen, He, Ge (2018), IEEE/CAA JAS 5(6), the sequence of Eq. (35).
    """
    cp, sp, cy, sy = jnp.cos(pitch), jnp.sin(pitch), jnp.cos(yaw), jnp.sin(yaw)
    cr, sr = jnp.cos(roll), jnp.sin(roll)
    return jnp.stack(
        [
            jnp.stack([cp * cy, cp * sy * sr - sp * cr, cp * sy * cr + sp * sr]),
            jnp.stack([sp * cy, sp * sy * sr + cp * cr, sp * sy * cr - cp * sr]),
            jnp.stack([-sy, cy * sr, cy * cr]),
        ]
    )


def euler_from_dcm(C: Array) -> Array:
    """Return ``(3,) [rad]`` pitch, yaw, roll of ``C_ib``; inverse of :func:`dcm_from_euler`."""
    horizontal = jnp.sqrt(C[0, 0] ** 2 + C[1, 0] ** 2)
    return jnp.stack(
        [
            jnp.arctan2(C[1, 0], C[0, 0]),
            jnp.arctan2(-C[2, 0], horizontal),
            jnp.arctan2(C[2, 1], C[2, 2]),
        ]
    )


def euler_error_from_rotation(C: Array) -> Array:
    """Return ``M`` ``(3, 3)`` taking a small rotation of ``C_ib`` to Euler-angle errors.

    For ``C_computed = (I + [phi]x) C``, the errors (pitch, yaw, roll), computed minus true, are
    ``M phi`` to first order, with

        inv(M) = [0, -sin(pitch), cos(pitch) cos(yaw);
                  0,  cos(pitch), sin(pitch) cos(yaw);
                  1,  0,          -sin(yaw)]

    This is what Eq. (38) of Zhao et al. (2018) means; as printed it is singular at a pitch of pi/4
    and of pi/2, the attitude at lift-off.
    """
    pitch, yaw, _ = euler_from_dcm(C)
    cp, sp, cy, ty = jnp.cos(pitch), jnp.sin(pitch), jnp.cos(yaw), jnp.tan(yaw)
    zero, one = jnp.zeros((), C.dtype), jnp.ones((), C.dtype)
    return jnp.stack(
        [
            jnp.stack([cp * ty, sp * ty, one]),
            jnp.stack([-sp, cp, zero]),
            jnp.stack([cp / cy, sp / cy, zero]),
        ]
    )
