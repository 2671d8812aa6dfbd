"""States that a process carries: as in a model that is wide by hand, and seen by name."""

import re
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.compiling import compiled
from jaxnav.estimation.carried import (
    Carried,
    CarriedParams,
    GaussMarkov,
    Law,
    carrying,
    constant,
    gauss_markov,
    random_walk,
    with_carried,
)
from jaxnav.estimation.filters.kalman import ekf
from jaxnav.estimation.models import Channel, ModelParams, Process, observing, shared
from jaxnav.estimation.run import run
from jaxnav.estimation.sampling import measured
from jaxnav.estimation.types import FilterParams, Gaussian, Model, Obs
from jaxnav.navigation.models import sins_gnss, vehicle
from jaxnav.navigation.models.sins_gnss import SinsGnssInput
from jaxnav.navigation.models.vehicle import VehicleInput, VehicleParams
from jaxnav.navigation.trajectory.vehicle import Leg, town_legs
from tests import town

F, H = jnp.array([[1.0, 0.1], [0.0, 1.0]]), jnp.array([[1.0, 0.5]])
DT, SIGMA, TIME, WALK = 0.1, 0.3, 2.0, 0.05
OWN = Process(lambda p, x, u: F @ x, lambda p, x, u: p * jnp.eye(2), differential=lambda p, x, u: F)
LINE = Channel(
    1,
    lambda p, x, u: H @ x.own + x.bias,
    lambda p, x, u: jnp.array([0.04]),
    differential=lambda p, x, u: lambda dx: H @ dx[:2],
)
LAWS = {"scale": random_walk(2), "bias": gauss_markov(1)}
WIDE = carrying(OWN, LAWS, period=DT)
LAW_PARAMS = {
    "bias": GaussMarkov(jnp.array(SIGMA), jnp.array(TIME)),
    "scale": jnp.array([WALK, 2 * WALK]),
}


def by_hand() -> Model:
    keep = np.exp(-DT / TIME)
    Phi = jax.scipy.linalg.block_diag(F, jnp.array([[keep]]), jnp.eye(2))
    Q = np.diag([0.01, 0.01, SIGMA**2 * (1 - keep**2), WALK**2 * DT, 4 * WALK**2 * DT])
    row = jnp.array([[1.0, 0.5, 1.0, 0.0, 0.0]])
    return Model(
        lambda p, x, u: Phi @ x,
        lambda p, x, u: jnp.asarray(Q),
        lambda p, x, u: row @ x,
        lambda p, x, u: jnp.array([0.04]),
    )


def test_a_process_that_carries_states_is_the_wide_one_by_hand() -> None:
    """Channels with a derivative of their own, and with none, see what is carried."""
    rng = np.random.default_rng(0)
    z = jnp.asarray(rng.normal(size=(30, 1)))
    obs = Obs(z, jnp.ones((30, 1), bool))
    start = Gaussian(jnp.array([0.3, -0.2]), jnp.eye(2))
    initial = with_carried(
        start,
        {
            "scale": (jnp.zeros(2), jnp.array([1.0, 2.0])),
            "bias": (jnp.array([0.1]), jnp.array([[0.5]])),
        },
    )
    wide = FilterParams((), Gaussian(jnp.array([0.3, -0.2, 0.1, 0, 0]), initial.cov))
    final = run(ekf(by_hand()), wide, None, obs).record[0]
    params = FilterParams(CarriedParams(jnp.array(0.01), LAW_PARAMS), initial)
    for line in (LINE, LINE._replace(differential=None)):
        model = observing(WIDE, {"line": line}, parts=shared)
        assert model.carried == (("bias", 1), ("scale", 2))
        ours = run(ekf(model), params, None, obs).record[0]
        flat = jnp.hstack([ours.mean.own, ours.mean.bias, ours.mean.scale])
        np.testing.assert_allclose(flat, final.mean, rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(ours.cov, final.cov, rtol=1e-12, atol=1e-14)


def test_states_are_seen_by_name_through_all_that_carries_them() -> None:
    twice = carrying(WIDE, {"delay": constant(1)}, period=DT)
    nested: Any = Carried
    x = nested(nested(sins_gnss.SinsLevel(*map(jnp.array, range(5))), {"scale": 7}), {"delay": 8})
    assert (x.velocity, x.scale, x.delay) == (1, 7, 8)
    assert not hasattr(x, "lever_arm")
    with pytest.raises(AttributeError, match="no 'lever_arm'"):
        _ = x.lever_arm
    moved = twice.transition(
        CarriedParams(CarriedParams(jnp.array(0.1), LAW_PARAMS), {"delay": ()}),
        Carried(
            Carried(jnp.ones(2), {"scale": jnp.ones(2), "bias": jnp.ones(1)}),
            {"delay": jnp.ones(1)},
        ),
        None,
    )
    np.testing.assert_allclose(moved.bias, np.exp(-DT / TIME))
    assert twice.carried == (*WIDE.carried, ("delay", 1))


ALL = {name: constant(size) for name, size in vehicle.CARRIED.items()}


def car_params() -> VehicleParams:
    return VehicleParams(
        inner=town.NOISE._replace(lever_arm=jnp.array([0.4, -0.3, 1.1])),
        time_offset=jnp.array(0.02),
        mounting=jnp.array([0.01, -0.02, 0.03]),
        axle=jnp.array([-1.0, 0.2, -0.4]),
        steered_noise=jnp.full(2, 0.1),
        rest_noise=jnp.array(0.02),
        rest_speed=jnp.array(1.0),
    )


@pytest.mark.parametrize("error", ["additive", "right-invariant"])
def test_derivatives_with_all_states_carried_are_the_automatic_ones(error: Any) -> None:
    """Within what the derivatives of the model itself leave out; carried columns to rounding."""
    drive = town.driven(0, town_legs(1), 60)
    at = jax.tree.map(lambda leaf: leaf[400], (drive.sensed.truth, drive.sensed.inputs))
    model = vehicle.vehicle(error, at[0].position, carry=ALL)
    rng = np.random.default_rng(1)
    carried = {name: jnp.asarray(0.01 * rng.normal(size=law.size)) for name, law in ALL.items()}
    x = Carried(at[0], carried)
    u = VehicleInput(at[1], jnp.array(0.03), jnp.array(1.5))
    params = CarriedParams(car_params(), dict.fromkeys(ALL, ()))
    n = 15 + sum(law.size for law in ALL.values())

    @compiled
    def both() -> tuple[Any, Any]:
        ahead, z = model.transition(params, x, u), model.observe(params, x, u)

        def pushed(dx: jax.Array) -> tuple[jax.Array, jax.Array]:
            y = model.retract(x, dx)
            moved = model.local(ahead, model.transition(params, y, u))
            return moved, model.residual(model.observe(params, y, u), z)

        assert model.jacobians is not None
        maps: Any = model.jacobians(params, x, u)
        own = [jax.vmap(one, out_axes=1)(jnp.eye(n)) for one in maps]
        return own, jax.jacfwd(pushed)(jnp.zeros(n))

    ours, automatic = both()
    for mine, theirs, left_out in zip(ours, automatic, (3e-4, 3e-4), strict=True):
        np.testing.assert_allclose(mine[:, 15:], theirs[:, 15:], rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(mine[:, :15], theirs[:, :15], rtol=0, atol=left_out)
    # Each has an effect on something other than itself.
    Phi, H = map(np.abs, automatic)
    assert np.maximum(Phi[:15, 15:].max(axis=0), H[:, 15:].max(axis=0)).min() > 1e-5


ARM = jnp.array([0.6, -0.5, 0.6])
"""Lever arm of the tests: 1 m long."""


def armed(seed: int, legs: tuple[Leg, ...], seconds: int, spread: float) -> tuple[Any, Any]:
    """Return error and covariance of a lever arm that starts at zero, sigma 1 m.

    What is known of the position at the start, by ``spread`` [m], tells of the arm as well.
    """
    drive = town.driven(seed, legs, seconds, ARM)
    model = sins_gnss.sins_gnss(carry={"lever_arm": constant(3)})
    start = drive.sensed.start
    position = jnp.arange(15) // 3 == 2
    start = start._replace(cov=jnp.diag(jnp.where(position, spread**2, jnp.diag(start.cov))))
    initial = with_carried(start, {"lever_arm": (jnp.zeros(3), jnp.ones(3))})
    params = FilterParams(CarriedParams(town.NOISE, {"lever_arm": ()}), initial)
    inputs: SinsGnssInput = drive.sensed.inputs
    fixes = {"velocity": drive.fixes[:, :3], "position": drive.fixes[:, 3:]}
    obs = model.stack(fixes, dict.fromkeys(fixes, drive.each_second))

    def record(state: Any, info: Any) -> Any:
        estimate = chosen.estimate(state)
        return estimate.mean.lever_arm - ARM, estimate.cov[15:, 15:]

    chosen = ekf(model)
    error, cov = run(chosen, params, inputs, obs, record=record).record
    return np.asarray(error), np.asarray(cov)


def test_a_lever_arm_is_found_in_turns_and_not_where_it_cannot_be_seen() -> None:
    """Wrong by a metre; on a straight no part of it can be told from the position."""
    error, cov = armed(0, town_legs(4), 270, 1.0)
    sigma = np.sqrt(np.diagonal(cov[-1]))
    assert np.all(np.abs(error[-1]) < 3 * sigma)
    assert np.all(np.abs(error[-1][:2]) < 0.1)
    straight, still = armed(0, (Leg(20.0, 15.0),), 120, 100.0)
    assert np.all(np.abs(straight[-1]) < 3 * np.sqrt(np.diagonal(still[-1])))
    # The noise of the measured rate looks like a little turning: a tenth in two minutes.
    assert np.all(np.diagonal(still[-1]) > 0.9)


NONE: dict[str, Law] = {}
WRONG: Any = 1.0
STATE = Carried(jnp.ones(2), {"scale": jnp.ones(2), "bias": jnp.ones(1)})


def run_from(initial: Any, own: Any = None) -> Any:
    """Run a filter of a model that carries a scale and a bias."""
    params = CarriedParams(jnp.array(0.01), LAW_PARAMS) if own is None else own
    model = observing(WIDE, {"line": LINE}, parts=shared)
    obs = Obs(jnp.ones((3, 1)), jnp.ones((3, 1), bool))
    return run(ekf(model), FilterParams(params, initial), None, obs)


START = Gaussian(jnp.zeros(2), jnp.eye(2))
MISUSE: dict[str, tuple[Callable[[], object], str]] = {
    "none": (lambda: carrying(OWN, NONE, period=1.0), "there is no state to carry"),
    "twice": (lambda: carrying(WIDE, {"bias": constant(1)}, period=1.0), "'bias' is carried twice"),
    "no name": (
        lambda: carrying(OWN, {"a b": constant(1)}, period=1.0),
        "'a b' cannot be the name",
    ),
    "taken": (lambda: carrying(OWN, {"own": constant(1)}, period=1.0), "'own' cannot be the name"),
    "no size": (
        lambda: carrying(OWN, {"a": constant(0)}, period=1.0),
        "'a' is 0; it must be",
    ),
    "nearly": (
        lambda: sins_gnss.sins_gnss(carry={"leverarm": constant(3)}),
        "did you mean 'lever_arm'",
    ),
    "another size": (
        lambda: vehicle.vehicle(carry={"mounting": constant(2)}),
        "'mounting' has the size 2; it must be 3",
    ),
    "a field of the state": (
        lambda: carrying(OWN, {"bias": constant(1)}, period=1.0).transition(
            CarriedParams((), {"bias": ()}),
            Carried(sins_gnss.SinsLevel(*[jnp.zeros(3)] * 5), {"bias": jnp.zeros(1)}),
            None,
        ),
        "the process has a state 'bias' itself",
    ),
    "a field of the state below another": (
        lambda: carrying(
            carrying(OWN, {"a": constant(1)}, period=1.0), {"position": constant(1)}, period=1.0
        ).transition(
            CarriedParams(CarriedParams((), {"a": ()}), {"position": ()}),
            Carried(
                Carried(sins_gnss.SinsLevel(*[jnp.zeros(3)] * 5), {"a": jnp.zeros(1)}),
                {"position": jnp.zeros(1)},
            ),
            None,
        ),
        "the process has a state 'position' itself",
    ),
    "a start that carries nothing": (lambda: run_from(START), "is Carried(own, {name: state})"),
    "a start that lacks one": (
        lambda: run_from(with_carried(START, {"bias": (jnp.zeros(1), jnp.ones(1))})),
        "the state lacks the carried 'scale'",
    ),
    "plain parameters": (
        lambda: WIDE.transition(WRONG, STATE, None),
        "a process that carries states takes CarriedParams(own, {name",
    ),
    "parameters of another state": (
        lambda: WIDE.transition(
            CarriedParams(jnp.array(0.1), {**LAW_PARAMS, "c": ()}), STATE, None
        ),
        "there are parameters of 'c', which is not carried",
    ),
    "a scalar mean": (
        lambda: with_carried(START, {"bias": (jnp.array(0.0), jnp.ones(1))}),
        "the mean of 'bias' is (); it must be (k,)",
    ),
    "a variance of another size": (
        lambda: with_carried(START, {"bias": (jnp.zeros(2), jnp.ones(3))}),
        "the variance of 'bias' is (3,); it must be (2,) or (2, 2)",
    ),
    "a model": (
        lambda: carrying(WRONG, {"bias": constant(1)}, period=1.0),
        "carrying takes a Process, of a model process_of(model)",
    ),
    "a law without its size": (
        lambda: carrying(OWN, {"bias": WRONG}, period=1.0),
        "it must be a Law, as constant(3) is",
    ),
    "a negative period": (
        lambda: carrying(OWN, {"bias": constant(1)}, period=-1.0),
        "period is -1; it must be in [0, inf]",
    ),
    "a list to carry": (
        lambda: sins_gnss.sins_gnss(carry=["lever_arm"]),  # pyright: ignore[reportArgumentType]
        "carry must be a mapping of names to laws",
    ),
    "a channel of a model again": (
        lambda: observing(sins_gnss.sins_gnss(), {"position": LINE}),
        "two channels 'position'",
    ),
    "parameters without a law's": (
        lambda: WIDE.transition(
            CarriedParams(jnp.array(0.1), {"bias": LAW_PARAMS["bias"]}),
            Carried(jnp.ones(2), {"scale": jnp.ones(2), "bias": jnp.ones(1)}),
            None,
        ),
        "no parameters of the carried state 'scale'",
    ),
}


@pytest.mark.parametrize("name", MISUSE)
def test_misuse_is_refused_in_one_sentence(name: str) -> None:
    call, sentence = MISUSE[name]
    with pytest.raises(ValueError, match=re.escape(sentence)) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_the_order_of_names_does_not_matter() -> None:
    parts = {"scale": (jnp.zeros(2), jnp.array([1.0, 2.0])), "bias": (jnp.zeros(1), jnp.ones(1))}
    orders = parts.items(), reversed(parts.items())
    one, other = (with_carried(START, dict(order)) for order in orders)
    np.testing.assert_array_equal(one.cov, other.cov)
    np.testing.assert_array_equal(np.diag(one.cov), [1, 1, 1, 1, 2])


def test_the_precision_is_that_of_the_arrays() -> None:
    narrow = jnp.float32
    start = Gaussian(jnp.zeros(2, narrow), jnp.eye(2, dtype=narrow))
    wide = with_carried(start, {"bias": (jnp.zeros(1, narrow), jnp.ones(1, narrow))})
    assert {leaf.dtype for leaf in jax.tree.leaves(wide)} == {jnp.dtype(narrow)}
    x, noise = jnp.zeros((3, 2), narrow), jnp.ones(1, narrow)
    seen = Channel(1, lambda p, x, u: x[:1], lambda p, x, u: p)
    assert measured(jax.random.key(0), seen, noise, x, None).dtype == narrow
    assert measured(jax.random.key(0), seen, jnp.array([1]), jnp.zeros((3, 2)), None).dtype == float


def test_channels_are_added_to_a_model_whose_own_go_on() -> None:
    """The model's parameters stand beside those of the new channel; the old parts are equal."""
    drive = town.driven(0, town_legs(1), 60)
    plain = sins_gnss.sins_gnss()
    upward = Channel(1, lambda p, x, u: x.position[2:], lambda p, x, u: p[None] ** 2)
    wider = observing(plain, {"height": upward})
    assert wider.channels == (*plain.channels, ("height", 1))
    fixes = {"velocity": drive.fixes[:, :3], "position": drive.fixes[:, 3:]}
    start, inputs = drive.sensed.start, drive.sensed.inputs
    one = run(ekf(plain), FilterParams(town.NOISE, start), inputs, plain.stack(fixes)).record
    params = FilterParams(ModelParams(town.NOISE, {"height": jnp.array(1e9)}), start)
    both = wider.stack({**fixes, "height": drive.fixes[:, 5:]})
    other = run(ekf(wider), params, inputs, both).record
    np.testing.assert_allclose(one[0].cov, other[0].cov, rtol=1e-9, atol=1e-18)
    np.testing.assert_allclose(
        plain.part(one[1], "position").nis, wider.part(other[1], "position").nis, rtol=1e-9
    )
