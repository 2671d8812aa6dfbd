"""Allan variance and the noise fit: exact laws, statistics, gradients."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.compiling import compiled
from jaxnav.navigation.sensors import allan, imu, noise_fit
from jaxnav.navigation.sensors.allan import (
    chi_square_ends,
    cluster_sizes,
    deviation_interval,
)
from jaxnav.navigation.sensors.imu import NoiseModel
from jaxnav.navigation.sensors.noise_fit import (
    coefficient_interval,
    covariance_kernel,
)

# As programs: a kernel for every operation and shape takes longer to compile.
allan_variance = compiled(allan.allan_variance, static_argnames=("step", "sizes", "overlapping"))
median_variance = compiled(allan.median_variance, static_argnames=("step", "sizes"))
slope_rule = compiled(allan.slope_rule, static_argnames="sharpness")
degrees_of_freedom = compiled(
    noise_fit.degrees_of_freedom, static_argnames=("step", "sizes", "count")
)
fit_noise = compiled(noise_fit.fit_noise, static_argnames=("step", "sizes", "count"))
model_variance = compiled(noise_fit.model_variance)
sensor_noise = compiled(imu.sensor_noise, static_argnames=("step", "count"))

STEP, COUNT = 0.01, 2**14
SIZES = cluster_sizes(COUNT)


def noise_model(Q=0.0, N=0.0, B=0.0, K=0.0) -> NoiseModel:
    return NoiseModel(*map(jnp.asarray, (Q, N, B, K)))


def fit_of(measured):
    return fit_noise(measured, STEP, SIZES, COUNT)


def fitted(rate, valid=None):
    return fit_of(allan_variance(rate, STEP, SIZES, valid))


# The Allan variance


def test_terms_are_those_of_the_definition():
    for overlapping, expected in ((True, [8, 6, 4]), (False, [8, 3, 2])):
        measured = allan_variance(jnp.arange(9.0), 1.0, (1, 2, 3), overlapping=overlapping)
        np.testing.assert_array_equal(measured.terms, expected)
        np.testing.assert_array_equal(measured.share, 1)


@pytest.mark.parametrize("masked", [False, True])
def test_a_constant_gives_zero_and_a_ramp_half_the_square(masked):
    count, sizes, step = 1000, (1, 7, 100, 200), 0.1
    valid = jnp.arange(count) != 600 if masked else None
    still = allan_variance(jnp.full(count, 0.1), step, sizes, valid)
    np.testing.assert_array_equal(still.variance, 0)
    ramp = allan_variance(1e3 + step * jnp.arange(1.0 * count), step, sizes, valid)
    np.testing.assert_allclose(ramp.variance, ramp.tau**2 / 2, rtol=1e-9)
    np.testing.assert_allclose(ramp.tau, step * np.array(sizes), rtol=1e-15)


def test_lost_samples_are_never_used(key):
    rate, lost = jax.random.normal(key, (500,)), np.zeros(500, bool)
    lost[[0, 17, 18, 400]] = True
    valid = jnp.asarray(~lost)
    measure = compiled(lambda rate: allan_variance(rate, 1.0, (1, 3, 20), valid))
    clean = measure(rate)
    for value in (jnp.nan, jnp.inf, 1e300, 0.0):
        spoilt = measure(jnp.where(lost, value, rate))
        for field, other in zip(clean, spoilt, strict=True):
            np.testing.assert_array_equal(field, other)
        slope = jax.grad(lambda rate: jnp.sum(measure(rate).variance))(jnp.where(lost, value, rate))
        assert np.isfinite(slope).all()
        np.testing.assert_array_equal(slope[lost], 0)
    for m, variance, terms in zip((1, 3, 20), clean.variance, clean.terms, strict=True):
        known = [
            np.mean(rate[k + m : k + 2 * m]) - np.mean(rate[k : k + m])
            for k in range(501 - 2 * m)
            if not lost[k : k + 2 * m].any()
        ]
        assert terms == len(known)
        np.testing.assert_allclose(variance, np.mean(np.square(known)) / 2, rtol=1e-12)


def test_gaps_leave_the_expectation(key):
    """The mean over runs is the model's with a third of the record lost, within five errors."""
    count, runs, sizes = 3000, 400, (1, 4, 16, 64)
    valid = jnp.ones(count, bool).at[700:1700].set(False)
    rates = jax.random.normal(key, (runs, count))
    measured = compiled(jax.vmap(lambda rate: allan_variance(rate, 1.0, sizes, valid)))(rates)
    freedom = degrees_of_freedom(noise_model(N=1.0), 1.0, sizes, count, measured.share[0])
    ratio = np.asarray(measured.variance) * sizes
    error = np.sqrt(2 / np.asarray(freedom) / runs)
    assert np.all(np.abs(ratio.mean(axis=0) - 1) < 5 * error)
    np.testing.assert_allclose(ratio.std(axis=0) / np.sqrt(2 / freedom), 1, rtol=0.15)


def test_cluster_sizes():
    assert cluster_sizes(72) == (1, 2, 4, 8)
    assert cluster_sizes(71) == (1, 2, 4)
    assert cluster_sizes(576, per_octave=2) == (1, 2, 3, 4, 6, 8, 11, 16, 23, 32, 45, 64)
    assert cluster_sizes(10, longest=0.5) == (1, 2, 4)
    with pytest.raises(ValueError, match="count must be at least 9, got 8"):
        cluster_sizes(8)
    with pytest.raises(ValueError, match="per_octave must be at least 1, got 0"):
        cluster_sizes(100, per_octave=0)
    with pytest.raises(ValueError, match="longest must be in"):
        cluster_sizes(100, longest=0.6)
    with pytest.raises(ValueError, match="sizes must be from 1 to 4"):
        allan_variance(jnp.zeros(9), 1.0, (1, 5))


# The covariance of the variances


def test_kernel_is_the_sum_over_all_pairs():
    """Against the covariance matrices of all second differences, written out."""
    count, sizes = 150, (1, 2, 3, 8, 20, 50, 75)
    u = np.abs(np.arange(count + 1)[:, None] - np.arange(count + 1.0)[None])
    logs = np.log(np.where(u == 0, 1, u))
    phase = [1.0 * (u == 0), -u / 2, u**2 * logs / (2 * np.pi), u**3 / 12]
    differences = []
    for m in sizes:
        rows = np.arange(count + 1 - 2 * m)
        D = np.zeros((len(rows), count + 1))
        D[rows, rows], D[rows, rows + m], D[rows, rows + 2 * m] = 1, -2, 1
        differences.append(D)
    kernel = covariance_kernel(sizes, count)
    for a, A in enumerate(differences):
        for b, B in enumerate(differences):
            C = np.stack([A @ R @ B.T for R in phase])
            exact = np.einsum("ikl,jkl->ij", C, C) / (2 * len(A) * len(B))
            exact /= (sizes[a] * sizes[b]) ** 2
            np.testing.assert_allclose(kernel[:, :, a, b], exact, rtol=2e-3)


def test_degrees_of_freedom_are_those_of_nist():
    """White noise to 2 %; NIST's formulas for the others are fits, 7 % above the exact limit."""
    count = 2**13
    sizes = cluster_sizes(count, longest=0.25)
    m, points = np.array(sizes), count + 1
    white = (3 * (points - 1) / (2 * m) - 2 * (points - 2) / points) * 4 * m**2 / (4 * m**2 + 5)
    flicker = 5 * points**2 / (4 * m * (points + 3 * m))
    walk = (points - 2) / m * ((points - 1) ** 2 - 3 * m * (points - 1) + 4 * m**2)
    walk = walk / (points - 3) ** 2
    freedom = partial(degrees_of_freedom, step=0.01, sizes=sizes, count=count)
    np.testing.assert_allclose(freedom(noise_model(N=3.0)), white, rtol=0.02)
    np.testing.assert_allclose(freedom(noise_model(B=3.0))[1:], flicker[1:], rtol=0.1)
    np.testing.assert_allclose(freedom(noise_model(K=3.0))[1:], walk[1:], rtol=0.12)
    # The covariance of random-walk differences is the cubic B-spline, whose squares sum to 151/315.
    few = degrees_of_freedom(noise_model(K=1.0), 1.0, (64,), 2**20)
    np.testing.assert_allclose(few, 2**20 / 64 * (4 / 9) / (151 / 315), rtol=1e-3)
    np.testing.assert_array_equal(freedom(noise_model()), 0)


def test_chi_square_ends():
    low, high = chi_square_ends(np.array([0.0, 10.0, 1e6]), 0.95)
    # Quantiles of ten degrees from any table: 3.247 and 20.483.
    np.testing.assert_allclose([low[1], high[1]], [10 / 20.483, 10 / 3.247], rtol=1e-4)
    np.testing.assert_allclose([low[2], high[2]], 1, atol=3e-3)
    np.testing.assert_array_equal([low[0], high[0]], [0, np.inf])
    with pytest.raises(ValueError, match="confidence"):
        chi_square_ends(np.ones(1), 1.0)


# The fit


def test_fit_of_the_expectation_is_exact():
    """Every set of noises comes back from its own Allan variances."""
    truth = np.array([2e-6, 1e-4, 3e-5, 1e-6])
    present = np.array([[s >> i & 1 for i in range(4)] for s in range(16)])
    squares = (truth * present) ** 2
    record = allan_variance(jnp.zeros(COUNT), STEP, SIZES)
    fits = [
        fit_of(record._replace(variance=model_variance(noise_model(*row), record.tau)))
        for row in truth * present
    ]
    found = jax.tree.map(lambda *rows: np.stack(rows), *fits)
    np.testing.assert_allclose(found.squared, squares, rtol=1e-7, atol=1e-9 * (truth**2).min())
    assert np.all(found.squared >= 0)
    low, high = coefficient_interval(found)
    for i in range(4):
        assert np.all(low[i] <= truth[i] * present[:, i] + 1e-12)
        assert np.all(high[i] >= truth[i] * present[:, i] - 1e-12)


def test_injected_noise_is_inside_the_intervals(key):
    """N, B, K lie in their 95 % intervals in 90 of 100 runs, the Allan deviation in most."""
    step, count, runs = 0.1, 2**17, 100
    sizes, truth = cluster_sizes(count), noise_model(N=1.0, B=0.3, K=0.02)

    def one(key):
        measured = allan_variance(sensor_noise(key, truth, step, count), step, sizes)
        fit = fit_noise(measured, step, sizes, count)
        return measured, fit, degrees_of_freedom(fit.noise, step, sizes, count)

    run = compiled(lambda keys: jax.lax.map(one, keys, batch_size=10))
    measured, fit, freedom = run(jax.random.split(key, runs))
    low, high = coefficient_interval(fit)
    for name in ("random_walk", "bias_instability", "rate_random_walk"):
        value = float(getattr(truth, name))
        inside = (getattr(low, name) <= value) & (value <= getattr(high, name))
        assert inside.sum() >= 90, name
        assert abs(np.mean(getattr(fit.noise, name)) / value - 1) < 0.1, name
    assert np.all(low.random_walk > 0.97)
    assert np.all(low.bias_instability > 0.2)
    assert np.mean(low.quantisation == 0) >= 0.9
    below, above = deviation_interval(measured, freedom)
    sigma = np.sqrt(model_variance(truth, measured.tau[0]))
    assert np.mean((below <= sigma) & (sigma <= above)) > 0.93
    np.testing.assert_allclose(np.mean(fit.misfit / fit.misfit_freedom), 1, atol=0.2)


def test_random_walk_of_a_minute_at_rest(key):
    """60 s at 400 Hz: N within 3 % in each of 100 runs by the fit, in rms by the slope rule."""
    step, count, truth = 1 / 400, 24000, 5e-4
    sizes = cluster_sizes(count)

    def one(key):
        rate = sensor_noise(key, noise_model(N=truth), step, count)
        measured = allan_variance(rate, step, sizes)
        rules = slope_rule(measured), slope_rule(measured, 3000.0)
        return jnp.stack([fit_noise(measured, step, sizes, count).noise.random_walk, *rules])

    found = compiled(lambda keys: jax.lax.map(one, keys, batch_size=10))(jax.random.split(key, 100))
    error = np.asarray(found) / truth - 1
    assert np.abs(error[:, 0]).max() < 0.03
    fitted, hard, smooth = np.sqrt(np.mean(error**2, axis=0))
    assert fitted < 0.01
    assert hard < 0.03
    assert smooth < 0.02


def test_quantised_increments(key):
    """An angle that is reported in whole units D has Q = D / sqrt(12), within 2 %."""
    unit = 1e-5
    rate = sensor_noise(key, noise_model(N=5e-5), STEP, COUNT) + 1e-3
    angle = jnp.round(jnp.cumsum(rate * STEP) / unit) * unit
    fit = fitted(jnp.diff(angle, prepend=0.0) / STEP)
    np.testing.assert_allclose(fit.noise.quantisation, unit / np.sqrt(12), rtol=0.02)
    np.testing.assert_allclose(fit.noise.random_walk, 5e-5, rtol=0.05)


def test_gaps_are_fitted(key):
    truth, valid = noise_model(N=1e-3, K=5e-4), jnp.arange(COUNT) % 3000 > 200
    fit = fitted(jnp.where(valid, sensor_noise(key, truth, STEP, COUNT), jnp.nan), valid)
    low, high = coefficient_interval(fit, 0.999)
    for name in ("random_walk", "rate_random_walk"):
        assert getattr(low, name) <= getattr(truth, name) <= getattr(high, name), name
    np.testing.assert_allclose(fit.noise.random_walk, 1e-3, rtol=0.03)


def test_records_without_information_say_so():
    ones, nothing = jnp.ones(COUNT), jnp.zeros(COUNT, bool)
    still = fitted(ones)
    np.testing.assert_array_equal(still.squared, 0)
    np.testing.assert_array_equal(coefficient_interval(still), 0)
    lost = allan_variance(ones, STEP, SIZES, nothing)
    np.testing.assert_array_equal(lost.terms, 0)
    unknown = fitted(ones, nothing)
    np.testing.assert_array_equal(unknown.squared, 0)
    low, high = coefficient_interval(unknown)
    np.testing.assert_array_equal(low, 0)
    np.testing.assert_array_equal(high, np.inf)
    assert np.all(np.isinf(deviation_interval(lost, jnp.ones(len(SIZES)))[1]))
    with pytest.raises(ValueError, match="at least 4"):
        fit_noise(lost, STEP, (1, 2, 3), COUNT)


# The slope rule


def test_slope_rule_is_exact_for_white_noise_alone():
    record = allan_variance(jnp.zeros(1000), 0.1, cluster_sizes(1000))
    white = record._replace(variance=9.0 / record.tau)
    for sharpness in (None, 10.0):
        np.testing.assert_allclose(slope_rule(white, sharpness), 3.0, rtol=1e-12)
    # Quantisation below and a random walk above: the slope is right in the middle alone.
    mixed = record._replace(variance=model_variance(noise_model(0.1, 3.0, 0, 0.5), record.tau))
    for sharpness in (None, 1e5):
        np.testing.assert_allclose(slope_rule(mixed, sharpness), 3.0, rtol=0.03)
    np.testing.assert_array_equal(slope_rule(record), 0)
    with pytest.raises(ValueError, match="at least 3"):
        slope_rule(allan_variance(jnp.zeros(9), 1.0, (1, 2)))


# Transformations


def test_gradients_are_those_of_central_differences(key):
    """Through the whole chain: the amplitudes of three noises to N, B, K and the smooth rule."""
    step, count = 0.1, 2**13
    sizes = cluster_sizes(count)
    keys = jax.random.split(key, 3)
    parts = (noise_model(N=1.0), noise_model(B=1.0), noise_model(K=0.2))
    noises = jnp.stack([sensor_noise(k, n, step, count) for k, n in zip(keys, parts, strict=True)])

    @compiled
    def found(amplitude):
        measured = allan_variance(amplitude @ noises, step, sizes)
        fit = fit_noise(measured, step, sizes, count)
        return jnp.stack([*fit.noise[1:], slope_rule(measured, 100.0)])

    at = jnp.array([1.0, 0.8, 0.5])
    assert np.all(found(at) > 0)
    small = 1e-5 * jnp.eye(3)
    central = [(found(at + e) - found(at - e)) / 2e-5 for e in small]
    slope = compiled(jax.jacrev(found))
    np.testing.assert_allclose(slope(at), np.stack(central, axis=1), rtol=1e-6, atol=1e-7)
    np.testing.assert_array_equal(slope(jnp.zeros(3)), 0)


def test_compiled_equals_eager_in_either_precision(key):
    step, count = 0.1, 2**7
    sizes = cluster_sizes(count)

    def found(rate):
        measured = allan.allan_variance(rate, step, sizes)
        fit = noise_fit.fit_noise(measured, step, sizes, count)
        return measured, fit, allan.slope_rule(measured, 100.0)

    rate = jax.random.normal(key, (count,))
    eager, program = found(rate), compiled(found)(rate)
    for one, other in zip(jax.tree.leaves(eager), jax.tree.leaves(program), strict=True):
        scale = np.max(np.abs(one)) + 1e-300
        np.testing.assert_allclose(one / scale, other / scale, rtol=0, atol=1e-9)
    coarse = compiled(found)(rate.astype(jnp.float32))
    assert {leaf.dtype for leaf in jax.tree.leaves(coarse)} == {jnp.dtype("float32")}
    np.testing.assert_allclose(coarse[1].noise.random_walk, eager[1].noise.random_walk, rtol=1e-4)


# The generator


def test_noises_follow_their_laws(key):
    """The mean Allan variance of 200 runs is the model's, within five standard errors."""
    step, count, runs = 0.1, 2**10, 200
    sizes = (8, 32, 128)
    tau = step * jnp.asarray(sizes, float)

    @compiled
    def measure(axes):
        keys = jax.random.split(key, runs)
        rates = jax.vmap(lambda k: sensor_noise(k, axes, step, count))(keys)
        assert rates.shape == (runs, count, 3)
        return jax.vmap(jax.vmap(lambda r: allan_variance(r, step, sizes), 1))(rates)

    for model in (noise_model(Q=0.2), noise_model(N=3.0), noise_model(B=2.0), noise_model(K=0.5)):
        axes = NoiseModel(*(jnp.full(3, part) for part in model))
        measured = measure(axes)
        ratio = measured.variance / model_variance(model, tau)[None, None]
        freedom = np.asarray(degrees_of_freedom(model, step, sizes, count))
        error = np.sqrt(2 / freedom / (3 * runs))
        # The filter's flicker noise has 1 % too much power at clusters of eight samples.
        slack = 0.015 if model.bias_instability > 0 else 0.0
        assert np.all(np.abs(ratio.mean(axis=(0, 1)) - 1) < 5 * error + slack)
    with pytest.raises(ValueError, match="count"):
        sensor_noise(key, noise_model(N=1.0), step, 0)


def test_the_median_is_as_good_without_spikes_and_better_with(key):
    """Of white noise within five standard errors; a spike moves the mean alone."""
    sizes = (1, 4, 16, 64)
    rate = sensor_noise(key, NoiseModel(0.0, jnp.full(1, 0.1), 0.0, 0.0), 0.01, 20_000)[:, 0]
    valid = jnp.ones(20_000, bool).at[500:600].set(False)
    spoilt = rate.at[7_000].add(100.0)
    expected = 0.1 / np.sqrt(0.01 * np.array(sizes))
    scatter = 1.17 * np.sqrt(np.array(sizes) / 20_000)
    for one in (rate, spoilt):
        for mask in (None, valid):
            found = median_variance(one, 0.01, sizes, mask)
            assert np.all(np.abs(found.deviation / expected - 1) < 5 * scatter)
    usual = allan_variance(spoilt, 0.01, sizes)
    assert usual.deviation[0] > 1.2 * expected[0]
    with pytest.raises(ValueError, match="sizes must be from 1 to 10000"):
        median_variance(rate, 0.01, (10_001,))
