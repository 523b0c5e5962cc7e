"""Judgement of where a search ended: success, what is determined, and what the user should know, in sentences."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sysid.assessment.bounds import bounds_in_words, on_bounds, pressed_in_words, pressure
from sysid.assessment.checks import contradictions, doubts
from sysid.assessment.determination import BY_RANK, determine
from sysid.assessment.gains import assumed, rests_on, taken_at_sensors
from sysid.assessment.model_error import Miss, levels_in_words, missed_in_words, misses_of, model_errors
from sysid.assessment.sensitivity import blocks_of
from sysid.assessment.uncertainty import LARGE
from sysid.measurement.missing import in_words
from sysid.nlp import EXACT
from sysid.problem.problem import Problem
from sysid.results.answer import NOT_JUDGED
from sysid.results.identification import Identification
from sysid.results.noise_table import noise_in_words
from sysid.search.deadline import TimeIsOver, within
from sysid.search.other_answers import with_other_answers
from sysid.search.session import Session
from sysid.search.strategy import HUBER, Outcome

_KNOWN = 0.1  # of the root of two diagonal entries; an entry with a larger standard deviation is not known
_OUTLIERS = "if they are spikes or drop-outs, state Problem(..., loss='huber'), or leave these lines out"
_NO_FIT = 0.5  # relative residual above which nothing is explained
_NO_END = "the search ended before it found a fit ({}): these matrices are no more than the best until then"
_CONVENTIONS = (
    "are the frequencies in Hz, the responses absolute and complex with exp(+iwt), the axes and signs of rigid_body "
    "right, the bounds wide enough?"
)
_SCALE = (
    "without a base force or a mass in kg their scale is not determined, and masses are normalised to 1 kg in each "
    "base direction, which the bounds of the stiffness may exclude: state total_mass, or give the base force"
)


class Verdict(NamedTuple):
    """Whether where a search ended is a fit.

    Attributes
    ----------
    fits : bool
        The solver succeeded, constraints hold, and the residual is within the goal, or of any use without one.
    wrong : tuple of str
        Why it is no success, in sentences.
    message : str
        These, and what the solver says.
    misses : list of Miss
        What the model leaves of each record, in units of its noise.
    """

    fits: bool
    wrong: tuple[str, ...]
    message: str
    misses: list[Miss]

    @property
    def success(self) -> bool:
        """It fits, and, without a goal, within the noise of the records."""
        return self.fits and not self.wrong


def judge(problem: Problem, end: Outcome, why: str, seed: int, session: Session) -> Identification:
    """Judge where a search ended: `why` tells why its strategy was taken, the session has its log and clock."""
    cut_short, records = session.cut_short, problem.screened
    verdict = verdict_of(problem, end, cut_short=cut_short)
    session.log(f"done: {verdict.message}")
    # What was stopped on its way has misfits of another kind.
    judged = end.stopped is None and (end.success or (problem.free_modes and not cut_short))
    closed_by: tuple[str, ...] = ()
    against = Against((*end.mistakes, *verdict.wrong))
    open_: tuple[str, ...] = ()
    try:
        with within(session.left):
            known = determine(records, end.structure, end.x, end.alternatives)
            against = _against(problem, end, verdict) if judged else against
            open_, closed_by = known.undetermined, known.closed_by
        if verdict.success and known.judged_by == BY_RANK and not (open_ or against.sentences):
            end, unknown = with_other_answers(problem, end, session)
            with within(session.left):
                others = determine(records, end.structure, end.x, end.alternatives).undetermined
            open_ = (*unknown, *others)
    except TimeIsOver:
        open_ = (NOT_JUDGED,)
    ended = () if end.success else (_NO_END.format(end.message),)
    first = ended if end.stopped is not None else ()  # what was stopped is no fit for that alone
    speak = tuple(dict.fromkeys((*end.mistakes, *first, *against.sentences, *ended)))
    open_ = tuple(dict.fromkeys((*speak, *open_)))
    it = Identification(
        structure=end.structure,
        problem=problem,
        x=end.x,
        strategy=end.strategy,
        seed=seed,
        success=verdict.success,
        message=end.message,
        history=replace(end.history, log=tuple(session.lines), wall_time=session.seconds),
        determined=not open_,
        closed_by=() if open_ else closed_by,
        undetermined=open_,
        remarks=(
            why,
            *end.remarks,
            *_remarks(problem, end, told_of_bounds=against.on_bounds),
            *(() if open_ else assumed(problem)),
        ),
        interrupted=isinstance(end.stopped, KeyboardInterrupt),
        against=speak,
        changing=against.changing,
    )
    try:
        with within(session.left):
            return _as_certain(it)
    except TimeIsOver:
        return replace(it, determined=False, closed_by=(), undetermined=(*it.against, NOT_JUDGED))


class Against(NamedTuple):
    """What speaks against an answer, in sentences, the weightiest first.

    Attributes
    ----------
    sentences : tuple of str
    changing : bool
        Frequencies change.
    on_bounds : bool
        Unknowns on bounds are the first of them.
    """

    sentences: tuple[str, ...]
    changing: bool = False
    on_bounds: bool = False


def _against(problem: Problem, end: Outcome, verdict: Verdict) -> Against:
    """What speaks against an answer, likely causes first; a mistake that is named explains what else does."""
    averaged = problem.screened.measurement.averaged
    if end.mistakes:
        further = doubts(problem.screened, end.structure, end.x) if averaged else ()
        return Against((*end.mistakes, *verdict.wrong, *end.doubts, *further))
    errors = model_errors(problem, end.structure, verdict.misses)
    further = (*end.doubts, *doubts(problem.screened, end.structure, end.x, changing=errors.changing))
    found = on_bounds(problem.screened, end.structure, end.x)
    press = pressure(problem.screened, end.structure, end.x, found)
    if press.explains or (press.significant and not (verdict.wrong or errors.sentences or further)):
        # Whatever else a misfit speaks against may be right once the bounds are wider.
        told_first = (pressed_in_words(found), *verdict.wrong, *errors.sentences)
        return Against(tuple(dict.fromkeys(told_first)), errors.changing, on_bounds=True)
    if errors.changing:
        return Against((*errors.sentences, *verdict.wrong, *further), changing=True)
    stated = contradictions(problem.screened, end.structure)
    return Against(tuple(dict.fromkeys((*stated, *verdict.wrong, *errors.sentences, *further))))


def verdict_of(problem: Problem, end: Outcome, *, cut_short: bool = False) -> Verdict:
    """Whether where a search ended is a fit; `cut_short` by its time it is blamed on nothing else."""
    records, goal, wrong = problem.screened, problem.goal, []
    test = records.measurement
    residual = test.residual(end.structure) if end.x is None or problem.free_modes else records.residual(end.x)
    if end.x is not None and end.success and not records.keeps_constraints(end.x):
        wrong.append("a constraint does not hold")
    if goal is not None and residual > goal:
        wrong.append(f"the residual {residual:.3g} is above the goal {goal:.3g}")
    if goal is None and residual > _NO_FIT and end.stopped is None and (end.success or not cut_short):
        scaled = problem.unit_mass and not problem.formulation.stiffness.free
        wrong.append(f"the residual {residual:.3g} is no fit: {_SCALE if scaled else _CONVENTIONS}")
    fits = end.success and not wrong
    misses = misses_of(problem, end.structure, end.x) if end.stopped is None else []
    if goal is None:
        wrong += missed_in_words(misses)
    # What the solver says stands first where it did not succeed, else last.
    told = (*wrong, end.message) if end.success else (end.message, *wrong)
    return Verdict(fits, tuple(wrong), "; ".join(told), misses)


def _remarks(problem: Problem, end: Outcome, *, told_of_bounds: bool) -> Iterator[str]:
    """What the user should know of the unknowns and of the misfit."""
    formulation = problem.formulation
    found = on_bounds(problem.screened, end.structure, end.x)
    yield from (
        f"on a bound, beyond which the truth may lie: {bounds_in_words(found)}" for _ in found[:1] if not told_of_bounds
    )
    if any(phase.name == "swarm" for phase in end.history.phases):  # other strategies search all between the bounds
        yield from (unknown.note for unknown in formulation.unknowns if unknown.note)
    yield from taken_at_sensors(problem)
    yield from levels_in_words(problem)
    # Not `formulation.tests`: the term of the problem's own test has matrices that the modal strategy has no use for.
    own = [problem.measurement] if formulation.fits_records else []
    tests = [*own, *(term.test for term in formulation.further_tests)]
    for i, test in enumerate(tests, start=problem.first_test):
        if test.dropped:
            where = f" ({in_words(test.holes, test.freq)})" if test.holes else ""
            which = "" if len(tests) == 1 else f" of test {i}"
            yield f"{test.dropped} lines at which a record holds NaN are left out{which} for all channels alike{where}"
    for test, _ in problem.fits(end.structure, end.x):
        yield from noise_in_words(test)
    yield from _outliers(problem, end)
    if not formulation.fits_records:
        yield "the problem states a misfit of its own; pictures and scores compare with the records as they are"
    if not formulation.tells_damping:
        yield "no damping ratio is identified: no unknown of the damping alone enters what is fitted"


def _outliers(problem: Problem, end: Outcome) -> Iterator[str]:
    """Which numbers of the records are far from the fit: all where they count little, else those that stand alone."""
    every = problem.outliers(end.structure, end.x)
    if problem.loss == "squares":
        what = f", while the lines beside them fit: {_OUTLIERS}"
    elif any(phase.name == HUBER for phase in end.history.phases):
        what = ": they count little, by Huber's loss"
    else:
        what = (
            ": the search ended before Huber's loss, so they count in full; those that stand alone were left out from "
            "the beginning"
        )
    tests = sorted({one.test for one in every})
    fits = {i: test for i, (test, _) in enumerate(problem.fits(end.structure, end.x), start=problem.first_test)}
    for i in tests:
        found, test = [one for one in every if one.test == i], fits[i]
        which = "the records" if len(fits) == 1 else f"test {i}"
        channels = ", ".join(f"{name} {count}" for name, count in Counter(one.channel for one in found).most_common(4))
        yield (
            f"{len(found)} of {test.numbers} numbers of {which} are up to {found[0].size:.3g} deviations from the fit "
            f"({found[0].channel} at {found[0].freq:.5g} Hz; by channel {channels}){what}"
        )


def _as_certain(it: Identification) -> Identification:
    """Call the matrices not determined where noise leaves entries open that are fixed without it.

    Null directions of exact records are closed by their noise, and show as large standard deviations only.
    """
    exact = max(it.residual, it.force_residual or 0.0) < EXACT
    if it.x is not None and not it.problem.free_modes:
        # A further test may be noisy, and what is stated as known always is.
        exact = exact and not it.problem.formulation.priors and it.problem.objective(it.x) < EXACT
    if not it.determined or exact:
        return it
    if it.structure.mode_shapes.size > LARGE:
        told = "whether noise leaves each entry known was not judged, as that takes minutes: see uncertainty"
        return replace(it, remarks=(*it.remarks, told))
    u, open_ = it.uncertainty, []
    stds = (u.mass, u.stiffness, u.damping)
    for name, matrix, std in zip(("M_SS", "K_SS", "C"), blocks_of(it.structure), stds, strict=True):
        size = np.sqrt(np.diag(matrix))
        size[size == 0] = max(size.max(), np.finfo(float).tiny)  # a degree of freedom without a damper
        largest = np.max(std / np.outer(size, size))
        if np.isnan(largest):
            open_.append(f"noise leaves entries of {name} open")
        elif largest > _KNOWN:
            open_.append(f"noise leaves entries of {name} with standard deviations up to {100 * largest:.2g} %")
    return replace(it, determined=False, closed_by=(), undetermined=tuple(open_)) if open_ else _with_gains(it)


def _with_gains(it: Identification) -> Identification:
    """Add the gains that what is determined rests on more closely than the records show them."""
    if not it.problem.formulation.fits_records:
        return it
    told = rests_on(it.problem.screened.measurement, it.gains, it.gain_worth)
    return replace(it, remarks=(*it.remarks, *told))
