"""Damped Gauss-Newton steps (Levenberg-Marquardt) on normal equations, and scores of further unknowns by these."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.linalg import norm
from numpy.typing import NDArray

from sysid.modal_analysis.modal_model import NormalEquations, Parameters
from sysid.structure.structure import Array
from sysid.structure.thresholds import ROUND_OFF

_DAMPING = (1e-12, 1e-6, 1e6)  # of a scaled normal matrix: least, at first, and at which no step helps


@dataclass(frozen=True, eq=False)
class SumOfSquares:
    """A sum of squares and its normal equations.

    Attributes
    ----------
    start : (p,)
    unpack : callable
        Parameters of a column of unknowns.
    chi2 : callable
        The sum of squares at parameters; infinite where there is none.
    equations : callable
        Normal equations at parameters, by the unknowns.
    renewed : callable
        The same where their matrix was that of other parameters close by, else None: asked for where a step fails.
    moved : callable
        Unknowns after a step: to first order their sum.
    bent : callable or None
        At parameters, whose unknowns are given too: the product of the Jacobian with what the errors bend by along a
        step, by which a step in a curved valley follows it.
    """

    start: Array
    unpack: Callable[[Array], Parameters]
    chi2: Callable[[Parameters], float]
    equations: Callable[[Parameters], NormalEquations]
    renewed: Callable[[Parameters], NormalEquations | None] = lambda _: None
    moved: Callable[[Array, Array], Array] = np.add
    bent: Callable[[Parameters, Array, Array], Array] | None = None


def minimise(
    problem: SumOfSquares,
    tell: Callable[[int, Parameters, float], bool],
    most: int,
    settled: Callable[[float], float],
    curved: float = 1e-7,
    bends: float = 0.75,
) -> tuple[Parameters, float, bool]:
    """Parameters of the least sum of squares near the start, the sum, and whether the end was reached.

    Steps are bent to second order where they are damped (geodesic acceleration: M. K. Transtrum, J. P. Sethna,
    arXiv:1201.5885).

    Parameters
    ----------
    problem : SumOfSquares
    tell : callable
        Called with the number of steps so far, parameters and sum of squares; whether to stop.
    most : int
        Steps.
    settled : callable
        The promised fall, of a sum of squares, at which the fit stands still.
    curved : float
        Damping above which steps are bent.
    bends : float
        Share of a step that its bend may be; where it is more, the step is too long.
    """
    least, damping, greatest = _DAMPING
    x, p = problem.start, problem.unpack(problem.start)
    after = np.inf
    for i in range(most):
        here = problem.equations(p)
        if tell(i, p, here.chi2):
            return p, here.chi2, False
        enough = settled(here.chi2)
        while True:
            unit = units_of(here.normal)
            scaled = here.normal * np.outer(unit, unit)
            step = _step(scaled, damping, here.gradient * unit) * unit
            promised, long = float(here.gradient @ step), False
            if problem.bent is not None and damping > curved:
                second = _step(scaled, damping, problem.bent(p, x, step) * unit)
                long = promised >= enough and norm(second) > bends * norm(step[unit > 0] / unit[unit > 0])
                step = step + second * unit / 2
            if not long:
                there = problem.moved(x, step)
                trial = problem.unpack(there)
                after = problem.chi2(trial)
                if after <= here.chi2 or promised < enough:
                    break
            if (renewed := problem.renewed(p)) is not None:
                here = renewed
                continue
            damping = max(10 * damping, _DAMPING[1])
            if damping > greatest:
                return p, here.chi2, False
        if after > here.chi2:
            return p, here.chi2, True
        x, p = there, trial
        damping = max(damping / 10, least)
        if promised < enough:
            return p, after, True
    return p, after, False


def units_of(normal: Array) -> Array:
    """Step of each unknown that shows as much as the noise; zero for one that shows nowhere, but for round-off."""
    known = np.diag(normal)
    return np.where(known > np.finfo(float).tiny, 1 / np.sqrt(np.maximum(known, np.finfo(float).tiny)), 0.0)


def _step(scaled: Array, damping: float, gradient: Array) -> Array:
    """A damped step; with more damping where round-off has made the normal matrix indefinite."""
    while True:
        try:
            factor = scipy.linalg.cho_factor(scaled + damping * np.eye(gradient.size), check_finite=False)
        except np.linalg.LinAlgError:
            damping = max(10 * damping, 1e-12)
            continue
        return np.asarray(scipy.linalg.cho_solve(factor, gradient))


def unit_diagonal(normal: Array) -> tuple[Array, Array]:
    """A normal matrix (p, p) divided so that its diagonal is one, and the roots of the diagonal that it had, (p,)."""
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    return normal / np.outer(size, size), size


def held_along(normal: Array, moves: Array) -> Array:
    """A normal matrix (p, p) with moves (k, p) that change nothing held at zero."""
    unit = units_of(normal)
    rows = np.divide(moves, unit, out=np.zeros_like(moves), where=unit > 0)
    rows = np.divide(rows / np.linalg.norm(rows, axis=1, keepdims=True), unit, out=np.zeros_like(rows), where=unit > 0)
    return normal + rows.T @ rows


def half_inverse(normal: Array, least: float) -> Array:
    """H with ``H H'`` the inverse of a scaled normal matrix, but for what shows by less than `least` of the most."""
    lam, V = np.linalg.eigh(normal)
    seen = lam > least * lam.max(initial=0.0)
    return np.asarray(V[:, seen] / np.sqrt(lam[seen]))


def over_root_of_rest(
    half: Array, normal: Array, score: Array, most: float, steps: int = 50, exact: float = 1e-8
) -> Array:
    """``(I - T)^-1/2 s`` with ``T = H' N H``, of H (p, r), N (p, p), s (r,); eigenvalues of T count as `most` at most.

    By Lanczos's method (Y. Saad, SIAM J. Numer. Anal. 29 (1992) 209-228): r is many, products with a vector are cheap.
    """
    size = float(norm(score))
    basis, along, beside, found = [score / max(size, np.finfo(float).tiny)], list[float](), list[float](), score
    for _ in range(steps):
        Q = np.array(basis)
        ahead = half.T @ (normal @ (half @ Q[-1]))
        along.append(float(Q[-1] @ ahead))
        for _ in range(2):  # once leaves round-off
            ahead = ahead - Q.T @ (Q @ ahead)
        taken, turn = scipy.linalg.eigh_tridiagonal(along, beside)
        before, found = found, size * (turn @ (turn[0] / np.sqrt(1 - np.clip(taken, 0.0, most)))) @ Q
        beside.append(float(norm(ahead)))
        if beside[-1] < exact or norm(found - before) <= exact * norm(found):
            break
        basis.append(ahead / beside[-1])
    return np.asarray(found)


def score(equations: NormalEquations, added: NDArray[np.bool_]) -> tuple[float, int]:
    """Fall of twice the sum of squares that `added` unknowns (p,) promise in one step, and how many of them show.

    The score has half the normal matrix for its covariance (C. R. Rao, Proc. Cambridge Phil. Soc. 44 (1948) 50-57).
    """
    N, size = unit_diagonal(equations.normal)
    gradient = equations.gradient / size
    half = half_inverse(N[np.ix_(~added, ~added)], ROUND_OFF)
    across = half.T @ N[np.ix_(~added, added)]
    left = gradient[added] - across.T @ (half.T @ gradient[~added])
    lam, V = np.linalg.eigh(N[np.ix_(added, added)] - across.T @ across)
    seen = lam > ROUND_OFF
    return float(2 * np.sum((V[:, seen].T @ left) ** 2 / lam[seen])), int(np.count_nonzero(seen))
