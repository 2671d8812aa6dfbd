"""The problem the benchmarks share: a bank of SINS/CNS Kalman filters along a rocket's flight.

Fifteen states, three measurements, five models that scale the process noise by 1 to 1e4. The runs
see either one solution of the navigation system, so that they can share a covariance, or each its
own, turned by a small rotation.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxnav.estimation.banks.mixture import BankParams
from jaxnav.estimation.types import FilterParams, Gaussian, replicate
from jaxnav.navigation.models.sins_cns import SinsCnsInput, SinsCnsParams
from jaxnav.navigation.states import LAYOUT
from jaxnav.numerics.lie import so3_exp
from jaxnav.studies.immae.config import ImmaeConfig
from jaxnav.studies.immae.simulation import build_world, fly_linear, noise_of, prior_sigma
from jaxnav.units import ARCSEC

PERIOD = 0.05
IMU_STEP = 0.01
THETA = (1.0, 10.0, 100.0, 1e3, 1e4)
TILT = 1e-2
"""Standard deviation [rad] of the rotation that sets one run's solution apart from another's."""


class Problem(NamedTuple):
    """What is filtered.

    Attributes:
        noise: Noise of the sensors, factor one.
        P0: ``(15, 15)`` initial covariance.
        inputs: Inputs of the model along the true trajectory, leading axis ``T``.
        tilt: ``(runs, 3) [rad]`` rotation of each run's own solution.
        z: ``(runs, T, 3) [rad]`` simulated observations.
    """

    noise: SinsCnsParams
    P0: Array
    inputs: SinsCnsInput
    tilt: Array
    z: Array


class Dense(NamedTuple):
    """The same problem as matrices, NumPy arrays, for filters that know no structure.

    The attitude is in arc seconds, which does not change the problem: peers that add a fixed 1e-9
    to an innovation covariance would be wrong in radians squared.

    Attributes:
        F: ``(..., T, 15, 15)`` transition of each step, a leading run axis if it differs.
        G: ``(..., T, 15, 6)`` with ``G G'`` the process noise at factor one.
        H: ``(3, 15)``.
        R: ``(3, 3)``.
        P0: ``(15, 15)``.
        z: ``(runs, T, 3)``.
    """

    F: np.ndarray
    G: np.ndarray
    H: np.ndarray
    R: np.ndarray
    P0: np.ndarray
    z: np.ndarray

    @property
    def Q(self) -> np.ndarray:
        """Process noise ``(..., T, 15, 15)`` at factor one."""
        return self.G @ np.swapaxes(self.G, -1, -2)

    @property
    def own(self) -> bool:
        """Whether every run has its own transition."""
        return self.F.ndim == 4


def make_problem(steps: int, runs: int, seed: int = 0) -> Problem:
    """Fly the trajectory and simulate the observations of every run."""
    config = ImmaeConfig(chain="linear", initial="drawn", duration_s=steps * PERIOD)
    world = build_world(config)
    flight_key, tilt_key = jax.random.split(jax.random.key(seed))
    keys = jax.random.split(flight_key, runs)
    simulated = jax.vmap(lambda key: fly_linear(key, world, PERIOD, IMU_STEP).z)(keys)
    return Problem(
        noise=noise_of(config),
        P0=jnp.diag(prior_sigma(config) ** 2),
        inputs=world.nominal,
        tilt=TILT * jax.random.normal(tilt_key, (runs, 3)),
        z=simulated,
    )


def own_inputs(inputs: SinsCnsInput, tilt: Array) -> SinsCnsInput:
    """Return the inputs of a solution turned by ``tilt``: every block is the run's own."""
    C = so3_exp(tilt)
    return inputs._replace(
        dcm=jnp.einsum("ij,kjl->kil", C, inputs.dcm),
        minus_force_skew=jnp.einsum("ij,kjl,ml->kim", C, inputs.minus_force_skew, C),
        gravity_gradient=jnp.einsum("ij,kjl,ml->kim", C, inputs.gravity_gradient, C),
    )


def bank_params(noise: SinsCnsParams, P0: Array, rule: Any = ()) -> BankParams:
    """Return the parameters of the bank of models under a weight rule."""
    members = replicate(FilterParams(noise, Gaussian(jnp.zeros(15), P0)), len(THETA))
    scaled = members.model._replace(noise_scale=jnp.array(THETA))
    return BankParams(members._replace(model=scaled), rule)


def dense(problem: Problem, own: bool) -> Dense:
    """Write the problem out as matrices, block by block and without the library's model."""
    s, inputs = LAYOUT, problem.inputs
    if own:
        inputs = jax.vmap(own_inputs, in_axes=(None, 0))(inputs, problem.tilt)
    C, f, g = (np.asarray(leaf) for leaf in inputs[:3])
    F = np.zeros((*C.shape[:-2], 15, 15)) + np.eye(15)
    F[..., s.phi, s.eps] = PERIOD * C
    F[..., s.dv, s.phi] = PERIOD * f
    F[..., s.dv, s.dr] = PERIOD * g
    F[..., s.dv, s.nabla] = PERIOD * C
    F[..., s.dr, s.dv] = PERIOD * np.eye(3)
    G = np.zeros((*C.shape[:-2], 15, 6))
    spread = np.sqrt(PERIOD * IMU_STEP)
    G[..., s.phi, :3] = spread * C * np.asarray(problem.noise.gyro_noise)
    G[..., s.dv, 3:] = spread * C * np.asarray(problem.noise.accel_noise)
    unit = np.ones(15)
    unit[s.phi] = ARCSEC
    return Dense(
        F=F * unit / unit[:, None],
        G=G / unit[:, None],
        H=np.eye(3, 15),
        R=np.diag((np.asarray(problem.noise.star_noise) / ARCSEC) ** 2),
        P0=np.asarray(problem.P0) / np.outer(unit, unit),
        z=np.asarray(problem.z) / ARCSEC,
    )


class Filtered(NamedTuple):
    """The oracle's answer for one run of the bank.

    Attributes:
        attitude: ``(T, M, 3) [arcsec]`` of every member.
        log_likelihood: ``(T, M)``.
        weights: ``(T, M)`` under Bayes' rule, after the update.
        mixture: ``(T, 3) [arcsec]`` mean of the bank.
        evidence: ``(T,)`` log-likelihood of the bank.
    """

    attitude: np.ndarray
    log_likelihood: np.ndarray
    weights: np.ndarray
    mixture: np.ndarray
    evidence: np.ndarray


def oracle(problem: Dense, run: int) -> Filtered:
    """Filter one run by the textbook: a loop over time and models, and Bayes' rule at the end."""
    F, Q = (m[run] if problem.own else m for m in (problem.F, problem.Q))
    H, R, z = problem.H, problem.R, problem.z[run]
    steps, models = len(z), len(THETA)
    attitude, log_likelihood = np.zeros((steps, models, 3)), np.zeros((steps, models))
    for i, scale in enumerate(THETA):
        x, P = np.zeros(15), problem.P0
        for k in range(steps):
            x, P = F[k] @ x, F[k] @ P @ F[k].T + scale * Q[k]
            nu, S = z[k] - H @ x, H @ P @ H.T + R
            K = np.linalg.solve(S, H @ P).T
            A = np.eye(15) - K @ H
            x, P = x + K @ nu, A @ P @ A.T + K @ R @ K.T
            attitude[k, i] = x[:3]
            nis = nu @ np.linalg.solve(S, nu)
            log_likelihood[k, i] = -0.5 * (nis + np.log(np.linalg.det(2 * np.pi * S)))
    total = np.logaddexp.reduce(np.cumsum(log_likelihood, axis=0), axis=1) - np.log(models)
    weights = np.exp(np.cumsum(log_likelihood, axis=0) - np.log(models) - total[:, None])
    mixture = np.einsum("km,kmi->ki", weights, attitude)
    return Filtered(attitude, log_likelihood, weights, mixture, np.diff(total, prepend=0.0))
