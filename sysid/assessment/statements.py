r"""Stated masses as statistics beside the records: adjustment of the modal parameters to both.

The records give an estimate of the modal parameters, ``theta + N a`` with a standard normal a, and leave the scale of
each mode open where no force was measured. A statement is a function ``s(theta) = v - D e``, D its deviation, zero
where it is exact. The likeliest theta makes ``|a|² + |e|²`` least, the scales being free: weighted least squares of
records and statements together. What is left is chi-squared at as many degrees of freedom as there are statements
that do not set scales.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sysid.assessment.information import Index
from sysid.assessment.sensitivity import gauge_of, slope_of_drawn_mass
from sysid.modal_analysis.modal_estimate import theta_of
from sysid.modal_analysis.modal_fit import Modes
from sysid.problem.prepared import Prepared
from sysid.structure.structure import Array, Structure
from sysid.structure.thresholds import EPSILON, EXACT, ROUND_OFF, round_off

_LONGEST = 0.5  # of a step: of the logarithm of a mode's scale, or of a shape's length
_WIDE = 5.0  # standard deviation of the logarithm of a mode's scale that nothing sets


class Statements(NamedTuple):
    """Statements about masses, one row each.

    ``entries`` (e, 2) of ``[M_SS, M_S0]``; ``totals`` (t, 2) of the rigid-body mass, or of the traces where ``kind`` is
    "trace"; ``values``, ``std`` and ``scale`` (e + t,): kg, the last what is a large change.
    """

    entries: NDArray[np.intp]
    totals: NDArray[np.intp]
    kind: str
    values: Array
    std: Array
    scale: Array

    def without(self, row: int) -> Statements:
        """All but one."""
        kept = np.arange(self.values.size) != row
        e = len(self.entries)
        return Statements(self.entries[kept[:e]], self.totals[kept[e:]], self.kind, *(a[kept] for a in self[3:]))


def statements_of(problem: Prepared, structure: Structure) -> Statements | None:
    """The statements that are adjusted together with the records; None where there are none."""
    mass, geometry, test = problem.formulation.mass, problem.geometry, problem.measurement
    if not (mass.weighs and problem.free_modes and structure.at_sensors):
        return None
    n, d = geometry.n, geometry.d
    known = problem.known_mass
    i, j = np.nonzero(np.isfinite(known))
    once = j >= i
    entries = np.column_stack([i[once], j[once]])
    std = np.zeros((n, n + d)) if mass.entries_std is None else mass.entries_std
    values, stds = known[i[once], j[once]], std[i[once], j[once]]
    size = np.sqrt(np.maximum(np.diag(structure.mass), 0.0))  # round-off of a base without mass
    size = np.where(size > 0, size, size.max())
    scale = size[entries[:, 0]] * size[entries[:, 1]]
    totals, kind = np.zeros((0, 2), dtype=int), ""
    if mass.totals is not None and test.force is not None:
        kind, given = mass.totals.kind, mass.totals.values
        pairs = [(i, j) for i in range(d) for j in range(i, d if given.ndim == 2 else i + 1)]
        totals = np.array(pairs)
        deviations = np.zeros_like(given) if mass.totals.std is None else mass.totals.std
        at = tuple(totals.T) if given.ndim == 2 else totals[:, 0]
        values, stds = np.concatenate([values, given[at]]), np.concatenate([stds, deviations[at]])
        rigid = np.sqrt(mass.totals.by_direction)
        scale = np.concatenate([scale, rigid[totals[:, 0]] * rigid[totals[:, 1]]])
    return Statements(entries, totals, kind, values, stds, scale)


def predict_statements(problem: Prepared, stated: Statements, theta: Array, index: Index) -> tuple[Array, Array]:
    """Statements as modal parameters predict them, (r,), and their slopes, (r, size of theta); in units of `scale`.

    With P the inverse of Phi the entries are those of ``M_SS = P' P`` and ``M_S0 = P' (Gamma - P G)``.
    """
    G, geometry = problem.geometry.rigid_body, problem.geometry
    phi, gamma, _, _, rigid = (part[..., 0] for part in index.split(theta[:, None]))
    n = len(phi)
    P = np.linalg.inv(phi)
    M, push = P.T @ P, P.T @ gamma
    whole, steps = np.hstack([M, push - M @ G]), np.hstack([-np.eye(n), G])
    values, slopes = np.zeros(stated.values.size), np.zeros((stated.values.size, index.size))
    for at, (i, j) in enumerate(stated.entries):
        values[at], row = whole[i, j], slopes[at]
        by_phi = np.outer(M[i], P @ steps[:, j]) + np.outer(M @ steps[:, j], P[:, i])
        if j >= n:
            by_phi -= np.outer(push[:, j - n], P[:, i])
            row[index.gamma].reshape(gamma.shape)[:, j - n] = P[:, i]
        row[index.phi] = by_phi.ravel()
    for at, (i, j) in enumerate(stated.totals, start=len(stated.entries)):
        values[at] = rigid[i, j]
        if stated.kind == "trace":
            delta, in_direction = gamma[:, i] - P @ G[:, i], geometry.directions[:n] == i
            values[at] += np.diag(M)[in_direction].sum() - gamma[:, i] @ gamma[:, i] + delta @ delta
            slopes[at] = -slope_of_drawn_mass(geometry, phi, gamma, index, i)
        slopes[at, index.rigid[index.pairs.index((i, j))]] += 1.0
    return values / stated.scale, slopes / stated.scale[:, None]


class Adjusted(NamedTuple):
    """Modal parameters that records and statements make likeliest.

    ``theta`` (size,); ``misfit``, chi-squared; ``freedom`` of it; ``holds``: exact statements are met.
    """

    theta: Array
    misfit: float
    freedom: int
    holds: bool


def adjust(
    problem: Prepared, stated: Statements, theta: Array, index: Index, normals: Array, steps: int = 40
) -> Adjusted:
    """Adjust modal parameters to statements by Gauss-Newton steps, so many at most.

    The records alone make `theta` (size,) likeliest, without a force at any scale of the modes; `normals` (size, k)
    are what one standard normal each makes of it.
    """
    k, weighed = normals.shape[1], problem.measurement.force is not None
    m = index.shapes[1][0]
    wanted, std = stated.values / stated.scale, stated.std / stated.scale
    if not wanted.size:
        return Adjusted(theta, 0.0, 0, holds=True)
    at, a, b = theta, np.zeros(k), np.zeros(0 if weighed else m)
    for step in range(steps):
        values, slopes = predict_statements(problem, stated, at, index)
        F, U = slopes @ _rescaled(normals, b, index), slopes @ _gauge(at, index, weighed)
        system = np.hstack([F, _WIDE * U, np.diag(std)])
        # Shapes of modes that almost share a pole turn too easily for steps to settle: then these only meet what is
        # exact.
        settling = step >= steps // 2
        gap = np.where(std > 0, 0.0, wanted - values) if settling else wanted - values + F @ a + U @ b
        y = np.linalg.lstsq(system, gap, rcond=None)[0]
        step_a, step_b = y[:k], _WIDE * y[k : k + b.size]
        if not settling:
            step_a, step_b = step_a - a, step_b - b
        shapes = (normals[index.phi] @ step_a).reshape(index.shapes[0])
        size = np.linalg.norm(theta[index.phi].reshape(index.shapes[0]), axis=0)
        long = max(np.max(np.linalg.norm(shapes, axis=0) / size), np.abs(step_b).max(initial=0.0))
        part = min(1.0, _LONGEST / long) if long > 0 else 1.0
        a, b = a + part * step_a, b + part * step_b
        at = _rescaled((theta + normals @ a)[:, None], b, index)[:, 0]
        if long < ROUND_OFF:
            break
    left = wanted - predict_statements(problem, stated, at, index)[0]
    e = np.where(std > 0, left / np.where(std > 0, std, 1.0), 0.0)
    spread = np.linalg.svd(_whitened(F, std) @ U, compute_uv=False) if U.size else np.zeros(0)
    freedom = wanted.size - int(np.count_nonzero(spread > 1.0))
    return Adjusted(at, float(a @ a + e @ e), freedom, bool(np.all(np.abs(left[std == 0]) < EXACT)))


def conditioned(
    problem: Prepared, structure: Structure, modes: Modes, index: Index, normals: Array, unseen: Array,
    shifts: Array,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Moves of theta that records and statements together leave: of a standard normal each, unseen, and shifts.

    The records alone leave `normals` (size, k) and `unseen` (size, q); `shifts` (size, r) is what errors that are no
    noise make of theta where they alone are fitted.
    """
    stated = statements_of(problem, structure)
    if stated is None:
        return normals, unseen, shifts
    theta = theta_of(modes, structure.rigid_body_mass, index)
    std = stated.std / stated.scale
    _, C = predict_statements(problem, stated, theta, index)
    gauge = _gauge(theta, index, problem.measurement.force is not None)
    U = C @ gauge
    F = np.hstack([C @ normals, np.diag(std)[:, std > 0]])
    left, s, _ = np.linalg.svd(U) if U.size else (np.eye(std.size), np.zeros(0), None)
    rank = int(np.count_nonzero(s > ROUND_OFF * s.max(initial=0.0)))
    checks = left[:, rank:].T @ F  # statements that no scale can meet
    back = np.linalg.pinv(U, rcond=ROUND_OFF) if U.size else np.zeros((0, std.size))
    conditional = np.hstack([normals, np.zeros((index.size, F.shape[1] - normals.shape[1]))]) - gauge @ (back @ F)
    turn, s, vt = np.linalg.svd(checks, full_matrices=False)
    seen = s > round_off(s.size) * s.max(initial=0.0)
    known = vt[seen]
    # A shift is taken for noise as far as noise explains by how much the statements are missed.
    missed = (turn[:, seen] / s[seen]).T @ (left[:, rank:].T @ (C @ shifts))
    shifts = shifts - gauge @ (back @ (C @ shifts)) - (conditional @ known.T) @ missed
    conditional = conditional - (conditional @ known.T) @ known
    return conditional, unseen - gauge @ (back @ (C @ unseen)), shifts


def _gauge(theta: Array, index: Index, weighed: bool) -> Array:
    """Moves of theta by the logarithm of each mode's scale, (size, m); nothing where a force sets it."""
    if weighed:
        return np.zeros((index.size, 0))
    phi, gamma, *_ = (part[..., 0] for part in index.split(theta[:, None]))
    return gauge_of(phi, gamma, index)


def _rescaled(theta: Array, scale: Array, index: Index) -> Array:
    """Columns of theta with the shape of each mode divided, its participation multiplied by exp(scale)."""
    if not scale.size:
        return theta
    theta, s, d = theta.copy(), index.shapes[0][0], index.shapes[1][1]
    theta[index.phi] *= np.tile(np.exp(-scale), s)[:, None]
    theta[index.gamma] *= np.repeat(np.exp(scale), d)[:, None]
    return theta


def _whitened(F: Array, std: Array) -> Array:
    """Inverse square root of the covariance of statements less what the records make of them."""
    lam, V = np.linalg.eigh(F @ F.T + np.diag(std**2))
    return (V / np.sqrt(np.maximum(lam, EPSILON**2 * max(lam[-1], np.finfo(float).tiny)))).T
