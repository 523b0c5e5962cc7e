"""Modal masses that stated totals, known entries and lumped masses leave, where modes make the matrices."""

from __future__ import annotations

import casadi as ca
import numpy as np
import scipy

from sysid.modal_analysis.modal_fit import Modes
from sysid.models.expressions import lower_entries
from sysid.problem.prepared import Prepared
from sysid.search.degrees_of_freedom import DegreesOfFreedom
from sysid.search.modal_program import Ties
from sysid.structure.structure import Array

_HELD = 1e5  # weight of known entries beside what is only likely
_LEAST_SHARE = 1e-3  # of a total mass: the least that is left to the base, or to a mode beside the largest
_LEAST = 0.5  # of an equal share of the mass, that each mode keeps where nothing tells modal masses


def stated_totals(problem: Prepared) -> Ties | None:
    """Equalities that hold the stated total mass of a free mass where the base force would set another."""
    geometry, mass, totals = problem.geometry, problem.formulation.mass, problem.totals
    if problem.measurement.force is None or not mass.free or mass.totals is None:
        return None
    stated = mass.totals

    def ties(phi: ca.MX, gamma: ca.MX, rigid: ca.MX) -> list[ca.MX]:
        if stated.values.ndim == 2:
            size = np.sqrt(totals)
            off = (rigid - ca.DM(stated.values)) / ca.DM(np.outer(size, size))
            return [lower_entries(off)]
        if stated.kind == "rigid_body" or phi.size1() != phi.size2():
            return [ca.diag(rigid) / totals - 1]
        P = ca.solve(phi, type(phi).eye(phi.size1()))  # of a triangle by substitution
        delta = gamma - P @ ca.DM(geometry.rigid_body)
        rows = ca.diag(P.T @ P)
        base = ca.diag(rigid - gamma.T @ gamma + delta.T @ delta)
        groups = geometry.directions[: geometry.n]
        modal = [ca.sum1(rows[np.flatnonzero(groups == i).tolist()]) for i in range(geometry.d)]
        return [(modal[i] + base[i]) / totals[i] - 1 for i in range(geometry.d)]

    return ties


def to_stated_totals(
    problem: Prepared, P: Array, gamma: Array, G: Array, groups: Array, remainder: Array, *, scaled: bool = False
) -> tuple[float, Array]:
    """Common modal-mass factor t and base remainder (d, d) with which a full mass has the stated totals.

    Scaling all modal masses by one t changes no response; the remainder is invisible in accelerations. It keeps its
    correlations, and takes what mass the modes leave. P (m, m) is the inverse of the mode shapes at the degrees of
    freedom, gamma and G (m, d) are participations and rigid motion, `groups` (m,) base directions, -1 for none. Where
    known masses have `scaled` the modal masses already t is one; a total that is not stated, or less than they make, is
    then what they make.
    """
    spare = 0.0 if problem.measurement.force is not None else _LEAST_SHARE  # a force tells what the base has
    if problem.rigid_total is not None:
        size = np.sqrt(problem.totals)
        modal, total = ((part / np.outer(size, size)) for part in (gamma.T @ gamma, problem.rigid_total))
        t = 1.0 if scaled else min(1.0, (1 - spare) / float(scipy.linalg.eigvalsh(modal, total)[-1]))
        return t, positive_part(total - t * modal) * np.outer(size, size)
    stated = problem.formulation.mass.totals
    # A mass that states no total is brought to totals of its kind all the same: 1 kg a direction, or known masses'.
    kind = getattr(problem.stated.mass, "healing", "trace") if stated is None else stated.kind
    if kind == "rigid_body":
        used = np.sum(gamma**2, axis=0)
    else:
        rows = np.sum(P**2, axis=0)
        modal = [rows[groups == i].sum() for i in range(G.shape[1])]
        used = np.array(modal) + np.sum((gamma - P @ G) ** 2, axis=0)
    totals = problem.totals
    if scaled:
        totals = np.maximum(0.0 if stated is None else totals, (1 + spare) * used)
    t = 1.0 if scaled else min(1.0, float(np.min((1 - spare) * totals / used)))
    share = np.sqrt(np.maximum(totals - t * used, 0.0) / np.maximum(np.diag(remainder), np.finfo(float).tiny))
    return t, remainder * np.outer(share, share)


def positive_part(matrix: Array) -> Array:
    """The positive semidefinite matrix nearest to a symmetric one (Frobenius)."""
    lam, vectors = np.linalg.eigh(matrix)
    positive: Array = (vectors * np.maximum(lam, 0.0)) @ vectors.T
    return positive


def nearest_lumped(
    problem: Prepared, P: Array, gamma: Array, G: Array, groups: Array, known: Array | None = None
) -> Array:
    """Modal masses (m,) whose mass matrix is nearest to a lumped, uncoupled one with the stated totals.

    P, gamma, G and groups are those of `to_stated_totals`; `known` (m, m + d) are entries of [M_SS, M_S0] to be met,
    NaN where there is none. Where they fix all modal masses nothing else counts.
    """
    from scipy.optimize import lsq_linear

    m = len(P)
    delta = gamma - P @ G
    off = np.einsum("ki,kj->ijk", P, P)[np.tril_indices(m, -1)]
    coupling = np.einsum("ki,kj->ijk", P, delta).reshape(-1, m)
    entries, values = _entries(P, delta, np.full((m, m + G.shape[1]), np.nan) if known is None else known)
    scaled = np.flatnonzero(values)
    lengths = np.linalg.norm(entries, axis=1, keepdims=True)  # zero where no modal mass makes an entry
    if scaled.size and np.linalg.matrix_rank(entries / np.where(lengths > 0, lengths, 1.0), 1e-9) == m:
        unit = np.linalg.norm(entries, axis=0)
        weights = 1 / np.where(values == 0, np.abs(values).max(), np.abs(values))[:, None]
        t = lsq_linear(entries * weights / unit, values * weights[:, 0], (0.0, np.inf), tol=1e-14).x
        return np.maximum(t, 1e-9 * t.max()) / unit
    # Known masses set the scale, or else the totals do.
    totals = [(entries[i], values[i]) for i in scaled if values[i] > 0 and np.all(entries[i] >= 0)] or [
        (np.sum(P[:, groups == i] ** 2, axis=1), problem.totals[i]) for i in range(G.shape[1])
    ]
    usable = [(row, total) for row, total in totals if np.any(row > 0)] or [(np.sum(P**2, axis=1), 1.0)]
    weight = max(total for _, total in usable)
    held = _HELD * weight / np.where(values == 0, weight, np.abs(values))
    rows = np.vstack([off, coupling, *(row[None] * weight / total for row, total in usable), entries * held[:, None]])
    wanted = np.concatenate([np.zeros(len(off) + len(coupling)), np.full(len(usable), weight), values * held])
    size = np.maximum(np.linalg.norm(rows, axis=0), np.finfo(float).tiny)
    # No modal mass vanishes, or M_SS would be singular: each keeps a share of what it could be by itself.
    share = np.max([row / total for row, total in usable], axis=0)
    least = _LEAST / m * size / np.maximum(share, _LEAST_SHARE * share.max())
    return np.maximum(lsq_linear(rows / size, wanted, (least, np.inf), tol=1e-14).x, least) / size


def _entries(P: Array, delta: Array, known: Array) -> tuple[Array, Array]:
    """Rows (e, m) of modal masses that make the known entries (e,) of [M_SS, M_S0]."""
    i, j = np.nonzero(np.isfinite(known))
    once = j >= i
    i, j = i[once], j[once]
    return (P[:, i] * np.hstack([P, delta])[:, j]).T, known[i, j]


def of_known_mass(mass: Array, P: Array, gamma: Array, G: Array) -> Array:
    """Modal masses (n,) with which the modes have a known mass matrix (n + d, n + d)."""
    from scipy.optimize import nnls

    n = len(P)
    rows = np.concatenate([P, gamma - P @ G], axis=1)[:, None, :] * P[:, :, None]
    t = nnls(rows.reshape(n, -1).T, mass[:n].ravel())[0]
    return np.maximum(t, np.finfo(float).eps * t.max())


def modal_masses_of(problem: Prepared, modes: Modes, chosen: DegreesOfFreedom) -> Array:
    """Modal masses that what is stated of the mass makes likely, (m,)."""
    P, G, groups = chosen.coordinates(problem, modes.phi)
    known, n = problem.known_mass, problem.geometry.n
    if np.all(np.isfinite(known)) and len(P) == n:
        return of_known_mass(known, P, modes.gamma, G)
    # Known entries of a free mass are those of the sensors' own mass matrix.
    ours = problem.formulation.mass.free and len(P) == n and chosen.modes.size == 0
    return nearest_lumped(problem, P, modes.gamma, G, groups, known if ours else None)
