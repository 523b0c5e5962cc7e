"""Slopes of modal parameters by the unknowns of a problem with free modes, and what holds them beside records."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import casadi as ca
import numpy as np

from sysid.assessment.information import Parametrisation
from sysid.modal_analysis.modal_fit import Index, Modes
from sysid.models.geometry import Geometry
from sysid.models.unknowns import scales_of
from sysid.problem.prepared import Prepared
from sysid.structure.structure import Array, Structure


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
    free = Parametrisation(slope, unit, gauge)
    if not problem.formulation.damping.free:
        free, keep[index.log_ratios] = _with_ratios_tied(problem, structure, modes, index, free), False
    keep = np.pad(keep, (0, free.unit.size - keep.size), constant_values=True)
    return Parametrisation(free.slope[:, keep], free.unit[keep], free.gauge[keep])


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
