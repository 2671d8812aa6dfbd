"""Monte Carlo: a run as a function of its key, mapped over many keys, tile by tile."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from queue import SimpleQueue
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.arguments import described, require_function, require_leaves, require_whole
from jaxnav.compiling import compiled, cores

TILE = 8
"""Number of runs in a tile on a CPU: few are then filled up in vain, the working set of a bank of
seven 15-state filters stays within the second-level cache, and larger ones are hardly faster."""
WIDE_TILE = 1024
"""Number of runs in a tile on an accelerator."""


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
    threads: int | None = None,
    keep: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Campaign:
    """Run a Monte Carlo study; run ``i`` has the key ``fold_in(key, i)`` whatever the tiling.

    A tile is a ``vmap`` over its runs, a program of one shape: the last tile is filled up, so that
    another number of runs compiles nothing. Threads compute tiles side by side, one for each core
    of a CPU, and a second call with the same ``run_one`` and shapes uses the program again. Per-run
    rows are the same, bit for bit, for any number of runs, threads and devices at the same tile,
    and equal to rounding for other tiles.

    Args:
        run_one: ``(key, shared) -> RunOutput``; pure.
        key: Root key.
        runs: Number of runs, at least one.
        shared: Pytree that all runs see; what depends on it alone is computed once per tile.
        tile: Runs per tile; the default is :data:`TILE` on a CPU, :data:`WIDE_TILE` elsewhere.
        devices: Devices to use; the default is the first local one. Each compiles for itself.
        threads: Tiles that a device computes side by side; the default shares the cores of this
            process among devices that are CPUs, and is one elsewhere.
        keep: Number of first runs whose ``trace`` is kept.
        progress: Called with (runs done, runs) after each tile, on the host.

    Returns:
        The campaign.

    Raises:
        ValueError: If an argument is not what it must be, there is no device, or ``run_one``
            returns something else than a :class:`RunOutput`.
    """
    require_function("run_one", run_one, "key", "shared")
    _require_key(key)
    require_leaves("shared", shared)
    if devices is not None and (isinstance(devices, str) or not isinstance(devices, Sequence)):
        raise ValueError(f"devices is {described(devices)}; it must be a list of JAX's devices")
    if progress is not None:
        require_function("progress", progress, "done", "runs")
    chosen = list(jax.local_devices()[:1] if devices is None else devices)
    if not chosen:
        raise ValueError("devices is empty; a Monte Carlo study needs at least one")
    on_cpu = chosen[0].platform == "cpu"
    if tile is None:
        tile = TILE if on_cpu else WIDE_TILE
    if threads is None:
        threads = max(cores() // len(chosen), 1) if on_cpu else 1
    for name, value in (("runs", runs), ("tile", tile), ("threads", threads)):
        require_whole(name, value, 1)
    require_whole("keep", keep, 0)
    most = np.iinfo(np.int32).max - tile
    if runs > most:
        raise ValueError(f"runs is {runs}; it must be at most {most}")
    starts = range(0, runs, tile)
    inputs = [jax.device_put((key, jnp.int32(runs), shared), device) for device in chosen]
    free: SimpleQueue[Any] = SimpleQueue()
    for each in inputs * threads:
        free.put(each)
    # A thread does not inherit the precision that a context manager has set for its caller.
    wide = jnp.result_type(float) == jnp.float64

    def compute(start: int) -> tuple[RunOutput, Array]:
        given = free.get()
        try:
            with jax.enable_x64(wide):
                output = _run_tile(run_one, tile, keep > 0, np.int32(start), *given)
                return jax.block_until_ready(output)
        finally:
            free.put(given)

    pieces: list[tuple[Any, np.ndarray]] = []
    total: Any = None
    traces: list[Any] = []
    pool = ThreadPoolExecutor(min(len(inputs) * threads, len(starts)))
    try:
        for start, (output, finite) in zip(starts, pool.map(compute, starts), strict=True):
            count = min(runs - start, tile)
            kept = min(max(keep - start, 0), count)
            pieces.append(_first((output.row, finite), count))
            total = _add(total, output.curve)
            if kept:
                traces.append(_first(output.trace, kept))
            if progress is not None:
                progress(start + count, runs)
    finally:
        pool.shutdown(cancel_futures=True)
    rows, finite = jax.tree.map(lambda *leaves: np.concatenate(leaves), *pieces)
    joined = jax.tree.map(lambda *leaves: np.concatenate(leaves), *traces) if traces else ()
    return Campaign(rows, total, joined, finite)


def _require_key(key: Any) -> None:
    """Raise ``ValueError`` unless it is one random key."""
    typed = isinstance(key, Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    raw = isinstance(key, Array) and key.dtype == jnp.uint32 and key.ndim == 1
    if not raw and not (typed and key.ndim == 0):
        raise ValueError(f"key is {described(key)}; it must be one key, as jax.random.key(0)")


def _add(total: Any, curve: Any) -> Any:
    """Add a tile's sum on the host, in the order of the runs, so that the result is fixed."""
    if total is None:
        return jax.tree.map(np.asarray, curve)
    return jax.tree.map(lambda a, b: a + np.asarray(b), total, curve)


def _first(tree: Any, count: int) -> Any:
    return jax.tree.map(lambda leaf: np.asarray(leaf)[:count], tree)


@compiled(static_argnums=(0, 1, 2))
def _run_tile(
    run_one: Callable[[Array, Any], RunOutput],
    tile: int,
    traced: bool,
    start: Array,
    key: Array,
    runs: Array,
    shared: Any,
) -> tuple[RunOutput, Array]:
    """Compute the tile of runs from ``start``."""
    indices = start + jnp.arange(tile, dtype=jnp.int32)
    keys = jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, indices)

    def one(key: Array, shared: Any) -> RunOutput:
        output = run_one(key, shared)
        if not isinstance(output, RunOutput):
            raise ValueError(
                f"run_one returns {described(output)}; it must return RunOutput(row), with numbers "
                "and small arrays as the row"
            )
        for name, value in zip(RunOutput._fields, output, strict=True):
            require_leaves(f"{name} of run_one", value)
        return output

    output = jax.vmap(one, in_axes=(0, None))(keys, shared)
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
