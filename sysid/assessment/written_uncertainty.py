"""Standard deviations of a problem in its own unknowns: of these, and of everything that follows from them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sysid.assessment.information import inflation_of, records_of
from sysid.assessment.sensitivity import Slopes, response_slopes, sensitivity, slopes_of
from sysid.assessment.uncertainty import MOVED, Moves, Uncertainty, modes_of, quantities
from sysid.models.unknowns import by_name
from sysid.problem.problem import Problem
from sysid.structure.structure import Array, ComplexArray


def written_uncertainty(problem: Problem, x: Array) -> Uncertainty:
    """Standard deviations of everything that follows from the unknowns of a problem in its own unknowns.

    Parameters
    ----------
    problem : Problem
    x : (n_variables,)
        Its fit.

    Returns
    -------
    Uncertainty
        First order in the noise; a variable on a bound is treated as if the bound were not there.
    """
    formulation, test = problem.formulation, problem.measurement
    slopes = slopes_of(formulation.matrices, x, test)
    known = sensitivity(problem, x, slopes)
    structure = slopes.structure
    inflation = 1.0
    if formulation.misfit is None:
        inflation = inflation_of(test, records_of(test, structure, x.size), x.size)
    every = np.hstack([known.normals, known.unit[:, None] * known.unseen])
    normals = known.rank
    shapes = np.einsum("si,ikc->skc", structure.recovery, slopes.d_shapes)
    parts = (shapes, slopes.d_participation, slopes.d_log_omega, slopes.d_log_ratios, slopes.d_rigid)
    shapes, pushes, log_omega, log_ratios, rigid = (part @ every for part in parts)
    moves = Moves(shapes, pushes, log_omega, log_ratios, rigid, normals)
    n = structure.n
    matrices = []
    for matrix, slope in (
        (structure.mass[:n, :n], slopes.mass), (structure.stiffness[:n, :n], slopes.stiffness),
        (structure.damping, slopes.damping),
    ):  # fmt: skip
        size = np.sqrt(np.abs(np.diag(matrix)))
        matrices.append(moves.std(slope @ every, np.outer(size, size)))
    std = moves.std(every, known.unit)
    covariance = every[:, :normals] @ every[:, :normals].T
    covariance[np.isnan(std)], covariance[:, np.isnan(std)] = np.nan, np.nan
    direct = None if structure.modal_damping else _Direct(slopes, moves, every)
    return replace(
        quantities(problem, structure, modes_of(structure), moves, inflation, tuple(matrices)),
        parameters=formulation.labels, covariance=covariance, _direct=direct,
        values=by_name(problem.variables, x), variables=by_name(problem.variables, std),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Direct:
    """Standard deviations of spectra where the damping is a matrix: by direct solves."""

    slopes: Slopes
    moves: Moves
    every: Array

    def transmissibility(self, freq: Array) -> Array:
        """As in `Uncertainty`."""
        X, dX = response_slopes(self.slopes, freq)
        R = self.slopes.structure.recovery
        return self._std(np.einsum("si,fidc->sdfc", R, dX, optimize=True), float(np.abs(X).max()))

    def base_force(self, freq: Array) -> Array:
        """As in `Uncertainty`."""
        s = self.slopes
        X, dX = response_slopes(s, freq)
        change = np.einsum("iec,fid->edfc", s.d_push, X, optimize=True) + s.d_rigid[:, :, None]
        change = change + np.einsum("ie,fidc->edfc", s.push, dX, optimize=True)
        return self._std(change, float(np.abs(s.structure.rigid_body_mass).max()))

    def _std(self, change: ComplexArray, size: float) -> Array:
        moved = change @ self.every
        std = np.linalg.norm(moved[..., : self.moves.normals], axis=-1)
        unseen = np.abs(moved[..., self.moves.normals :]).max(axis=-1, initial=0.0)
        return np.where(unseen > MOVED * size, np.nan, std)
