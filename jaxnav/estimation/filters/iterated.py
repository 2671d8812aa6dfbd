"""Iterated filters: an update by Gauss-Newton on the posterior, with the prior held fixed.

With ``P- = L L'`` and the state written as ``retract(x-, L xi)``, the posterior's mode minimises

    T(xi) = |xi|^2 + |z - h(xi)|^2 in the norm of inv(R)

and the step from an iterate ``xi`` is, with ``A = H L`` the slope of ``h`` there and ``nu`` the
innovation,

    S = A A' + R,   D = A' inv(S) (nu + A xi) - xi,   xi + a D with a from a back-tracking search

In these coordinates the statistical linearisation by cubature points about an iterate is a central
difference along the axes, and no covariance is ever inverted.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxnav.arguments import described, require_switch, require_whole
from jaxnav.estimation.checks import require_filter_params, require_own
from jaxnav.estimation.filters.innovation import (
    Measurement,
    innovation_info,
    mask_noise,
    measurement_of,
)
from jaxnav.estimation.filters.kalman import KalmanState, ekf
from jaxnav.estimation.filters.line_search import Search, step_length
from jaxnav.estimation.filters.sigma_point import SigmaPointState, ckf
from jaxnav.estimation.filters.whitened import (
    Problem,
    Slope,
    additive,
    augmented,
    cubature,
    derivative,
    misfit,
)
from jaxnav.estimation.types import (
    Filter,
    FilterParams,
    Info,
    Input,
    Model,
    Obs,
    Params,
    Point,
)
from jaxnav.numerics.linalg import (
    Cholesky,
    cholesky,
    solve_lower,
    solve_lower_transposed,
    symmetrise,
)
from jaxnav.numerics.roots import semidefinite_root


class _Step(NamedTuple):
    """What an iteration leaves: the slope, the factor of ``S``, the whitened gain ``(n, m)``."""

    slope: Slope
    S: Array
    root: Cholesky
    gain: Array
    moved: Array


class _Form(NamedTuple):
    """What tells the filters apart.

    Attributes:
        base: The filter whose ``init`` and ``predict`` are used.
        rebuilt: ``(x, P) -> state``.
        problem: ``(model, params, x, L, u, measurement) -> Problem``.
        slope: ``(model, problem, obs, point, search) -> (residual's mean, slope, spread noise)``.
    """

    base: Filter
    rebuilt: Callable[[Point, Array], Any]
    problem: Callable[[Model, Params, Point, Array, Input, Measurement], Problem]
    slope: Callable[[Model, Problem, Obs, Array, Search], tuple[Array, Array, Array]]


def iterated_ekf(
    model: Model, *, iterations: int = 3, trials: int = 6, search: Search | None = None
) -> Filter:
    """Return the iterated extended Kalman filter, with parameters :class:`FilterParams`.

    Prediction, masks and flags are those of :func:`~jaxnav.estimation.filters.kalman.ekf`; the
    update is that of :func:`iterated_ckf`, with its arguments and errors, but for the derivative at
    the iterate, always automatic, in place of points. Its fixed point is the posterior's mode.

    References:
        Bell and Cathey (1993), IEEE Trans. Automatic Control 38(2).
    """
    base = ekf(model)
    form = _Form(base, _kalman_state, additive, derivative)
    on = partial(iterated_ekf, iterations=iterations, trials=trials, search=search)
    return _iterated(model, form, iterations, trials, search, False, on)


def iterated_ckf(
    model: Model,
    *,
    iterations: int = 3,
    trials: int = 6,
    search: Search | None = None,
    printed: bool = False,
) -> Filter:
    """Return the iterated cubature Kalman filter, with parameters :class:`FilterParams`.

    Prediction is that of :func:`~jaxnav.estimation.filters.sigma_point.ckf`. Each iteration draws
    points about the iterate with the spread of the prior, and takes from them the slope ``A``, the
    mean of the observation, and the scatter that the slope leaves unexplained, which joins ``R`` in
    ``S``; so one full step is the update of the ``ckf``. With the full spread the fixed point
    differs from the mode by that linearisation. The covariance is updated once, with the gain of
    the last iteration, in Joseph form.

    The number of iterations is fixed, so that gradients and ``vmap`` work. A search guards them:
    a step that does not lower ``T`` enough is halved, and where none does the iterate stays. A
    :class:`Search` as ``FilterParams.own`` overrides the numbers of the search as leaves. ``Info``
    holds the innovation and likelihood of the prediction, and the number of steps accepted.

    ``T`` knows the function, the step with a full spread its statistical linearisation only: where
    the two disagree all steps may be refused while the covariance still shrinks, which happened in
    11 to 23 % of strongly nonlinear scalar cases. A smaller ``search.spread`` mends that. Range on
    ill-conditioned updates: as the ``ckf``.

    Args:
        model: The model.
        iterations: Number of Gauss-Newton steps, at least one.
        trials: Number of step lengths that the search tries; 0 takes ``search.step`` unseen.
        search: Numbers of the search.
        printed: Iterate as Eqs. (20)-(26) print it: linearised at the prior in every iteration, the
            sign of ``X_j - X-`` reversed, and no search. It diverges from the second iteration on.

    Raises:
        ValueError: If ``iterations`` is below 1 or ``trials`` below 0; in a run, if shapes do not
            fit together.

    References:
        Shi, Chen, Wang (2023), Eqs. (9)-(28). The functional (10) is printed with ``P_zz`` and the
        predicted observation, of which its first terms do not depend on the state; (12) likewise;
        (13) and (26) have the wrong sign, and an innovation that is not made anew. All are put
        right here. Arasaratnam and Haykin (2009) for the rule.
    """
    form = _Form(ckf(model), _sigma_state, additive, cubature)
    numbers = {"iterations": iterations, "trials": trials, "search": search, "printed": printed}
    return _iterated(model, form, **numbers, on=partial(iterated_ckf, **numbers))


def modified_iterated_ckf(
    model: Model,
    *,
    iterations: int = 3,
    trials: int = 6,
    search: Search | None = None,
    printed: bool = False,
) -> Filter:
    """Return the iterated cubature filter whose state is augmented with the observation's noise.

    The points are drawn about the iterate of state and noise together, through
    :attr:`Model.noisy`; ``R`` is part of the augmented covariance and enters nowhere else. For
    noise that only adds (to the residual, where that is no difference of values) it cancels from
    every step and the filter is :func:`iterated_ckf` but for the spread of its points; it then has
    that filter's fixed point in the limit of no spread. Noise that enters ``h`` otherwise is
    iterated on with the state.

    Arguments and errors are those of :func:`iterated_ckf`.

    References:
        Shi, Chen, Wang (2023), Eqs. (19)-(28), with the sizes of (19)-(20) put right and without
        the second ``R`` of (23).
    """
    form = _Form(ckf(model), _sigma_state, augmented, cubature)
    numbers = {"iterations": iterations, "trials": trials, "search": search, "printed": printed}
    return _iterated(model, form, **numbers, on=partial(modified_iterated_ckf, **numbers))


def _iterated(
    model: Model,
    form: _Form,
    iterations: int,
    trials: int,
    search: Search | None,
    printed: bool,
    on: Callable[[Model], Filter],
) -> Filter:
    require_whole("iterations", iterations, 1)
    require_whole("trials", trials, 0)
    require_switch("printed", printed)
    if not isinstance(search, Search | None):
        raise ValueError(f"search is {described(search)}; it must be Search(...), or None")
    built_with = Search() if search is None else search

    def check(params: FilterParams) -> None:
        require_filter_params(model, params, own=Search)

    def init(params: FilterParams) -> Any:
        return form.base.init(params._replace(own=()))

    def predict(params: FilterParams, state: Any, u: Input) -> Any:
        return form.base.predict(params._replace(own=()), state, u)

    def update(params: FilterParams, state: Any, u: Input, obs: Obs) -> tuple[Any, Info]:
        require_own(params.own, Search)
        rule: Search = params.own or built_with
        prior = form.base.estimate(state)
        whitening = semidefinite_root(prior.cov)
        L = whitening.factor
        measurement = measurement_of(model, params.model, prior.mean, u, obs)
        obs = measurement.obs
        problem = form.problem(model, params.model, prior.mean, L, u, measurement)

        def iterate(point: Array, _: None) -> tuple[Array, _Step]:
            at = jnp.zeros_like(point) if printed else point
            slope = _slope(model, form, problem, obs, at, rule)
            moved, solved = _gauss_newton(problem, slope, point, printed)
            length = rule.step
            if trials and not printed:
                length = _search_length(model, problem, obs, slope, point, moved, rule, trials)
            step = jnp.where(solved.root.positive_definite, length * moved, 0)
            return point + step, solved._replace(moved=jnp.any(step != 0))

        point, steps = jax.lax.scan(
            iterate, jnp.zeros(problem.size, L.dtype), None, length=iterations
        )
        first, last = (jax.tree.map(lambda leaf, i=i: leaf[i], steps) for i in (0, -1))
        left = jnp.eye(problem.states, dtype=L.dtype) - last.gain @ last.slope.A
        noise = last.slope.R + last.slope.spread_noise
        whitened = left @ left.T + last.gain @ noise @ last.gain.T
        solvable = jnp.all(steps.root.positive_definite)
        point = jnp.where(solvable, point, 0)
        whitened = jnp.where(solvable, whitened, jnp.eye(problem.states, dtype=L.dtype))
        x = model.retract(prior.mean, L @ point[: problem.states])
        mended = state.indefinite | ~whitening.semidefinite
        judged = first.root._replace(positive_definite=solvable)
        info = innovation_info(first.slope.innovation, first.S, judged, measurement, mended)
        taken = jnp.sum(steps.moved).astype(jnp.int32)
        return form.rebuilt(x, symmetrise(L @ whitened @ L.T)), info._replace(iterations=taken)

    return form.base._replace(init=init, predict=predict, update=update, check=check, on=on)


def _kalman_state(x: Point, P: Array) -> KalmanState:
    return KalmanState(x, P, jnp.array(False))


def _sigma_state(x: Point, P: Array) -> SigmaPointState:
    return SigmaPointState(x, P, (), jnp.array(False))


def _slope(
    model: Model, form: _Form, problem: Problem, obs: Obs, point: Array, search: Search
) -> Slope:
    """Linearise the observation about a point ``(d,)``, masked."""
    n = problem.states
    nu = misfit(model, problem, obs, point)
    mean, whole, spread_noise = form.slope(model, problem, obs, point, search)
    A, G = whole[:, :n], whole[:, n:]
    R = mask_noise(problem.noise, obs.valid) + G @ G.T
    return Slope(nu - mean, A, G, R, spread_noise)


def _gauss_newton(
    problem: Problem, slope: Slope, point: Array, printed: bool
) -> tuple[Array, _Step]:
    """Return the full step ``(d,)`` from a point."""
    S = symmetrise(slope.A @ slope.A.T) + slope.R + slope.spread_noise
    root = cholesky(S)
    root = root._replace(positive_definite=root.positive_definite & problem.sound)
    whole = jnp.concatenate([slope.A, slope.G], axis=1)
    gain = solve_lower_transposed(root.factor, solve_lower(root.factor, whole)).T
    gain = jnp.where(root.positive_definite, gain, 0)
    target = gain @ (slope.innovation + whole @ point)
    moved = target + point if printed else target - point
    return moved, _Step(slope, S, root, gain[: problem.states], jnp.array(True))


def _search_length(
    model: Model,
    problem: Problem,
    obs: Obs,
    slope: Slope,
    point: Array,
    moved: Array,
    search: Search,
    trials: int,
) -> Array:
    """Return the step length of a back-tracking search on the posterior's functional.

    Noise in the state is held and its effect taken to first order, ``e(x) = z - h(x, v) + G v``
    with covariance ``G G'``: the step is Gauss-Newton's on that functional too.
    """
    n = problem.states
    root = cholesky(slope.R)
    held = slope.G @ point[n:]

    def functional(length: Array) -> Array:
        state = point[:n] + length * moved[:n]
        here = misfit(model, problem, obs, jnp.concatenate([state, point[n:]]))
        whitened = solve_lower(root.factor, here + held)
        return jnp.sum(state * state) + jnp.sum(whitened * whitened)

    left = slope.innovation + held
    pull = solve_lower_transposed(root.factor, solve_lower(root.factor, left))
    promised = 2 * (point[:n] - slope.A.T @ pull) @ moved[:n]
    # Without noise there is no functional to search on.
    length = step_length(functional, promised, search, trials)
    return jnp.where(root.positive_definite, length, search.step)
