"""Misuses that filters, wrappers, banks and rules share, and those of single keywords."""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp

import jaxnav as jn
from jaxnav.estimation.carried import constant
from tests.faulty.test_misuse import KF, MODEL, ONE, STEPS, U, Z, filtered, weighed

public: Any = jn
"""The library, for calls that a type checker would refuse."""
Case = tuple[Callable[[], Any], str]

FILTERS = (
    *("kf", "ekf", "square_root_kf", "square_root_ekf"),
    *("ckf", "ukf", "square_root_ckf", "square_root_ukf"),
    *("iterated_ekf", "iterated_ckf", "modified_iterated_ckf"),
)
ITERATED = FILTERS[-3:]
WRAPPERS = ("versoria", "correntropy", "innovation_adaptive", "sage_husa")
BANKS = ("mmae", "immae", "imm")
RULES = ("bayes", "fixed", "markov", "forget", "floor", "switch", "penalty", "windowed_reset")

EYE, W, KEY = jnp.eye(2), jnp.zeros((STEPS, 2)), jax.random.key(0)
PROCESS = jn.Process(MODEL.transition, MODEL.process_noise)
SEEN = jn.Channel(2, lambda p, x, u: x, lambda p, x, u: jnp.ones(2))
MEAN, VARIANCE = jnp.zeros(1), jnp.ones(1)


def a_run(key: Any, shared: Any) -> jn.RunOutput:
    del key, shared
    return jn.RunOutput(0.0)


def of_a_filter(name: str) -> Iterator[Case]:
    build = getattr(jn, name)
    needed = r"; it must be a Model, as jaxnav\.Model\("
    for given, words in (
        (lambda x: x, r"the function <lambda>"),
        (jn.Model, "the class Model"),
        (EYE, r"an array \(2, 2\) of float64"),
        (KF, "a Filter"),
        (PROCESS, "a Process"),
    ):
        yield lambda given=given: build(given), f"^model is {words}{needed}"
    accepted = r"it must be a function of \(params, x, u\)$"
    for change, words in (
        ({"transition": EYE}, r"^transition of the model is an array \(2, 2\) of float64; "),
        ({"observe": lambda x, u: x}, r"^observe of the model takes \(x, u\); "),
    ):
        yield lambda change=change: build(MODEL._replace(**change)), words + accepted
    rows = MODEL._replace(process_noise=lambda p, x, u: [[0.1, 0.0], [0.0, 0.1]])
    sigmas = MODEL._replace(process_noise=lambda p, x, u: jnp.ones(2))
    wide = MODEL._replace(observation_noise=lambda p, x, u: jnp.eye(3))
    for model, words in (
        (rows, r"^the process noise is a list; it must be an array$"),
        (sigmas, r"^the process noise is \(2,\); it must be \(2, 2\), as the state$"),
        (wide, r"^the model's observation noise is \(3, 3\) and the observation has 2 channels"),
    ):
        yield lambda model=model: filtered(filter=build(model))(), words
    yield lambda: filtered(ONE._replace(own=3.0), filter=build(MODEL))(), r"^own is 3\.0; "


def of_a_wrapper(name: str) -> Iterator[Case]:
    wrap = getattr(jn, name)
    extra = {"channels": 2} if name == "sage_husa" else {}
    for given, words in (
        (jn.ekf, "the function ekf"),
        (MODEL, "a Model"),
        (jn.bayes(), "a WeightRule"),
    ):
        call = lambda given=given: wrap(given, **extra)  # noqa: E731
        yield call, rf"^filter is {words}; {name} takes a filter, as ekf\(model\)$"
    yield (
        lambda: wrap(jn.mmae(KF), **extra),
        rf"^{name} hands noise to the model of a single filter, and a bank has one for each",
    )
    over = wrap(KF, **extra)
    yield filtered(ONE._replace(own=((), (), ())), filter=over), r"^own is a tuple; it must be \w+"


def of_a_bank(name: str) -> Iterator[Case]:
    build = getattr(jn, name)
    for given, words in (
        (jn.ekf, "the function ekf"),
        (MODEL, "a Model"),
        ([KF, KF], "a list"),
        (jn.bayes(), "a WeightRule"),
    ):
        yield lambda given=given: build(given), f"^filter is {words}; it must be a Filter"
    yield filtered(ONE, filter=build(KF)), r"^params is a FilterParams; a bank takes BankParams"


def of_a_rule(name: str) -> Iterator[Case]:
    rule = getattr(jn, name)()
    for given in ("0.1", [0.1]):
        words = r"'0\.1'" if given == "0.1" else "a list"
        yield weighed(rule, given), rf"^the [\w ]+ is {words}; \S.*(must be|needs) \S"
    yield (
        lambda: jn.chain(getattr(jn, name)),
        rf"^rule 0 of a chain is the function {name}; it",
    )


def misused(name: str, least: str, *values: Any, **fixed: Any) -> Iterator[Case]:
    """Yield calls of a function with values that one of its keywords must not have."""
    *where, keyword = name.split(".")
    function = getattr(public, where[0])
    given = fixed.pop("given", ())
    for value in values:
        sentence = rf"^(the )?{keyword} is {value!r}; it must be {least}$"
        yield lambda value=value: function(*given, **{**fixed, keyword: value}), sentence


WHOLE, COUNT = "at least 1, and whole", "at least 0, and whole"
SWITCH = "True or False"
RUN, STUDY, FIT = (KF, ONE, U, Z), (a_run, KEY, 2), (lambda p: p**2, 1.0)


def of_keywords() -> Iterator[tuple[str, Case]]:
    for name, accepted, values, given in (
        *((f"{f}.iterations", WHOLE, (0, 2.5, "3"), (MODEL,)) for f in ITERATED),
        *((f"{f}.trials", COUNT, (-1, 1.5), (MODEL,)) for f in ITERATED),
        *((f"{f}.search", r"Search\(\.\.\.\), or None", (3,), (MODEL,)) for f in ITERATED),
        *((f"{f}.printed", SWITCH, ("no",), (MODEL,)) for f in ITERATED[1:]),
        *((f"{f}.redraw", SWITCH, ("no",), (MODEL,)) for f in ("ckf", "ukf")),
        *(
            (f"{f}.{of}", r"a number in \(-inf, inf\)", ("1", None), (MODEL,))
            for f in ("ukf", "square_root_ukf")
            for of in ("alpha", "beta", "kappa")
        ),
        *((f"{f}.iterations", WHOLE, (0, 1.5, True), (KF,)) for f in WRAPPERS[:2]),
        *((f"{f}.smooth", SWITCH, ("yes",), (KF,)) for f in ("innovation_adaptive", "immae")),
        *((f"{f}.smooth", SWITCH, ("yes",), ()) for f in ("floor", "windowed_reset")),
        ("sage_husa.channels", WHOLE, (0, "2", 2.0), (KF,)),
        ("sage_husa.form", "one of clamped, residual, printed", ("hard",), (KF,)),
        ("gated.groups", "a list of names or of places", ("gnss", 3), (KF,)),
        ("run.every", WHOLE, (0, 1.5, "2", True), RUN),
        ("run.segment", COUNT, (-1, "a"), RUN),
        ("run.record", r"a function of \(state, info\)", (3, "P"), RUN),
        ("run.debug", SWITCH, ("yes",), RUN),
        ("negative_log_likelihood.segment", COUNT, (-1, 2.5), RUN),
        ("monte_carlo.tile", WHOLE, (0, 1.5), STUDY),
        ("monte_carlo.keep", COUNT, (-1, 1.5, "a"), STUDY),
        ("monte_carlo.devices", "a list of JAX's devices", ("cpu", 3), STUDY),
        ("monte_carlo.progress", r"a function of \(done, runs\)", (3,), STUDY),
        ("fit.steps", WHOLE, (1.5, "3", True), FIT),
        ("fit.mode", "'reverse' or 'forward'", ("fwd",), FIT),
        ("fit.optimiser", r"one of optax, as optax\.adam\(0\.1\)", ("adam",), FIT),
        ("fit.transform", "one Transform, or a tree of them like start", ("exp", None), FIT),
        ("fit.data", "a tuple of what the loss is given", (3.0,), FIT),
        ("fit.validation", r"Validation\(\.\.\.\)", (3,), FIT),
        ("fit.batches", r"a function of \(number\)", (3,), FIT),
        ("carrying.period", r"a number in \[0, inf\]", ("a", None), (PROCESS, {"b": constant(1)})),
        ("observing.parts", r"a function of \(params, name\)", (3,), (PROCESS, {"a": SEEN})),
    ):
        for case in misused(name, accepted, *values, given=given):
            yield name.split(".")[0], case
