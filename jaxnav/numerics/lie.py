"""Rotations: the group SO(3), its logarithm, and Euler angles at the edges.

Small angles take a Taylor branch, and the argument of the closed form is replaced before the
division and the root, so that both branches are finite and so are their gradients.
"""

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.numerics.linalg import matmul


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


def _vee(K: Array) -> Array:
    """Return the vector ``(3,)`` of a skew-symmetric matrix; inverse of :func:`skew`."""
    return jnp.stack([K[2, 1], K[0, 2], K[1, 0]])


def _skew_squared(v: Array) -> Array:
    """Return ``[v]x^2 = v v' - |v|^2 I`` ``(3, 3)``, each diagonal entry as minus two squares."""
    # A batched dot of 3x3 blocks costs more than all the rest of an exponential.
    x, y, z = v[0], v[1], v[2]
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    return jnp.stack(
        [
            jnp.stack([-(yy + zz), xy, xz]),
            jnp.stack([xy, -(xx + zz), yz]),
            jnp.stack([xz, yz, -(xx + yy)]),
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
    return jnp.eye(3, dtype=phi.dtype) + sinc * skew(phi) + half * _skew_squared(phi)


def so3_left_jacobian(phi: Array) -> Array:
    """Return ``J`` ``(3, 3)`` with ``exp(phi + d) = exp(J d) exp(phi)`` to first order in ``d``.

    ``J = I + (1 - cos(a))/a^2 [phi]x + (a - sin(a))/a^3 [phi]x^2``. The right Jacobian is
    ``so3_left_jacobian(-phi)``.
    """
    _, half, cubic = _exp_coefficients(jnp.sum(phi * phi))
    return jnp.eye(3, dtype=phi.dtype) + half * skew(phi) + cubic * _skew_squared(phi)


def so3_left_jacobian_inverse(phi: Array) -> Array:
    """Return the inverse ``(3, 3)`` of :func:`so3_left_jacobian`, for angles below a full turn.

    ``I - [phi]x / 2 + (1 - a/2 cot(a/2)) / a^2 [phi]x^2``.
    """
    squared = jnp.sum(phi * phi)
    small = squared < _taylor_angle(phi.dtype) ** 2
    safe = jnp.where(small, 1, squared)
    half = 0.5 * jnp.sqrt(safe)
    closed = (1 - half * jnp.cos(half) / jnp.sin(half)) / safe
    series = 1 / 12 + squared / 720 * (1 + squared / 42 * (1 + squared / 40))
    second = jnp.where(small, series, closed)
    return jnp.eye(3, dtype=phi.dtype) - 0.5 * skew(phi) + second * _skew_squared(phi)


def so3_log(C: Array) -> Array:
    """Return the rotation vector ``(3,) [rad]`` of a rotation matrix ``(3, 3)``, norm at most pi.

    Goes through the unit quaternion with its largest component divided out (Shepperd, 1978), which
    keeps full precision up to and at the angle pi, where the direction is unique up to sign.
    """
    q = _largest_component_quaternion(C)
    negative = q[0] < 0
    w, v = jnp.where(negative, -q[0], q[0]), q[1:]
    squared = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    small = squared < 1e-4
    norm = jnp.sqrt(jnp.where(small, 1, squared))
    # 2 atan(t)/t with t^2 = s/w^2, expanded where |v| is small; w is then near one.
    safe = jnp.where(small, w, 1)
    t2 = squared / safe**2
    series = 2 / safe * (1 - t2 * (1 / 3 - t2 * (1 / 5 - t2 * (1 / 7 - t2 / 9))))
    factor = jnp.where(small, series, 2 * jnp.arctan2(norm, w) / norm)
    return v * jnp.where(negative, -factor, factor)


def so3_retract(C: Array, phi: Array) -> Array:
    """Return ``exp([phi]x) C``: the attitude C_ib ``(3, 3)`` turned about inertial axes."""
    return matmul(so3_exp(phi), C)


def so3_local(C: Array, D: Array) -> Array:
    """Return phi ``(3,) [rad]`` with ``D = exp([phi]x) C``; inverse of :func:`so3_retract`."""
    return so3_log(matmul(D, C.T))


def _largest_component_quaternion(C: Array) -> Array:
    """Return the unit quaternion ``(4,)``, scalar first, of a rotation matrix."""
    xx, yy, zz = C[0, 0], C[1, 1], C[2, 2]
    ww, xx, yy, zz = 1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz
    wx, wy, wz = C[2, 1] - C[1, 2], C[0, 2] - C[2, 0], C[1, 0] - C[0, 1]
    xy, xz, yz = C[0, 1] + C[1, 0], C[0, 2] + C[2, 0], C[1, 2] + C[2, 1]
    # Four times the products of the components; the row of the largest square, by selections,
    # since a gather does not vectorise. Of equal squares the first is taken.
    upper, lower = ww >= xx, yy >= zz
    first = jnp.where(upper, ww, xx) >= jnp.where(lower, yy, zz)

    def select(w: Array, x: Array, y: Array, z: Array) -> Array:
        return jnp.where(first, jnp.where(upper, w, x), jnp.where(lower, y, z))

    row = [select(ww, wx, wy, wz), select(wx, xx, xy, xz), select(wy, xy, yy, yz)]
    row = jnp.stack([*row, select(wz, xz, yz, zz)])
    return row / (2 * jnp.sqrt(select(ww, xx, yy, zz)))


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


def wrapped_angle(z: Array, reference: Array) -> Array:
    """Return the differences ``z - reference`` of angles [rad], in [-pi, pi).

    Differences within that are returned as they are, without the rounding of a remainder.
    """
    difference = z - reference
    return difference - 2 * jnp.pi * jnp.floor((difference + jnp.pi) / (2 * jnp.pi))


def euler_error_from_rotation(C: Array) -> Array:
    """Return ``M`` ``(3, 3)`` taking a small rotation of ``C_ib`` to Euler-angle errors.

    For ``C_computed = (I + [phi]x) C``, the errors (pitch, yaw, roll), computed minus true, are
    ``M phi`` to first order: the derivative of the angles of ``exp([phi]x) C`` at zero, with

        inv(M) = [0, -sin(pitch), cos(pitch) cos(yaw);
                  0,  cos(pitch), sin(pitch) cos(yaw);
                  1,  0,          -sin(yaw)]

    and so singular at a yaw of +-pi/2 alone. This is what Eq. (38) of Zhao et al. (2018) means; as
    printed it is singular at a pitch of pi/4 and of pi/2, the attitude at lift-off.
    """
    return jax.jacfwd(lambda phi: euler_from_dcm(matmul(so3_exp(phi), C)))(jnp.zeros(3, C.dtype))


def body_rate_from_euler_rate(pitch: Array, yaw: Array, roll: Array) -> Array:
    """Return ``W`` ``(3, 3)`` taking Euler-angle rates to the angular rate in body axes.

    ``omega_ib = W (pitch', yaw', roll')`` is the vector of ``C' dC/dt`` for the matrix ``C_ib`` of
    :func:`dcm_from_euler` at angles in rad, whose derivative is automatic:

        W = [-sin(yaw),            0,         1;
             sin(roll) cos(yaw),   cos(roll), 0;
             cos(roll) cos(yaw),  -sin(roll), 0]

    References:
        Zhao, Chen, He, Ge (2018), Eq. (35), whose element (3, 1) is printed ``cos(roll) sin(yaw)``:
        a vehicle with no yaw and no roll would then pitch without turning.
    """
    angles = jnp.stack([pitch, yaw, roll])
    C = dcm_from_euler(pitch, yaw, roll)
    slopes = jax.jacfwd(lambda a: dcm_from_euler(a[0], a[1], a[2]))(angles)
    return jnp.stack([_vee(matmul(C.T, slopes[:, :, k])) for k in range(3)], axis=1)
