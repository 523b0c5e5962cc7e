"""Sensitivity of all that is fitted to the unknowns at an answer: rank, null directions and noise, by exact Jacobian.

To first order: what is said of a direction holds for small steps along it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from sysid.assessment.information import Parametrisation
from sysid.errors import listed
from sysid.modal_analysis.modal_fit import Index, Modes
from sysid.models.model import Geometry
from sysid.models.unknowns import Unknown, scales_of, split
from sysid.problem.direct_response import Rows, Slopes, stacked_rows
from sysid.problem.formulation import Formulation
from sysid.problem.prepared import Prepared
from sysid.structure.structure import Array, Structure
from sysid.structure.thresholds import NEGLIGIBLE, ROUND_OFF

KNOWN = 0.1  # of the root of two diagonal entries; an entry with a larger standard deviation is not known


def parametrisation(problem: Prepared, structure: Structure, modes: Modes, index: Index) -> Parametrisation:
    """Theta itself, less what the damping model and stated totals tie."""
    test, (phi, gamma, _, _) = problem.measurement, modes
    d = gamma.shape[1]
    slope, unit, keep = np.eye(index.size), np.ones(index.size), np.ones(index.size, bool)
    strength = np.linalg.norm(phi, axis=0)
    unit[index.phi] = np.tile(strength, len(phi))
    # Only the product of shape and participation has a size of its own.
    unit[index.gamma] = np.repeat(np.max(strength * np.linalg.norm(gamma, axis=1)) / strength, d)
    weight = np.sqrt(problem.totals)
    unit[index.rigid] = [weight[i] * weight[j] for i, j in index.pairs]
    gauge = np.zeros((index.size, 0))
    if test.force is None:
        gauge = gauge_of(phi, gamma, index)
    else:
        for entry, row in _tied_masses(problem, modes, index):
            slope[entry], keep[entry] = row, False
    static = structure.residual.static
    if static:  # its pole is none that is fitted, and turning these modes into each other changes nothing
        keep[index.log_omega][-static:] = keep[index.log_ratios][-static:] = False
        gauge = np.hstack([gauge, _turns(modes, index, static, all_=test.force is None)])
    free = Parametrisation(slope, unit, gauge)
    if not problem.formulation.damping.free:
        free, keep[index.log_ratios] = _with_ratios_tied(problem, structure, modes, index, free), False
    keep = np.pad(keep, (0, free.unit.size - keep.size), constant_values=True)
    return Parametrisation(free.slope[:, keep], free.unit[keep], free.gauge[keep])


def _turns(modes: Modes, index: Index, count: int, *, all_: bool) -> Array:
    """Moves of theta, (size, moves), that mix the last modes at each pole: rotations, or with `all_` any but scales."""
    (phi, gamma, omega, _), columns = modes, []
    last = range(len(gamma) - count, len(gamma))
    for i, j in ((i, j) for i in last for j in last if omega[i] == omega[j] and (i < j or (all_ and i > j))):
        of_phi, of_gamma = np.zeros_like(phi), np.zeros_like(gamma)
        of_phi[:, i], of_gamma[j] = phi[:, j], -gamma[i]
        if not all_:
            of_phi[:, j], of_gamma[i] = -phi[:, i], gamma[j]
        column = np.zeros(index.size)
        column[index.phi], column[index.gamma] = of_phi.ravel(), of_gamma.ravel()
        columns.append(column)
    return np.array(columns).reshape(-1, index.size).T


def _with_ratios_tied(
    problem: Prepared, structure: Structure, modes: Modes, index: Index, free: Parametrisation
) -> Parametrisation:
    """The same with log zeta a function of log w and of the damping's own unknowns, which come last."""
    omega, ratios, formulation = modes.omega, modes.ratios, problem.formulation
    unknowns, geometry = formulation.of_models[2], formulation.geometry
    damping: Any = formulation.models[2]
    at = damping.values(geometry, structure)
    y, w = ca.SX.sym("y", at.size), ca.SX.sym("w", omega.size)
    answer = damping.ratios(geometry, y, w)
    slopes = ca.Function("slopes", [y, w], [ca.jacobian(answer, y), ca.jacobian(answer, w)])
    by_unknowns, by_omega = (ca.densify(part).full() / ratios[:, None] for part in slopes(at, omega))
    slope = np.hstack([free.slope, np.zeros((index.size, at.size))])
    slope[index.log_ratios] = 0.0
    slope[index.log_ratios, index.log_omega] = by_omega * omega
    slope[index.log_ratios, index.size :] = by_unknowns
    unit = np.concatenate([free.unit, scales_of(unknowns, at)])
    return Parametrisation(slope, unit, np.pad(free.gauge, ((0, at.size), (0, 0))))


def _tied_masses(problem: Prepared, modes: Modes, index: Index) -> Iterator[tuple[int, Array]]:
    """Entries of M_rb that a stated total mass ties, and how they follow theta, (size of theta,)."""
    totals, geometry, (phi, gamma, _, _) = problem.formulation.mass.totals, problem.geometry, modes
    if totals is None or problem.formulation.mass.weighs:  # there they are statistics
        return
    for at, (i, j) in zip(index.rigid.tolist(), index.pairs, strict=True):
        if i != j and problem.rigid_total is None:  # its diagonal alone is stated
            continue
        row = np.zeros(index.size)
        # With other degrees of freedom than the sensors the fit ties M_rb itself.
        if totals.kind == "trace" and phi.shape[0] == phi.shape[1]:
            row = slope_of_drawn_mass(geometry, phi, gamma, index, i)
        yield at, row


def gauge_of(phi: Array, gamma: Array, index: Index) -> Array:
    """Moves of theta, (size, m), that change the scale of one mode each: no acceleration shows them."""
    m = len(gamma)
    gauge, of_mode = np.zeros((index.size, m)), np.eye(m)
    gauge[index.phi] = -(phi[:, :, None] * of_mode).reshape(-1, m)
    gauge[index.gamma] = (gamma[:, :, None] * of_mode[:, None]).reshape(-1, m)
    return gauge


def slope_of_drawn_mass(geometry: Geometry, phi: Array, gamma: Array, index: Index, i: int) -> Array:
    """Slope (size of theta,) of what M_rb,ii is less by than the trace of M over direction i.

    ``M_rb,ii = trace - sum of the sensors' M_jj - (delta' delta)_ii + (Gamma' Gamma)_ii``, ``delta = Gamma - P G``.
    """
    row = np.zeros(index.size)
    P, in_direction = np.linalg.inv(phi), geometry.directions[: geometry.n] == i
    drawn = P @ geometry.rigid_body[:, i]
    delta = gamma[:, i] - drawn
    by_phi = 2 * (P.T @ P)[:, in_direction] @ P[:, in_direction].T - 2 * np.outer(P.T @ delta, drawn)
    row[index.phi] = by_phi.ravel()
    row[index.gamma].reshape(gamma.shape)[:, i] = 2 * (gamma[:, i] - delta)
    return row


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Sensitivity of the data to p unknowns about a point.

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

    @property
    def steps(self) -> Array:
        """The normals, then what no record sees in steps of order one, (p, q)."""
        return np.hstack([self.normals, self.unit[:, None] * self.unseen])


def sensitivity(
    formulation: Formulation, x: Array, slopes: Slopes | None = None, *, priors: bool = True, as_stated: bool = False
) -> Sensitivity:
    """Rank, null directions and noise of all unknowns at `x`, (n_variables,).

    `slopes` are those of the problem's own matrices at x, where they are known; `priors` counts what is stated as
    known to some accuracy; `as_stated` is that of `Term.linearised`.
    """
    rows = rows_of(formulation, x, slopes, priors=priors, as_stated=as_stated)
    return _judged(formulation, x, rows, np.full(x.size, True))


def rows_of(
    formulation: Formulation, x: Array, slopes: Slopes | None = None, *, priors: bool = True, as_stated: bool = False
) -> list[Rows]:
    """All that is fitted at `x`, with its Jacobian, a term each; parameters as of `sensitivity`."""
    rows: list[Rows] = []
    if formulation.fits_records:
        rows.append(formulation.own_test.linearised(x, slopes=slopes, as_stated=as_stated))
    for term in (term for term in formulation.beside if priors or term not in formulation.priors):
        noise = float(np.sqrt(np.mean(rows[0].std ** 2))) if rows else np.nan
        rows.append(term.linearised(x, noise, as_stated=as_stated))
    return rows


def of_outside(formulation: Formulation, x: Array) -> Sensitivity:
    """Sensitivity to the variables that enter no matrix (`Formulation.outside`), by the terms beside the records."""
    rows = [term.linearised(x, formulation.noise) for term in formulation.beside]
    return _judged(formulation, x, rows, formulation.outside)


def with_totals(problem: Prepared, structure: Structure, x: Array) -> tuple[Formulation, Array]:
    """The formulation and its unknowns; with total masses among them where nobody stated these, so that none is known.

    Without them a mass that is normalised to 1 kg would count as weighed.
    """
    formulation = problem.formulation
    if not problem.unit_mass:
        return formulation, x
    geometry = problem.geometry.weighing(problem.totals)
    of_mass = formulation.models[0].values(geometry, structure)
    return problem.formulate(geometry), np.concatenate([of_mass, x[formulation.parts.mass.stop :]])


def system_matrices(structure: Structure) -> tuple[Array, Array, Array]:
    """M_SS, K_SS and C, (n, n) each."""
    n = structure.n
    return structure.mass[:n, :n], structure.stiffness[:n, :n], structure.damping


def largest_deviations(structure: Structure, stds: Sequence[Array]) -> dict[str, float]:
    """Largest of the deviations `stds` of M_SS, K_SS, C over the root of two diagonal entries each; NaN where open."""
    found = {}
    for name, matrix, std in zip(("M_SS", "K_SS", "C"), system_matrices(structure), stds, strict=True):
        size = np.sqrt(np.diag(matrix))
        size[size == 0] = max(size.max(), np.finfo(float).tiny)  # a degree of freedom without a damper
        found[name] = float(np.max(std / np.outer(size, size)))
    return found


def blocks_and_slopes(structure: Structure, slopes: Slopes) -> list[tuple[Array, Array]]:
    """M_SS, K_SS and C, (n, n), each with its derivatives by the unknowns, (n, n, p)."""
    return list(zip(system_matrices(structure), (slopes.mass, slopes.stiffness, slopes.damping), strict=True))


def meaningful(formulation: Formulation) -> NDArray[np.bool_]:
    """Which entries of x mean something by themselves, (size,): no factors of a free matrix, no shares of a total."""
    mask = np.concatenate([np.full(unknown.size, not unknown.relative) for unknown in formulation.unknowns])
    mask[formulation.parts.mass] &= not formulation.mass.free
    mask[formulation.parts.stiffness] &= not formulation.stiffness.free
    return mask


def outside_variables(formulation: Formulation) -> tuple[Unknown, ...]:
    """The variables that enter no matrix."""
    unknowns = formulation.unknowns
    return tuple(u for u, part in zip(unknowns, split(unknowns, formulation.outside), strict=True) if np.all(part))


def _judged(formulation: Formulation, x: Array, rows: list[Rows], part: NDArray[np.bool_]) -> Sensitivity:
    """Sensitivity of the stacked rows to the unknowns in `part`, the others held."""
    unit = scales_of(formulation.unknowns, x)[part]
    none = Rows(np.zeros(0), np.zeros((0, x.size)), np.zeros(0))
    all_rows = stacked_rows([none, *rows])
    J, std = all_rows.jacobian[:, part] * unit, all_rows.std
    free = left_by_constraints(formulation, x, unit, J, part)
    J = J @ free
    U, s, Vt = np.linalg.svd(J, full_matrices=len(J) < J.shape[1])
    rank, V = _rank(s, ROUND_OFF), Vt.T
    s = np.concatenate([s, np.zeros(J.shape[1] - s.size)])
    # x = unit V (1/s) U' e: each column of U carries the noise of its rows.
    mixed = (U[:, :rank].T * std**2) @ U[:, :rank]
    # Where the lines are too few to tell a noise that is not stated, no deviation is known.
    lam, turn = np.linalg.eigh(mixed) if np.all(np.isfinite(mixed)) else (np.full(rank, np.nan), np.eye(rank))
    normals = unit[:, None] * (free @ (V[:, :rank] / s[:rank]) @ (turn * np.sqrt(np.maximum(lam, 0.0))))
    return Sensitivity(unit, free, s, free @ V[:, :rank], free @ V[:, rank:], normals)


def left_by_constraints(
    formulation: Formulation, x: Array, unit: Array, records: Array, part: NDArray[np.bool_]
) -> Array:
    """Orthonormal directions, in units of x, along which equalities and what presses on an inequality stay as they are.

    An inequality that happens to be at its bound, and that a direction leaves which no record sees, holds nothing.
    """
    constraints = formulation.constraints
    symbol = ca.MX.sym("x", x.size)
    g = constraints.function(symbol)
    value, slope = ca.Function("active", [symbol], [ca.densify(g), ca.densify(ca.jacobian(g, symbol))])(x)
    at, J = np.asarray(value).ravel(), np.asarray(slope)[:, part] * unit
    size = np.maximum(np.linalg.norm(J, axis=1), np.finfo(float).tiny)
    rows, equal = J / size[:, None], constraints.equal
    free = _null_space(rows[equal])
    if np.all(equal):
        return free
    unseen = free @ _null_space(records @ free, ROUND_OFF)
    at_bound = np.logical_not(equal) & (np.abs(at - constraints.upper) < NEGLIGIBLE * size)
    pressed = at_bound & (np.abs(rows @ unseen).max(axis=1, initial=0.0) < NEGLIGIBLE)
    return _null_space(rows[equal | pressed])


def _null_space(rows: Array, least: float = 1e-9) -> Array:
    """Orthonormal basis of what rows (count, p) do not see, (p, free); `least` of the largest singular value."""
    _, s, Vt = np.linalg.svd(rows, full_matrices=len(rows) < rows.shape[1])
    return Vt[_rank(s, least) :].T


def _rank(singular_values: Array, least: float) -> int:
    """Number of singular values that are more than `least` of the largest."""
    return int(np.count_nonzero(singular_values > least * singular_values.max(initial=np.finfo(float).tiny)))


def directions_in_words(unknowns: Sequence[Unknown], x: Array, unit: Array, directions: Array) -> list[str]:
    """Directions, (p, count) in units, in the user's names: "k[0] +1 %, m +2 %"; a name alone is all of it."""
    sentences = []
    for v in _sparse(directions).T:
        terms = []
        pieces = (split(unknowns, part) for part in (v, v * unit, x, unit))
        for unknown, share, moved, value, large in zip(unknowns, *pieces, strict=True):
            steps = [
                f"{100 * step / abs(at):+.3g} %" if abs(at) > 1e-3 * size else f"{step:+.3g}"
                for step, at, size in zip(moved, value, large, strict=True)
            ]
            if len(set(steps)) == 1 and abs(share[0]) > NEGLIGIBLE:
                terms.append(f"{unknown.title} {steps[0]}")
                continue
            terms += [f"{unknown.labels[j]} {steps[j]}" for j in np.flatnonzero(np.abs(share) > NEGLIGIBLE)]
        sentences.append(listed(terms))
    return sentences


def _sparse(directions: Array) -> Array:
    """The same space by vectors with as few entries as elimination gives, the largest entry of each 1 %."""
    V = directions.copy()
    used: list[int] = []
    for j in range(V.shape[1]):
        weight = np.abs(V[:, j:]).max(axis=1)
        weight[used] = 0.0
        row = int(np.argmax(weight))
        column = j + int(np.argmax(np.abs(V[row, j:])))
        V[:, [j, column]] = V[:, [column, j]]
        V[:, j] /= V[row, j]
        others = np.arange(V.shape[1]) != j
        V[:, others] -= np.outer(V[:, j], V[row, others])
        used.append(row)
    V[np.abs(V) < 1e-9] = 0.0
    return 0.01 * V / np.abs(V).max(axis=0)
