"""What an outcome is worth: success, what is determined, and what the user should know, in sentences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sysid.assessment.checks import doubts
from sysid.assessment.determination import determine
from sysid.nlp import EXACT
from sysid.problem.problem import Problem
from sysid.results.identification import Identification
from sysid.search.session import Session
from sysid.search.strategy import Outcome

_KNOWN = 0.1  # of the root of two diagonal entries; an entry with a larger standard deviation is not known
_LARGE = 4000  # entries of the mode shapes, beyond which the covariance takes minutes and gigabytes
_NO_FIT = 0.5  # relative residual above which nothing is explained
_ON_BOUND = 1e-6  # of an unknown's range


def judge(problem: Problem, end: Outcome, why: str, seed: int, session: Session) -> Identification:
    """Judge where a search ended.

    Parameters
    ----------
    problem : Problem
    end : Outcome
    why : str
        Why the strategy was taken.
    seed : int
    session : Session
        Its log and clock.
    """
    success, message = _success(problem, end)
    session.log(f"done: {message}")
    known = determine(problem, end.structure, end.x, end.alternatives)
    # What was stopped on its way has misfits of another kind.
    judged = end.stopped is None and (success or problem.free_modes)
    doubtful = doubts(problem, end.structure, end.x) if judged else ()
    open_ = (*doubtful, *known.undetermined)
    if doubtful:
        message += "; " + "; ".join(doubtful)
    if not success:
        open_ = ("the search did not end in a fit, so this is not yet any structure that explains the data", *open_)
    it = Identification(
        structure=end.structure,
        problem=problem,
        x=end.x,
        strategy=end.strategy,
        seed=seed,
        success=success,
        message=message,
        history=replace(end.history, log=tuple(session.lines), wall_time=session.seconds),
        determined=not open_,
        closed_by=() if open_ else known.closed_by,
        undetermined=open_,
        remarks=(why, *end.remarks, *_remarks(problem, end)),
        interrupted=isinstance(end.stopped, KeyboardInterrupt),
    )
    return _as_certain(it)


def _success(problem: Problem, end: Outcome) -> tuple[bool, str]:
    """Whether this is a fit, and the message."""
    success, message = end.success, end.message
    residual = residual_of(problem, end)
    if end.x is not None and success and not problem.keeps_constraints(end.x):
        success = False
        message += "; a constraint does not hold"
    if problem.goal is not None and residual > problem.goal:
        success = False
        message += f"; the residual {residual:.3g} is above the goal {problem.goal:.3g}"
    elif problem.goal is None and residual > _NO_FIT and end.stopped is None:
        success = False
        message += (
            f"; the residual {residual:.3g} is no fit: are the frequencies in Hz, the responses absolute and complex "
            "with exp(+iwt), the axes and signs of rigid_body right, the bounds wide enough?"
        )
    return success, message


def residual_of(problem: Problem, end: Outcome) -> float:
    """The residual where a search ended; where modes are free it is the structure's."""
    if end.x is None or problem.free_modes:
        return problem.measurement.residual(end.structure)
    return problem.residual(end.x)


def _remarks(problem: Problem, end: Outcome) -> tuple[str, ...]:
    """What the user should know of the unknowns and of the misfit."""
    formulation = problem.formulation
    remarks: tuple[str, ...] = ()
    if end.x is not None and formulation.variables:
        near = _ON_BOUND * (problem.upper - problem.lower)
        at = (end.x - problem.lower < near) | (problem.upper - end.x < near)
        names = [label for label, on in zip(formulation.labels, at, strict=True) if on]
        if names:
            remarks += (f"on a bound of the search space, beyond which the truth may lie: {', '.join(names)}",)
    if not formulation.fits_records:
        remarks += ("the problem states a misfit of its own; pictures and scores compare with the records as they are",)
    return remarks


def _as_certain(it: Identification) -> Identification:
    """The same; not determined where noise leaves matrices open that are fixed without it.

    Null directions of exact records are closed by their noise, and show as large standard deviations only.
    """
    exact = max(it.residual, it.force_residual or 0.0) < EXACT
    if it.x is not None and not it.problem.free_modes:
        # A further test may be noisy, and what is stated as known always is.
        exact = exact and not it.problem.formulation.priors and it.problem.objective(it.x) < EXACT
    if not it.determined or exact:
        return it
    if it.structure.mode_shapes.size > _LARGE:
        told = "whether noise leaves each entry known was not judged, as that takes minutes: see uncertainty"
        return replace(it, remarks=(*it.remarks, told))
    s, u = it.structure, it.uncertainty
    n, open_ = s.n, []
    pairs = ("M_SS", s.mass[:n, :n], u.mass), ("K_SS", s.stiffness[:n, :n], u.stiffness), ("C", s.damping, u.damping)
    for name, matrix, std in pairs:
        size = np.sqrt(np.diag(matrix))
        size[size == 0] = max(size.max(), np.finfo(float).tiny)  # a degree of freedom without a damper
        relative = std / np.outer(size, size)
        if not np.all(relative <= _KNOWN):
            told = (
                "open" if np.any(np.isnan(relative)) else f"with standard deviations up to {100 * relative.max():.2g} %"
            )
            open_.append(f"noise leaves entries of {name} {told}")
    return replace(it, determined=False, closed_by=(), undetermined=tuple(open_)) if open_ else it
