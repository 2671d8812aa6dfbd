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

from jaxnav.estimation.filters.innovation import (
    innovation_info,
    mask_noise,
    masked_innovation,
    require_prior,
    require_step,
)
from jaxnav.estimation.filters.square_root import read_array, update_array
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
    downdate,
    matmul,
    semidefinite_root,
    solve_lower,
    solve_lower_transposed,
    symmetrise,
    tria,
)
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


class Cloud(NamedTuple):
    """Sigma points as tangent vectors at a mean, their weighted mean being zero.

    Attributes:
        offsets: ``(2 n, d)`` of the points.
        centre: ``(d,)`` of the centre.
    """

    offsets: Array
    centre: Array


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

    with ``e_i`` and ``d_i`` the deviations from their means. Masks and flags are as for the
    :func:`~jaxnav.estimation.filters.kalman.ekf`. A covariance that is not semi-definite where
    points are drawn, which a negative centre weight can cause, loses the columns of its negative
    pivots and raises :attr:`Flag.INDEFINITE`.

    The defaults keep the centre's weight positive for any number of states; ``kappa = 3 - n`` makes
    it negative for n above 3. ``FilterParams.sigma`` overrides the rule, as a leaf that may be
    tuned or differ between members.

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
    return _sigma_point(model, partial(unscented, alpha=alpha, beta=beta, kappa=kappa), redraw)


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
    """Return the unscented filter in array (QR) square-root form; points are always redrawn.

    Arguments, parameters and errors are those of :func:`ukf`.

        [sqrt(w) e_i, sqrt(Q)] Theta = [L-, 0]
        [sqrt(R), sqrt(w) d_i; 0, sqrt(w) e_i] Theta = [sqrt(S), 0; K sqrt(S), L]

    A negative weight of the centre is taken away afterwards by a downdate; where the difference is
    not positive definite the centre is left in and :attr:`Flag.INDEFINITE` raised. At a weight of
    exactly 0 the derivative by it comes out as 0, as its root has none; that of :func:`ukf` is
    right. The caution about several devices of
    :func:`~jaxnav.estimation.filters.square_root.square_root_kf` holds here too.

    Range: on the ill-conditioned update of Grewal and Andrews the covariance is right to 1e-6 for a
    ratio of measurement to prior sigma of 1e-9 in float64, to 1e-3 for 1e-4 in float32; the
    gradient of the log-likelihood is right to 1e-6 for 1e-8 in float64. In float32 with
    ``alpha = 1e-3`` the factor stays positive but is wrong, mostly without a flag.

    References:
        van der Merwe and Wan (2001), The square-root unscented Kalman filter; the update is the
        array form of Arasaratnam and Haykin (2009), which needs no downdate for positive weights.
    """
    return _square_root(model, partial(unscented, alpha=alpha, beta=beta, kappa=kappa))


def square_root_ckf(model: Model) -> Filter:
    """Return the cubature filter in the form of :func:`square_root_ukf`; it never downdates.

    Arguments, errors and range are as there.

    References:
        Arasaratnam and Haykin (2009), IEEE Trans. Automatic Control 54(6), appendix B.
    """
    return _square_root(model, cubature)


def _sigma_point(model: Model, rule_of: RuleOf, redraw: bool) -> Filter:
    """Return the filter in covariance form."""

    def init(params: FilterParams) -> SigmaPointState:
        require_prior(model, params.initial)
        rule = _rule(params, rule_of, params.initial.cov.shape[0])
        root = semidefinite_root(params.initial.cov)
        points = () if redraw else drawn(rule, root.factor)
        return SigmaPointState(*params.initial, points, ~root.semidefinite)

    def predict(params: FilterParams, state: SigmaPointState, u: Input) -> SigmaPointState:
        rule = _rule(params, rule_of, state.P.shape[0])
        root = semidefinite_root(state.P)
        x, cloud = _propagate(model, params, rule, state.x, root.factor, u)
        Q = model.process_noise(params.model, state.x, u)
        require_step(model, state.x, x, Q)
        P = symmetrise(_second_moment(rule, cloud, cloud)) + Q
        mended = state.indefinite | ~root.semidefinite
        return SigmaPointState(x, P, () if redraw else cloud, mended)

    def update(
        params: FilterParams, state: SigmaPointState, u: Input, obs: Obs
    ) -> tuple[SigmaPointState, Info]:
        rule = _rule(params, rule_of, state.P.shape[0])
        indefinite = state.indefinite
        cloud = state.points
        if redraw:
            root = semidefinite_root(state.P)
            cloud, indefinite = drawn(rule, root.factor), indefinite | ~root.semidefinite
        seen, nu = _observe(model, params, rule, state.x, cloud, u, obs)
        R = mask_noise(model.observation_noise(params.model, state.x, u), obs.valid)
        S = symmetrise(_second_moment(rule, seen, seen)) + R
        factor = cholesky(S)
        cross = _second_moment(rule, seen, cloud)
        gain = solve_lower_transposed(factor.factor, solve_lower(factor.factor, cross))
        gain = jnp.where(obs.valid[:, None] & factor.positive_definite, gain, 0)
        gain = jax.lax.optimization_barrier(gain)
        if redraw:
            left = Cloud(
                cloud.offsets - matmul(seen.offsets, gain), cloud.centre - seen.centre @ gain
            )
            P = _second_moment(rule, left, left) + matmul(gain.T, matmul(R, gain))
        else:
            P = state.P - matmul(gain.T, matmul(S, gain))
        x = model.retract(state.x, matmul(gain.T, nu))
        info = innovation_info(nu, S, factor, obs.valid, indefinite)
        return SigmaPointState(x, symmetrise(P), state.points, jnp.zeros_like(indefinite)), info

    def estimate(state: SigmaPointState) -> Gaussian:
        return Gaussian(state.x, state.P)

    def restart(state: SigmaPointState, given: Gaussian) -> SigmaPointState:
        # Points that were kept stay until the next prediction makes them anew.
        return SigmaPointState(given.mean, given.cov, state.points, state.indefinite)

    return Filter(init, predict, update, estimate, restart, model.retract, model.local)


def _square_root(model: Model, rule_of: RuleOf) -> Filter:
    """Return the filter in square-root form."""

    def init(params: FilterParams) -> SquareRootSigmaPointState:
        require_prior(model, params.initial)
        _rule(params, rule_of, params.initial.cov.shape[0])
        root = semidefinite_root(params.initial.cov)
        return SquareRootSigmaPointState(params.initial.mean, root.factor, ~root.semidefinite)

    def predict(
        params: FilterParams, state: SquareRootSigmaPointState, u: Input
    ) -> SquareRootSigmaPointState:
        rule = _rule(params, rule_of, state.L.shape[0])
        x, cloud = _propagate(model, params, rule, state.x, state.L, u)
        Q = model.process_noise(params.model, state.x, u)
        require_step(model, state.x, x, Q)
        points, centre = _weighted(rule, cloud)
        noise = semidefinite_root(Q)
        L = tria(jnp.concatenate([points, centre.above, noise.factor], axis=1))
        L, sound = _without(rule, L, centre)
        mended = state.indefinite | ~sound | ~noise.semidefinite
        return SquareRootSigmaPointState(x, L, mended)

    def update(
        params: FilterParams, state: SquareRootSigmaPointState, u: Input, obs: Obs
    ) -> tuple[SquareRootSigmaPointState, Info]:
        rule = _rule(params, rule_of, state.L.shape[0])
        cloud = drawn(rule, state.L)
        seen, nu = _observe(model, params, rule, state.x, cloud, u, obs)
        R = mask_noise(model.observation_noise(params.model, state.x, u), obs.valid)
        joint = Cloud(
            jnp.concatenate([seen.offsets, cloud.offsets], axis=1),
            jnp.concatenate([seen.centre, cloud.centre]),
        )
        m = R.shape[0]
        points, centre = _weighted(rule, joint)
        columns = jnp.concatenate([points, centre.above], axis=1)
        triangle, sound = _without(rule, tria(update_array(R, columns[:m], columns[m:])), centre)
        done = read_array(triangle, m, state.L)
        x = model.retract(state.x, done.gain_root @ solve_lower(done.root.factor, nu))
        indefinite = state.indefinite | ~sound
        info = innovation_info(nu, done.S, done.root, obs.valid, indefinite, rooted=True)
        return SquareRootSigmaPointState(x, done.L, jnp.zeros_like(indefinite)), info

    def estimate(state: SquareRootSigmaPointState) -> Gaussian:
        return Gaussian(state.x, state.L @ state.L.T)

    def restart(state: SquareRootSigmaPointState, given: Gaussian) -> SquareRootSigmaPointState:
        root = semidefinite_root(given.cov)
        return SquareRootSigmaPointState(given.mean, root.factor, ~root.semidefinite)

    return Filter(init, predict, update, estimate, restart, model.retract, model.local)


def drawn(rule: SigmaRule, L: Array) -> Cloud:
    """Return the points ``+-spread L_j`` of a factor ``(n, n)`` about their centre."""
    offsets = rule.spread * L.T
    return Cloud(jnp.concatenate([offsets, -offsets]), jnp.zeros(L.shape[0], L.dtype))


def _rule(params: FilterParams, rule_of: RuleOf, n: int) -> SigmaRule:
    if isinstance(params.sigma, SigmaRule):
        return params.sigma
    if not isinstance(params.sigma, tuple) or params.sigma:
        raise ValueError(
            f"sigma is a {type(params.sigma).__name__}; it must be a SigmaRule, or () for the rule "
            "that the filter was built with"
        )
    return rule_of(n)


def _propagate(
    model: Model, params: FilterParams, rule: SigmaRule, x: Point, L: Array, u: Input
) -> tuple[Point, Cloud]:
    """Return the mean of the propagated points and the cloud about it."""
    reference = jax.lax.optimization_barrier(model.transition(params.model, x, u))

    def moved(offset: Array) -> Array:
        point = model.transition(params.model, model.retract(x, offset), u)
        return model.local(reference, point)

    mean, cloud = _centred(rule, jax.vmap(moved)(drawn(rule, L).offsets))
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
    residuals = jax.vmap(lambda offset: model.residual(predicted(offset), reference))(cloud.offsets)
    mean, seen = _centred(rule, jnp.where(obs.valid[None], residuals, 0))
    return seen, nu - mean


def _centred(rule: SigmaRule, differences: Array) -> tuple[Array, Cloud]:
    """Return the mean of points ``(2 n, d)`` given relative to the centre, and the cloud."""
    mean = rule.weight * jnp.sum(differences, axis=0)
    return mean, Cloud(differences - mean[None], -mean)


def _second_moment(rule: SigmaRule, a: Cloud, b: Cloud) -> Array:
    """Return ``sum w_i a_i b_i'``."""
    centre = rule.centre * (a.centre[:, None] * b.centre[None])
    return rule.weight * (a.offsets.T @ b.offsets) + centre


class _CentreColumn(NamedTuple):
    """The centre's column ``(d, 1)``: what to add to a root, and what to take away again."""

    above: Array
    below: Array


def _weighted(rule: SigmaRule, cloud: Cloud) -> tuple[Array, _CentreColumn]:
    """Return the points as columns ``(d, 2 n)`` of a root of their second moment."""
    weight = jnp.asarray(rule.centre, cloud.centre.dtype)
    size = jnp.abs(weight)
    # the root of a zero weight would have no derivative
    root = jnp.where(size > 0, jnp.sqrt(jnp.where(size > 0, size, 1)), 0)
    column = (root * cloud.centre)[:, None]
    above, below = jnp.where(weight > 0, column, 0), jnp.where(weight < 0, column, 0)
    return rule.weight**0.5 * cloud.offsets.T, _CentreColumn(above, below)


def _without(rule: SigmaRule, L: Array, centre: _CentreColumn) -> tuple[Array, Array]:
    """Take a negative centre away from a root; return it and whether that could be done."""
    if not isinstance(rule.centre, Array) and rule.centre >= 0:
        return L, jnp.array(True)
    return downdate(L, centre.below[:, 0])
