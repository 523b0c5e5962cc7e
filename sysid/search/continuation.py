"""Strategy "continuation": from wide peaks, step by step, to the records themselves, for structured problems."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from numpy.typing import ArrayLike

from sysid.errors import InputError, SolverError
from sysid.modal_analysis.complex_frequency import PolesAndResidues, Smoothed
from sysid.nlp import EXACT
from sysid.problem.feasibility import spread
from sysid.problem.problem import Problem
from sysid.search import local
from sysid.search.local import LocalResult
from sysid.search.session import Desk, Stop
from sysid.search.strategy import History, Outcome, as_unknowns
from sysid.structure.structure import Array, Structure

SHIFTS = (0.5, 0.2, 0.08, 0.03, 0.01)  # of the geometric mean of the natural frequencies
_DRAWN = 20  # points looked at for each that is a structure
_STEPS = 60  # iterations of a fit on the way
_NEAR = 1.1  # times the misfit of free residues at the poles of the data: what a structure may leave
_CHANCE = 1e-3  # that noise alone makes the misfit of one of two answers so much larger
_APART = 0.01  # of an unknown's size, from which two solutions are two ...
_TOGETHER = 1e-3  # ... and up to which two ways are one


@dataclass(frozen=True)
class Continuation:
    """Strategy "continuation", with its settings.

    The misfit of a lightly damped structure has minima as narrow as its peaks. So each search begins with the
    responses at complex frequencies, where the peaks are wide, and takes smaller and smaller shifts to the records
    themselves; IPOPT with exact derivatives does each step.

    Parameters
    ----------
    starts : int
        Where searches begin: at the guess, and at so many less one points spread over the search space. Several also
        show whether another structure explains the data as well.
    """

    starts: int = 3


def tests_of(problem: Problem) -> list[PolesAndResidues] | None:
    """What stands for each test at complex frequencies; None where one shows no poles or the misfit is an own one."""
    formulation = problem.formulation
    if formulation.misfit is not None:
        return None
    found = [PolesAndResidues.of(test) for test in (problem.measurement, *(test for test, _ in formulation.others))]
    known = [poles for poles in found if poles is not None]
    return known if len(known) == len(found) else None


def levels_of(problem: Problem, tests: list[PolesAndResidues]) -> list[tuple[Smoothed, ...]]:
    """The problem's own test and its further ones, with smaller and smaller shifts."""
    records = (problem.measurement, *(test for test, _ in problem.formulation.others))
    return [tuple(poles.smoothed(test, share) for poles, test in zip(tests, records, strict=True)) for share in SHIFTS]


def smooth_fit(
    problem: Problem,
    x: Array,
    steps: list[tuple[Smoothed, ...]],
    *,
    left: Callable[[], float | None],
    monitor: Callable[[int, float], object] | None = None,
) -> LocalResult | None:
    """Fit every step from where the one before ended; None without steps."""
    curve: list[float] = []
    answer = None
    for step in steps:
        taken = len(curve)
        watch = None if monitor is None else lambda i, cost, taken=taken: monitor(taken + i, cost)
        try:
            new = local.solve(problem, x, max_iterations=_STEPS, max_time=left(), monitor=watch, smoothed=step)
        except InputError:  # modes are needed, and this is no structure
            break
        curve += new.curve.tolist()
        if not np.all(np.isfinite(new.x)):
            break
        answer, x = replace(new, curve=np.array(curve)), new.x
        if new.stopped is not None:
            break
    return answer


def descend(
    problem: Problem,
    x: Array,
    steps: list[tuple[Smoothed, ...]],
    *,
    left: Callable[[], float | None],
    monitor: Callable[[int, float], object] | None = None,
) -> LocalResult:
    """Fit every step, and at last the records."""
    way = smooth_fit(problem, x, steps, left=left, monitor=monitor)
    if way is not None and way.stopped is not None:
        return way
    return local.solve(problem, x if way is None else way.x, max_time=left(), monitor=monitor)


def by_continuation(
    problem: Problem,
    options: Continuation,
    desk: Desk,
    random: np.random.SeedSequence,
    start: ArrayLike | Structure | None,
) -> tuple[Outcome, float, bool]:
    """Search from several starts; the best end, its misfit, and whether the data let a structure be hardly better."""
    poles = tests_of(problem)
    steps = [] if poles is None else levels_of(problem, poles)
    floor = (
        0.0
        if poles is None
        else float(
            np.linalg.norm([s * p.residual for s, p in zip((1.0, *problem.formulation.shares), poles, strict=True)])
        )
    )
    desk.note(
        f"continuation over {problem.n_variables} unknowns in {len(steps)} steps"
        + ("" if poles is None else f"; free residues at the poles of the data leave {floor:.3g}")
    )
    first = problem.formulation.guess if start is None else as_unknowns(problem, start)
    ends: list[tuple[float, LocalResult]] = []
    ways: list[Array] = []
    history = replace(History(), start=_misfit_at(problem, first))
    stopped: BaseException | None = None
    wrong: InputError | None = None
    on_way = lambda i, cost: desk.tell("continuation", i, 0, cost)  # noqa: E731
    at_end = lambda i, cost: desk.tell("local phase", i, 0, cost)  # noqa: E731
    for x in (first, *_starts(problem, options.starts - 1, random)):
        try:
            way = smooth_fit(problem, x, steps, left=lambda: desk.left, monitor=on_way)
            if way is not None and way.stopped is None:
                if any(_apart(problem, way.x, other) < _TOGETHER for other in ways):
                    desk.note("another start comes the same way")
                    continue
                ways.append(way.x)
                x = way.x
            answer = (
                way
                if way is not None and way.stopped is not None
                else local.solve(problem, x, max_time=desk.left, monitor=at_end)
            )
        except InputError as error:
            wrong = error
            desk.note(f"a start is passed over: {error}")
            continue
        except (Stop, KeyboardInterrupt) as stop:
            stopped = stop
            break
        misfit = _misfit_at(problem, answer.x)
        desk.note(f"local phase: {answer.message}, {answer.curve.size} iterates, {misfit:.4e} of all that is fitted")
        ends.append((misfit, answer))
        stopped = answer.stopped
        if stopped is not None or not desk.time_for_more:
            break
    if stopped is not None and not isinstance(stopped, Stop | KeyboardInterrupt):
        raise stopped
    if not ends:
        raise stopped or SolverError(f"no search began at a structure ({wrong}): state guesses that make one")
    misfit, best, structure = _best(problem, ends)
    history = replace(history, local=misfit, local_curve=best.curve)
    if problem.goal is not None:
        good = problem.residual_of(best.x) <= problem.goal
    else:
        # What residuals of the user's own leave beside the tests has no floor of its own.
        reached = float(np.sqrt(max(misfit**2 - problem.own_squares(best.x), 0.0)))
        good = reached <= max(_NEAR * floor, EXACT) if poles is not None else best.success
    success, message = best.success, best.message
    if stopped is not None:
        success, message = False, str(stopped) or "interrupted"
    rivals = tuple(_rivals(problem, best.x, misfit, ends)) if success else ()
    return Outcome(structure, best.x, "continuation", success, message, history, stopped, rivals=rivals), misfit, good


def _best(problem: Problem, ends: list[tuple[float, LocalResult]]) -> tuple[float, LocalResult, Structure]:
    """The end with the least misfit that is a structure."""
    wrong: InputError | None = None

    def order(end: tuple[float, LocalResult]) -> tuple[bool, float]:
        return not problem.keeps_constraints(end[1].x), end[0] if np.isfinite(end[0]) else np.inf

    for misfit, answer in sorted(ends, key=order):
        try:
            return misfit, answer, problem.structure(answer.x)
        except InputError as error:
            wrong = error
    raise SolverError(
        f"no search ended at a structure ({wrong}): write the matrices so that they are positive for all unknowns "
        "within their bounds, by a Cholesky factor or by springs and dampers that are positive"
    )


def _starts(problem: Problem, count: int, random: np.random.SeedSequence) -> list[Array]:
    """Points spread over the search space as the swarm's are, of those that stand for a structure."""
    if count < 1:
        return []
    points = spread(problem.formulation, _DRAWN * count, np.random.default_rng(random))
    return list(islice((x for x in points if _is_structure(problem, x)), count))


def _is_structure(problem: Problem, x: Array) -> bool:
    try:
        problem.structure(x)
    except InputError:
        return False
    return True


def _misfit_at(problem: Problem, x: Array) -> float:
    """NaN where modes are needed and `x` is no structure."""
    try:
        return problem.misfit_of(x)
    except InputError:
        return float("nan")


def _rivals(problem: Problem, x: Array, misfit: float, ends: list[tuple[float, LocalResult]]) -> list[Array]:
    """Other ends that explain the data as well."""
    from scipy.stats import chi2

    tests = (problem.measurement, *(test for test, _ in problem.formulation.others))
    numbers = 2 * sum(test.response.size + (0 if test.force is None else test.force.size) for test in tests)
    as_good = misfit * np.sqrt(1 + chi2.isf(_CHANCE, x.size) / max(numbers - x.size, 1))
    found: list[Array] = []
    for other, answer in ends:
        good = np.isfinite(other) and other <= max(as_good, EXACT)
        if good and all(_apart(problem, answer.x, known) > _APART for known in (x, *found)):
            found.append(answer.x)
    return found


def _apart(problem: Problem, x: Array, other: Array) -> float:
    """Largest difference of two sets of unknowns, of their size or, where that is less, of the search space."""
    width = np.where(problem.upper > problem.lower, problem.upper - problem.lower, 1.0)
    return float(np.max(np.abs(x - other) / np.minimum(width, np.maximum(np.abs(other), np.finfo(float).tiny))))
