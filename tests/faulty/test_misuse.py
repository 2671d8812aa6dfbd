"""A misuse of the library ends in one sentence: what was given, what it was, what it may be."""

import re
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnav as jn
from jaxnav.cli import main
from jaxnav.estimation.banks.weights import Floor, switch
from jaxnav.estimation.filters.adaptive import Adaptation
from jaxnav.estimation.filters.robust import Versoria
from jaxnav.estimation.filters.sage_husa import SageHusa

STEPS = 4
LISTED: Any = [[0.0, 0.0]] * STEPS
INSIDE = re.compile(r"tracer|jvp|vmap|\bzip\b|has no attribute|Traced<|NoneType", re.IGNORECASE)
"""Words of JAX and Python that mean nothing to the caller."""

MODEL = jn.Model(
    transition=lambda p, x, u: x,
    process_noise=lambda p, x, u: 0.1 * jnp.eye(2),
    observe=lambda p, x, u: x,
    observation_noise=lambda p, x, u: p * jnp.ones(2),
)
Z = jn.Obs(jnp.zeros((STEPS, 2)), jnp.ones((STEPS, 2), bool))
U = jnp.zeros((STEPS, 1))
ONE = jn.FilterParams(jnp.array(1.0), jn.Gaussian(jnp.zeros(2), jnp.eye(2)))
MEMBERS = jn.replicate(ONE, 3)
KF = jn.kf(MODEL)


def prior(mean: Any, cov: Any) -> jn.FilterParams:
    return ONE._replace(initial=jn.Gaussian(mean, cov))


def weighed(rule: jn.WeightRule, params: Any, members: Any = MEMBERS) -> Callable[[], Any]:
    return lambda: jn.run(jn.bank(KF, rule), jn.BankParams(members, params), U, Z)


def switching(matrix: Any) -> Callable[[], Any]:
    return lambda: jn.run(jn.imm(KF), jn.BankParams(MEMBERS, matrix), U, Z)


def filtered(params: Any = ONE, z: Any = Z, filter: Any = KF, u: Any = U) -> Callable[[], Any]:
    return lambda: jn.run(filter, params, u, z)


def part(wrap: Callable[..., jn.Filter], own: Any) -> Callable[[], Any]:
    return filtered(ONE._replace(own=own), filter=wrap(jn.ekf(MODEL)))


def study(run_one: Any = lambda key, shared: jn.RunOutput(0.0), key: Any = None, runs: Any = 2):
    return lambda: jn.monte_carlo(run_one, jax.random.key(0) if key is None else key, runs)


CURVED = {
    "transition": MODEL._replace(transition=lambda p, x, u: jnp.sin(x)),
    "observe": MODEL._replace(observe=lambda p, x, u: x * x[::-1]),
}
EYE = jnp.eye(2)
TWO = MEMBERS._replace(model=jnp.ones(2))
MISUSES: dict[str, tuple[Callable[[], Any], str]] = {
    "a builder for a filter": (
        filtered(filter=jn.kf),
        r"^filter is the function kf; it must be a Filter, as jaxnav\.ekf\(model\)",
    ),
    "a model for a filter": (filtered(filter=MODEL), r"^filter is a Model; it must be a Filter"),
    "a nonlinear transition": (
        filtered(filter=jn.kf(CURVED["transition"])),
        r"^the derivative of the model's transition depends on the state; a linear filter needs",
    ),
    "a rounded transition": (
        filtered(filter=jn.kf(MODEL._replace(transition=lambda p, x, u: x + jnp.floor(x)))),
        r"^the derivative of the model's transition depends on the state; a linear filter needs",
    ),
    "a nonlinear observation": (
        filtered(filter=jn.square_root_kf(CURVED["observe"])),
        r"^the derivative of the model's observe depends on the state; .* the ekf takes all",
    ),
    "an array for observations": (
        filtered(z=jnp.zeros((STEPS, 2))),
        r"^observations is an array \(4, 2\) of float64; it must be Obs\(z, valid\)",
    ),
    "a list for observations": (filtered(z=[1.0, 2.0]), r"^observations is a list; it must be Obs"),
    "a list for z": (
        filtered(z=Z._replace(z=LISTED)),
        r"^observations\.z is a list; it must be an array$",
    ),
    "one channel without its axis": (
        filtered(z=jn.Obs(jnp.zeros(STEPS), jnp.ones(STEPS, bool))),
        r"^observations has z \(4,\) and valid \(4,\); both must be \(T, m\)$",
    ),
    "numbers for a mask": (
        filtered(z=jn.Obs(jnp.zeros((STEPS, 2)), jnp.ones((STEPS, 2)))),
        r"^observations\.valid is of float64; it must be of bool$",
    ),
    "other steps": (filtered(u=jnp.zeros((5, 1))), r"have \[4, 5\] steps"),
    "another number of channels": (
        filtered(z=jn.Obs(jnp.zeros((STEPS, 3)), jnp.ones((STEPS, 3), bool))),
        r"the observation has z \(3,\) .* the model observes \(2,\)",
    ),
    "parameters of a bank": (
        filtered(jn.BankParams(MEMBERS, ())),
        r"^params is a BankParams; a single filter takes FilterParams\(model, initial\)$",
    ),
    "the prior alone": (filtered(ONE.initial), r"^params is a Gaussian; a single filter takes"),
    "a pair for the prior": (
        filtered(ONE._replace(initial=(jnp.zeros(2), EYE))),
        r"^initial is a tuple; it must be Gaussian\(mean, cov\)$",
    ),
    "a list for the mean": (
        filtered(prior([0.0, 0.0], EYE)),
        r"^the initial mean is a list; it must be an array$",
    ),
    "a list for the covariance": (
        filtered(prior(jnp.zeros(2), [[1.0, 0.0], [0.0, 1.0]])),
        r"^the initial covariance is a list; it must be an array$",
    ),
    "an integer mean": (
        filtered(prior(jnp.zeros(2, int), EYE)),
        r"^the initial mean is of int64; it must be of floating-point numbers",
    ),
    "an integer covariance": (
        filtered(prior(jnp.zeros(2), jnp.eye(2, dtype=int))),
        r"^the initial covariance is of int64; it must be of floating-point numbers",
    ),
    "a column mean": (
        filtered(prior(jnp.zeros((2, 1)), EYE)),
        r"^the initial mean is \(2, 1\); it must be a vector \(n,\)",
    ),
    "standard deviations for a covariance": (
        filtered(prior(jnp.zeros(2), jnp.ones(2))),
        r"^the initial covariance is \(2,\); the initial mean has 2 tangent coordinates",
    ),
    "an asymmetric covariance": (
        filtered(prior(jnp.zeros(2), jnp.array([[1, 0.2], [0.1, 1]]))),
        r"^the initial covariance is not symmetric: 0\.2 at \(0, 1\) and 0\.1 at \(1, 0\)$",
    ),
    "an indefinite covariance": (
        filtered(prior(jnp.zeros(2), jnp.array([[1, 2.0], [2, 1]]))),
        r"^the initial covariance is not positive semi-definite: .* least eigenvalue is -1$",
    ),
    "a negative variance": (
        filtered(prior(jnp.zeros(2), jnp.diag(jnp.array([1.0, -2.0])))),
        r"^the initial covariance has the variance -2 at 1; none may be negative$",
    ),
    "a covariance of NaN": (
        filtered(prior(jnp.zeros(2), jnp.nan * EYE)),
        r"^the initial covariance has an entry that is not finite$",
    ),
    "parameters of one filter for a bank": (
        filtered(ONE, filter=jn.mmae(KF)),
        r"^params is a FilterParams; a bank takes BankParams\(members, rule\)",
    ),
    "members that are not replicated": (
        weighed(jn.bayes(), (), ONE),
        r"^members\.model is one number; .* leading model axis, which jaxnav\.replicate",
    ),
    "members of two numbers": (
        weighed(jn.bayes(), (), TWO),
        r"^members\.model has 2 entries along the model axis and members\.initial\.mean has 3",
    ),
    "a member with a bad prior": (
        weighed(
            jn.bayes(),
            (),
            MEMBERS._replace(
                initial=MEMBERS.initial._replace(cov=MEMBERS.initial.cov.at[1, 0, 0].set(-1))
            ),
        ),
        r"^member 1: the initial covariance has the variance -1 at 0",
    ),
    "a forgotten probability": (
        weighed(jn.markov(), ()),
        r"^the probability to switch is \(\); it must be a number in \[0, 1\]$",
    ),
    "a probability of 2": (
        weighed(jn.markov(), 2.0),
        r"^the probability to switch is 2; it must be in \[0, 1\]$",
    ),
    "a probability of -0.5": (weighed(jn.markov(), jnp.array(-0.5)), r"is -0\.5; it must be in"),
    "a floor of 1/M": (
        weighed(jn.floor(), 1 / 3),
        r"^the floor of the weights is 0\.333333; it must be in \(0, 1/3\)$",
    ),
    "a smooth floor without its class": (
        weighed(jn.floor(smooth=True), 0.1),
        r"^the parameter of a smooth floor is 0\.1; it must be Floor\(\.\.\.\)$",
    ),
    "a smooth floor above 1/M": (
        weighed(jn.floor(smooth=True), Floor(0.5)),
        r"^bound of Floor is 0\.5; it must be in \(0, 1/3\)$",
    ),
    "forgetting of 1.5": (
        weighed(jn.forget(), 1.5),
        r"^the factor of forgetting is 1\.5; it must be in \(0, 1\]$",
    ),
    "forgetting of another shape": (
        weighed(jn.forget(), jnp.ones(3)),
        r"^the factor of forgetting is an array \(3,\) of float64; it must be a number",
    ),
    "a penalty as a number": (
        weighed(jn.penalty(), 0.5),
        r"^the parameter of penalty is 0\.5; it must be Penalty\(\.\.\.\)$",
    ),
    "a negative penalty": (
        weighed(jn.penalty(), jn.Penalty(scale=-1.0)),
        r"^scale of Penalty is -1; it must be in \[0, inf\)$",
    ),
    "a threshold of 2": (
        weighed(jn.windowed_reset(), jn.WindowedReset(10, 2.0)),
        r"^threshold of WindowedReset is 2; it must be in \(0, 1\]$",
    ),
    "a chain without its tuple": (
        weighed(jn.chain(jn.bayes(), jn.floor()), 0.1),
        r"^the parameter of a chain is 0\.1; it must be a tuple of 2",
    ),
    "a chain with an entry too few": (
        weighed(jn.chain(jn.bayes(), jn.floor()), (0.1,)),
        r"^the parameter of a chain is a tuple of 1; it must be a tuple of 2",
    ),
    "a matrix of another size": (
        weighed(switch(), jnp.eye(2)),
        r"^the transition matrix is \(2, 2\); a bank of 3 members needs \(3, 3\)$",
    ),
    "rows that do not sum to one": (
        switching(jnp.full((3, 3), 0.5)),
        r"^row 0 of the transition matrix sums to 1\.5; each must sum to 1$",
    ),
    "a number for a matrix": (switching(0.1), r"^the transition matrix is 0\.1; a bank of 3"),
    "a prior of other length": (
        lambda: jn.run(jn.mmae(KF), jn.BankParams(MEMBERS, (), jnp.zeros(2)), U, Z),
        r"^log_prior is \(2,\); a bank of 3 members needs \(3,\)$",
    ),
    "a prior that rules all members out": (
        lambda: jn.run(jn.mmae(KF), jn.BankParams(MEMBERS, (), jnp.full(3, -jnp.inf)), U, Z),
        r"^log_prior is \[-inf, -inf, -inf\]; it must be log-weights of which at least one",
    ),
    "a panel without a rule's parameters": (
        lambda: jn.run(
            jn.panel(KF, {"a": jn.bayes(), "b": jn.markov()}),
            jn.BankParams(MEMBERS, {"a": ()}),
            U,
            Z,
        ),
        r"^rule of a panel is a; it must be a mapping with a, b$",
    ),
    "a kernel as a number": (
        part(jn.versoria, 0.1),
        r"^own is 0\.1; it must be Versoria\(\.\.\.\), or \(\)",
    ),
    "a negative kernel": (
        part(jn.versoria, Versoria(width=-1.0)),
        r"^width of Versoria is -1; it must be in \[0, inf\)$",
    ),
    "an adaptation of another filter": (
        part(jn.innovation_adaptive, SageHusa()),
        r"^own is a SageHusa; it must be Adaptation\(\.\.\.\), or \(\)",
    ),
    "a memory below one": (
        part(jn.innovation_adaptive, Adaptation(memory=0.5)),
        r"^memory of Adaptation is 0\.5; it must be in \[1, inf\)$",
    ),
    "a forgetting factor of 1.2": (
        lambda: jn.run(
            jn.sage_husa(jn.ekf(MODEL), channels=2),
            ONE._replace(own=SageHusa(forgetting=1.2)),
            U,
            Z,
        ),
        r"^forgetting of SageHusa is 1\.2; it must be in \(0, 1\]$",
    ),
    "an integer seed": (
        study(key=3),
        r"^key is 3; it must be one key, as jax\.random\.key\(0\)$",
    ),
    "many keys": (
        study(key=jax.random.split(jax.random.key(0), 3)),
        r"^key is an array \(3,\) of key<fry>; it must be one key",
    ),
    "runs that are not whole": (
        study(runs=2.5),
        r"^runs is 2\.5; it must be at least 1, and whole$",
    ),
    "no runs": (study(runs=0), r"^runs is 0; it must be at least 1, and whole$"),
    "a run without RunOutput": (
        study(lambda key, shared: jnp.zeros(2)),
        r"^run_one returns an array \(2,\) of float64; it must return RunOutput\(row\)",
    ),
    "no steps of a fit": (
        lambda: jn.fit(lambda p: p**2, 1.0, steps=0),
        r"^steps is 0; it must be at least 1, and whole$",
    ),
}


@pytest.mark.parametrize("name", MISUSES)
def test_misuse_is_told_in_the_callers_words(name: str) -> None:
    call, sentence = MISUSES[name]
    with pytest.raises(ValueError, match=sentence) as caught:
        call()
    message = str(caught.value)
    assert "\n" not in message
    assert not INSIDE.search(message), message


def test_misuse_of_shapes_is_told_under_transformations_too() -> None:
    """Types and shapes are known while a program is traced; values are not."""
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), ONE)
    with pytest.raises(ValueError, match="a bank takes BankParams"):
        jax.vmap(lambda params: jn.run(jn.mmae(KF), params, U, Z))(batch)
    with pytest.raises(ValueError, match="it must be Obs"):
        jax.jit(lambda z: jn.run(KF, ONE, U, z))(jnp.zeros((STEPS, 2)))


def test_names_close_to_a_public_one_are_suggested() -> None:
    for wrong, right in (("EKF", "ekf"), ("ekff", "ekf"), ("montecarlo", "monte_carlo")):
        with pytest.raises(AttributeError, match=f"did you mean '{right}'"):
            getattr(jn, wrong)
    with pytest.raises(AttributeError, match=r"has no attribute 'qqqq'$"):
        _ = jn.qqqq  # pyright: ignore[reportAttributeAccessIssue]


def test_the_package_lists_itself() -> None:
    assert set(jn.__all__) <= set(dir(jn))
    assert "get_close_matches" not in dir(jn)
    assert re.fullmatch(r"\d+\.\d+\.\d+.*", jn.__version__)
    assert np.all([getattr(jn, name) is not None for name in jn.__all__])


WORDS = {
    "run immae --theta 1 -5": (
        "--theta is (1.0, -5.0); it must be one or more numbers, each positive"
    ),
    "run immae --runs abc": "--runs is 'abc'; it must be a whole number",
    "run immae --runs 1000000000000": ("--runs is 1000000000000; it must be from 1 to 1000000000"),
    "run immae --nope 3": (
        "there is no flag '--nope'; `jaxnav run immae --help` lists what is accepted"
    ),
    "tune gnss-track": (
        "log is not given; it must be the path of an RTKLIB .pos file, by --log, or by --study.log "
        "where it is tuned"
    ),
}


@pytest.mark.parametrize("command", WORDS)
def test_the_command_line_says_it_in_one_sentence(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command.split()) == 2
    said = capsys.readouterr().err
    assert said == f"jaxnav: {WORDS[command]}\n"
