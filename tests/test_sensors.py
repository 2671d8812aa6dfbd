"""Statistics of the simulated sensors, within five standard errors."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.navigation.sensors.imu import ImuErrors, corrupt
from jaxnav.navigation.sensors.star import observe_attitude
from jaxnav.numerics.lie import so3_exp, so3_log
from jaxnav.units import ARCSEC, DEG_PER_HOUR, MICRO_G

COUNT = 200_000
STEP = 0.01


def assert_white(samples, sigma):
    """Assert zero mean, the standard deviation and no correlation of columns or neighbours."""
    count = len(samples)
    unit = samples / sigma
    bound = 5 / np.sqrt(count)
    np.testing.assert_allclose(unit.mean(axis=0), 0, rtol=0, atol=bound)
    np.testing.assert_allclose(unit.std(axis=0), 1, rtol=0, atol=bound / np.sqrt(2))
    correlation = unit.T @ unit / count - np.diag(np.mean(unit**2, axis=0))
    np.testing.assert_allclose(correlation, 0, rtol=0, atol=bound)
    np.testing.assert_allclose(np.mean(unit[1:] * unit[:-1], axis=0), 0, rtol=0, atol=bound)


def test_imu_noise_drift_and_bias(key):
    gyro_noise = np.array([1.0, 2.0, 3.0]) * DEG_PER_HOUR
    accel_noise = np.array([500.0, 50.0, 5.0]) * MICRO_G
    drift = np.array([0.5, -1.0, 0.0]) * DEG_PER_HOUR
    bias = np.array([-100.0, 0.0, 100.0]) * MICRO_G
    errors = ImuErrors(*map(jnp.asarray, (gyro_noise, accel_noise, drift, bias)))
    rng = np.random.default_rng(1)
    dtheta, dvel = 1e-4 * rng.standard_normal((2, COUNT, 3))
    scale = np.repeat([1.0, 10.0, 0.0, 1e4], COUNT // 4)
    measured = jax.jit(corrupt)(key, errors, dtheta, dvel, STEP, scale)
    constant = STEP * np.concatenate([drift, bias])
    sigma = STEP * np.concatenate([gyro_noise, accel_noise])
    noise = np.concatenate(measured, axis=1) - np.concatenate([dtheta, dvel], axis=1) - constant
    noisy = scale > 0
    assert_white(noise[noisy] / np.sqrt(scale[noisy])[:, None], sigma)
    for theta in (1.0, 10.0, 1e4):
        assert_white(noise[scale == theta], np.sqrt(theta) * sigma)
    np.testing.assert_allclose(noise[scale == 0], 0, rtol=0, atol=1e-18)


def test_increments_pass_a_perfect_imu_unchanged(key):
    zero = jnp.zeros(3)
    dtheta, dvel = 1e-3 * np.random.default_rng(2).standard_normal((2, 10, 3))
    perfect = ImuErrors(zero, zero, zero, zero)
    measured = jax.jit(corrupt)(key, perfect, dtheta, dvel, STEP, np.ones(10))
    np.testing.assert_array_equal(measured, [dtheta, dvel])


def test_star_tracker_errs_in_inertial_axes(key):
    sigma = np.array([1.0, 3.0, 10.0]) * ARCSEC
    rng = np.random.default_rng(3)
    attitudes = jax.jit(jax.vmap(so3_exp))(rng.standard_normal((50_000, 3)))

    @jax.jit
    def observed(key, attitudes, noise):
        measured = observe_attitude(key, attitudes, noise)
        return measured, jax.vmap(lambda M, C: so3_log(M @ C.T))(measured, attitudes)

    measured, v = map(np.asarray, observed(key, attitudes, sigma))
    assert_white(v, sigma)
    product = measured @ measured.transpose(0, 2, 1)
    np.testing.assert_allclose(product, np.eye(3)[None] + 0 * product, rtol=0, atol=3e-15)
    np.testing.assert_allclose(np.linalg.det(measured), 1, rtol=0, atol=3e-15)
