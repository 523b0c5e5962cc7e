"""Strategy "continuation": from wide peaks, step by step, to the records themselves."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from sysid.errors import InputError, SolverError, Stop, whole_number
from sysid.modal_analysis.complex_frequency import PolesAndResidues
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.problem.prepared import Prepared, spread_points
from sysid.problem.terms import TestTerm
from sysid.search import local
from sysid.search.local import Coordinates, LocalResult
from sysid.search.session import Session
from sysid.search.strategy import History, Outcome, Phase, as_unknowns, search_note
from sysid.structure.structure import Array, Structure
from sysid.structure.thresholds import EXACT, OTHER_ANSWER, SAME_ANSWER, UNEXPLAINED, beyond_chance

SHIFTS = (0.5, 0.2, 0.08, 0.03, 0.01)  # of the geometric mean of the natural frequencies
DRAWN = 20  # points looked at for each that is a structure
_NEAR = 1.1  # times the misfit of free residues at the poles of the data: what a structure may leave
_LEFT_OUT = (
    "{} of {} starts were left out for want of time: whether they end at another structure that explains the data as "
    "well is not known"
)


@dataclass(frozen=True)
class Continuation:
    """Strategy "continuation", with its settings.

    The misfit of a lightly damped structure has minima as narrow as its peaks. So each search begins with the
    responses at complex frequencies, where the peaks are wide, and takes smaller and smaller shifts to the records
    themselves; IPOPT with exact gradients does each step (Hessian: Gauss-Newton
    where the response is a direct solve, exact where modes are unknowns).

    Parameters
    ----------
    starts : int
        Where searches begin: at the guess, and at so many less one points spread over the search space. Several also
        show whether another structure explains the data as well.
    """

    starts: int = 3
    name: ClassVar[str] = "continuation"

    def __post_init__(self) -> None:
        whole_number("Continuation: starts", self.starts, at_least=1)

    def refusal(self, problem: Prepared, start: ArrayLike | Structure | None) -> str | None:
        """Why "auto" does not take it: poles and residues make the matrices, or entries of a free mass are stated."""
        formulation = problem.formulation
        if formulation.mass.weighs or (formulation.mass.free and problem.rigid_total is not None):
            return "it cannot hold known entries of a free mass or a whole rigid-body mass"
        described = formulation.mass.free or formulation.mass.entries is not None
        if formulation.test_alone and formulation.geometry.at_sensors and formulation.stiffness.free and described:
            return "neither mass nor stiffness has a form of its own"
        return None

    def run(self, problem: Prepared, session: Session, start: ArrayLike | Structure | None) -> Outcome:
        """Search from several starts: the best end."""
        return _Run(problem, session).outcome(self.starts, start)


def smoothed_tests(problem: Prepared, monitor: Callable[[int, float], object] | None = None) -> _Smoother:
    """Fitted tests at complex frequencies; none where one shows no poles, or none is fitted."""
    terms = problem.formulation.tests if problem.formulation.fits_records else ()
    found = [PolesAndResidues.of(term.test, monitor=monitor) for term in terms]
    known = [poles for poles in found if poles is not None]
    return _Smoother(terms, known) if len(known) == len(terms) else _Smoother((), ())


@dataclass(frozen=True, eq=False)
class _Smoother:
    """The fitted tests, and the poles and residues that stand for their records."""

    terms: Sequence[TestTerm]
    poles: Sequence[PolesAndResidues]

    @property
    def steps(self) -> list[tuple[TestTerm, ...]]:
        """The tests with smaller and smaller shifts."""
        shares = SHIFTS if self.terms else ()
        return [tuple(self._at(term, poles, share) for term, poles in self._pairs) for share in shares]

    @property
    def floor(self) -> float:
        """Objective that free residues at the poles of the data leave."""
        return float(np.linalg.norm([term.weight * poles.residual for term, poles in self._pairs]))

    @property
    def _pairs(self) -> list[tuple[TestTerm, PolesAndResidues]]:
        return list(zip(self.terms, self.poles, strict=True))

    @staticmethod
    def _at(term: TestTerm, poles: PolesAndResidues, share: float) -> TestTerm:
        # Poles above the lines are left to residual modes, which are held far from some of them.
        wide = poles.smoothed(term.test, share, term.test.freq[-1] if term.matrices.beyond.size else np.inf)
        return replace(term, modal=ModalEstimate.of_lines(wide.test), shift=wide.shift)


def smooth_fits(
    problem: Prepared, x: Array, steps: list[tuple[TestTerm, ...]], session: Session,
    monitor: Callable[[int, float], object], most: int = 60,
) -> Iterator[LocalResult]:  # fmt: skip
    """Fit every step from where the one before ended, while there is time, `most` iterations each: all ends."""
    curve: list[float] = []
    for step in steps:
        if session.is_over:
            break
        taken = len(curve)
        listener = lambda i, objective, taken=taken: monitor(taken + i, objective)  # noqa: E731
        try:
            new = local.solve_or_read(problem, x, session, max_iterations=most, monitor=listener, smoothed=step)
        except InputError:  # modes are needed, and this is no structure
            break
        curve += new.curve.tolist()
        if not np.all(np.isfinite(new.x)):
            break
        yield replace(new, curve=np.array(curve))
        x = new.x
        if new.stopped is not None:
            break


def descend(
    problem: Prepared, x: Array, steps: list[tuple[TestTerm, ...]], session: Session, coordinates: Coordinates = "modal"
) -> LocalResult:
    """Fit every step, and at last the records."""
    monitor = session.reporter("local phase")
    way = None
    for way in smooth_fits(problem, x, steps, session, monitor):
        x = way.x
    if way is not None and way.stopped is not None:
        return replace(way, curve=np.zeros(0))  # the records have none yet
    return local.solve_or_read(problem, x, session, monitor=monitor, coordinates=coordinates)


class _Run:
    """Searches from several starts: where they ended so far."""

    def __init__(self, problem: Prepared, session: Session) -> None:
        self.problem, self.session = problem, session
        self.smoother = smoothed_tests(problem, session.preparing)
        self.steps = self.smoother.steps
        self.ends: list[tuple[float, LocalResult]] = []
        self.ways: list[list[Array]] = []  # where the steps of each start ended
        self.joined = 0  # starts whose way another one has come before
        self.stopped: BaseException | None = None
        self.start_time = session.seconds
        self.wrong: InputError | None = None

    def outcome(self, starts: int, start: ArrayLike | Structure | None) -> Outcome:
        """Search, and take the best end."""
        problem, session = self.problem, self.session
        floor = f"; free residues at the poles of the data leave {self.smoother.floor:.3g}" * bool(self.steps)
        session.log(f"continuation over {problem.n_variables} unknowns in {len(self.steps)} steps{floor}")
        left_out = 0
        first = problem.formulation.guess if start is None else as_unknowns(problem, start)
        points = (first, *random_starts(problem, starts - 1, session.random))
        for left, x in zip(reversed(range(len(points))), points, strict=True):
            self._from(x)
            if self.stopped is not None:
                break
            if self.ends and not session.time_for_more:
                left_out = left
                break
        if self.stopped is not None and not isinstance(self.stopped, Stop | KeyboardInterrupt):
            raise self.stopped
        if not self.ends:
            raise self.stopped or SolverError(
                f"no search began at a structure ({self.wrong}): state guesses that make one"
            )
        objective, best, structure = _best(problem, self.ends)
        success, message = best.success, best.message
        if self.stopped is not None:
            success, message = False, str(self.stopped) or "interrupted"
        initial = _objective_at(problem, first)
        phases = (
            *((Phase("start", initial, first, self.start_time, 1),) if np.isfinite(initial) else ()),
            Phase("local phase", objective, best.x, session.seconds, best.curve.size),
        )
        return Outcome(
            structure, best.x, Continuation.name, success, message,
            History(start=initial, local=objective, local_curve=best.curve, phases=phases), self.stopped,
            alternatives=tuple(_alternatives(problem, best.x, objective, self.ends)) if success else (),
            findings=(search_note(_LEFT_OUT.format(left_out, len(points))),) * bool(left_out),
            good=self._good(objective, best), unanimous=self._unanimous(best),
        )  # fmt: skip

    def _from(self, x: Array) -> None:
        """One search."""
        problem, session = self.problem, self.session
        try:
            answer, course = None, list[Array]()
            for way in smooth_fits(problem, x, self.steps, session, session.reporter("continuation")):
                if way.stopped is not None:
                    answer = replace(way, curve=np.zeros(0))  # the records have none yet
                elif self._was_at(len(course), x := way.x):
                    session.log("another start comes the same way")
                    self.joined += 1
                    return
                course.append(x)
            self.ways.append(course)
            if answer is None:
                answer = local.solve_or_read(problem, x, session, monitor=session.reporter("local phase"))
        except InputError as error:
            self.wrong = error
            session.log(f"a start is passed over: {error}")
            return
        except (Stop, KeyboardInterrupt) as stop:
            self.stopped = stop
            return
        objective = _objective_at(problem, answer.x)
        session.log(f"local phase: {answer.message}, {answer.curve.size} iterates, objective {objective:.4e}")
        self.ends.append((objective, answer))
        self.stopped = answer.stopped

    def _was_at(self, step: int, x: Array) -> bool:
        """True where an earlier start was at these unknowns after the same step: what follows is the same."""
        return any(apart(self.problem, x, way[step]) < SAME_ANSWER for way in self.ways if step < len(way))

    def _good(self, objective: float, best: LocalResult) -> bool:
        """True where the data let a structure be hardly better."""
        problem = self.problem
        if problem.stated.goal is not None:
            return problem.residual(best.x) <= problem.stated.goal
        if not self.steps:
            return best.success
        # What residuals of the user's own leave beside the tests has no floor of its own.
        of_terms = sum(term.error(best.x) ** 2 for term in problem.formulation.beside if not isinstance(term, TestTerm))
        return float(np.sqrt(max(objective**2 - of_terms, 0.0))) <= max(_NEAR * self.smoother.floor, EXACT)

    def _unanimous(self, best: LocalResult) -> bool:
        """True where three starts or more all ended at the best end, a fit of sorts: only a wrong model leaves more."""
        same = [apart(self.problem, best.x, answer.x) < OTHER_ANSWER for _, answer in self.ends]
        return all(same) and len(same) + self.joined >= 3 and self.problem.residual(best.x) < UNEXPLAINED


def _best(problem: Prepared, ends: list[tuple[float, LocalResult]]) -> tuple[float, LocalResult, Structure]:
    """The end with the least objective that is a structure."""
    wrong: InputError | None = None

    def order(end: tuple[float, LocalResult]) -> tuple[bool, float]:
        return not problem.keeps_constraints(end[1].x), end[0] if np.isfinite(end[0]) else np.inf

    for objective, answer in sorted(ends, key=order):
        try:
            return objective, answer, problem.structure(answer.x)
        except InputError as error:
            wrong = error
    raise SolverError(
        f"no search ended at a structure ({wrong}): write the matrices so that they are positive for all unknowns "
        "within their bounds, by a Cholesky factor or by springs and dampers that are positive"
    )


def random_starts(problem: Prepared, count: int, random: np.random.SeedSequence) -> list[Array]:
    """Points spread over the search space as the swarm's are, of those that stand for a structure."""
    if count < 1:
        return []
    points = spread_points(problem.formulation, DRAWN * count, np.random.default_rng(random))
    return list(islice((x for x in points if structure_of(problem, x) is not None), count))


def structure_of(problem: Prepared, x: Array) -> Structure | None:
    """The structure that unknowns stand for; None where they stand for none."""
    try:
        return problem.structure(x)
    except InputError:
        return None


def _objective_at(problem: Prepared, x: Array) -> float:
    """NaN where modes are needed and `x` is no structure."""
    try:
        return problem.objective(x)
    except InputError:
        return float("nan")


def _alternatives(problem: Prepared, x: Array, objective: float, ends: list[tuple[float, LocalResult]]) -> list[Array]:
    """Other ends that explain the data as well."""
    most = as_good_as(problem, objective)
    found: list[Array] = []
    for other, answer in ends:
        good = np.isfinite(other) and other <= most
        if good and all(apart(problem, answer.x, known) > OTHER_ANSWER for known in (x, *found)):
            found.append(answer.x)
    return found


def as_good_as(problem: Prepared, objective: float) -> float:
    """The most that another answer leaves where it explains the data as well as one that leaves `objective`."""
    tests = [term.test for term in problem.formulation.tests]
    numbers = 2 * sum(test.numbers for test in tests)
    size = problem.n_variables
    return max(objective * float(np.sqrt(1 + beyond_chance(size) / max(numbers - size, 1))), EXACT)


def apart(problem: Prepared, x: Array, other: Array) -> float:
    """Largest difference of two sets of unknowns, of their size or, where that is less, of the search space.

    An unknown that may be zero has at least a thousandth of its range as its size.
    """
    width = np.where(problem.upper > problem.lower, problem.upper - problem.lower, 1.0)
    least = np.where(problem.lower * problem.upper > 0, np.finfo(float).tiny, SAME_ANSWER * width)
    return float(np.max(np.abs(x - other) / np.minimum(width, np.maximum(np.abs(other), least))))
