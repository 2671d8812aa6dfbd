"""The group SO(3): axioms, exp and log from zero to pi, derivatives, Euler angles."""

import jax
import jax.numpy as jnp
import numpy as np
from oracles import rotations
from oracles.matrices import central_difference

from jaxnav.compiling import compiled
from jaxnav.numerics import lie

SWITCH = 1e-2
ANGLES = np.array(
    [0.0, 1e-12, 1e-9, 1e-8, 1e-6, 1e-3, 0.5 * SWITCH]
    + [SWITCH * (1 + d) for d in (-1e-9, 1e-9)]
    + [0.02 - 1e-6, 0.02 + 1e-6, 0.1, 1.0, 0.5 * np.pi, 2.0, 3.0, np.pi - 1e-3]
)


def vectors(angles, per_angle=8):
    """Return rotation vectors: random directions and the axes, each with every angle."""
    rng = np.random.default_rng(1)
    directions = rng.standard_normal((per_angle, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    directions = np.concatenate([directions, np.eye(3), -np.eye(3)])
    return (np.asarray(angles)[:, None, None] * directions).reshape(-1, 3)


def inverse(C):
    return np.swapaxes(C, -1, -2)


def assert_rotations(C):
    np.testing.assert_allclose(
        C @ inverse(C), np.broadcast_to(np.eye(3), C.shape), rtol=0, atol=2e-15
    )
    np.testing.assert_allclose(np.linalg.det(C), 1, rtol=0, atol=2e-15)


exp = compiled(jax.vmap(lie.so3_exp))
log = compiled(jax.vmap(lie.so3_log))


def test_skew_is_the_cross_product():
    v, w = np.random.default_rng(2).standard_normal((2, 20, 3))
    K = np.asarray(compiled(jax.vmap(lie.skew))(v))
    np.testing.assert_allclose((K @ w[..., None])[..., 0], np.cross(v, w), rtol=0, atol=1e-15)
    np.testing.assert_array_equal(K, -inverse(K))


def test_exp_equals_the_power_series_and_obeys_the_axioms():
    phi = vectors([*ANGLES, np.pi - 1e-9, np.pi])
    C = np.asarray(exp(phi))
    np.testing.assert_allclose(C, [rotations.exp(p) for p in phi], rtol=0, atol=1e-14)
    assert_rotations(C)
    np.testing.assert_allclose(exp(-phi), inverse(C), rtol=0, atol=1e-15)
    np.testing.assert_array_equal(exp(np.zeros((1, 3)))[0], np.eye(3))
    product = C @ C[::-1]
    assert_rotations(product)
    np.testing.assert_allclose(exp(np.asarray(log(product))), product, rtol=0, atol=5e-15)


def test_small_rotations_keep_their_relative_precision():
    phi = vectors(ANGLES[ANGLES > 0])
    back = np.asarray(log(exp(phi)))
    error = np.linalg.norm(back - phi, axis=1) / np.linalg.norm(phi, axis=1)
    assert error.max() < 2e-15


def test_log_up_to_and_at_pi():
    for angle in (np.pi - 1e-3, np.pi - 1e-6, np.pi - 1e-9):
        phi = vectors([angle])
        np.testing.assert_allclose(log(exp(phi)), phi, rtol=0, atol=5e-15)
    half_turn = vectors([np.pi])
    axis = half_turn / np.pi
    # C = 2 a a' - I is the exact half turn, and has no sign.
    C = 2 * axis[:, :, None] * axis[:, None, :] - np.eye(3)
    back = np.asarray(log(C))
    np.testing.assert_allclose(np.linalg.norm(back, axis=1), np.pi, rtol=1e-15)
    np.testing.assert_allclose(np.abs(np.sum(back * axis, axis=1)), np.pi, rtol=1e-15)
    beyond = vectors([np.pi + 1e-6])
    expected = beyond * (1 - 2 * np.pi / (np.pi + 1e-6))
    np.testing.assert_allclose(log(exp(beyond)), expected, rtol=0, atol=5e-15)


def test_left_jacobian_equals_its_series_and_its_definition():
    phi = vectors(ANGLES)

    @compiled
    @jax.vmap
    def jacobians(phi):
        def turned(d):
            return lie.so3_log(lie.so3_exp(phi + d) @ lie.so3_exp(phi).T)

        right = lie.so3_left_jacobian(-phi)
        return lie.so3_left_jacobian(phi), jax.jacfwd(turned)(jnp.zeros(3)), right

    J, automatic, right = map(np.asarray, jacobians(phi))
    K = np.array([rotations.skew(p) for p in phi])
    C = np.array([rotations.exp(p) for p in phi])
    np.testing.assert_allclose(J, [rotations.left_jacobian(p) for p in phi], rtol=0, atol=1e-14)
    np.testing.assert_allclose(automatic, J, rtol=0, atol=1e-13)
    np.testing.assert_allclose(np.eye(3) + K @ J, C, rtol=0, atol=1e-14)
    np.testing.assert_allclose(C @ right, J, rtol=0, atol=1e-14)


def test_derivatives_are_right_from_zero_to_near_pi():
    phi = vectors(ANGLES, per_angle=4)

    @compiled
    @jax.vmap
    def derivatives(phi):
        def there_and_back(p):
            return lie.so3_log(lie.so3_exp(p))

        return (
            jax.jacrev(there_and_back)(phi),
            jax.jacrev(lie.so3_exp)(phi),
            jax.jacrev(lie.so3_left_jacobian)(phi),
        )

    round_trip, of_exp, of_jacobian = map(np.asarray, derivatives(phi))
    np.testing.assert_allclose(round_trip, np.eye(3)[None] + 0 * round_trip, rtol=0, atol=2e-13)
    h = 1e-3
    for p, dC, dJ in zip(phi, of_exp, of_jacobian, strict=True):
        for k, axis in enumerate(np.eye(3)):
            numeric = central_difference(rotations.exp, p, axis, h)
            np.testing.assert_allclose(dC[..., k], numeric, rtol=0, atol=1e-11)
            numeric = central_difference(rotations.left_jacobian, p, axis, h)
            np.testing.assert_allclose(dJ[..., k], numeric, rtol=0, atol=1e-11)


def test_second_derivatives_at_zero():
    direction = jnp.array([1.0, -2.0, 0.5])

    def along(t):
        p = t * direction
        return lie.so3_log(lie.so3_exp(p)), lie.so3_left_jacobian(p)

    of_log, of_jacobian = compiled(jax.jacfwd(jax.jacfwd(along)))(0.0)
    np.testing.assert_allclose(of_log, 0, rtol=0, atol=1e-15)
    K = rotations.skew(np.asarray(direction))
    np.testing.assert_allclose(of_jacobian, K @ K / 3, rtol=1e-15)


def random_angles(count):
    """Return pitch, yaw, roll away from the singular yaw; the first ones stand vertical."""
    rng = np.random.default_rng(3)
    angles = rng.uniform(-1, 1, (count, 3)) * [np.pi, 1.2, np.pi]
    angles[:5] = np.array([[0.5, 0, 0], [-0.5, 0, 0], [0.5, 0.2, -0.9], [1, 0, 1], [0, 0, 0]])
    angles[:5] *= np.pi
    return angles


def test_euler_angles_round_trip():
    angles = random_angles(200)
    C = np.asarray(compiled(jax.vmap(lie.dcm_from_euler))(*angles.T))
    np.testing.assert_allclose(C, [rotations.dcm(*a) for a in angles], rtol=0, atol=1e-14)
    assert_rotations(C)
    back = np.asarray(compiled(jax.vmap(lie.euler_from_dcm))(C))
    wrapped = (back - angles + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(wrapped, 0, rtol=0, atol=2e-15)
    np.testing.assert_array_less(np.abs(back), np.pi + 1e-15)


def test_yaw_keeps_its_precision_close_to_its_limit():
    for yaw in (np.pi / 2 - 1e-6, 1e-6 - np.pi / 2):
        C = rotations.dcm(0.3, yaw, 0.4)
        np.testing.assert_allclose(compiled(lie.euler_from_dcm)(C)[1], yaw, rtol=1e-15)


def test_euler_errors_of_a_small_rotation():
    angles = random_angles(60)
    C = np.array([rotations.dcm(*a) for a in angles])

    @compiled
    @jax.vmap
    def maps(C):
        def turned(phi):
            return lie.euler_from_dcm(lie.so3_exp(phi) @ C)

        return lie.euler_error_from_rotation(C), jax.jacfwd(turned)(jnp.zeros(3))

    M, automatic = map(np.asarray, maps(C))
    np.testing.assert_allclose(automatic, M, rtol=1e-12, atol=1e-13)
    regular = np.abs(np.abs(angles[:, [0, 2]]) - np.pi).min(axis=1) > 0.1
    assert regular.sum() > 30
    assert regular[:3].all()
    for m, c in zip(M[regular], C[regular], strict=True):
        for k, axis in enumerate(np.eye(3)):
            numeric = central_difference(
                lambda phi, c=c: rotations.euler(rotations.exp(phi) @ c), np.zeros(3), axis, 2e-4
            )
            np.testing.assert_allclose(m[:, k], numeric, rtol=1e-10, atol=1e-10)


def closed_error_map(pitch, yaw, roll):
    """Return the small rotation in inertial axes per Euler-angle error: Eq. (38) as meant."""
    cp, sp, cy, sy = np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw)
    return np.array([[0, -sp, cp * cy], [0, cp, sp * cy], [1, 0, -sy]])


def closed_rate_map(pitch, yaw, roll):
    """Return the body rate per Euler-angle rate: Eq. (35) with its element (3, 1) corrected."""
    cy, sy, cr, sr = np.cos(yaw), np.sin(yaw), np.cos(roll), np.sin(roll)
    return np.array([[-sy, 0, 1], [sr * cy, cr, 0], [cr * cy, -sr, 0]])


def test_euler_maps_are_those_of_the_paper_as_meant():
    angles = random_angles(200)
    C = np.array([rotations.dcm(*a) for a in angles])
    M = np.asarray(compiled(jax.vmap(lie.euler_error_from_rotation))(C))
    W = np.asarray(compiled(jax.vmap(lie.body_rate_from_euler_rate))(*angles.T))
    inverse_of_m = np.array([closed_error_map(*a) for a in angles])
    one = np.broadcast_to(np.eye(3), M.shape)
    np.testing.assert_allclose(M @ inverse_of_m, one, rtol=0, atol=2e-15)
    np.testing.assert_allclose(W, [closed_rate_map(*a) for a in angles], rtol=0, atol=1e-15)
    # One rotation seen from either side: C W = inv(M).
    np.testing.assert_allclose(C @ W, inverse_of_m, rtol=0, atol=2e-15)


def test_body_rates_are_those_of_the_turning_matrix():
    angles = random_angles(60)
    W = np.asarray(compiled(jax.vmap(lie.body_rate_from_euler_rate))(*angles.T))
    for a, w in zip(angles, W, strict=True):
        C = rotations.dcm(*a)
        for k, axis in enumerate(np.eye(3)):
            dC = central_difference(lambda b: rotations.dcm(*b), a, axis, 1e-3)
            numeric = C.T @ dC
            np.testing.assert_allclose(rotations.skew(w[:, k]), numeric, rtol=0, atol=1e-11)


def test_body_rate_map_is_singular_at_a_quarter_turn_of_yaw_alone():
    rng = np.random.default_rng(4)
    pitch, roll = rng.uniform(-np.pi, np.pi, (2, 41))
    pitch[:2], yaw = np.pi / 2, np.linspace(-np.pi / 2, np.pi / 2, 41)
    W = np.asarray(compiled(jax.vmap(lie.body_rate_from_euler_rate))(pitch, yaw, roll))
    np.testing.assert_allclose(np.linalg.det(W), -np.cos(yaw), rtol=0, atol=1e-15)


def test_log_takes_every_branch_with_finite_derivatives():
    # The largest component of the quaternion in turn, exact half turns and ties between components.
    axes = np.concatenate([np.eye(3), [[1, 1, 0], [1, -1, 0], [1, 0, 1], [0, 1, 1], [1, 1, 1]]])
    axes = axes / np.linalg.norm(axes, axis=1)[:, None]
    half = 2 * axes[:, :, None] * axes[:, None, :] - np.eye(3)
    near = np.array([rotations.exp((np.pi - 1e-7) * a) for a in axes])
    third = np.array([rotations.exp(2 * np.pi / 3 * axes[-1])])
    C = np.concatenate([np.eye(3)[None], half, near, third])
    back, forward, reverse = compiled(
        jax.vmap(lambda C: (lie.so3_log(C), jax.jacfwd(lie.so3_log)(C), jax.jacrev(lie.so3_log)(C)))
    )(C)
    np.testing.assert_allclose([rotations.exp(p) for p in np.asarray(back)], C, rtol=0, atol=2e-15)
    np.testing.assert_allclose(back[9:17], (np.pi - 1e-7) * axes, rtol=0, atol=2e-15)
    assert np.all(np.isfinite(forward))
    np.testing.assert_allclose(reverse, forward, rtol=0, atol=1e-14)


def test_float32_stays_float32_and_precise():
    phi = vectors([1e-6, 1e-3, 0.1, 0.2 - 1e-6, 0.2 + 1e-6, 1.0, 3.0]).astype(np.float32)
    C, J, back = exp(phi), compiled(jax.vmap(lie.so3_left_jacobian))(phi), log(exp(phi))
    assert C.dtype == J.dtype == back.dtype == jnp.float32
    exact = phi.astype(float)
    np.testing.assert_allclose(C, [rotations.exp(p) for p in exact], rtol=0, atol=3e-7)
    np.testing.assert_allclose(J, [rotations.left_jacobian(p) for p in exact], rtol=0, atol=3e-7)
    error = np.linalg.norm(back - phi, axis=1) / np.linalg.norm(phi, axis=1)
    assert error.max() < 5e-7
