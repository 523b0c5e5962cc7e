r"""What each unknown does to matrices, modes and records: exact first derivatives, and what the data make of them.

With :math:`Z = -\omega^2 M + i\omega C + K` and :math:`X = Z^{-1} \omega^2 B` (unit base motion), an unknown moves the
accelerations by :math:`dX = Z^{-1} (\omega^2 dB - dZ\, X)`; modes follow by first-order perturbation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from sysid.models.unknowns import Block, Variable, split, steps_of
from sysid.problem.formulation import labels_of
from sysid.problem.problem import Problem
from sysid.structure.structure import Array

_NULL = 1e-9  # of the largest singular value of the Jacobian, in units of the unknowns: what no record sees
_SMALL = 1e-6  # of a unit: what is not told of a direction
_TERMS = 8  # of a direction, told
_ACTIVE = 1e-6  # of its scale: how near its bound an inequality counts as active


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """What the data say about the unknowns about a point.

    Attributes
    ----------
    unit : (p,)
        The step of each unknown in which the others below are counted: its size, or a part of its range.
    free : (p, q)
        Directions, in units, that active equalities leave.
    singular_values : (q,)
        Of the weighted Jacobian along these, descending.
    seen, unseen : (p, rank), (p, q - rank)
        Directions of x, in units, that records see and that none does.
    normals : (p, rank)
        Moves of x that one standard normal of noise each makes.
    """

    unit: Array
    free: Array
    singular_values: Array
    seen: Array
    unseen: Array
    normals: Array

    @property
    def rank(self) -> int:
        """Number of directions that the records see."""
        return self.seen.shape[1]


def sensitivity(
    problem: Problem, x: Array, slopes: Slopes | None = None, *, known: bool = True, as_stated: bool = False
) -> Sensitivity:
    """Rank, null directions and noise of the unknowns at `x`, from the exact Jacobian.

    With `known` false without what is stated as known to some accuracy; `as_stated` as in `rows_of_test`.
    """
    formulation, p = problem.formulation, x.size
    rows: list[Rows] = []
    if formulation.misfit is None:
        slopes = slopes or slopes_of(formulation.matrices, x, problem.measurement)
        rows += rows_of_test(problem.measurement, slopes, p, as_stated=as_stated)
    else:
        rows.append(_own_rows(formulation.misfit, x, None))
    for share, (test, matrices) in zip(formulation.shares, formulation.others, strict=True):
        rows += rows_of_test(test, slopes_of(matrices, x, test), p, share=share, as_stated=as_stated)
    if formulation.residuals is not None:
        # One more number each, of the same relative noise as those measured.
        rows.append(_own_rows(formulation.residuals, x, float(np.sqrt(np.mean(rows[0].std ** 2)))))
    if formulation.known is not None and known:
        stated, level = _own_rows(formulation.known, x, 1.0), formulation.level
        rows.append(Rows(level * stated.residuals, level * stated.jacobian, level * stated.std))
    unit = steps_of(problem.variables, x)
    J = np.concatenate([row.jacobian for row in rows]) * unit
    free = _left_by_constraints(problem, x, unit, J)
    J = J @ free
    std = np.concatenate([row.std for row in rows])
    U, s, Vt = np.linalg.svd(J, full_matrices=False)
    s = np.concatenate([s, np.zeros(J.shape[1] - s.size)])
    rank = int(np.count_nonzero(s > _NULL * max(s[0], np.finfo(float).tiny))) if s.size else 0
    V = np.linalg.svd(J, full_matrices=True)[2].T if rank < J.shape[1] and len(J) < J.shape[1] else Vt.T
    # x = unit V (1/s) U' e: each column of U carries the noise of its rows.
    mixed = (U[:, :rank].T * std**2) @ U[:, :rank]
    # Where the lines are too few to tell a noise that is not stated, no deviation is known.
    lam, turn = np.linalg.eigh(mixed) if np.all(np.isfinite(mixed)) else (np.full(rank, np.nan), np.eye(rank))
    normals = unit[:, None] * (free @ (V[:, :rank] / s[:rank]) @ (turn * np.sqrt(np.maximum(lam, 0.0))))
    return Sensitivity(unit, free, s, free @ V[:, :rank], free @ V[:, rank:], normals)


def _own_rows(function: ca.Function, x: Array, std: float | None) -> Rows:
    symbol = ca.MX.sym("x", x.size)
    column = function(symbol)
    value, slope = ca.Function("rows", [symbol], [ca.densify(column), ca.densify(ca.jacobian(column, symbol))])(x)
    left = np.asarray(value).ravel()
    if std is None:
        std = max(float(np.linalg.norm(left)) / np.sqrt(max(left.size - x.size, 1)), 1e-15)
    return Rows(left, np.asarray(slope), np.full(left.size, std))


def _left_by_constraints(problem: Problem, x: Array, unit: Array, records: Array) -> Array:
    """Orthonormal directions, in units of x, along which equalities and what presses on an inequality stay as they are.

    An inequality that happens to be at its bound, and that a direction leaves which no record sees, holds nothing.
    """
    constraints = problem.formulation.constraints
    if constraints is None:
        return np.eye(x.size)
    symbol = ca.MX.sym("x", x.size)
    g = constraints.function(symbol)
    value, slope = ca.Function("active", [symbol], [ca.densify(g), ca.densify(ca.jacobian(g, symbol))])(x)
    at, J = np.asarray(value).ravel(), np.asarray(slope) * unit
    size = np.maximum(np.linalg.norm(J, axis=1), np.finfo(float).tiny)
    rows = J / size[:, None]
    equal = constraints.lower == constraints.upper
    free = _null_space(rows[equal])
    unseen = free @ _null_space(records @ free, _NULL)
    at_bound = ~equal & (np.abs(at - constraints.upper) < _ACTIVE * size)
    pressed = at_bound & (np.abs(rows @ unseen).max(axis=1, initial=0.0) < _SMALL)
    return _null_space(rows[equal | pressed])


def _null_space(rows: Array, least: float = 1e-9) -> Array:
    """Orthonormal basis of what rows (count, p) do not see, (p, free); `least` of the largest singular value."""
    if not len(rows):
        return np.eye(rows.shape[1])
    _, s, Vt = np.linalg.svd(rows, full_matrices=len(rows) < rows.shape[1])
    return Vt[int(np.count_nonzero(s > least * max(s[0], np.finfo(float).tiny))) :].T


def directions_in_words(variables: Sequence[Block | Variable], x: Array, unit: Array, directions: Array) -> list[str]:
    """Directions, (p, count) in units, in the user's names: "k[0] +1 %, m +2 %"; a name alone is all of it."""
    sentences = []
    for v in _sparse(directions).T:
        terms = []
        pieces = (split(variables, part) for part in (v, v * unit, x, unit))
        for variable, share, moved, value, large in zip(variables, *pieces, strict=True):
            told = [
                f"{100 * step / abs(at):+.3g} %" if abs(at) > 1e-3 * size else f"{step:+.3g}"
                for step, at, size in zip(moved, value, large, strict=True)
            ]
            if len(set(told)) == 1 and abs(share[0]) > _SMALL:
                terms.append(f"{variable.name} {told[0]}")
                continue
            names = labels_of(variable)
            terms += [f"{names[j]} {told[j]}" for j in np.flatnonzero(np.abs(share) > _SMALL)]
        rest = len(terms) - _TERMS
        sentences.append(", ".join(terms[:_TERMS]) + (f" and {rest} more" if rest > 0 else ""))
    return sentences


def _sparse(directions: Array) -> Array:
    """The same space by vectors with as few entries as elimination gives, the largest entry of each 1 %."""
    V = directions.copy()
    count = V.shape[1]
    used: list[int] = []
    for j in range(count):
        weight = np.abs(V[:, j:]).max(axis=1)
        weight[used] = 0.0
        row = int(np.argmax(weight))
        column = j + int(np.argmax(np.abs(V[row, j:])))
        V[:, [j, column]] = V[:, [column, j]]
        V[:, j] /= V[row, j]
        for other in range(count):
            if other != j:
                V[:, other] -= V[row, other] * V[:, j]
        used.append(row)
    V[np.abs(V) < 1e-9] = 0.0
    return 0.01 * V / np.abs(V).max(axis=0)
