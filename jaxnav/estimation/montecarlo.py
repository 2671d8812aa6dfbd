"""Monte Carlo: a run as a function of its key, mapped over many keys, tile by tile."""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

TILE = 16
"""Largest number of runs in a tile by default: the working set of a bank of seven 15-state filters
then stays within the second-level cache."""


class RunOutput(NamedTuple):
    """What one run hands back.

    Attributes:
        row: Pytree of small arrays, kept for every run.
        curve: Pytree summed over the runs inside the tile, so that time histories cost no memory
            per run; runs whose row is not finite are left out of the sum.
        trace: Pytree kept for the first runs only.
    """

    row: Any
    curve: Any = ()
    trace: Any = ()


class Campaign(NamedTuple):
    """The result of :func:`monte_carlo`, as NumPy arrays.

    Attributes:
        rows: Each leaf with a leading axis of runs, in order of the run's index.
        curve: The sum over the runs whose rows are finite in every entry.
        traces: Each leaf with a leading axis of the runs that were kept.
        finite: ``(runs,)`` whether every entry of a run's row is finite.
    """

    rows: Any
    curve: Any
    traces: Any
    finite: np.ndarray

    @property
    def mean_curve(self) -> Any:
        """The mean over the runs that are finite."""
        count = max(int(self.finite.sum()), 1)
        return jax.tree.map(lambda leaf: leaf / count, self.curve)


def monte_carlo(
    run_one: Callable[[Array, Any], RunOutput],
    key: Array,
    runs: int,
    shared: Any = (),
    *,
    tile: int | None = None,
    devices: Sequence[Any] | None = None,
    keep: int = 0,
    compile_in_turn: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Campaign:
    """Run a Monte Carlo study; run ``i`` has the key ``fold_in(key, i)`` whatever the tiling.

    A tile is a ``vmap`` over its runs; the devices compute tiles side by side with the same
    program, which a second call with the same ``run_one`` and shapes uses again. Per-run
    rows are the same, bit for bit, for any number of devices and any order at the same tile shape,
    and equal to rounding for other shapes.

    Args:
        run_one: ``(key, shared) -> RunOutput``; pure.
        key: Root key.
        runs: Number of runs, at least one.
        shared: Pytree that all runs see; what depends on it alone is computed once per tile.
        tile: Runs per tile and device; the default spreads the runs evenly, at most :data:`TILE`.
        devices: Devices to use; the default is :func:`default_devices`.
        keep: Number of first runs whose ``trace`` is kept.
        compile_in_turn: Compile for one device after the other instead of for all at once: a large
            program takes more memory to compile than to run.
        progress: Called with (runs done, runs) after each round of tiles, on the host.

    Returns:
        The campaign.

    Raises:
        ValueError: If ``runs`` or ``tile`` is not positive.
    """
    if runs < 1:
        raise ValueError(f"runs is {runs}; a Monte Carlo study needs at least 1")
    chosen = list(devices) if devices is not None else default_devices()
    if tile is None:
        tile = _even_tile(runs, len(chosen))
    if tile < 1:
        raise ValueError(f"tile is {tile}; it needs at least 1 run")
    stride = tile * len(chosen)
    inputs = [jax.device_put((key, jnp.int32(runs), shared), device) for device in chosen]
    pieces: list[tuple[Any, np.ndarray]] = []
    total: Any = None
    traces: list[Any] = []

    # A thread does not inherit the precision that a context manager has set for its caller.
    wide = jnp.result_type(float) == jnp.float64

    def launch(start: int, place: int) -> tuple[RunOutput, Array]:
        first = np.int32(start + place * tile)
        with jax.enable_x64(wide):
            return _run_tile(run_one, tile, keep > 0, first, *inputs[place])

    def compute(start: int, place: int) -> tuple[RunOutput, Array]:
        return jax.block_until_ready(launch(start, place))

    with ThreadPoolExecutor(len(chosen)) as pool:
        for start in range(0, runs, stride):
            if compile_in_turn and start == 0:
                # A call returns once it has compiled; the devices then run side by side.
                results = jax.block_until_ready([launch(0, place) for place in range(len(chosen))])
            else:
                results = list(pool.map(partial(compute, start), range(len(chosen))))
            for place, (output, finite) in enumerate(results):
                first = start + place * tile
                count = min(max(runs - first, 0), tile)
                kept = min(max(keep - first, 0), count)
                pieces.append(_first((output.row, finite), count))
                total = _add(total, output.curve)
                if kept:
                    traces.append(_first(output.trace, kept))
            if progress is not None:
                progress(min(start + stride, runs), runs)
    rows, finite = jax.tree.map(lambda *leaves: np.concatenate(leaves), *pieces)
    joined = jax.tree.map(lambda *leaves: np.concatenate(leaves), *traces) if traces else ()
    return Campaign(rows, total, joined, finite)


def default_devices() -> list[Any]:
    """Return the devices that a study uses unless told otherwise: all local ones."""
    return jax.local_devices()


def _even_tile(runs: int, devices: int) -> int:
    """Return the tile that spreads the runs over equal rounds of at most :data:`TILE` a device."""
    rounds = math.ceil(runs / (devices * TILE))
    return math.ceil(runs / (devices * rounds))


def _add(total: Any, curve: Any) -> Any:
    """Add a tile's sum on the host, in the order of the runs, so that the result is fixed."""
    if total is None:
        return jax.tree.map(np.asarray, curve)
    return jax.tree.map(lambda a, b: a + np.asarray(b), total, curve)


def _first(tree: Any, count: int) -> Any:
    return jax.tree.map(lambda leaf: np.asarray(leaf)[:count], tree)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _run_tile(
    run_one: Callable[[Array, Any], RunOutput],
    tile: int,
    traced: bool,
    start: Array,
    key: Array,
    runs: Array,
    shared: Any,
) -> tuple[RunOutput, Array]:
    """Compute the tile of runs from ``start``; every device runs this same program.

    One program split over the devices (``shard_map``) is compiled differently for one device and
    for two, and its results differ in the last bits.
    """
    indices = start + jnp.arange(tile, dtype=jnp.int32)
    keys = jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, indices)
    output = jax.vmap(run_one, in_axes=(0, None))(keys, shared)
    finite = jax.vmap(_all_finite)(output.row)
    counted = finite & (indices < runs)

    def add_up(leaf: Array) -> Array:
        mask = counted.reshape(-1, *([1] * (leaf.ndim - 1)))
        return jnp.sum(jnp.where(mask, leaf, 0), axis=0)

    curve = jax.tree.map(add_up, output.curve)
    return RunOutput(output.row, curve, output.trace if traced else ()), finite


def _all_finite(row: Any) -> Array:
    checks = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(row)]
    return jnp.all(jnp.stack(checks)) if checks else jnp.array(True)
