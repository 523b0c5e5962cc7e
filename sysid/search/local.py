"""The local phase: IPOPT with exact derivatives, in coordinates in which the problem is easy.

The response is bilinear in mode shapes and participations, so these are the unknowns, with
``log w`` and ``log zeta``; no inverse, no eigenvector routine and no infinite slope is left in the graph.

- A full mass with a spectral stiffness is free in them: every regular Phi gives a positive definite
  ``M_SS = (Phi Phi')^-1`` and ``K_SS = M_SS Phi diag(w²) Phi' M_SS``, and participations give the coupling.
  A local minimum shows: with frequencies and damping as they ended, the best residues are a linear
  least-squares problem, and where that fits clearly better, the search starts again from there.
- A structured mass or stiffness keeps its own unknowns (`local_structured`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import casadi as ca
import numpy as np

from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.complex_frequency import Smoothed
from sysid.modal_analysis.modal_fit import ModalFit, Modes, fit_modes, rank_one
from sysid.modal_analysis.residues import linear_residues
from sysid.models.damping import ModalDamping
from sysid.models.spectrum import SOLVED
from sysid.nlp import EXACT, Coordinates, Watch
from sysid.problem.problem import Problem, assemble
from sysid.search.local_structured import StructuredFit, fit_structured, frequencies
from sysid.search.modal_scaling import stated_totals, to_stated_totals
from sysid.structure.structure import Array, Structure

_SUSPECT = 1.05  # a residual so many times that of free residues at the same poles is a local minimum
_LEAST_SHAPE = 1e-6  # of the largest singular value of the shapes, below which M_SS would be no mass matrix


@dataclass(frozen=True, eq=False)
class LocalResult:
    """How the local phase ended.

    Attributes
    ----------
    x : (n_variables,)
        The problem's unknowns; not held by the box where the coordinates are modal.
    success : bool
        IPOPT's status is Solve_Succeeded or Solved_To_Acceptable_Level, or the fit is exact to round-off.
    message : str
        IPOPT's status and what else the user must know, such as a bound that the solution ends on.
    curve : (iterations,)
        Residual of each iterate, over all attempts (root of the sum of the squared relative
        residuals of accelerations and, where measured, of the force).
    stopped : BaseException or None
        What the monitor raised, or Ctrl-C; `x` is then the last iterate.
    """

    x: Array
    success: bool
    message: str
    curve: Array
    stopped: BaseException | None = None


def solve(
    problem: Problem,
    x: Array,
    *,
    max_iterations: int = 500,
    max_time: float | None = None,
    monitor: Callable[[int, float], object] | None = None,
    smoothed: tuple[Smoothed, ...] | None = None,
) -> LocalResult:
    """Minimise the residual from the unknowns `x`.

    Parameters
    ----------
    problem : Problem
    x : ndarray, shape (n_variables,)
    max_iterations : int
        Of each attempt.
    max_time : float, optional
        s, for all attempts.
    monitor : callable, optional
        Called with (iteration, residual) after each iteration; whatever it raises stops the solver
        and is handed back in `stopped`.
    smoothed : tuple of Smoothed, optional
        To be fitted in the place of the problem's tests, where it has unknowns of its own.
    """
    watch = Watch(monitor, max_time)
    if problem.free_modes:
        return _in_modal_coordinates(problem, problem.structure(x), watch, max_iterations)
    end = fit_structured(problem, x, watch, max_iterations, smoothed)
    return _result(end.x, end, watch)


def _in_modal_coordinates(problem: Problem, start: Structure, watch: Watch, max_iterations: int) -> LocalResult:
    """A full mass with spectral stiffness, where mode shapes and participations are free."""
    first, test = _modes(start), problem.measurement
    remainder = start.rigid_body_mass - start.participation.T @ start.participation

    def attempt(modes: Modes) -> ModalFit:
        return fit_modes(
            test, modes, lambda z: _spectrum(problem, modes, z), unit=np.sqrt(problem.totals),
            remainder=remainder, ties=stated_totals(problem), watch=watch, max_iterations=max_iterations,
        )  # fmt: skip

    best, tried = attempt(first), 1
    for again in _linear_starts(test, best, first):
        if watch.stopped is not None or best.residual <= EXACT or watch.left < 1.0:
            break
        answer = attempt(again)
        tried += 1
        if answer.residual < best.residual:
            best = answer
    message = f"best of {tried} starts, as the first ended in a local minimum" if tried > 1 else ""
    modes = best.modes
    if test.force is None:
        # Accelerations leave the scale of each mode open: shapes keep the size that they had.
        size = np.linalg.norm(first.phi, axis=0) / np.maximum(np.linalg.norm(modes.phi, axis=0), np.finfo(float).tiny)
        modes = modes._replace(phi=modes.phi * size, gamma=modes.gamma / size[:, None])
    return _result(_unknowns(problem, modes, best.rigid, remainder), best, watch, message)


def _result(x: Array, end: ModalFit | StructuredFit, watch: Watch, message: str = "") -> LocalResult:
    words = [f"IPOPT: {end.status}"]
    if end.bounds:
        words.append(f"ended on a bound: {end.bounds}")
    if message:
        words.append(message)
    # At round-off IPOPT runs out of steps rather than of gradient.
    success = end.status in SOLVED or end.residual <= EXACT
    return LocalResult(x, success, "; ".join(words), np.array(watch.curve), watch.stopped)


def _linear_starts(test: Measurement, ended: ModalFit, first: Modes) -> Iterator[Modes]:
    """New starts where free residues fit clearly better than what was reached: at its poles, then at the first ones."""
    fits = [(poles, *linear_residues(test, poles.omega, poles.ratios)) for poles in (ended.modes, first)]
    if ended.of_accelerations <= _SUSPECT * min(possible for _, _, possible in fits):
        return
    for poles, residues, _ in fits:
        yield rank_one(residues, poles.omega, poles.ratios, np.linalg.norm(poles.phi, axis=0))


def _modes(structure: Structure) -> Modes:
    return Modes(
        structure.mode_shapes,
        structure.participation,
        2 * np.pi * structure.natural_frequencies,
        structure.damping_ratios,
    )


def _spectrum(problem: Problem, start: Modes, z: Coordinates) -> tuple[ca.MX, ca.MX]:
    """Circular frequencies and damping ratios as expressions."""
    omega, _ = frequencies(problem, start.omega, z)
    damping = problem.damping
    (variable,) = damping.variables(problem.layout)
    if isinstance(damping, ModalDamping):
        guess = np.clip(start.ratios, variable.lower, variable.upper)
        low, high = np.log(variable.lower / guess), np.log(variable.upper / guess)
        return omega, ca.DM(guess) * ca.exp(z.add("damping ratio", np.zeros(guess.size), low, high))
    guess = np.clip(damping.values(start.ratios, start.omega), variable.lower, variable.upper)
    y = z.add("rayleigh factor", guess / variable.upper, variable.lower / variable.upper, 1.0)
    return omega, damping.ratios(y * ca.DM(variable.upper), omega)


def _unknowns(problem: Problem, modes: Modes, rigid: Array, remainder: Array) -> Array:
    """The problem's unknowns of a fit in modal coordinates; the damping inside its search space."""
    order = np.argsort(modes.omega)
    pushes, w, zeta = modes.gamma[order], modes.omega[order], np.maximum(modes.ratios[order], 0.0)
    P = _regular_inverse(modes.phi[:, order])
    if problem.measurement.force is None:
        t, left = to_stated_totals(
            problem, P, pushes, problem.layout.rigid_body, problem.layout.directions[: len(P)], remainder
        )
        P, pushes = P * np.sqrt(t), pushes * np.sqrt(t)
    else:
        left = rigid - pushes.T @ pushes
    G = problem.layout.rigid_body
    M_SS = P.T @ P
    M_S0 = P.T @ pushes - M_SS @ G
    low = np.linalg.solve(np.linalg.cholesky(M_SS), M_S0)
    x = problem.values(assemble(M_SS, M_S0, low.T @ low + left, (P.T * w**2) @ P, zeta, G))
    at = problem.parts.damping
    x[at] = np.clip(x[at], problem.lower[at], problem.upper[at])  # IPOPT may leave bounds by its tolerance
    return x


def _regular_inverse(phi: Array) -> Array:
    """Inverse of the shapes; where a bad fit has made some alike or next to nothing, of near ones that are not."""
    u, s, vt = np.linalg.svd(phi)
    return (vt.T / np.maximum(s, _LEAST_SHAPE * s[0])) @ u.T
