"""One job: build the problem from its recipe, and run the local phase from one start, or identify it whole."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from sysid import catalogue
from sysid.assessment.checks.context import Context
from sysid.assessment.checks.gains import gain_errors
from sysid.assessment.sensitivity import sensitivity
from sysid.errors import InputError, SolverError
from sysid.identify import identify
from sysid.jobs.changes import Change, NumberOfModes, drawn, drawn_from
from sysid.jobs.score import Score, scored
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.nlp import one_thread
from sysid.problem.prepared import Prepared
from sysid.problem.problem import Problem
from sysid.problem.terms import TestTerm
from sysid.results.identification import Identification, Recipe
from sysid.results.judgement import judge, verdict_of
from sysid.search.auto import robust_fit, within_tolerances
from sysid.search.continuation import Continuation, descend, random_starts, smoothed_tests
from sysid.search.modal import fit_records_as_asked
from sysid.search.session import DeferredInterrupt, Session
from sysid.search.strategy import History, Outcome, as_unknowns
from sysid.structure.structure import Array

_BUILT = 4  # problems that a worker keeps


@dataclass(frozen=True)
class Job:
    """Description of a job for a worker."""

    index: int  # among all jobs that were submitted together
    recipe: Recipe
    start: int  # 0 is the recipe's own where it has one; all others are fresh points of the search space
    source: str  # tells what one problem is made from, from another's
    draw: int = 0  # of noise, from 1, fitted from the recipe's start. 0 fits the records themselves
    strategy: str = ""  # by which the problem is identified whole; empty for the local phase alone
    change: Change | None = None  # of the problem that is identified whole

    @property
    def seed(self) -> int:
        """Of the fresh point or the noise: the recipe's and the number of the start or the draw make it.

        Of a whole identification of the records themselves it is the recipe's.
        """
        if self.strategy and not self.draw:
            return self.recipe.rng
        key = (self.start, self.draw) if self.draw else (self.start,)
        return int(np.random.SeedSequence(self.recipe.rng, spawn_key=key).generate_state(1, np.uint64)[0] >> 1)


@dataclass(frozen=True, eq=False)
class JobResult:
    """Result of a job.

    Attributes
    ----------
    index : int
        Of the job: recipe by recipe, start by start.
    seed : int
        Of the start, where it was a fresh point, of the noise that was drawn, or of a whole identification.
    success : bool
        The solver's status is good, the residual meets the problem's goal, or is within the noise where none is given,
        and a whole identification is of more numbers than parameters.
    message : str
        The solver's status, or why there is no result.
    x : (n_variables,)
        The unknowns; empty where there is no result, and where a whole identification chose other degrees of freedom.
    residual : float
        Relative residual of all fitted tests; NaN where there is no result.
    score : Score or None
        Of a whole identification.
    """

    index: int
    seed: int
    success: bool
    message: str
    x: Array
    residual: float
    score: Score | None = None

    @property
    def has_result(self) -> bool:
        """True where it came to anything, a fit or not."""
        return self.x.size > 0 or self.score is not None


def run(job: Job) -> JobResult:
    """Run a job where it stands; the same bits wherever that is on one kind of machine."""
    interrupt = DeferredInterrupt()
    try:
        with one_thread(), interrupt:
            session = Session([], interrupt)
            result = _identified(job, session) if job.strategy else _refined(job, session)
            interrupt.check()
            return result
    except Exception as error:  # whatever one start leads to, all others go on
        interrupt.check()  # what a search that Ctrl-C stopped before its first fit raises is no result of the job
        ours = isinstance(error, InputError | SolverError)
        return without_result(job, str(error) if ours else f"{type(error).__name__}: {error}")


def without_result(job: Job, why: str) -> JobResult:
    """Result of a job that came to nothing."""
    return JobResult(job.index, job.seed, False, why, np.zeros(0), float("nan"))


def _identified(job: Job, session: Session) -> JobResult:
    """The result of a whole identification.

    A change of a problem whose matrices do not follow from modes is fitted from the recipe's start, where there is one.
    """
    problem = _built(replace(job.recipe, start=None), job.source)
    changed = problem if job.change is None else job.change.of(problem)
    from_start = job.change is not None and job.strategy == "auto" and not changed.declared.free_modes
    if job.recipe.start is not None and from_start:
        prepared = changed.prepared
        x = as_unknowns(prepared, np.array(job.recipe.start))
        prepared, end = _descended(prepared, x, [], session)
        result = judge(changed, prepared, end, "from the result's unknowns", job.seed, session)
    else:
        there = changed.measurement.sensor_names
        asked = replace(job.recipe, sensors=tuple(name for name in job.recipe.sensors if name in there))
        if isinstance(job.change, NumberOfModes):
            asked = replace(asked, modes=job.change.count)
        if job.draw:
            answer = _answer(asked, job.source, job.strategy)
            asked = replace(asked, modes=answer.structure.n)
            changed = drawn_from(answer, np.random.SeedSequence(job.seed))
        result = identify(changed, strategy=asked.strategy(job.strategy), rng=job.seed)
        if result.interrupted:
            raise KeyboardInterrupt
    score = scored(result, None if job.change is None else _predicted(problem, result, job.change))
    success, message = result.success, "; ".join((*map(str, result.contradictions), result.message))
    if score.numbers <= score.parameters:
        success = False
        message = f"{message}; {score.numbers} numbers of the records do not suffice for {score.parameters} parameters"
    x = np.zeros(0) if result.x is None else result.x
    return JobResult(job.index, job.seed, success, message, x, result.residual, score)


def _predicted(problem: Problem, result: Identification, change: Change) -> float | None:
    """Residual of what was left out, predicted by the rest; NaN where the rest does not tell all of the whole test."""
    x = result.x
    if x is not None and not problem.declared.free_modes:
        part, whole = (sensitivity(one.formulation, x, priors=False).rank for one in (result.problem, problem))
        if part < whole:
            return np.nan
    try:
        return change.predicted(problem.prepared.screened, result)  # whose residual is of such records too
    except InputError:  # such as a base that does not move outside a band
        return np.nan


def _refined(job: Job, session: Session) -> JobResult:
    bare = replace(job.recipe, start=None)
    problem = _prepared(bare, job.source)
    from_recipe = job.start == 0 and job.recipe.start is not None
    if from_recipe:
        x = as_unknowns(problem, np.array(job.recipe.start))
        if job.draw:
            if any(one.calibration is not None for one in problem.modal):
                problem, _ = _descended(problem, x, [], session)  # without errors of gains
            # Noise of the size that counts: there are no outliers in it, so that squares are as good.
            fitted = problem if problem.in_squares else problem.pseudo_values(problem.structure(x), x)
            problem = _as_asked(Prepared(drawn(fitted, x, np.random.SeedSequence(job.seed))), bare)
    else:
        found = random_starts(problem, 1, np.random.SeedSequence(job.seed))
        if not found:
            return without_result(job, "no point of the search space is a structure; state guesses that make one")
        x = found[0]
    # What ended a search needs no widened peaks.
    problem, end = _descended(problem, x, [] if from_recipe else _widened(bare, job.source), session)
    assert end.x is not None
    verdict = verdict_of(Context(problem, end))
    return JobResult(job.index, job.seed, verdict.success, verdict.message, end.x, problem.residual(end.x))


def _descended(
    problem: Prepared, x: Array, steps: list[tuple[TestTerm, ...]], session: Session
) -> tuple[Prepared, Outcome]:
    """Where the local phase ends from `x`, and of what problem: without errors of gains within tolerances."""
    answer = descend(problem.screened, x, steps, session)
    if answer.stopped is not None:
        raise answer.stopped
    structure = problem.structure(answer.x)
    end = Outcome(structure, answer.x, "local phase", answer.success, answer.message, History(), None)
    problem, end = within_tolerances(problem, end, Continuation(), session, gain_errors)
    end = robust_fit(problem, end, Continuation(), session)
    if end.stopped is not None:
        raise end.stopped
    return problem, end


@lru_cache(maxsize=_BUILT)
def _answer(recipe: Recipe, source: str, strategy: str) -> Identification:
    """The answer of a recipe, about which noise is drawn, once a worker."""
    return identify(_built(recipe, source), strategy=recipe.strategy(strategy), rng=recipe.rng)


@lru_cache(maxsize=_BUILT)
def _prepared(recipe: Recipe, source: str) -> Prepared:
    """The problem with the modes of its records that the recipe asks for, once a worker."""
    return _as_asked(_built(recipe, source).prepared, recipe)


def _as_asked(problem: Prepared, recipe: Recipe) -> Prepared:
    """The problem, where its matrices follow from modes with those that a recipe asks for, as its identification."""
    if recipe.modal.refusal(problem, None) is None:
        fit_records_as_asked(problem, recipe.modal, nullcontext(FitMonitor()))
    return problem


@lru_cache(maxsize=_BUILT)
def _built(recipe: Recipe, source: str) -> Problem:
    """The problem, once a worker."""
    return catalogue.build(recipe)


@lru_cache(maxsize=_BUILT)
def _widened(recipe: Recipe, source: str) -> list[tuple[TestTerm, ...]]:
    """Its tests with widened peaks, step by step, once a worker."""
    problem = _built(recipe, source).prepared
    return [] if problem.free_modes else smoothed_tests(problem).steps
