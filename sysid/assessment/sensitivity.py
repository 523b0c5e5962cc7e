r"""What each unknown does to matrices, modes and records: exact first derivatives, and what the data make of them.

With :math:`Z = -\omega^2 M + i\omega C + K` and :math:`X = Z^{-1} \omega^2 B` (unit base motion), an unknown moves the
accelerations by :math:`dX = Z^{-1} (\omega^2 dB - dZ\, X)`; modes follow by first-order perturbation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
import numpy as np

from sysid.assessment.information import inflation_of, records_of
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.response import columns
from sysid.models.unknowns import Block, Variable, split, steps_of
from sysid.problem.formulation import Matrices, labels_of
from sysid.problem.problem import Problem
from sysid.structure.structure import Array, ComplexArray, Structure

_SAME = 1e-9  # relative distance of squared frequencies that count as one
_NULL = 1e-9  # of the largest singular value of the Jacobian, in units of the unknowns: what no record sees
_SMALL = 1e-6  # of a unit: what is not told of a direction
_TERMS = 8  # of a direction, told
_ACTIVE = 1e-6  # of its scale: how near its bound an inequality counts as active


class Slopes(NamedTuple):
    """A structure and the derivatives by x, which come last, of its matrices (n, n, p), push (n, d, p) and modes."""

    structure: Structure
    push: Array
    mass: Array
    stiffness: Array
    damping: Array
    d_push: Array
    d_rigid: Array
    d_shapes: Array
    d_log_omega: Array
    d_log_ratios: Array

    @property
    def d_participation(self) -> Array:
        """Of ``gamma = Phi' B``, (n, d, p)."""
        moved = np.einsum("ikc,id->kdc", self.d_shapes, self.push)
        return moved + np.einsum("ik,idc->kdc", self.structure.normal_modes, self.d_push)


def slopes_of(matrices: Matrices, x: Array, test: Measurement, omega: Array | None = None) -> Slopes:
    """Derivatives of everything that `x` stands for.

    The shapes of modes of one frequency are not turned into each other, unless `omega` (n,), rad/s, sets them apart.
    """
    structure = matrices.structure(x, test)
    symbol, p = ca.MX.sym("x", x.size), x.size
    function = ca.Function("matrices", [symbol], [ca.densify(part) for part in matrices.function(symbol)[:5]])
    # One forward sweep an unknown: a Jacobian of all entries as a graph takes far longer to build.
    sweeps = function.forward(1).map(p)
    here = (ca.repmat(ca.DM(part), 1, p) for part in (x, *function(x)))
    dM, dM_S0, dM_00, dK, dC = (
        np.asarray(wide).reshape(wide.shape[0], p, -1).swapaxes(1, 2) for wide in sweeps(*here, ca.DM.eye(p))
    )
    n = len(matrices.rigid_body_dofs)
    dM, dM_00, dK = ((part + part.swapaxes(0, 1)) / 2 for part in (dM, dM_00, dK))
    G = matrices.rigid_body_dofs
    M, M_S0 = structure.mass[:n, :n], structure.mass[:n, n:]
    push, d_push = M @ G + M_S0, np.einsum("ijc,je->iec", dM, G) + dM_S0
    cross = np.einsum("ie,ifc->efc", G, dM_S0)
    d_rigid = np.einsum("ie,ijc,jf->efc", G, dM, G, optimize=True) + cross + cross.swapaxes(0, 1) + dM_00

    phi, ratios = structure.normal_modes, structure.damping_ratios
    omega = 2 * np.pi * structure.natural_frequencies if omega is None else omega
    lam = omega**2
    by_mass = np.einsum("il,ijc,jk->lkc", phi, dM, phi, optimize=True)
    by_stiffness = np.einsum("il,ijc,jk->lkc", phi, dK, phi, optimize=True)
    moved = by_stiffness - lam[:, None] * by_mass  # column k of phi_l' (dK - lam_k dM) phi_k
    gap = lam[None] - lam[:, None]
    apart = np.abs(gap) > _SAME * lam.max()
    turn = np.where(apart[:, :, None], moved / np.where(apart, gap, 1.0)[:, :, None], 0.0)
    k = np.arange(n)
    turn[k, k] = -by_mass[k, k] / 2
    d_shapes = np.einsum("il,lkc->ikc", phi, turn)
    d_log_omega = moved[k, k] / (2 * lam[:, None])
    if matrices.by_ratios:
        # C = P' diag(2 zeta w) P with P = Phi^-1, so that dP = -turn P.
        P, loss = phi.T @ M, 2 * ratios * omega
        d_ratios = dC[:, 0]
        d_loss = 2 * omega[:, None] * d_ratios + loss[:, None] * d_log_omega
        inner = -(loss[:, None, None] * turn)
        inner = inner + inner.swapaxes(0, 1)
        inner[k, k] += d_loss
        dC = np.einsum("ki,klc,lj->ijc", P, inner, P, optimize=True)
    else:
        dC = (dC + dC.swapaxes(0, 1)) / 2
        modal = phi.T @ structure.damping @ phi
        d_modal = np.einsum("ik,ijc,jk->kc", phi, dC, phi, optimize=True) + 2 * np.einsum("lk,lkc->kc", modal, turn)
        d_ratios = d_modal / (2 * omega[:, None]) - ratios[:, None] * d_log_omega
    d_log_ratios = d_ratios / np.maximum(ratios, 1e-12)[:, None]
    return Slopes(structure, push, dM, dK, dC, d_push, d_rigid, d_shapes, d_log_omega, d_log_ratios)


def response_slopes(s: Slopes, freq: Array) -> tuple[ComplexArray, ComplexArray]:
    """Relative accelerations of the degrees of freedom for unit base motion, (n_freq, n, d), and slopes (..., p)."""
    n = s.structure.n
    w = 2 * np.pi * freq
    square, once = (w**2)[:, None, None], w[:, None, None]
    M, K, C = s.structure.mass[:n, :n], s.structure.stiffness[:n, :n], s.structure.damping
    Z = -square * M + 1j * once * C + K
    X: ComplexArray = np.linalg.solve(Z, (square * s.push).astype(complex))
    right = square[..., None] * s.d_push
    right = right + square[..., None] * np.einsum("ijc,fjd->fidc", s.mass, X, optimize=True)
    right = right - 1j * once[..., None] * np.einsum("ijc,fjd->fidc", s.damping, X, optimize=True)
    right = right - np.einsum("ijc,fjd->fidc", s.stiffness, X, optimize=True)
    F, _, d, p = right.shape
    dX: ComplexArray = np.linalg.solve(Z, right.reshape(F, n, d * p)).reshape(F, n, d, p)
    return X, dX


@dataclass(frozen=True, eq=False)
class Rows:
    """Weighted real residuals of one record, their Jacobian by x (rows, p), and the noise in each (rows,)."""

    residuals: Array
    jacobian: Array
    std: Array


def rows_of_test(
    test: Measurement, s: Slopes, unknowns: int, *, share: float = 1.0, as_stated: bool = False
) -> list[Rows]:
    """Rows of the accelerations and, where it was measured, of the force, as the local phase weighs them.

    Noise that is larger than stated, or shared by neighbouring lines, counts as the misfit shows it; with `as_stated`
    it is not, as where a test is planned.
    """
    X, dX = response_slopes(s, test.freq)
    R, u = s.structure.recovery, test.base  # (runs, d, n_freq)
    d_a = np.einsum("si,fidc,rdf->srfc", R, dX, u, optimize=True)
    parts = [d_a.reshape(R.shape[0], -1, d_a.shape[-1])]
    if test.force is not None:
        a = np.einsum("fid,rdf->irf", X, u, optimize=True)
        d_f = np.einsum("iec,irf->erfc", s.d_push, a, optimize=True)
        d_f = d_f + np.einsum("ie,fidc,rdf->erfc", s.push, dX, u, optimize=True)
        d_f = d_f + np.einsum("edc,rdf->erfc", s.d_rigid, u, optimize=True)
        parts.append(d_f.reshape(d_f.shape[0], -1, d_f.shape[-1]))
    measured = [columns(test.relative)] + ([] if test.force is None else [columns(test.force)])
    both_stated = test.response_std is not None and test.force_std is not None
    rows: list[Rows] = []
    scale = 1.0
    records = records_of(test, s.structure, unknowns)
    inflation = 1.0 if as_stated else inflation_of(test, records, unknowns)
    for i, (record, change, target) in enumerate(zip(records, parts, measured, strict=True)):
        weight = record.by_channel[:, None] * record.by_line
        if i == 0 or not both_stated:
            scale = float(np.linalg.norm(weight * target))
        weight = share * weight / scale
        flat = (weight[..., None] * change).reshape(-1, change.shape[-1])
        left, std = (-weight * record.misfit).ravel(), inflation * (weight * record.std).ravel() / np.sqrt(2)
        rows.append(Rows(_real(left), _real(flat), np.concatenate([std, std])))
    return rows


def _real(z: ComplexArray) -> Array:
    return np.concatenate([z.real, z.imag])


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
