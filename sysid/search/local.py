"""The local phase: IPOPT with exact gradients, in coordinates in which the problem is easy.

Where modes are free these are shapes and participations (`modal_coordinates`), or the inverse of the mass's factor;
else the unknowns themselves:

- Where C is an expression the response is a direct solve, and the unknowns are all there is: a least-squares problem
  with exact Jacobian, whose Hessian is taken as ``J'J`` (Gauss-Newton) plus that of the constraints.
- Where damping is by ratios the response needs the modes. They are further unknowns: ``Phi = L^-T Psi``, Psi is held
  orthogonal and, but for a free stiffness, diagonalises ``H = L^-1 K L^-T``: polynomial equalities, so that no
  eigenvector routine is left in the graph. A scale of the mass that no record sees then moves no mode.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import casadi as ca
import numpy as np

from sysid.models.expressions import lower_entries
from sysid.models.spectrum import SOLVED
from sysid.nlp import IterationMonitor, NonlinearProgram, ended_in_words, time_too_short
from sysid.problem.feasible import HELD
from sysid.problem.formulation import Formulation
from sysid.problem.matrices import assemble
from sysid.problem.prepared import LOOSE, Prepared
from sysid.problem.terms import ModeSymbols, Term, TestTerm
from sysid.search.inverse_factor_coordinates import fit_in_inverse_factor
from sysid.search.modal_coordinates import fit_in_modes, frequencies
from sysid.search.modal_program import End, add_unknowns, fit_apart
from sysid.search.session import Session
from sysid.structure.structure import Array, Structure
from sysid.structure.thresholds import EXACT, NEGLIGIBLE

Coordinates = Literal["modal", "cholesky", "entries"]


@dataclass(frozen=True, eq=False)
class LocalResult:
    """Result of the local phase.

    Where modes are free, only the damping in `x` is held by the box, and frequencies have windows about those stated.
    """

    x: Array  # the problem's unknowns, (n_variables,)
    success: bool  # Solve_Succeeded or Solved_To_Acceptable_Level, or the fit is exact to round-off
    message: str  # IPOPT's status and what else the user must know, such as a bound that the solution ends on
    curve: Array  # objective of each iterate, over all attempts
    stopped: BaseException | None = None  # what the listener raised, or Ctrl-C; `x` is then the last iterate


def solve(
    problem: Prepared,
    x: Array,
    *,
    max_iterations: int = 500,
    max_time: float | None = None,
    monitor: Callable[[int, float], object] | None = None,
    smoothed: Sequence[TestTerm] = (),
    coordinates: Coordinates = "modal",
) -> LocalResult:
    """Minimise the objective from the unknowns `x`, in so many iterations of each attempt, and seconds of all.

    Parameters
    ----------
    monitor : callable, optional
        Called with (iteration, objective) after each iteration; whatever it raises stops the solver
        and is handed back in `stopped`.
    smoothed : sequence of TestTerm, optional
        To be fitted in the place of the problem's tests, where modes are not free.
    coordinates : {"modal", "cholesky", "entries"}
        Where modes are free: mode shapes and participations; the inverse of the mass's Cholesky factor, the spectrum of
        H near the stated one and log zeta, for the published algorithm; or the paper's plain x, the spectrum of H free,
        which goes nowhere from most starts and serves comparison. Other problems are searched in their own unknowns,
        whatever is given.
    """
    watched = IterationMonitor(monitor, max_time)
    if not problem.free_modes or coordinates == "entries":
        return _result(fit_in_matrices(problem, x, watched, max_iterations, smoothed), watched)
    fit = fit_in_inverse_factor if coordinates == "cholesky" else fit_in_modes
    return _result(fit_apart(problem, fit(problem, x, watched, max_iterations), watched, max_iterations), watched)


def solve_or_read(problem: Prepared, x: Array, session: Session, **settings: Any) -> LocalResult:
    """`solve`, or its end where the session's journal has it from an earlier run."""
    part = session.journal.part("local phase")
    if part.found is not None:
        return LocalResult(**part.found)
    result = solve(problem, x, max_time=session.left, **settings)
    if not result.curve.size:
        session.left_out = True
    if result.stopped is None and not session.cut_short:
        part.ended(lambda: {name: value for name, value in vars(result).items() if name != "stopped"})
    return result


def _result(end: End, monitor: IterationMonitor) -> LocalResult:
    words = (ended_in_words(end.status), f"ended on a bound: {end.bounds}" * bool(end.bounds), end.remark)
    # At round-off IPOPT runs out of steps rather than of gradient.
    success = end.status in SOLVED or end.objective <= EXACT
    return LocalResult(end.x, success, "; ".join(filter(None, words)), np.array(monitor.curve), monitor.stopped)


_JACOBIAN = 6e-7  # s of a processor, that the graph of a Jacobian takes for a row and the square of an unknown
_SECONDS, _POWER = 2.4, 4.6  # likewise, that those of 12 modes take, and how that grows with the modes


def fit_in_matrices(
    problem: Prepared, x: Array, monitor: IterationMonitor, max_iterations: int, smoothed: Sequence[TestTerm] = ()
) -> End:
    """Minimise the objective of a problem over its own unknowns, from `x`.

    `smoothed` are fitted in the place of the tests, in their order. Where the monitor's deadline would pass while the
    graphs of the derivatives are made, nothing is begun.
    """
    formulation, z = problem.formulation, NonlinearProgram()
    modal = formulation.fits_records and formulation.matrices.by_ratios  # damping by ratios has no direct solve
    # The modes themselves stand for a free stiffness; of free modes only the plain entries are asked for here.
    apart = modal and formulation.stiffness.free and not problem.free_modes
    held = formulation.parts.stiffness if apart else slice(0, 0)
    start = np.clip(x, formulation.lower, formulation.upper)
    start[held] = x[held]
    unknowns = add_unknowns(z, formulation.unknowns, start, held)
    _add_constraints(problem, unknowns, z)
    modes = _add_modes(problem, unknowns, problem.structure(start), z, tied=not apart) if modal else None
    rows = ca.vertcat(*(term.rows(unknowns, modes) for term in terms_with(formulation, smoothed)))
    seconds = _SECONDS * (problem.geometry.n / 12) ** _POWER if modal else _JACOBIAN * rows.numel() * z.z.numel() ** 2
    if not monitor.allows(seconds):
        return End(start, np.inf, time_too_short(seconds), "")
    derivatives = None if modal else {"hess_lag": _gauss_newton(z, rows)}
    # Beside noise the objective's round-off stops the line search first: the gradient is then small, not at tolerance.
    best, status = z.minimize(ca.sumsqr(rows), monitor, max_iterations, derivatives, acceptable=1e2 if modal else 1e3)
    symbols = (modes.shapes, modes.omega) if modes else (ca.MX(0, 1), ca.MX(0, 1))
    end = ca.Function("end", [z.z], [unknowns, *symbols, ca.norm_2(rows)])
    if not smoothed and status in SOLVED and 0 < float(end(best)[-1]) < NEGLIGIBLE and not monitor.is_over:
        best = z.finished(rows, best)
    ended, shapes, omega, objective = (np.asarray(value) for value in end(best))
    ended = ended.ravel()
    if modes is not None:
        ended = _in_order(problem, ended, shapes, omega.ravel(), tied=not apart)
    inside = np.clip(ended, formulation.lower, formulation.upper)
    inside[held] = ended[held]  # of the modes, which have no box
    return End(inside, float(objective.item()), status, z.on_bounds(best))


def terms_with(formulation: Formulation, smoothed: Sequence[TestTerm]) -> list[Term]:
    """All terms, with other records in the place of the tests', in their order; none given: as they are."""
    others = iter(smoothed)
    return [next(others, term) if isinstance(term, TestTerm) else term for term in formulation.terms]


def _add_constraints(problem: Prepared, unknowns: ca.MX, z: NonlinearProgram) -> None:
    """The problem's constraints, in units of what each makes over the search space."""
    constraints = problem.formulation.constraints
    unit = problem.tolerance / np.where(constraints.equal, LOOSE, HELD)
    if unit.size:
        z.constrain(constraints.function(unknowns) / ca.DM(unit), constraints.lower / unit, constraints.upper / unit)


def _add_modes(problem: Prepared, unknowns: ca.MX, start: Structure, z: NonlinearProgram, *, tied: bool) -> ModeSymbols:
    """Mode shapes and frequencies as new unknowns, bound to the mass and, where they are `tied`, to the stiffness."""
    formulation = problem.formulation
    n = start.n
    omega, center = frequencies(problem, 2 * np.pi * start.natural_frequencies, z, near=not problem.free_modes)
    _, inverse = formulation.matrices.factors(unknowns)
    psi = z.variable("mode shape", np.linalg.cholesky(start.mass[:n, :n]).T @ start.normal_modes)
    z.constrain(lower_entries(psi.T @ psi - ca.MX.eye(n)))
    if tied:
        scaled = psi @ ca.diag(1 / ca.DM(center))
        H = inverse @ formulation.matrices.motion(unknowns).stiffness @ inverse.T
        z.constrain(lower_entries(scaled.T @ H @ scaled - ca.diag((omega / ca.DM(center)) ** 2)))
    return ModeSymbols(inverse.T @ psi, omega)


def _in_order(problem: Prepared, x: Array, shapes: Array, omega: Array, *, tied: bool) -> Array:
    """Unknowns with modes in ascending order, and a stiffness that is not `tied` to them made of these modes."""
    formulation, order = problem.formulation, np.argsort(omega)
    if formulation.damping.free:
        at = formulation.parts.damping
        x[at] = x[at][order]
    if tied:
        return x
    matrices = formulation.matrices
    M_SS, M_S0, M_00, *_ = matrices.numbers(x)
    L = np.linalg.cholesky(M_SS)
    u, _, vt = np.linalg.svd(L.T @ shapes[:, order])
    root = L @ (u @ vt) * omega[order]  # Psi exactly orthogonal
    structure = assemble(
        M_SS, M_S0, M_00, root @ root.T, matrices.rigid_body, ratios=np.full(omega.size, 0.01),
        recovery=None if matrices.at_sensors else matrices.recovery, test=problem.measurement,
    )  # fmt: skip
    at = formulation.parts.stiffness
    x[at] = formulation.models[1].values(formulation.geometry, structure)
    return x


def _gauss_newton(z: NonlinearProgram, miss: ca.MX) -> ca.Function:
    """Hessian of the Lagrangian with ``2 J'J`` for that of the objective (Gauss-Newton), as nlpsol's `hess_lag`."""
    J = ca.densify(ca.jacobian(miss, z.z))
    return z.hessian(2 * (J.T @ J))
