"""Statistics of the simulated sensors, within five standard errors."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.compiling import compiled
from jaxnav.navigation.channels.star import observe_attitude
from jaxnav.navigation.sensors.imu import ImuErrors, corrupt, markov_error
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
    measured = compiled(corrupt)(key, errors, dtheta, dvel, STEP, scale)
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
    measured = compiled(corrupt)(key, perfect, dtheta, dvel, STEP, np.ones(10))
    np.testing.assert_array_equal(measured, [dtheta, dvel])


def test_constant_bias_is_the_same_for_every_interval(key):
    dtheta, dvel = 1e-3 * np.random.default_rng(4).standard_normal((2, 1000, 3))
    vector = jnp.array([1e-3, -2e-3, 3e-4])
    noise = jnp.ones(3)
    run = compiled(corrupt)
    measured = [
        run(key, ImuErrors(noise, noise, 0 * noise, bias), dtheta, dvel, STEP, np.ones(1000))
        for bias in (vector, jnp.broadcast_to(vector, (1000, 3)))
    ]
    np.testing.assert_array_equal(*measured)


def test_bias_of_each_interval_enters_its_velocity_increment(key):
    zero = jnp.zeros(3)
    dtheta, dvel, bias = np.random.default_rng(5).standard_normal((3, 50, 3))
    errors = ImuErrors(zero, zero, zero, jnp.asarray(bias))
    scale = jnp.ones(50)
    measured = compiled(corrupt)(key, errors, dtheta, dvel, STEP, scale)
    np.testing.assert_array_equal(measured[0], dtheta)
    np.testing.assert_allclose(measured[1], dvel + STEP * bias, rtol=0, atol=1e-15)
    three = ImuErrors(zero, zero, zero, jnp.asarray(bias[:3]))
    with pytest.raises(ValueError, match="broadcast"):
        corrupt(key, three, jnp.asarray(dtheta), jnp.asarray(dvel), STEP, scale)


def test_markov_error_is_stationary_and_forgets_over_its_correlation_time(key):
    runs, count, tau, step = 40_000, 41, 2.0, 0.1
    sigma = np.array([50.0, 5.0, 500.0]) * MICRO_G

    @compiled
    def histories(key):
        start_key, key = jax.random.split(key)
        start = sigma[None] * jax.random.normal(start_key, (runs, 3))
        # Every second run starts from rest instead.
        start = jnp.where(jnp.arange(runs)[:, None] % 2 == 0, start, 0)
        draw = partial(markov_error, step=step, count=count)
        keys = jax.random.split(key, runs)
        return start, jax.vmap(draw, in_axes=(0, None, None, 0))(
            keys, jnp.asarray(sigma), tau, start
        )

    start, x = map(np.asarray, histories(key))
    np.testing.assert_array_equal(x[:, 0], start)
    unit = x / sigma
    stationary, rising = unit[::2], unit[1::2]
    time = step * np.arange(count)
    # The variance of a product of unit normals of correlation rho is 1 + rho^2.
    bound = 5 / np.sqrt(runs / 2)
    assert np.abs(stationary.mean(axis=0)).max() < bound
    assert np.abs(stationary.var(axis=0) - 1).max() < np.sqrt(2) * bound
    for lag in (1, 10, 40):
        rho = np.exp(-time[lag] / tau)
        product = np.mean(stationary[:, 0] * stationary[:, lag], axis=0)
        later = np.mean(stationary[:, -1 - lag] * stationary[:, -1], axis=0)
        assert np.abs(np.array([product, later]) - rho).max() < np.sqrt(1 + rho**2) * bound
    growth = 1 - np.exp(-2 * time / tau)
    error = np.abs(rising.var(axis=0) - growth[:, None])
    assert np.all(error <= np.sqrt(2) * bound * growth[:, None])
    cross = stationary[:, 20].T @ stationary[:, 20] / (runs / 2)
    assert np.abs(cross[np.triu_indices(3, 1)]).max() < bound


def test_markov_error_decays_from_its_start(key):
    start = jnp.array([1.0, -2.0, 0.5])
    x = markov_error(key, 0.0, 300.0, start, STEP, 500)
    decay = np.exp(-STEP * np.arange(500) / 300.0)
    np.testing.assert_allclose(x, decay[:, None] * np.asarray(start), rtol=1e-13)
    np.testing.assert_array_equal(markov_error(key, 1.0, 300.0, start, STEP, 1), start[None])
    with pytest.raises(ValueError, match="count must be at least 1, got 0"):
        markov_error(key, 1.0, 300.0, start, STEP, 0)


def test_star_tracker_errs_in_inertial_axes(key):
    sigma = np.array([1.0, 3.0, 10.0]) * ARCSEC
    rng = np.random.default_rng(3)
    attitudes = compiled(jax.vmap(so3_exp))(rng.standard_normal((50_000, 3)))

    @compiled
    def observed(key, attitudes, noise):
        measured = observe_attitude(key, attitudes, noise)
        return measured, jax.vmap(lambda M, C: so3_log(M @ C.T))(measured, attitudes)

    measured, v = map(np.asarray, observed(key, attitudes, sigma))
    assert_white(v, sigma)
    product = measured @ measured.transpose(0, 2, 1)
    np.testing.assert_allclose(product, np.eye(3)[None] + 0 * product, rtol=0, atol=3e-15)
    np.testing.assert_allclose(np.linalg.det(measured), 1, rtol=0, atol=3e-15)
