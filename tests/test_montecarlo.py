"""Monte Carlo: the same run whatever the tiling, devices and order; memory; failures as data."""

import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.compiling import accepted_options
from jaxnav.estimation.filters.sigma_point import square_root_ckf, square_root_ukf
from jaxnav.estimation.filters.square_root import square_root_ekf, square_root_kf
from jaxnav.estimation.montecarlo import RunOutput, monte_carlo
from jaxnav.estimation.types import FilterParams, Gaussian, Model, Obs
from jaxnav.studies.immae.config import ImmaeConfig
from jaxnav.studies.immae.study import run_campaign
from tests.programs import compilations


@pytest.mark.slow
def test_tiles_threads_and_devices_do_not_change_a_run() -> None:
    config = ImmaeConfig(chain="linear", runs=16, duration_s=20.0)
    both = jax.local_devices()[:2]
    assert len(both) == 2
    reference = run_campaign(config, keep=1)
    for tile in (1, 7, 16):
        narrow = run_campaign(config, tile=tile, threads=1, keep=1)
        for options in ({"threads": 2}, {"threads": 5}, {"devices": both}):
            wide = run_campaign(config, tile=tile, keep=1, **options)
            for a, b in zip(jax.tree.leaves(narrow), jax.tree.leaves(wide), strict=True):
                np.testing.assert_array_equal(a, b)
        for a, b in zip(jax.tree.leaves(narrow.rows), jax.tree.leaves(reference.rows), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-9)
        for a, b in zip(
            jax.tree.leaves(narrow.curve), jax.tree.leaves(reference.curve), strict=True
        ):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-18)


@pytest.mark.slow
def test_another_number_of_runs_gives_the_same_rows_and_compiles_nothing() -> None:
    config = ImmaeConfig(chain="linear", runs=16, duration_s=20.0)
    many = run_campaign(config, tile=4)
    with compilations() as programs:
        for runs in (1, 3, 9):
            few = run_campaign(replace(config, runs=runs), tile=4)
            for a, b in zip(jax.tree.leaves(few.rows), jax.tree.leaves(many.rows), strict=True):
                np.testing.assert_array_equal(a, b[:runs])
    assert programs == []


def _noisy(key: jax.Array, shared: jax.Array) -> RunOutput:
    x = shared + jax.random.normal(key, (5,))
    bad = x[0] > 1.5
    return RunOutput(row=jnp.where(bad, jnp.nan, x), curve=x, trace=x)


def test_a_run_is_a_function_of_its_index() -> None:
    key = jax.random.key(3)
    few = monte_carlo(_noisy, key, 10, jnp.zeros(()), tile=4, keep=3)
    many = monte_carlo(_noisy, key, 23, jnp.zeros(()), tile=5, keep=3)
    np.testing.assert_array_equal(few.rows, many.rows[:10])
    np.testing.assert_array_equal(few.traces, many.traces)
    alone = _noisy(jax.random.fold_in(key, 7), jnp.zeros(()))
    np.testing.assert_array_equal(alone.row, many.rows[7])


def test_a_failed_run_is_kept_as_a_row_and_left_out_of_the_sum() -> None:
    campaign = monte_carlo(_noisy, jax.random.key(0), 60, jnp.zeros(()), tile=8)
    failed = np.isnan(campaign.rows).any(axis=1)
    assert 0 < failed.sum() < 60
    np.testing.assert_array_equal(campaign.finite, ~failed)
    np.testing.assert_allclose(campaign.mean_curve, campaign.rows[~failed].mean(axis=0))


def test_precision_of_the_caller_reaches_the_threads() -> None:
    for wide, dtype in ((True, np.float64), (False, np.float32)):
        with jax.enable_x64(wide):
            campaign = monte_carlo(_noisy, jax.random.key(0), 3, jnp.zeros(()), tile=2)
        assert campaign.rows.dtype == dtype


def test_progress_counts_runs() -> None:
    seen: list[tuple[int, int]] = []
    monte_carlo(
        _noisy,
        jax.random.key(0),
        11,
        jnp.zeros(()),
        tile=2,
        progress=lambda done, total: seen.append((done, total)),
    )
    assert seen == [(2, 11), (4, 11), (6, 11), (8, 11), (10, 11), (11, 11)]


N = 7
SQUARE_ROOTS = {
    build.__name__: build
    for build in (square_root_kf, square_root_ekf, square_root_ukf, square_root_ckf)
}


def linear_model() -> Model:
    rng = np.random.default_rng(0)
    A, H = jnp.array(np.eye(N) + 0.1 * rng.normal(size=(N, N))), jnp.array(rng.normal(size=(3, N)))
    return Model(
        transition=lambda p, x, u: 0.9 * A @ x,
        process_noise=lambda p, x, u: 0.1 * jnp.eye(N),
        observe=lambda p, x, u: H @ x,
        observation_noise=lambda p, x, u: jnp.ones(3),
    )


@pytest.mark.parametrize("name", SQUARE_ROOTS)
def test_square_roots_on_many_threads_never_stall_and_are_bitwise_those_of_one(name: str) -> None:
    """Batched LAPACK calls shared the threads they were called from, and waited for ever."""
    filter = SQUARE_ROOTS[name](linear_model())
    params = FilterParams((), Gaussian(jnp.zeros(N), jnp.eye(N)))

    def step(params: FilterParams, z: jax.Array) -> Any:
        state = filter.predict(params, filter.init(params), jnp.zeros(()))
        return filter.update(params, state, jnp.zeros(()), Obs(z, jnp.ones(3, bool)))

    batch = jax.jit(jax.vmap(step, in_axes=(None, 0)), compiler_options=accepted_options())
    program = batch.lower(params, jnp.zeros((4, 3))).compile().as_text()
    assert program is not None
    assert "custom-call" not in program
    assert "custom_call_target" not in program

    def run_one(key: jax.Array, params: FilterParams) -> RunOutput:
        state, info = step(params, jax.random.normal(key, (3,)))
        return RunOutput((filter.estimate(state), info.log_likelihood))

    one, many = (
        monte_carlo(run_one, jax.random.key(0), 1600, params, tile=4, threads=threads)
        for threads in (1, 4)
    )
    assert one.finite.all()
    for a, b in zip(jax.tree.leaves(one.rows), jax.tree.leaves(many.rows), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    ("runs", "options", "said"),
    [
        (0, {}, "runs is 0; it must be at least 1"),
        (-3, {}, "runs is -3; it must be at least 1"),
        (4, {"tile": 0}, "tile is 0; it must be at least 1"),
        (4, {"threads": 0}, "threads is 0; it must be at least 1"),
        (4, {"devices": []}, "devices is empty"),
    ],
)
def test_numbers_that_are_not_positive_are_refused(
    runs: int, options: dict[str, Any], said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        monte_carlo(_noisy, jax.random.key(0), runs, jnp.zeros(()), **options)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads its memory from /proc")
def test_ten_thousand_runs_of_the_linear_chain_hold_in_memory() -> None:
    """They take no more than five hundred do; the histories alone would take 600 MB more."""
    script = """
        from dataclasses import replace
        from pathlib import Path
        import jax
        jax.config.update("jax_enable_x64", True)
        from jaxnav.studies.immae.config import ImmaeConfig
        from jaxnav.studies.immae.study import run_campaign
        def peak():
            # getrusage would count what the parent held when it started this process
            status = Path("/proc/self/status").read_text().splitlines()
            return 1024 * next(int(line.split()[1]) for line in status if line.startswith("VmHWM"))
        config = ImmaeConfig(chain="linear", duration_s=10.0)
        run_campaign(replace(config, runs=512))
        few = peak()
        campaign = run_campaign(replace(config, runs=10_000))
        assert campaign.finite.all()
        assert campaign.rows.mean_square.shape == (10_000, 6, 3)
        print(few, peak())
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script)],
        capture_output=True,
        text=True,
        check=True,
    )
    few, many = map(int, done.stdout.split())
    assert many < 2.5 * 2**30
    assert many - few < 200e6
