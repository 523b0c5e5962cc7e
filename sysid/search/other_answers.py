r"""Look for other unknowns that explain the data as well as an answer does.

The rank of a Jacobian speaks of small changes only. Far from the answer another one may give the same records: in a
chain of two known masses whose roof alone is measured, stiffnesses ``k1, k2`` do what ``k2 (m1 + m2) / m2`` and
``k1 m2 / (m1 + m2)`` do, at every frequency (Udwadia, Sharma, SIAM J. Appl. Math. 34 (1978) 104-118). So structures of
the same response are looked for from many points of the search space (`SameResponse`), and those that are found are
fitted to the records.

Responses are compared at complex frequencies :math:`s = \sigma + i\omega`, away from the imaginary axis: there no peak
is narrow, so that a descent comes from far away; and two structures whose responses agree there at more lines than they
have coefficients agree everywhere, to the records' own lines.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from sysid.errors import InputError, Stop
from sysid.finding import Finding, Severity
from sysid.modal_analysis.complex_frequency import BEYOND
from sysid.modal_analysis.response import columns
from sysid.problem.batch import Batch, expanded, in_chunks
from sysid.problem.prepared import Prepared
from sysid.problem.terms import ExpressionTerm, TestTerm
from sysid.search import local
from sysid.search.continuation import as_good_as, structure_of
from sysid.search.session import Session
from sysid.search.strategy import Outcome
from sysid.structure.structure import Array, ComplexArray, Structure
from sysid.structure.thresholds import EPSILON, NEGLIGIBLE, OTHER_ANSWER
from sysid.swarm.box import latin_hypercube

_FIRST, _LEAST, _MOST = 1e-2, 1e-12, 1e8  # damping of a step, in squared singular values
_LESS, _MORE = 0.2, 5.0  # its change after a step that was taken, and after one that was not


@dataclass(eq=False)
class LeastSquares:
    """Levenberg and Marquardt's method from many starts in the unit box, all stepping together.

    `rows` takes points (count, p) to residuals (count, m); what is not finite is never stepped to. What one point gives
    must not depend on the others.
    """

    rows: Callable[[Array], Array]
    points: Array  # starts within [0, 1], (count, p); then where each has come

    def __post_init__(self) -> None:
        self._values = self.rows(self.points)
        self.left = _norms(self._values)
        self.damping = np.full(len(self.points), _FIRST)
        self.idle: NDArray[np.bool_] = ~np.isfinite(self.left)  # which have come to rest: no step lowers what is left

    def step(self) -> None:
        """One step of all that are not idle."""
        at = np.flatnonzero(~self.idle)
        if not at.size:
            return
        x, r = self.points[at], self._values[at]
        J = self._slopes(x, r)
        # A bound that a point lies on, and that its descent presses against, holds that unknown.
        down = -np.einsum("cmp,cm->cp", J, r)
        held = ((x <= 0) & (down < 0)) | ((x >= 1) & (down > 0))
        J = np.where(held[:, None, :], 0.0, J)
        square = np.einsum("cmp,cmq->cpq", J, J)
        size = np.einsum("cpp->cp", square)
        size = np.maximum(size, 1e-12 * size.max(axis=1, keepdims=True)) + np.finfo(float).tiny
        damped = square + (self.damping[at, None] * size)[:, :, None] * np.eye(x.shape[1])
        move = np.linalg.solve(damped, np.where(held, 0.0, down)[:, :, None])[:, :, 0]
        new = np.clip(x + move, 0.0, 1.0)
        values = self.rows(new)
        left = _norms(values)
        better = left < self.left[at]
        taken = at[better]
        self.points[taken], self._values[taken], self.left[taken] = new[better], values[better], left[better]
        self.damping[at] *= np.where(better, _LESS, _MORE)
        self.damping = np.maximum(self.damping, _LEAST)
        self.idle[at] = (self.damping[at] > _MOST) | (np.abs(new - x).max(axis=1) < np.finfo(float).eps)

    def _slopes(self, x: Array, r: Array) -> Array:
        """Jacobians (count, m, p) by differences towards the middle of the box."""
        count, p = x.shape
        step = EPSILON**0.5  # of a unit; what differences lose only slows the last steps where the least is zero
        h = np.where(x > 0.5, -step, step)
        moved = x[:, None, :] + h[:, :, None] * np.eye(p)
        values = self.rows(moved.reshape(count * p, p)).reshape(count, p, -1)
        J = (values - r[:, None, :]) / h[:, :, None]
        return np.where(np.isfinite(J), J, 0.0).swapaxes(1, 2)


def _norms(values: Array) -> Array:
    """Of each row of residuals; infinite where one is not finite."""
    with np.errstate(invalid="ignore", over="ignore"):
        left = np.linalg.norm(values, axis=1)
    return np.where(np.isfinite(left), left, np.inf)


SHIFT = 0.3  # of the geometric mean of the natural frequencies
LINES = 4  # a degree of freedom: twice as many numbers as a response has coefficients


class SameResponse:
    """Differences of all that is fitted from what it is at an answer, (count, size) to (count, rows).

    Responses relative to their size, further rows (what is stated as known, say) and broken constraints as the fit
    weighs them.
    """

    def __init__(self, problem: Prepared, x: Array) -> None:
        formulation = problem.formulation
        self.terms = [_Response(term, x) for term in formulation.tests]
        further = [term for term in formulation.beside if isinstance(term, ExpressionTerm)]
        symbol = ca.MX.sym("x", x.size)
        rows = [ca.densify(term.rows(symbol)) for term in further]
        constraints = formulation.constraints
        if constraints.lower.size:
            g, unit = constraints.function(symbol), ca.DM(problem.tolerance)
            beyond = ca.fmax(ca.fmax(ca.DM(constraints.lower) - g, g - ca.DM(constraints.upper)), 0)
            rows.append(ca.densify(beyond / unit))
        self.further = Batch(expanded(ca.Function("rows", [symbol], [ca.vertcat(*rows)]))) if rows else None
        self.at_answer = self._values(x[None])

    def __call__(self, points: Array) -> Array:
        """The differences; not finite where a candidate is no structure."""
        return in_chunks(lambda chunk: self._values(chunk) - self.at_answer, points)

    def _values(self, points: Array) -> Array:
        parts = [term(points) for term in self.terms]
        if self.further is not None:
            parts.append(self.further(points)[0][:, :, 0])
        return np.hstack(parts)


class _Response:
    """Response of candidates in a test at complex frequencies, over its size at an answer, (count, rows)."""

    def __init__(self, term: TestTerm, x: Array) -> None:
        matrices = self.matrices = term.matrices
        structure = matrices.structure(x, term.test)
        omega = 2 * np.pi * structure.natural_frequencies
        lines = np.linspace(0.0, (1 + BEYOND) * omega[-1], LINES * omega.size + 1)[1:]
        self.s = SHIFT * float(np.exp(np.log(omega).mean())) + 1j * lines
        base = columns(term.test.base)
        directions, size, _ = np.linalg.svd(np.hstack([base.real, base.imag]), full_matrices=False)
        self.inputs = directions[:, size > NEGLIGIBLE * size[0]]
        self.with_force = term.test.force is not None
        symbol, n = ca.MX.sym("x", x.size), structure.n
        self._expand = Batch(
            expanded(ca.Function("matrices", [symbol], [ca.densify(part) for part in matrices.function(symbol)]))
        )
        w = ca.MX.sym("w", n)
        self._ratios = None
        if matrices.by_ratios:
            self._ratios = Batch(expanded(ca.Function("ratios", [symbol, w], [matrices.ratio_function(symbol, w)])))
        self.scales = [np.ones((1, 1, 1, 1))] * (1 + self.with_force)
        records = self._records(x[None])
        self.scales = [np.linalg.norm(record, axis=(1, 3), keepdims=True) for record in records]
        self.weight = term.weight

    def __call__(self, points: Array) -> Array:
        records = np.concatenate([record.reshape(len(points), -1) for record in self._records(points)], axis=1)
        return self.weight * np.hstack([records.real, records.imag])

    def _records(self, points: Array) -> list[ComplexArray]:
        """Accelerations and, where measured, force for each input, (count, lines, channels, inputs) each."""
        M, M_S0, M_00, K, C, L, H = self._expand(points)
        G, s = self.matrices.rigid_body, self.s[:, None, None]
        if self._ratios is not None:
            C, broken = self._damping(points, L, H)
        else:
            broken = ~np.all([np.all(np.isfinite(part), axis=(1, 2)) for part in (M, M_S0, K, C)], axis=0)
        M[broken], K[broken], C[broken] = np.eye(len(G)), np.eye(len(G)), 0.0
        push = M @ G + M_S0
        Z = s**2 * M[:, None] + s * C[:, None] + K[:, None]
        right = -(s**2) * (push @ self.inputs)[:, None]
        a: ComplexArray = np.linalg.solve(Z, right)
        a[broken] = np.nan
        records: list[ComplexArray] = [self.matrices.recovery @ a]
        if self.with_force:
            rigid = G.T @ push + M_S0.swapaxes(1, 2) @ G + M_00
            records.append(push.swapaxes(1, 2)[:, None] @ a + (rigid @ self.inputs)[:, None])
        return [np.asarray(record / scale) for record, scale in zip(records, self.scales, strict=True)]

    def _damping(self, points: Array, L: Array, H: Array) -> tuple[Array, Array]:
        """``C = L Psi diag(2 zeta w) Psi' L'`` with ``H = Psi diag(w²) Psi'``, and which are no structure."""
        assert self._ratios is not None
        L = np.tril(L)
        broken = ~(np.all(np.isfinite(H), axis=(1, 2)) & np.all(np.isfinite(L), axis=(1, 2)))
        H[broken] = np.eye(H.shape[1])
        lam, psi = np.linalg.eigh((H + H.swapaxes(1, 2)) / 2)
        broken |= lam[:, 0] <= 0
        omega = np.sqrt(np.maximum(lam, np.finfo(float).tiny))
        ratios = self._ratios(points, omega)[0][:, :, 0]
        root = L @ psi
        return (root * (2 * ratios * omega)[:, None]) @ root.swapaxes(1, 2), broken


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
        structure = structure_of(problem, point)
        if structure is None or any(_matrices_apart(structure, known) <= OTHER_ANSWER for known in tried):
            continue
        tried.append(structure)
        end = _fit(problem, point, session)
        fitted = structure_of(problem, end)
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
        end = local.solve(problem, x, max_iterations=50, max_time=session.left, monitor=monitor)
    except InputError:  # of no structure
        return x
    if end.stopped is not None:
        raise end.stopped
    return end.x


def _explains(problem: Prepared, x: Array, objective: float) -> bool:
    """True where unknowns of a structure explain the data as well as those that leave `objective`."""
    return problem.keeps_constraints(x) and problem.objective(x) <= as_good_as(problem, objective)


def _matrices_apart(one: Structure, other: Structure) -> float:
    """Largest difference of entries of M_SS, K_SS and C, each over the root of the other's two diagonal entries."""
    n = one.n
    pairs = (
        (one.mass[:n, :n], other.mass[:n, :n]),
        (one.stiffness[:n, :n], other.stiffness[:n, :n]),
        (one.damping, other.damping),
    )
    return max(entries_apart(a, b, np.abs(np.diag(b))) for a, b in pairs)


def entries_apart(a: Array, b: Array, diagonal: Array) -> float:
    """Largest difference of entries of two matrices, each over the root of its two entries of a `diagonal`."""
    size = np.sqrt(diagonal)
    size[size == 0] = size.max() or 1.0  # a degree of freedom without a damper, a base without mass
    return float(np.max(np.abs(a - b) / np.outer(size, size)))
