"""Structures that change during a test, and measured ones: whether they are told to, and linear ones are not."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

import sysid
from benchmarks.line import Line, above, below
from benchmarks.mistakes.changing import (
    SECONDS,
    SOFTENING,
    at_rest,
    measured,
    motion,
    noisy,
    of_lines,
    response,
    tuned_mass,
)
from benchmarks.modal.spread import spread
from benchmarks.problem_modules import load_module
from benchmarks.swarm.shake_table import ABSENT, EVENTS, records_folder

GROWS, RUNS, ALONG = "as the motion grows", "differs from record to record", "changes along the records"
MISSED = r"the model misses the accelerations by (?:at least )?[\d.]+ times their noise"
CHANGES = "|".join((GROWS, RUNS, ALONG))
TOLD = {  # what a structure of each kind may be told to do; a level that grows along a record is told either way
    "level along": (GROWS, ALONG), "level of a test": (GROWS, RUNS), "drift": (ALONG,), "runs": (RUNS,),
}  # fmt: skip
FORMS = {"full": lambda: sysid.FullMass(), "stated masses": lambda: np.diag([2.0, 1.0, 0.0])}
SHARE = 0.95
SEEDS = {
    "level along": 11,
    "level of a test": 15,
    "drift": 5,
    "runs": 4,
    "linear": 6,
    "wrong": 5,
    "wrong, at rest": 14,
    "tuned mass": 10,
}  # of all draws of a kind


class Case(NamedTuple):
    """A kind of change, a form of the mass, and the draw.

    Linear are "linear", "wrong" (with wrong masses), "wrong, at rest" (the same, as plain spectra of runs of two
    lengths) and "tuned mass" (a mode more than sensors can tell, near another of its shape).
    """

    kind: str
    form: str
    seed: int


def lines(reduced: bool) -> Iterator[Line]:
    """Ten draws of each kind and form, twenty linear ones; reduced, one of each; and the measured frame."""
    forms = [*FORMS][: 1 if reduced else None]
    changing = [Case(kind, form, s) for kind in TOLD for form in forms for s in range(1 if reduced else 10)]
    linear = [Case("linear", form, seed) for form in forms for seed in range(1 if reduced else 20)]
    others = [
        Case(kind, "stated masses", seed)
        for kind in ("wrong", "wrong, at rest", "tuned mass")
        for seed in range(1 if reduced else 10)
    ]
    every = [*changing, *linear, *others]
    told = dict(zip(every, spread(said, every), strict=True))
    shown = lambda some: "".join(f"; {one.form}, draw {one.seed}: {told[one][:200]!r}" for one in some[:3])  # noqa: E731
    for kind, words in TOLD.items():
        cases = [case for case in changing if case.kind == kind]
        missed = [case for case in cases if not re.search("|".join(words), told[case])]
        yield above(f"{kind}: of {len(cases)} told so{shown(missed)}", 1 - len(missed) / len(cases), SHARE)
    for what, cases, accuses in (
        ("linear structures", linear, f"{MISSED}|{CHANGES}"), ("linear, wrong masses or a tuned mass", others, CHANGES),
    ):  # fmt: skip
        accused = [case for case in cases if re.search(accuses, told[case])]
        yield below(f"{what}, of {len(cases)}: accused{shown(accused)}", len(accused), 0)
    yield from _frame(reduced)


def said(case: Case) -> str:
    """All that is said against the answer."""
    rng = np.random.default_rng((case.seed, SEEDS[case.kind]))
    first, second = motion(rng), motion(rng)
    unseen: list[sysid.Measurement] = []
    estimator = "records"
    if case.kind == "level along":
        base = first * np.interp(np.arange(first.size), [0, first.size - 1], [0.2, 2.0])
        runs = [noisy(rng, base, response(base, softening=SOFTENING))]
    elif case.kind == "level of a test":
        small, large = 0.2 * first, 2 * second
        runs = [noisy(rng, small, response(small, softening=SOFTENING))]
        unseen = [measured(noisy(rng, large, response(large, softening=SOFTENING)))]
    elif case.kind == "drift":
        runs = [noisy(rng, first, response(first, lambda t: 1 - 0.06 * t / SECONDS))]
    elif case.kind == "runs":
        runs = [noisy(rng, first, response(first)), noisy(rng, second, response(second, lambda t: 0.94))]
    elif case.kind == "tuned mass":
        runs = [noisy(rng, first, of_lines(tuned_mass(float(rng.uniform(0.001, 0.01))), first[None])[:2])]
    elif case.kind == "wrong, at rest":
        estimator = "spectra"
        first, second = (at_rest(base) for base in (first, second[: int(0.9 * second.size)]))
        runs = [noisy(rng, first, response(first), 0.005), noisy(rng, 2 * second, response(2 * second), 0.005)]
    else:
        runs = [noisy(rng, first, response(first)), noisy(rng, 2 * second, response(2 * second))]
    masses = np.diag([2.0, 2.0, 0.0]) if case.kind.startswith("wrong") else FORMS[case.form]()
    try:
        result = sysid.identify(
            sysid.Problem(measured(*runs, estimator=estimator), mass=masses, validation=unseen), rng=0
        )
    except (sysid.InputError, sysid.SolverError) as error:
        return str(error)
    return "; ".join(result.confidence)


def _frame(reduced: bool) -> Iterator[Line]:
    """The measured frame, fitted on either event, reduced on one: what its first two sentences say."""
    data = records_folder()
    if data is None:
        yield ABSENT
        return
    module = load_module("mini_shake_table")
    problem = module.problem(data=str(data))
    for estimator in ("spectra",) if reduced else ("spectra", "records"):
        events = [module.event(data / name, estimator) for name in EVENTS]
        pairs = [(EVENTS[0], *events), (EVENTS[1], *events[::-1])]
        for name, fitted, unseen in pairs[: 1 if reduced else None]:
            given = sysid.Problem(
                fitted, mass=problem.mass, stiffness=problem.stiffness, damping=problem.damping, validation=[unseen]
            )
            result = sysid.identify(given, rng=0)
            first = result.confidence[:2]
            told = not result.success and all(
                any(re.search(words, one) for one in first) for words in (MISSED, "falls as the motion grows")
            )
            figures = ", ".join(re.findall(r"[\d.]+ times|[\d.]+ Hz at", "".join(first)))
            yield Line(f"{name} as {estimator}: missed by times the noise, softens", figures, "both first", bool(told))
