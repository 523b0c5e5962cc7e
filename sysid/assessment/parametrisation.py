"""How the modal parameters of a problem with free modes move with its unknowns, and what holds them beside records."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import casadi as ca
import numpy as np

from sysid.assessment.information import Parametrisation
from sysid.modal_analysis.modal_fit import Index, Modes
from sysid.models.unknowns import scales_of
from sysid.problem.problem import Problem
from sysid.structure.structure import Array, Structure


def parametrisation(problem: Problem, structure: Structure, modes: Modes, index: Index) -> Parametrisation:
    """Theta itself, less what the damping model and stated totals tie."""
    test, (phi, gamma, _, _) = problem.measurement, modes
    m, d = gamma.shape
    slope, unit, keep = np.eye(index.size), np.ones(index.size), np.ones(index.size, bool)
    strength = np.linalg.norm(phi, axis=0)
    unit[index.phi] = np.tile(strength, len(phi))
    # Only the product of shape and participation has a size of its own.
    unit[index.gamma] = np.repeat(np.max(strength * np.linalg.norm(gamma, axis=1)) / strength, d)
    weight = np.sqrt(problem.totals)
    unit[index.rigid] = [weight[i] * weight[j] for i, j in index.pairs]
    gauge, of_mode = np.zeros((index.size, 0)), np.eye(m)
    if test.force is None:
        gauge = np.zeros((index.size, m))
        gauge[index.phi] = -(phi[:, :, None] * of_mode).reshape(-1, m)
        gauge[index.gamma] = (gamma[:, :, None] * of_mode[:, None]).reshape(-1, m)
    else:
        for entry, row in _tied_masses(problem, modes, index):
            slope[entry], keep[entry] = row, False
    free = Parametrisation(slope, unit, gauge)
    if not problem.formulation.damping.free:
        free, keep[index.log_ratios] = _with_ratios_tied(problem, structure, modes, index, free), False
    keep = np.pad(keep, (0, free.unit.size - keep.size), constant_values=True)
    return Parametrisation(free.slope[:, keep], free.unit[keep], free.gauge[keep])


def _with_ratios_tied(
    problem: Problem, structure: Structure, modes: Modes, index: Index, free: Parametrisation
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


def _tied_masses(problem: Problem, modes: Modes, index: Index) -> Iterator[tuple[int, Array]]:
    """Entries of M_rb that a stated total mass ties, and how they follow theta, (size of theta,)."""
    totals, geometry, (phi, gamma, _, _) = problem.formulation.mass.totals, problem.geometry, modes
    if totals is None:
        return
    for at, (i, j) in zip(index.rigid.tolist(), index.pairs, strict=True):
        if i != j and problem.rigid_total is None:  # its diagonal alone is stated
            continue
        row = np.zeros(index.size)
        # With other degrees of freedom than the sensors the fit ties M_rb itself.
        if totals.kind == "trace" and phi.shape[0] == phi.shape[1]:
            # M_rb,ii = total - sum of the sensors' M_jj - (delta' delta)_ii + (Gamma' Gamma)_ii, delta = Gamma - P G
            P, own = np.linalg.inv(phi), geometry.directions[: geometry.n] == i
            drawn = P @ geometry.rigid_body[:, i]
            delta = gamma[:, i] - drawn
            by_phi = 2 * (P.T @ P)[:, own] @ P[:, own].T - 2 * np.outer(P.T @ delta, drawn)
            row[index.phi] = by_phi.ravel()
            row[index.gamma].reshape(gamma.shape)[:, i] = 2 * (gamma[:, i] - delta)
        yield at, row


def held_by_entries(
    problem: Problem, structure: Structure, modes: Modes, index: Index, path: Parametrisation, moves: Array
) -> Array:
    """Moves of theta (size of theta, moves) with the scale of each mode moved so that known entries of the mass stay.

    So it is where these, not a force, set the scale of the modes. With P the inverse of Phi the entries are those of
    ``M_SS = P' P`` and ``M_S0 = P' (Gamma - P G)``.
    """
    G, known = problem.geometry.rigid_body, problem.known_mass
    if problem.measurement.force is not None or not structure.at_sensors or not np.any(np.isfinite(known)):
        return moves
    phi, gamma, _, _ = modes
    n, d = gamma.shape
    P = np.linalg.inv(phi)
    M, push, steps = P.T @ P, P.T @ gamma, np.hstack([-np.eye(n), G])
    size = np.sqrt(np.diag(M))
    scale = np.outer(size, np.concatenate([size, np.full(d, size.max())]))
    rows = []
    for i, j in np.argwhere(np.isfinite(known)):
        row = np.zeros(index.size)
        # Of -M_ij, or of the second part of M_S0 = P' Gamma - M G.
        by_phi = np.outer(M[i], P @ steps[:, j]) + np.outer(M @ steps[:, j], P[:, i])
        if j >= n:
            by_phi -= np.outer(push[:, j - n], P[:, i])
            row[index.gamma].reshape(gamma.shape)[:, j - n] = P[:, i]
        row[index.phi] = by_phi.ravel()
        rows.append(row / scale[i, j])
    C, gauge = np.array(rows), path.slope @ path.gauge
    return moves - gauge @ (np.linalg.pinv(C @ gauge, rcond=1e-9) @ (C @ moves))
