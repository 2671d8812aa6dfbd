"""Other ways to run the bank's members: JAX libraries, filterpy, batched NumPy and plain C.

Each takes the problem as matrices and gives the members' attitude and log-likelihood; the weights
of the bank are no part of their work.
"""

import ctypes
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from benchmarks._problem import THETA, Dense

TILE = 16
Series = Callable[[Array, Array, Array], tuple[Array, Array]]
"""``(F (T, 15, 15), G (T, 15, 6), z (T, 3)) -> (attitude (T, 3), log-likelihood)`` of one model."""


class Missing(Exception):
    """A contestant that cannot run here; the message says why."""


class Contestant(NamedTuple):
    """A way to run the members.

    Attributes:
        name: For the table.
        lane_steps: Filter steps over all runs and models in one timed call, at most: what is slow,
            or holds a matrix per run, model and step, is timed on a part of the flight.
        prepare: ``(problem) -> calls``, by the way they spread the work; each gives attitude
            ``(runs, M, T, 3)`` and log-likelihood ``(runs, M)``. Raises :class:`Missing`.
        jax: Whether it is a JAX library.
        runs: Largest number of runs it is asked for; it has no batch if 1.
    """

    name: str
    lane_steps: int
    prepare: Callable[[Dense], dict[str, Callable[[], tuple[Any, Any]]]]
    jax: bool = False
    runs: int = 2**31


def first_prediction(F: Array, Q: Array, P0: Array) -> Array:
    """Return the covariance before the first update, for libraries whose prior is that one."""
    return F[0] @ P0 @ F[0].T + Q[0]


def dynamax_series(H: Array, R: Array, P0: Array) -> Series:
    """Return dynamax's linear-Gaussian filter."""
    try:
        from dynamax.linear_gaussian_ssm import inference  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise Missing("dynamax is not installed") from error

    def filter_one(F: Array, G: Array, z: Array) -> tuple[Array, Array]:
        Q = G @ jnp.swapaxes(G, -1, -2)
        P = first_prediction(F, Q, P0)
        params = inference.make_lgssm_params(jnp.zeros(15), P, F, Q, H, R)
        out = inference.lgssm_filter(params, z)
        return jnp.asarray(out.filtered_means)[:, :3], jnp.asarray(out.marginal_loglik)

    return filter_one


def smcx_series(H: Array, R: Array, P0: Array) -> Series:
    """Return smcx's Kalman filter."""
    try:
        from smcx import kalman_filter  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise Missing("smcx is not installed") from error

    def filter_one(F: Array, G: Array, z: Array) -> tuple[Array, Array]:
        Q = G @ jnp.swapaxes(G, -1, -2)
        P = first_prediction(F, Q, P0)
        out = kalman_filter(jnp.zeros(15), P, F[1:], Q[1:], H, R, z)
        return out.filtered_means[:, :3], jnp.asarray(out.marginal_loglik)

    return filter_one


def cuthbert_series(H: Array, R: Array, P0: Array) -> Series:
    """Return cuthbert's square-root Kalman filter, in sequential form."""
    try:
        from cuthbert import filter as run_filter  # pyright: ignore[reportMissingImports]
        from cuthbert.gaussian import kalman  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise Missing("cuthbert is not installed") from error

    def filter_one(F: Array, G: Array, z: Array) -> tuple[Array, Array]:
        root = jnp.concatenate([G, jnp.zeros((len(G), 15, 9))], axis=-1)

        def dynamics(model_inputs: Any) -> tuple[Array, Array, Array]:
            return model_inputs[0], jnp.zeros(15), model_inputs[1]

        def observation(model_inputs: Any) -> tuple[Array, Array, Array, Array]:
            return H, jnp.zeros(3), jnp.sqrt(R), model_inputs[2]

        built = kalman.build_filter(jnp.zeros(15), jnp.sqrt(P0), dynamics, observation)
        states = run_filter(built, (F, root, z), built.init_prepare())
        mean, total = states.mean, states.log_normalizing_constant
        return mean[1:, :3], total[-1]

    return filter_one


def jax_calls(series: Callable[[Array, Array, Array], Series]) -> Callable[[Dense], dict]:
    """Return how a user runs a JAX filter over models and runs: ``vmap`` and ``jit``.

    Once as it is and once in tiles of runs, XLA being free to use both cores. Splitting the runs
    over two host devices is no third way: batched LAPACK calls, which these libraries make, of two
    devices can wait for each other's threads for ever.
    """

    def prepare(problem: Dense) -> dict[str, Callable[[], tuple[Any, Any]]]:
        filter_one = series(*(jnp.asarray(m) for m in (problem.H, problem.R, problem.P0)))
        axis = 0 if problem.own else None

        def models(F: Array, G: Array, z: Array) -> tuple[Array, Array]:
            roots = jnp.sqrt(jnp.array(THETA))
            return jax.vmap(lambda root: filter_one(F, root * G, z))(roots)

        batch = jax.vmap(models, in_axes=(axis, axis, 0))

        def tiled(F: Array, G: Array, z: Array) -> tuple[Array, Array]:
            if problem.own:
                return jax.lax.map(lambda run: models(*run), (F, G, z), batch_size=TILE)
            return jax.lax.map(lambda one: models(F, G, one), z, batch_size=TILE)

        values = tuple(jnp.asarray(m) for m in (problem.F, problem.G, problem.z))
        calls = {"vmap": jax.jit(batch)}
        if len(problem.z) > TILE:
            calls["tiles"] = jax.jit(tiled)
        return {name: lambda call=call: call(*values) for name, call in calls.items()}

    return prepare


def prepare_filterpy(problem: Dense) -> dict[str, Callable[[], tuple[Any, Any]]]:
    """Return filterpy's loop over one run and one model after the other."""
    try:
        from filterpy.kalman import KalmanFilter  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise Missing("filterpy is not installed") from error
    F = problem.F if problem.own else problem.F[None]
    Q = problem.Q if problem.own else problem.Q[None]

    def loop(run: int, scale: float) -> tuple[np.ndarray, float]:
        kf = KalmanFilter(dim_x=15, dim_z=3)
        kf.P, kf.H, kf.R = problem.P0.copy(), problem.H, problem.R
        attitude, total, own = [], 0.0, run if problem.own else 0
        for k, z in enumerate(problem.z[run]):
            kf.predict(F=F[own, k], Q=scale * Q[own, k])
            kf.update(z)
            total += kf.log_likelihood
            attitude.append(kf.x[:3, 0].copy())
        return np.array(attitude), total

    def call() -> tuple[np.ndarray, np.ndarray]:
        done = [[loop(run, scale) for scale in THETA] for run in range(len(problem.z))]
        return np.array([[a for a, _ in row] for row in done]), np.array(
            [[t for _, t in row] for row in done]
        )

    return {"loop": call}


def prepare_numpy(problem: Dense) -> dict[str, Callable[[], tuple[Any, Any]]]:
    """Return batched NumPy: ``matmul`` over runs and models; runs that can share, share."""
    F, Q, H, R = problem.F, problem.Q, problem.H, problem.R
    batch = len(problem.z) if problem.own else 1
    Ft, Qt = (np.moveaxis(m, -3, 0).reshape(-1, batch, 1, 15, 15) for m in (F, Q))
    theta = np.array(THETA)[:, None, None]

    def call() -> tuple[np.ndarray, np.ndarray]:
        x = np.zeros((len(problem.z), len(THETA), 15, 1))
        P = np.broadcast_to(problem.P0, (batch, len(THETA), 15, 15))
        attitude, total = [], np.zeros(x.shape[:2])
        for k in range(problem.z.shape[1]):
            x, P = Ft[k] @ x, Ft[k] @ P @ Ft[k].swapaxes(-1, -2) + theta * Qt[k]
            nu = problem.z[:, None, k, :, None] - H @ x
            S = H @ P @ H.T + R
            inverse = np.linalg.inv(S)
            K = P @ H.T @ inverse
            A = np.eye(15) - K @ H
            x, P = x + K @ nu, A @ P @ A.swapaxes(-1, -2) + K @ R @ K.swapaxes(-1, -2)
            nis = (nu.swapaxes(-1, -2) @ inverse @ nu)[..., 0, 0]
            total = total - 0.5 * (nis + np.log(np.linalg.det(2 * np.pi * S)))
            attitude.append(x[..., :3, 0])
        return np.moveaxis(np.array(attitude), 0, 2), total

    return {"matmul": call}


def prepare_c(problem: Dense) -> dict[str, Callable[[], tuple[Any, Any]]]:
    """Return the C loop of ``kalman.c``, compiled for this machine, on one core."""
    function = _compiled().kalman_bank
    function.argtypes = [ctypes.c_long] * 4 + [np.ctypeslib.ndpointer(flags="C")] * 10
    function.restype = None
    runs, steps, models = *problem.z.shape[:2], len(THETA)
    matrices = (problem.F, problem.Q, np.array(THETA), problem.H, problem.R, problem.P0, problem.z)
    given = [np.ascontiguousarray(m) for m in matrices]
    lanes = (runs, models) if problem.own else (models, runs)
    x, attitude, total = (np.empty((*lanes, *rest)) for rest in ((15,), (steps, 3), ()))

    def call() -> tuple[np.ndarray, np.ndarray]:
        function(problem.own, runs, models, steps, *given, x, attitude, total)
        return (attitude, total) if problem.own else (attitude.swapaxes(0, 1), total.T)

    return {"one core": call}


def _compiled() -> ctypes.CDLL:
    compiler = shutil.which(os.environ.get("CC", "cc"))
    if compiler is None:
        raise Missing("no C compiler was found")
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "kalman.so"
        source = Path(__file__).with_name("kalman.c")
        flags = ["-O3", "-march=native", "-shared", "-fPIC"]
        try:
            subprocess.run(
                [compiler, *flags, source, "-o", library, "-lm"], check=True, capture_output=True
            )
        except subprocess.CalledProcessError as error:
            raise Missing(f"{compiler} failed: {error.stderr.decode().strip()}") from error
        return ctypes.CDLL(str(library))


CONTESTANTS = (
    Contestant("dynamax", 200_000, jax_calls(dynamax_series), jax=True),
    Contestant("smcx", 200_000, jax_calls(smcx_series), jax=True),
    Contestant("cuthbert", 20_000, jax_calls(cuthbert_series), jax=True),
    Contestant("NumPy, batched", 50_000, prepare_numpy),
    Contestant("filterpy, one run", 2_500, prepare_filterpy, runs=1),
    Contestant("C, dense", 200_000, prepare_c),
)
