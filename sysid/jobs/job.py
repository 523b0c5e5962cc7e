"""One refinement job: build the problem from its recipe, and run the local phase from one start."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from sysid import catalogue
from sysid.errors import InputError, SolverError
from sysid.jobs.draws import drawn
from sysid.nlp import one_thread
from sysid.problem.problem import Problem
from sysid.problem.terms import TestTerm
from sysid.results.identification import Recipe
from sysid.results.judgement import succeeded
from sysid.search.continuation import Continuation, descend, random_starts, smoothed_tests
from sysid.search.robust import settled
from sysid.search.session import DeferredInterrupt, Session
from sysid.search.strategy import History, Outcome, as_unknowns
from sysid.structure.structure import Array

_BUILT = 4  # problems that a worker keeps


@dataclass(frozen=True)
class Job:
    """What a worker needs.

    Attributes
    ----------
    index : int
        Among all jobs that were submitted together.
    recipe : Recipe
    start : int
        0 is the recipe's own start where it has one; all others are fresh points of the search space.
    source : str
        Tells one text of the problem module from another.
    draw : int
        Of noise, by number from 1; the job then starts where the recipe does. 0 fits the records themselves.
    """

    index: int
    recipe: Recipe
    start: int
    source: str
    draw: int = 0

    @property
    def seed(self) -> int:
        """Of the fresh point or the noise: the recipe's and the number of the start or the draw make it."""
        key = (self.start, self.draw) if self.draw else (self.start,)
        return int(np.random.SeedSequence(self.recipe.rng, spawn_key=key).generate_state(1, np.uint64)[0] >> 1)


@dataclass(frozen=True, eq=False)
class JobResult:
    """How a job ended.

    Attributes
    ----------
    index : int
        Of the job: recipe by recipe, start by start.
    seed : int
        Of the start, where it was a fresh point, or of the noise that was drawn.
    success : bool
        The solver's status is good and the residual meets the problem's goal, or is a fit at all where none is given.
    message : str
        The solver's status, or why there is no result.
    x : (n_variables,)
        The unknowns; empty where there is no result.
    residual : float
        Relative residual of all fitted tests; NaN where there is no result.
    """

    index: int
    seed: int
    success: bool
    message: str
    x: Array
    residual: float


def run(job: Job) -> JobResult:
    """Run a job where it stands; the same bits wherever that is on one kind of machine."""
    try:
        with one_thread(), DeferredInterrupt() as interrupt:
            result = _refined(job, Session([], interrupt))
            interrupt.check()
            return result
    except (InputError, SolverError) as error:
        return without_result(job, str(error))
    except Exception as error:  # whatever one start leads to, all others go on
        return without_result(job, f"{type(error).__name__}: {error}")


def without_result(job: Job, why: str) -> JobResult:
    """What stands for a job that came to nothing."""
    return JobResult(job.index, job.seed, False, why, np.zeros(0), float("nan"))


def _refined(job: Job, session: Session) -> JobResult:
    problem, steps = _built(replace(job.recipe, start=None), job.source)
    own = job.start == 0 and job.recipe.start is not None
    if own:
        x = as_unknowns(problem, np.array(job.recipe.start))
        if job.draw:
            # Noise of the size that counts: there are no outliers in it, so that squares are as good.
            fitted = problem if problem.loss == "squares" else problem.pseudo_values(problem.structure(x), x)
            problem = drawn(fitted, x, np.random.SeedSequence(job.seed))
    else:
        found = random_starts(problem, 1, np.random.SeedSequence(job.seed))
        if not found:
            return without_result(job, "no point of the search space is a structure; state guesses that make one")
        x = found[0]
    # What ended a search needs no widened peaks.
    answer = descend(problem.screened, x, [] if own else steps, session)
    if answer.stopped is not None:
        raise answer.stopped
    end = Outcome(problem.structure(answer.x), answer.x, "local phase", answer.success, answer.message, History(), None)
    end = settled(problem, end, Continuation(), session)
    if end.stopped is not None:
        raise end.stopped
    success, message = succeeded(problem.screened, end)
    assert end.x is not None
    return JobResult(job.index, job.seed, success, message, end.x, problem.residual(end.x))


@lru_cache(maxsize=_BUILT)
def _built(recipe: Recipe, source: str) -> tuple[Problem, list[tuple[TestTerm, ...]]]:
    """The problem and its tests with widened peaks, once a worker."""
    problem = catalogue.build(recipe)
    smoother = None if problem.free_modes else smoothed_tests(problem)
    return problem, [] if smoother is None else smoother.steps
