"""Sigma-point filters on manifolds: one body over the unscented and the cubature rule.

The centre is propagated as it is and the other points relative to it, in tangent coordinates; all
means are means of these differences, so that nothing is averaged that does not live in a vector
space. In a vector space this is the textbook's weighted sum, the weights summing to one.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.arguments import FINITE, require_number, require_switch
from jaxnav.estimation.checks import (
    require_filter_params,
    require_model,
    require_own,
    require_prior,
)
from jaxnav.estimation.filters.cloud import (
    Cloud,
    centre_column,
    centred,
    drawn,
    drawn_moments,
    halves_of,
    moments,
    once,
    second_moment,
    without,
)
from jaxnav.estimation.filters.innovation import (
    innovation_info,
    is_covariance,
    masked_innovation,
    measurement_of,
    require_step,
)
from jaxnav.estimation.filters.square_root import read_array
from jaxnav.estimation.types import (
    Filter,
    FilterParams,
    Gaussian,
    Info,
    Input,
    Model,
    Obs,
    Point,
)
from jaxnav.numerics.linalg import (
    cholesky,
    matmul,
    solve_lower,
    solve_lower_transposed,
    symmetrise,
)
from jaxnav.numerics.roots import semidefinite_root, tria_beside, tria_of_update
from jaxnav.numerics.sigma import SigmaRule, cubature, unscented

RuleOf = Callable[[int], SigmaRule]


class SigmaPointState(NamedTuple):
    """Mean, covariance ``(n, n)`` and what an update without a redraw needs.

    Attributes:
        x: A point of the state's manifold.
        P: Covariance in its tangent space.
        points: The propagated :class:`Cloud` about ``x``; ``()`` if points are drawn anew.
        indefinite: Whether a covariance was mended in making this state; the next update tells.
    """

    x: Point
    P: Array
    points: Any
    indefinite: Array


class SquareRootSigmaPointState(NamedTuple):
    """Mean, lower factor ``L`` ``(n, n)`` of the covariance, and :attr:`SigmaPointState`'s mark."""

    x: Point
    L: Array
    indefinite: Array


def ukf(
    model: Model,
    *,
    alpha: float = 1.0,
    beta: float = 2.0,
    kappa: float = 0.0,
    redraw: bool = True,
) -> Filter:
    """Return the unscented Kalman filter, with parameters :class:`FilterParams`.

    Points ``retract(x, +-spread L_j)`` with ``P = L L'`` go through ``transition`` and ``observe``;

        P- = sum w_i e_i e_i' + Q,   S = sum w_i d_i d_i' + R,   K = sum w_i e_i d_i' inv(S)
        P = sum w_i (e_i - K d_i)(e_i - K d_i)' + K R K'

    with ``e_i`` and ``d_i`` the deviations from their means. Sums over opposite points are taken
    over half their difference and half their sum, of which ``e_i`` has the former alone.
    Masks and flags are as for the :func:`~jaxnav.estimation.filters.kalman.ekf`. A covariance that
    is not semi-definite where points are drawn, which a negative centre weight can cause, loses the
    columns of its negative pivots and raises :attr:`Flag.INDEFINITE`.

    The defaults keep the centre's weight positive for any number of states; ``kappa = 3 - n`` makes
    it negative for n above 3. A :class:`~jaxnav.numerics.sigma.SigmaRule` as ``FilterParams.own``
    overrides the rule, with leaves that may be tuned or differ between members.

    Args:
        model: The model.
        alpha: Spread of the points, see :func:`~jaxnav.numerics.sigma.unscented`.
        beta: 2 is best for a Gaussian prior.
        kappa: Secondary spread.
        redraw: Draw the points of the update from ``P-``, which holds ``Q``. ``False`` uses the
            propagated points again, as Zhao et al. do in Eq. (19): ``S`` and ``K`` then miss the
            share of ``Q``, and ``P = P- - K S K'``.

    Raises:
        ValueError: In a run, if the rule has no meaning for the model's number of states, or if
            shapes do not fit together.

    Range: on the ill-conditioned update of Grewal and Andrews the covariance is right to 1e-7 for a
    ratio of measurement to prior sigma of 1e-6 in float64 and to 1e-3 for 3e-3 in float32, as for
    the Joseph form; where it is wrong a flag is raised. In float32 a small ``alpha`` is of no use:
    with 15 states and ``alpha = 1e-3`` the covariance is wrong by tens of per cent. A covariance
    that an update makes indefinite is flagged where points are drawn next.

    References:
        Zhao, Chen, He, Ge (2018), IEEE/CAA JAS 5(6), Eqs. (12)-(25), with the index of (14) and the
        weight after (22) put right; Hertzberg et al. (2013), Information Fusion 14(1).
    """
    return _sigma_point(model, _unscented(alpha, beta, kappa), redraw)


def ckf(model: Model, *, redraw: bool = True) -> Filter:
    """Return the cubature Kalman filter: the body of :func:`ukf` with equal weights, no centre.

    All weights are positive, so no covariance can become indefinite other than by rounding. The
    range is that of :func:`ukf`; with 15 states in float32 it is right to 1e-3.

    Args:
        model: The model.
        redraw: As for :func:`ukf`.

    Raises:
        ValueError: In a run, if shapes do not fit together.

    References:
        Arasaratnam and Haykin (2009), IEEE Trans. Automatic Control 54(6).
    """
    return _sigma_point(model, cubature, redraw)


def square_root_ukf(
    model: Model, *, alpha: float = 1.0, beta: float = 2.0, kappa: float = 0.0
) -> Filter:
    """Return the unscented filter in array square-root form; points are always redrawn.

    Arguments, parameters and errors are those of :func:`ukf`.

        [sqrt(Q), sqrt(w) e_i] Theta = [L-, 0]
        [sqrt(R), sqrt(w) d_i; 0, sqrt(w) e_i] Theta = [sqrt(S), 0; K sqrt(S), L]

    Opposite points are turned into half their difference and half their sum first, after which the
    second array is a triangle beside a few full rows. A negative weight of the centre is taken away
    afterwards by a downdate; where the difference is not positive definite the centre is left in
    and :attr:`Flag.INDEFINITE` raised. At a weight of exactly 0 the derivative by it comes out as
    0, as its root has none; that of :func:`ukf` is right.

    Range: on the ill-conditioned update of Grewal and Andrews the covariance is right to 1e-6 for a
    ratio of measurement to prior sigma of 1e-9 in float64, to 1e-3 for 1e-4 in float32; the
    gradient of the log-likelihood is right to 1e-6 for 1e-8 in float64. In float32 with
    ``alpha = 1e-3`` the factor stays positive but is wrong, mostly without a flag.

    References:
        van der Merwe and Wan (2001), The square-root unscented Kalman filter; the update is the
        array form of Arasaratnam and Haykin (2009), which needs no downdate for positive weights.
    """
    return _square_root(model, _unscented(alpha, beta, kappa))


def square_root_ckf(model: Model) -> Filter:
    """Return the cubature filter in the form of :func:`square_root_ukf`; it never downdates.

    Arguments, errors and range are as there.

    References:
        Arasaratnam and Haykin (2009), IEEE Trans. Automatic Control 54(6), appendix B.
    """
    return _square_root(model, cubature)


def _unscented(alpha: float, beta: float, kappa: float) -> RuleOf:
    given = {"alpha": alpha, "beta": beta, "kappa": kappa}
    for name, value in given.items():
        require_number(name, value, *FINITE)
    return partial(unscented, **given)


def _sigma_point(model: Model, rule_of: RuleOf, redraw: bool) -> Filter:
    """Return the filter in covariance form."""
    require_model(model)
    require_switch("redraw", redraw)
    check = partial(require_filter_params, model, own=SigmaRule)

    def init(params: FilterParams) -> SigmaPointState:
        require_prior(model, params.initial)
        rule = _rule(params, rule_of, params.initial.cov.shape[0])
        x, P = params.initial
        points = () if redraw else drawn(rule, semidefinite_root(P).factor)
        return SigmaPointState(x, P, points, ~is_covariance(P))

    def predict(params: FilterParams, state: SigmaPointState, u: Input) -> SigmaPointState:
        rule = _rule(params, rule_of, state.P.shape[0])
        root = semidefinite_root(state.P)
        x, cloud = _propagate(model, params, rule, state.x, root.factor, u)
        Q = model.process_noise(params.model, state.x, u)
        require_step(model, state.x, x, Q)
        P = symmetrise(second_moment(rule, cloud, cloud)) + Q
        mended = state.indefinite | ~root.semidefinite | jnp.any(jnp.diag(Q) < 0)
        return SigmaPointState(x, P, () if redraw else cloud, mended)

    def update(
        params: FilterParams, state: SigmaPointState, u: Input, obs: Obs
    ) -> tuple[SigmaPointState, Info]:
        rule = _rule(params, rule_of, state.P.shape[0])
        measurement = measurement_of(model, params.model, state.x, u, obs)
        obs, R = measurement.obs, measurement.noise
        indefinite = state.indefinite
        cloud = state.points
        if redraw:
            root = semidefinite_root(state.P)
            cloud, indefinite = drawn(rule, root.factor), indefinite | ~root.semidefinite
        seen, nu = _observe(model, params, rule, state.x, cloud, u, obs)
        moments_of = drawn_moments if redraw else moments
        S, cross, left = moments_of(rule, seen, cloud, R)
        factor = cholesky(S)
        gain = solve_lower_transposed(factor.factor, solve_lower(factor.factor, cross))
        gain = jnp.where(obs.valid[:, None] & factor.positive_definite, gain, 0)
        gain = jax.lax.optimization_barrier(gain)
        P = left(gain, state.P)
        x = model.retract(state.x, matmul(gain.T, nu))
        info = innovation_info(nu, S, factor, measurement, indefinite)
        return SigmaPointState(x, symmetrise(P), state.points, jnp.zeros_like(indefinite)), info

    def estimate(state: SigmaPointState) -> Gaussian:
        return Gaussian(state.x, state.P)

    def restart(state: SigmaPointState, estimate: Gaussian) -> SigmaPointState:
        # Points that were kept stay until the next prediction makes them anew.
        return SigmaPointState(estimate.mean, estimate.cov, state.points, state.indefinite)

    def on(other: Model) -> Filter:
        return _sigma_point(other, rule_of, redraw)

    retract, local = model.retract, model.local
    return Filter(init, predict, update, estimate, restart, retract, local, check, model, on)


def _square_root(model: Model, rule_of: RuleOf) -> Filter:
    """Return the filter in square-root form."""
    require_model(model)
    check = partial(require_filter_params, model, own=SigmaRule)

    def init(params: FilterParams) -> SquareRootSigmaPointState:
        require_prior(model, params.initial)
        _rule(params, rule_of, params.initial.cov.shape[0])
        x, P = params.initial
        return SquareRootSigmaPointState(x, semidefinite_root(P).factor, ~is_covariance(P))

    def predict(
        params: FilterParams, state: SquareRootSigmaPointState, u: Input
    ) -> SquareRootSigmaPointState:
        rule = _rule(params, rule_of, state.L.shape[0])
        x, cloud = _propagate(model, params, rule, state.x, state.L, u)
        Q = model.process_noise(params.model, state.x, u)
        require_step(model, state.x, x, Q)
        centre = centre_column(rule, cloud.centre)
        points = rule.weight**0.5 * cloud.offsets.T
        noise = semidefinite_root(Q)
        L = tria_beside(noise.factor, jnp.concatenate([points, centre.above], axis=1))
        L, sound = without(rule, L, centre.below)
        mended = state.indefinite | ~sound | ~noise.semidefinite
        return SquareRootSigmaPointState(x, L, mended)

    def update(
        params: FilterParams, state: SquareRootSigmaPointState, u: Input, obs: Obs
    ) -> tuple[SquareRootSigmaPointState, Info]:
        rule = _rule(params, rule_of, state.L.shape[0])
        measurement = measurement_of(model, params.model, state.x, u, obs)
        obs, R = measurement.obs, measurement.noise
        seen, nu = _observe(model, params, rule, state.x, drawn(rule, state.L), u, obs)
        seen = halves_of(seen)
        root, m = semidefinite_root(R).factor, R.shape[0]
        centre = centre_column(rule, seen.centre)
        size = (2 * rule.weight) ** 0.5
        root = tria_beside(root, jnp.concatenate([size * seen.even.T, centre.above], axis=1))
        triangle = tria_of_update(root, size * seen.odd.T, size * rule.spread * state.L)
        below = jnp.concatenate([centre.below, jnp.zeros((state.L.shape[0], 1), state.L.dtype)])
        triangle, sound = without(rule, triangle, below)
        done = read_array(triangle, m, state.L)
        x = model.retract(state.x, done.gain_root @ solve_lower(done.root.factor, nu))
        indefinite = state.indefinite | ~sound
        info = innovation_info(nu, done.S, done.root, measurement, indefinite, rooted=True)
        return SquareRootSigmaPointState(x, done.L, jnp.zeros_like(indefinite)), info

    def estimate(state: SquareRootSigmaPointState) -> Gaussian:
        return Gaussian(state.x, state.L @ state.L.T)

    def restart(state: SquareRootSigmaPointState, estimate: Gaussian) -> SquareRootSigmaPointState:
        root = semidefinite_root(estimate.cov)
        indefinite = state.indefinite | ~root.semidefinite
        return SquareRootSigmaPointState(estimate.mean, root.factor, indefinite)

    def on(other: Model) -> Filter:
        return _square_root(other, rule_of)

    retract, local = model.retract, model.local
    return Filter(init, predict, update, estimate, restart, retract, local, check, model, on)


def _rule(params: FilterParams, rule_of: RuleOf, n: int) -> SigmaRule:
    require_own(params.own, SigmaRule)
    return params.own or rule_of(n)


def _propagate(
    model: Model, params: FilterParams, rule: SigmaRule, x: Point, L: Array, u: Input
) -> tuple[Point, Cloud]:
    """Return the mean of the propagated points and the cloud about it."""
    reference = jax.lax.optimization_barrier(model.transition(params.model, x, u))

    def moved(offset: Array) -> Array:
        point = model.transition(params.model, model.retract(x, offset), u)
        return model.local(reference, point)

    mean, cloud = centred(rule, once(jax.vmap(moved)(drawn(rule, L).offsets)))
    return model.retract(reference, mean), cloud


def _observe(
    model: Model,
    params: FilterParams,
    rule: SigmaRule,
    x: Point,
    cloud: Cloud,
    u: Input,
    obs: Obs,
) -> tuple[Cloud, Array]:
    """Return the cloud of predicted observations and the innovation, masked."""

    def predicted(offset: Array) -> Array:
        return model.observe(params.model, model.retract(x, offset), u)

    reference = predicted(cloud.centre)
    nu = masked_innovation(model, obs, reference)

    def residual(offset: Array) -> Array:
        return model.residual(predicted(offset), reference)

    residuals = jnp.where(obs.valid[None], jax.vmap(residual)(cloud.offsets), 0)
    mean, seen = centred(rule, once(residuals))
    return seen, nu - mean
