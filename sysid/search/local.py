"""The local phase: IPOPT with exact gradients, in coordinates in which the problem is easy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import casadi as ca
import numpy as np

from sysid.models.spectrum import SOLVED
from sysid.nlp import IterationMonitor, NonlinearProgram, ended_in_words
from sysid.problem.prepared import Prepared
from sysid.problem.terms import TestTerm
from sysid.search.inverse_factor_coordinates import fit_in_inverse_factor
from sysid.search.matrix_coordinates import fit_in_matrices
from sysid.search.modal_coordinates import End, add_unknowns, fit_in_modes
from sysid.search.session import Session
from sysid.structure.structure import Array
from sysid.structure.thresholds import EXACT

Coordinates = Literal["modal", "cholesky", "entries"]


@dataclass(frozen=True, eq=False)
class LocalResult:
    """Result of the local phase.

    Attributes
    ----------
    x : (n_variables,)
        The problem's unknowns; where modes are free, only the damping is held by the box, and frequencies have windows
        about those stated.
    success : bool
        IPOPT's status is Solve_Succeeded or Solved_To_Acceptable_Level, or the fit is exact to round-off.
    message : str
        IPOPT's status and what else the user must know, such as a bound that the solution ends on.
    curve : (iterations,)
        Objective of each iterate, over all attempts.
    stopped : BaseException or None
        What the listener raised, or Ctrl-C; `x` is then the last iterate.
    """

    x: Array
    success: bool
    message: str
    curve: Array
    stopped: BaseException | None = None


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
    """Minimise the objective from the unknowns `x`.

    Parameters
    ----------
    problem : Prepared
    x : ndarray, shape (n_variables,)
    max_iterations : int
        Of each attempt.
    max_time : float, optional
        s, for all attempts.
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


def fit_apart(problem: Prepared, end: End, monitor: IterationMonitor, max_iterations: int = 500) -> End:
    """The same end with the unknowns that enter no matrix fitted to the terms and constraints that they enter.

    Where modes are free nothing connects them with the others.
    """
    formulation = problem.formulation
    at = formulation.parts.damping.stop
    if at == formulation.size or monitor.stopped is not None:
        return end
    z, auxiliary = NonlinearProgram(), formulation.unknowns[sum(map(len, formulation.of_models)) :]
    start = np.clip(end.x[at:], formulation.lower[at:], formulation.upper[at:])
    unknowns = ca.vertcat(ca.DM(end.x[:at]), add_unknowns(z, auxiliary, start))
    constraints = formulation.constraints
    if constraints.lower.size:
        z.constrain(constraints.function(unknowns), constraints.lower, constraints.upper)
    rows = ca.vertcat(ca.MX(0, 1), *(term.rows(unknowns) for term in formulation.beside))
    best, status = z.minimize(ca.sumsqr(rows), monitor, max_iterations)
    x = np.asarray(ca.Function("end", [z.z], [unknowns])(best)).ravel()
    if status in SOLVED:
        return end._replace(x=x)
    return end._replace(x=x, status=status, remark=f"{end.remark or end.status}; that is of what enters no matrix")


def _result(end: End, monitor: IterationMonitor) -> LocalResult:
    words = [ended_in_words(end.status)]
    if end.bounds:
        words.append(f"ended on a bound: {end.bounds}")
    if end.remark:
        words.append(end.remark)
    # At round-off IPOPT runs out of steps rather than of gradient.
    success = end.status in SOLVED or end.objective <= EXACT
    return LocalResult(end.x, success, "; ".join(words), np.array(monitor.curve), monitor.stopped)
