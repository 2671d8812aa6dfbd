"""Every public function tells of two misuses or more in one sentence that names the argument."""

import inspect
import re
from itertools import chain
from typing import Any

import jax.numpy as jnp
import pytest

import jaxnav as jn
from jaxnav.estimation.carried import constant
from tests.faulty.misuses import (
    BANKS,
    EYE,
    FILTERS,
    KEY,
    MEAN,
    PROCESS,
    RULES,
    SEEN,
    VARIANCE,
    WRAPPERS,
    Case,
    W,
    a_run,
    of_a_bank,
    of_a_filter,
    of_a_rule,
    of_a_wrapper,
    of_keywords,
    public,
)
from tests.faulty.test_misuse import INSIDE, KF, MEMBERS, MODEL, ONE, STEPS, U, Z, filtered, weighed

P, X = jnp.array(1.0), jnp.zeros(2)
PRIOR = ONE.initial
CARRIED = {"b": constant(1)}
SEEN_BY_NAME = jn.observing(PROCESS, {"a": SEEN})
PAIR = jnp.zeros((STEPS, 2))
BUILDER = r"^filter is the function kf; it must be a Filter"
RULE = r" it must be a WeightRule, as jaxnav\.bayes\(\)"
NO_NUMBER = r"it must be a number, an array or "
LONE = jn.BankParams(MEMBERS, {"a": ()})


def simulated(**given: Any) -> Any:
    """Return a call of simulate with arguments that are right but for those given."""
    right = {
        "model": MODEL,
        "params": P,
        "start": X,
        "inputs": U,
        "process_noise": W,
        "observation_noise": W,
    }
    return lambda: public.simulate(**{**right, **given})


OWN: dict[str, list[Case]] = {
    "gated": [
        (lambda: public.gated(jn.kf), BUILDER),
        (lambda: public.gated(MODEL), r"^filter is a Model; it must be a Filter"),
        (lambda: public.gated(KF, []), r"^groups is \[\]; a gate needs groups of one channel"),
        (lambda: public.gated(KF, [[0], [0]]), r"^groups is .*; a channel can be in one group"),
        (lambda: public.gated(KF, ["x"]), r"^the model has no channel 'x'"),
    ],
    "sage_husa": [
        (lambda: jn.sage_husa(KF), r"^the model's channels have no names; give their number"),
        (
            filtered(filter=jn.sage_husa(KF, channels=3)),
            r"^channels is 3; it must be 2, the values of the observation$",
        ),
    ],
    "bank": [
        (lambda: public.bank(jn.kf, jn.bayes()), BUILDER),
        (lambda: public.bank(jn.bayes(), KF), r"^filter is a WeightRule; it must be a Filter"),
        (lambda: public.bank(KF, jn.bayes), r"^rule is the function bayes;" + RULE),
        (lambda: public.bank(KF, "bayes"), r"^rule is 'bayes';" + RULE),
        (lambda: public.bank(KF, (jn.bayes(), jn.floor())), r"^rule is a tuple;" + RULE),
    ],
    "panel": [
        (lambda: public.panel(MODEL, {"a": jn.bayes()}), r"^filter is a Model; it must be a Fil"),
        (lambda: public.panel(KF, [jn.bayes()]), r"^rules is a list; it must be a mapping of"),
        (lambda: public.panel(KF, jn.bayes()), r"^rules is a WeightRule; it must be a mapping"),
        (lambda: public.panel(KF, {}), r"^rules is a dict; it must be .* to one rule or more$"),
        (lambda: public.panel(KF, {"a": jn.bayes}), r"^rule 'a' is the function bayes;" + RULE),
    ],
    "chain": [
        (lambda: public.chain([jn.bayes(), jn.floor()]), r"^rule 0 of a chain is a list;" + RULE),
        (lambda: public.chain(jn.bayes(), KF), r"^rule 1 of a chain is a Filter;" + RULE),
    ],
    "switch": [
        (
            weighed(jn.switch(), jnp.array([[1.1, -0.1, 0], [0, 1, 0], [0, 0, 1]])),
            r"^the transition matrix has the entry -0\.1; none may be negative$",
        ),
        (
            weighed(jn.switch(), jnp.array([[0.9, 0.05, 0.05], [0.2] * 3, [0.2] * 3]).T),
            r"^row 1 of the transition matrix sums to 0\.45; each must sum to 1$",
        ),
    ],
    "penalty": [
        (
            weighed(jn.penalty(), jn.Penalty(exponent=jnp.nan)),
            r"^exponent of Penalty is nan; it must be in \(-inf, inf\)$",
        ),
    ],
    "windowed_reset": [
        (
            weighed(jn.windowed_reset(), jn.WindowedReset(0.9, 10)),
            r"^period of WindowedReset is 0\.9; it must be in \[1, inf\)$",
        ),
    ],
    "imm_params": [
        (lambda: jn.imm_params(ONE, jnp.eye(3)), r"^members\.model is one number; "),
        (lambda: jn.imm_params(MEMBERS, EYE), r"^the transition matrix is \(2, 2\); a bank of 3"),
        (lambda: public.imm_params(MEMBERS, [[1.0]]), r"^the transition matrix is a list; a bank"),
        (lambda: jn.imm_params((), EYE), r"^the members' parameters have no arrays"),
        (
            lambda: jn.imm_params(MEMBERS, jnp.eye(3), X),
            r"^log_prior is \(2,\); a bank of 3 members needs \(3,\)$",
        ),
    ],
    "uniform_switching": [
        (lambda: jn.uniform_switching(3, -0.1), r"^the probability to leave a model is -0\.1; "),
        (lambda: public.uniform_switching(0.1, 3), r"^count is 0\.1; it must be at least 1, and"),
        (lambda: jn.uniform_switching(0, 0.1), r"^count is 0; it must be at least 1, and whole$"),
        (lambda: public.uniform_switching(3, jnp.ones(3)), r"^the probab.* is an array \(3,\) of"),
    ],
    "run": [
        (lambda: public.run(ONE, KF, U, Z), r"^filter is a FilterParams; it must be a Filter"),
        (lambda: public.run(KF, ONE, Z, U), r"^observations is an array \(4, 1\) of float64; "),
        (filtered(None), r"^params is None; a single filter takes FilterParams"),
        (filtered(u=[[0.0]] * STEPS), r"^inputs has 0\.0 in it; every leaf needs a leading time"),
        (filtered(u=jnp.array(0.1)), r"^inputs has an array \(\) of float64 in it; every leaf"),
        (filtered(z=jn.Obs(W.T, W.T == 0)), r"^inputs and observations have \[2, 4\] steps; "),
        (
            filtered(z=Z._replace(z=W.astype(complex))),
            r"^observations\.z is of complex128; it must be of re",
        ),
        (
            lambda: public.run(KF, ONE, U, Z, record=lambda state: state),
            r"^record takes \(state\); it must be a function of \(state, info\)$",
        ),
    ],
    "negative_log_likelihood": [
        (lambda: public.negative_log_likelihood(jn.kf, ONE, U, Z), BUILDER),
        (lambda: public.negative_log_likelihood(KF, ONE, U, W), r"^observations is an array"),
        (
            lambda: jn.negative_log_likelihood(jn.panel(KF, {"a": jn.bayes()}), LONE, U, Z),
            r"^filter is a panel of a; it must be one filter or bank, which has one likelihood$",
        ),
    ],
    "simulate": [
        (simulated(model=KF), r"^model is a Filter; it must be a Model"),
        (simulated(model=P, params=MODEL), r"^model is an array \(\) of float64; it must be a Mo"),
        (simulated(params=ONE), r"^params is a FilterParams; simulate takes those of the mo"),
        (simulated(start=[0.0, 0.0]), r"^start is a list; it must be a state, as an array \(n,\)$"),
        (simulated(start=PRIOR), r"^start is a Gaussian; it must be a state"),
        (simulated(process_noise=KEY), r"^process_noise has an array \(\) of key<fry> in it; "),
        (simulated(process_noise=EYE), r"have \[2, 4\] steps; every leaf needs the same leading"),
        (simulated(process_noise=0.1), r"^process_noise is 0\.1; it must be an array$"),
        (simulated(process_noise=W[:, :1]), r"^process_noise is \(1,\) in a step; by the model"),
        (simulated(observation_noise=W[:, 0]), r"^observation_noise is \(\) in a step; by the mo"),
        (simulated(observation_noise=W[:, :1]), r"^observation_noise is \(1,\) in a step; by th"),
    ],
    "monte_carlo": [
        (lambda: public.monte_carlo(KF, KEY, 2), r"^run_one is a Filter; it must be a function"),
        (lambda: public.monte_carlo(jn.RunOutput(0.0), KEY, 2), r"^run_one is a RunOutput; it mus"),
        (lambda: public.monte_carlo(lambda key: 0, KEY, 2), r"^run_one takes \(key\); it must be"),
        (lambda: public.monte_carlo(a_run, 2, KEY), r"^key is 2; it must be one key, as jax"),
        (lambda: jn.monte_carlo(a_run, KEY, 2, MODEL), r"^shared\.transition is the function <lam"),
        (
            lambda: jn.monte_carlo(lambda key, shared: jn.RunOutput("a"), KEY, 2),
            r"^row of run_one is 'a'; " + NO_NUMBER,
        ),
    ],
    "fit": [
        (lambda: public.fit(1.0, lambda p: p), r"^loss is 1\.0; it must be a function$"),
        (lambda: public.fit(KF, 1.0), r"^loss is a Filter; it must be a function$"),
        (lambda: jn.fit(lambda p: p, -1.0), r"^the parameter is -1\.0; it must be positive and"),
        (lambda: jn.fit(lambda p: p, "a"), r"^start is 'a'; " + NO_NUMBER),
        (
            lambda: jn.fit(lambda p: p * X, 1.0),
            r"^loss returns an array \(2,\) of float64; it must",
        ),
        (lambda: public.fit(lambda p: None, 1.0), r"^loss returns None; it must return one float"),
        (lambda: jn.fit(lambda p: jnp.nan * p, 1.0), r"^the loss nan or its gradient is not fin"),
    ],
    "observing": [
        (lambda: public.observing(jn.Process, {"a": SEEN}), r"^process is the class Process; obs"),
        (lambda: public.observing(KF, {"a": SEEN}), r"^process is a Filter; observing takes a Pr"),
        (lambda: public.observing(PROCESS, SEEN), r"^the channels are a Channel; they must be a m"),
        (lambda: public.observing(PROCESS, {3: SEEN}), r"^the name of a channel is 3; it must be"),
        (
            lambda: public.observing(PROCESS, {"a": lambda x: x}),
            r"^channel 'a' is the function <lambda>; it must be a Channel$",
        ),
        (
            lambda: jn.observing(PROCESS, {"a": SEEN._replace(size=2.0)}),  # pyright: ignore[reportArgumentType]
            r"^the size of channel 'a' is 2\.0; it must be at least 1, and whole$",
        ),
        (
            lambda: jn.observing(MODEL, {"a": SEEN}),
            r"^process is a Model whose channels have no names; observing takes a Process",
        ),
        (
            filtered(filter=jn.ekf(SEEN_BY_NAME)),
            r"^the model's parameters are an array \(\) of float64; .* takes ModelParams\(process",
        ),
    ],
    "carrying": [
        (lambda: public.carrying(MODEL, CARRIED, period=0.1), r"^process is a Model; carrying ta"),
        (lambda: public.carrying(PROCESS, ["b"], period=0.1), r"^states is a list; it must be a"),
        (
            lambda: jn.carrying(PROCESS, CARRIED, period=-0.1),
            r"^period is -0\.1; it must be in \[0",
        ),
        (
            lambda: public.carrying(PROCESS, {"b": constant}, period=0.1),
            r"^the law of 'b' is the function constant; it must be a Law, as constant\(3\) is$",
        ),
        (
            lambda: public.carrying(PROCESS, {3: constant(1)}, period=0.1),
            r"^3 cannot be the name of a carried state",
        ),
    ],
    "with_carried": [
        (lambda: public.with_carried(ONE, {}), r"^initial is a FilterParams; it must be Gaussian"),
        (lambda: public.with_carried(PRIOR, [MEAN]), r"^states is a list; it must be a mapping of"),
        (lambda: public.with_carried(PRIOR, {"b": MEAN}), r"^'b' of states is an array \(1,\) of"),
        (lambda: public.with_carried(PRIOR, CARRIED), r"^'b' of states is a Law; it must be \(mea"),
        (
            lambda: jn.with_carried(PRIOR, {"b": (MEAN, -VARIANCE)}),
            r"^the variance of 'b' has the variance -1 at 0; none may be negative$",
        ),
        (
            lambda: public.with_carried(PRIOR, {"b": ("a", VARIANCE)}),
            r"^the mean of 'b' is 'a'; " + NO_NUMBER,
        ),
    ],
    "discretise": [
        (lambda: jn.discretise(EYE, None, EYE, -0.1), r"^dt is -0\.1; it must not be negative$"),
        (lambda: jn.discretise(EYE, None, EYE, jnp.nan), r"^dt is nan; it must not be negative$"),
        (lambda: public.discretise(EYE, None, EYE, "0.1"), r"^dt is '0\.1'; " + NO_NUMBER),
        (lambda: public.discretise(MODEL, None, EYE, 0.1), r"^F is a Model; " + NO_NUMBER),
        (lambda: public.discretise(EYE, None, None, 0.1), r"^Qc is None; " + NO_NUMBER),
        (lambda: jn.discretise(EYE, EYE[:1], EYE, 0.1), r"^G is \(1, 2\); with F \(2, 2\) it must"),
        (lambda: jn.discretise(X, None, EYE, 0.1), r"^F is \(2,\); it must be square, \(n, n\)$"),
    ],
    "oracle": [
        (lambda: public.oracle(jn.kf, lambda p, u: p), BUILDER),
        (lambda: public.oracle(KF, ONE), r"^informed is a FilterParams; it must be a function"),
        (
            lambda: public.oracle(KF, lambda p: p),
            r"^informed takes \(p\); it must be a function of",
        ),
        (
            filtered(filter=jn.oracle(KF, lambda params, u: params.model)),
            r"^informed returns an array \(\) of float64; it must return the filter's parameters",
        ),
        (
            filtered(None, filter=jn.oracle(KF, lambda params, u: params)),
            r"^params is None; an oracle's has the filter's prior, as FilterParams",
        ),
    ],
    "linearised_at_truth": [
        (lambda: public.linearised_at_truth(KF, lambda u: (u, u)), r"^model is a Filter; it must"),
        (
            lambda: public.linearised_at_truth(MODEL, PAIR),
            r"^truth is an array \(4, 2\) of float64",
        ),
        (
            filtered(filter=public.linearised_at_truth(MODEL, lambda u: u), u=PAIR),
            r"^truth returns an array \(2,\) of float64; it must return two states, at the start",
        ),
        (
            filtered(filter=jn.linearised_at_truth(MODEL, lambda u: (u, u))),
            r"^truth returns states \(1,\); they must be \(2,\), as the filter's$",
        ),
    ],
    "observed": [
        (lambda: public.observed([[1.0, 2.0]]), r"^z is a list; it must be an array$"),
        (lambda: public.observed(Z), r"^z is an Obs; it must be an array$"),
        (
            lambda: jn.observed(W.astype(complex)),
            r"^z is of complex128; it must be of real numbers$",
        ),
    ],
    "replicate": [
        (lambda: public.replicate(3, ONE), r"^count is a FilterParams; it must be at least 1, and"),
        (lambda: jn.replicate(ONE, 0), r"^count is 0; it must be at least 1, and whole$"),
        (lambda: public.replicate(ONE, 2.5), r"^count is 2\.5; it must be at least 1, and whole$"),
        (lambda: jn.replicate(KF, 3), r"^params\.init is the function init; " + NO_NUMBER),
    ],
}


def every() -> dict[str, list[Case]]:
    found: dict[str, list[Case]] = {name: list(cases) for name, cases in OWN.items()}
    kinds = {of_a_filter: FILTERS, of_a_wrapper: WRAPPERS, of_a_bank: BANKS, of_a_rule: RULES}
    shared = ((name, case) for of, names in kinds.items() for name in names for case in of(name))
    for name, case in chain(shared, of_keywords()):
        found.setdefault(name, []).append(case)
    return found


CASES = every()


@pytest.mark.parametrize(
    ("name", "place"), [(name, i) for name, cases in CASES.items() for i in range(len(cases))]
)
def test_a_misuse_ends_in_one_sentence_that_names_the_argument(name: str, place: int) -> None:
    call, sentence = CASES[name][place]
    # JAX leaves a note, on lines of its own, where the error came through it.
    with pytest.raises(ValueError, match=re.compile(sentence, re.MULTILINE)) as caught:
        call()
    message = str(caught.value)
    assert "\n" not in message
    assert not INSIDE.search(message.replace("NoneType", "")), message


def test_every_public_function_has_two_misuses_or_more() -> None:
    functions = {name for name in jn.__all__ if inspect.isfunction(getattr(jn, name))}
    assert set(CASES) == functions
    assert not {name: len(CASES[name]) for name in functions if len(CASES[name]) < 2}
