"""Look for other unknowns that explain the data as well as an answer does.

The rank of a Jacobian speaks of small changes only. Far from the answer another one may give the same records: in a
chain of two known masses whose roof alone is measured, stiffnesses ``k1, k2`` do what ``k2 (m1 + m2) / m2`` and
``k1 m2 / (m1 + m2)`` do, at every frequency (Udwadia, Sharma, SIAM J. Appl. Math. 34 (1978) 104-118). So structures of
the same response are looked for from many points of the search space (`SameResponse`), and those that are found are
fitted to the records.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import casadi as ca
import numpy as np

from sysid.errors import InputError, Stop
from sysid.finding import Finding, Severity
from sysid.problem.prepared import Prepared
from sysid.problem.terms import ExpressionTerm
from sysid.search import local
from sysid.search.batch_least_squares import LeastSquares
from sysid.search.continuation import as_good_as
from sysid.search.same_response import LINES, SameResponse
from sysid.search.session import Session
from sysid.search.strategy import Outcome
from sysid.structure.structure import Array, Structure
from sysid.structure.thresholds import NEGLIGIBLE, OTHER_ANSWER
from sysid.swarm.sampling import latin_hypercube

_MOST_STARTS, _FEWEST_STARTS = 64, 4
_ENOUGH = 0.6  # of the starts that have come to the response: the others are not waited for
_SECONDS = 0.06  # of a processor, that a step of all starts may take
_LINE, _CUBE = 1.5e-6, 5e-9  # s of a processor, that a line of a candidate takes, and a cube of degrees of freedom more
_ROW = 1e-6  # likewise, a row of what the user states beside the records or in their place
_NOT_LOOKED_FOR = "whether another structure explains the data as well was not looked for to its end: {}"


def is_unique_if_rank_is_full(problem: Prepared) -> bool:
    """True where an answer that small changes cannot replace has no other one far from it either.

    Where all degrees of freedom are measured and the matrices are linear in the unknowns, so are the equations of
    motion, at any responses; damping ratios follow from the poles.
    """
    formulation = problem.formulation
    if not (formulation.test_alone and formulation.geometry.at_sensors):
        return False
    x = ca.MX.sym("x", formulation.size)
    M, M_S0, M_00, K, C, _, _ = formulation.matrices.function(x)
    ratios = formulation.matrices.ratio_function(x, ca.DM.ones(formulation.geometry.n))
    return all(ca.is_linear(ca.densify(part), x) for part in (M, M_S0, M_00, K, C, ratios))


def with_other_answers(problem: Prepared, end: Outcome, session: Session) -> Outcome:
    """The outcome with another answer among its alternatives if one is found, or told that it was not looked for.

    The search ends with the first one. It is not begun where none can be, or where unknowns are too many for it.
    """
    if end.x is None or end.stopped is not None or is_unique_if_rank_is_full(problem):
        return end
    starts = _number_of_starts(problem)
    if starts < _FEWEST_STARTS:
        sentence = f"no other structure that explains the data as well was looked for: {problem.n_variables} unknowns"
        return end.with_note(f"{sentence} in {problem.geometry.n} degrees of freedom take long")
    fitted = problem if problem.in_squares else problem.pseudo_values(end.structure, end.x)
    try:
        found = _first(fitted, end.x, session, starts)
    except (Stop, KeyboardInterrupt) as stop:
        return replace(_unfinished(end, str(stop) or "interrupted"), stopped=stop)
    if found is None and session.is_over:
        return _unfinished(end, "the time was over")
    session.log("no other answer was found" if found is None else "another answer explains the data as well")
    return end if found is None else replace(end, alternatives=(*end.alternatives, found))


def _unfinished(end: Outcome, why: str) -> Outcome:
    """The outcome, told that other answers were not looked for to the end."""
    return replace(
        end, findings=(*end.findings, Finding("other answers", Severity.CAUTION, _NOT_LOOKED_FOR.format(why)))
    )


def _number_of_starts(problem: Prepared) -> int:
    """As many as a step of all of them has time for; it depends on no clock, so that the bits do not."""
    formulation, n = problem.formulation, problem.geometry.n
    rows = sum(term.function.numel_out(0) for term in formulation.beside if isinstance(term, ExpressionTerm))
    responses = len(formulation.tests) * LINES * n * (_LINE + _CUBE * n**3)
    return min(int(_SECONDS / ((1 + formulation.size) * (responses + _ROW * rows))), _MOST_STARTS)


def _first(problem: Prepared, x: Array, session: Session, starts: int, most: int = 4) -> Array | None:
    """The first other answer that is found, of `most` structures that are fitted to the records."""
    objective = problem.objective(x)
    tried = [problem.structure(x)]
    for point in _candidates(problem, x, session, objective, starts):
        if len(tried) > most or session.is_over:
            return None
        structure = _structure_of(problem, point)
        if structure is None or any(_matrices_apart(structure, known) <= OTHER_ANSWER for known in tried):
            continue
        tried.append(structure)
        end = _fit(problem, point, session)
        fitted = _structure_of(problem, end)
        other = fitted is not None and _matrices_apart(fitted, tried[0]) > OTHER_ANSWER
        if other and _explains(problem, end, objective):
            return end
    return None


def _candidates(
    problem: Prepared, x: Array, session: Session, objective: float, starts: int, steps: int = 60
) -> Iterator[Array]:
    """Points of the answer's response as they are found, then those whose response differs by less than the misfit."""
    same, box = SameResponse(problem, x), _Box(problem)
    search = LeastSquares(lambda points: same(box.unknowns(points)), box.starts(session, starts))
    given = np.zeros(starts, dtype=bool)
    for step in range(steps):
        session.report("other answers", step, steps, objective)
        if session.is_over or np.all(search.idle) or np.mean(given) > _ENOUGH:
            break
        search.step()
        new = (search.left < NEGLIGIBLE) & ~given
        search.idle |= new
        given |= new
        yield from (box.unknowns(search.points[i : i + 1])[0] for i in np.flatnonzero(new))
    rest = np.flatnonzero((search.left < objective) & ~given)
    yield from (box.unknowns(search.points[i : i + 1])[0] for i in rest[np.argsort(search.left[rest], kind="stable")])


class _Box:
    """The unit box of the coordinates in which points are drawn, and the unknowns."""

    def __init__(self, problem: Prepared) -> None:
        formulation = problem.formulation
        self.lower, upper = formulation.box
        self.width = upper - self.lower
        s = ca.MX.sym("s", formulation.size)
        self.function = ca.Function("unknowns", [s], [formulation.from_sampling(s)])

    def unknowns(self, points: Array) -> Array:
        """Of points (count, size) within [0, 1]."""
        return np.asarray(self.function((self.lower + points * self.width).T)).T.reshape(points.shape)

    def starts(self, session: Session, count: int) -> Array:
        """A Latin hypercube."""
        # A source of its own, so that no other phase draws other numbers.
        source = np.random.SeedSequence(session.random.entropy, spawn_key=(*session.random.spawn_key, 0x6F74686572))
        return latin_hypercube(count, self.lower.size, np.random.default_rng(source))


def _fit(problem: Prepared, x: Array, session: Session) -> Array:
    """The records fitted from a point that answers nearly as they do, so that its fit is near, if it has one."""
    monitor = session.reporter("other answers")
    try:
        end = local.solve(problem, x, max_iterations=100, max_time=session.left, monitor=monitor)
    except InputError:  # of no structure
        return x
    if end.stopped is not None:
        raise end.stopped
    return end.x


def _explains(problem: Prepared, x: Array, objective: float) -> bool:
    """True where unknowns of a structure explain the data as well as those that leave `objective`."""
    return problem.keeps_constraints(x) and problem.objective(x) <= as_good_as(problem, objective)


def _structure_of(problem: Prepared, x: Array) -> Structure | None:
    """None where the unknowns stand for none."""
    try:
        return problem.structure(x)
    except InputError:
        return None


def _matrices_apart(one: Structure, other: Structure) -> float:
    """Largest difference of entries of M_SS, K_SS and C, each over the root of the other's two diagonal entries."""
    n, most = one.n, 0.0
    pairs = (
        (one.mass[:n, :n], other.mass[:n, :n]),
        (one.stiffness[:n, :n], other.stiffness[:n, :n]),
        (one.damping, other.damping),
    )
    for a, b in pairs:
        size = np.sqrt(np.abs(np.diag(b)))
        size[size == 0] = size.max() or 1.0  # a degree of freedom without a damper
        most = max(most, float(np.max(np.abs(a - b) / np.outer(size, size))))
    return most
