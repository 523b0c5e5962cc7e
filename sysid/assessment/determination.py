"""What the data determine of a problem in its own unknowns: rank and null directions of the exact Jacobian."""

from __future__ import annotations

import numpy as np

from sysid.assessment.modal_mass_cone import Determination, Intervals
from sysid.assessment.sensitivity import Sensitivity, Slopes, directions_in_words, sensitivity, slopes_of
from sysid.errors import InputError
from sysid.nlp import EXACT
from sysid.problem.problem import Problem
from sysid.structure.structure import Array

_LOOSE = 1e-2  # of an unknown, by which what is left of exact records may move it
_MOVED = 1e-6  # of the root of two diagonals, by which an unseen step of order one must change an entry to count


def written_determination(problem: Problem, x: Array, rivals: tuple[Array, ...] = ()) -> Determination:
    """Whether records, constraints and the form of the matrices fix every entry of M_SS, K_SS and C at `x`.

    `rivals` are other unknowns found to explain the data as well.
    """
    slopes = slopes_of(problem.formulation.matrices, x, problem.measurement)
    known = sensitivity(problem, x, slopes)
    count, labels = x.size, problem.formulation.labels
    open_: list[str] = []
    if known.unseen.shape[1]:
        moved = _moves_matrices(slopes, known)
        words = directions_in_words(problem.variables, x, known.unit, known.unseen)
        fixed = "" if moved else "; mass, stiffness and damping stay the same all the same"
        sentence = (
            f"the records see {known.rank} of {known.free.shape[1]} directions of the {count} unknowns; no record sees "
            f"a change of {'; nor of '.join(words)}{fixed}"
        )
        if moved:
            open_.append(sentence)
    misfit = problem.misfit_of(x)
    if known.rank and misfit < EXACT and misfit > _LOOSE * known.singular_values[known.rank - 1]:
        weakest = directions_in_words(problem.variables, x, known.unit, known.seen[:, -1:])[0]
        open_.append(f"the search ended at {misfit:.2g} of the records, by which {weakest} is hardly held")
    for other in rivals:
        far = np.argsort(-np.abs(other - x) / known.unit)
        far = far[np.abs(other - x)[far] > 1e-3 * known.unit[far]][:4]
        told = ", ".join(f"{labels[j]} = {other[j]:.4g} in place of {x[j]:.4g}" for j in np.sort(far))
        if _other_matrices(problem, slopes, other):
            open_.append(f"another structure explains the data as well: {told}")
    closed = f"the data and the written model fix all {count} unknowns"
    if problem.formulation.known is not None:
        alone = sensitivity(problem, x, slopes, known=False)
        only = known.rank - alone.rank
        closed += f", {only} of them by what is stated as known alone" if only else ""
    if known.free.shape[1] < count:
        closed += f", {count - known.free.shape[1]} of them by constraints"
    closed += " about this answer; what is written as a number counts as exact"
    if known.unseen.shape[1]:
        closed = "the data and the written model fix mass, stiffness and damping"
    return Determination(not open_, () if open_ else (closed,), tuple(open_))


def written_intervals(problem: Problem, x: Array) -> Intervals:
    """Extremes of M_SS and K_SS over what the data leave open: infinite for an entry that something unseen moves.

    To first order: no end is followed along a null direction until a bound stops it.
    """
    slopes = slopes_of(problem.formulation.matrices, x, problem.measurement)
    known = sensitivity(problem, x, slopes)
    n = slopes.structure.n
    ends = []
    for matrix, slope in ((slopes.structure.mass, slopes.mass), (slopes.structure.stiffness, slopes.stiffness)):
        value = matrix[:n, :n]
        open_ = _open_entries(value, slope, known)
        low, high = value.copy(), value.copy()
        low[open_], high[open_] = -np.inf, np.inf
        diagonal = open_ & np.eye(n, dtype=bool)
        low[diagonal] = 0.0
        ends.append(np.stack([low, high]))
    return Intervals(*ends)


def _open_entries(matrix: Array, slope: Array, known: Sensitivity) -> Array:
    size = np.sqrt(np.abs(np.diag(matrix)))
    moved = np.abs(slope @ (known.unit[:, None] * known.unseen)).max(axis=-1, initial=0.0)
    return moved > _MOVED * np.outer(size, size)


def _moves_matrices(slopes: Slopes, known: Sensitivity) -> bool:
    s = slopes.structure
    n = s.n
    pairs = (s.mass[:n, :n], slopes.mass), (s.stiffness[:n, :n], slopes.stiffness), (s.damping, slopes.damping)
    return any(bool(np.any(_open_entries(matrix, slope, known))) for matrix, slope in pairs)


def _other_matrices(problem: Problem, slopes: Slopes, other: Array) -> bool:
    """Whether other unknowns stand for other matrices, and not for the same in another way."""
    mine = slopes.structure
    try:
        its = problem.structure(other)
    except InputError:  # of no structure
        return False
    n = mine.n
    pairs = (mine.mass[:n, :n], its.mass[:n, :n]), (mine.stiffness[:n, :n], its.stiffness[:n, :n])
    for a, b in (*pairs, (mine.damping, its.damping)):
        size = np.sqrt(np.abs(np.diag(a))) + np.finfo(float).tiny
        if np.any(np.abs(a - b) > 1e-3 * np.outer(size, size)):
            return True
    return False
