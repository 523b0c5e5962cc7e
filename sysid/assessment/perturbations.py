"""Standard deviations of what follows from modal parameters or matrices, by the chain rule.

What noise does is kept as columns, each the move that one independent standard normal makes; moves that no record sees
stand beside them. The variance of a quantity is a sum of squares; it is NaN where something unseen moves it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sysid.modal_analysis.modal_fit import Modes
from sysid.modal_analysis.response import gains, gains_and_slopes
from sysid.problem.slopes import Slopes, response_slopes
from sysid.structure.structure import Array, Structure
from sysid.structure.thresholds import NEGLIGIBLE


def std_of(change: NDArray[np.inexact[Any]], normals: int, size: ArrayLike) -> Array:
    """Standard deviations of quantities with this change, (..., moves), `normals` of them of a standard normal each.

    `size` (...) tells what is much.
    """
    seen = change[..., :normals]
    std = np.sqrt(np.einsum("...c,...c->...", seen, seen.conj()).real)
    unseen = np.abs(change[..., normals:]).max(axis=-1, initial=0.0)
    return np.where(unseen > NEGLIGIBLE * np.asarray(size), np.nan, std)


class Perturbations(NamedTuple):
    """Moves of the modal parameters in the last axis: `normals` of a standard normal each, then those unseen."""

    normals: int
    phi: Array
    gamma: Array
    log_omega: Array
    log_ratios: Array
    rigid: Array

    def std(self, change: Array, size: ArrayLike) -> Array:
        """Standard deviations of quantities that change so, (...): see `std_of`."""
        return std_of(change, self.normals, size)

    def std_of_lines(self, change: Array, factors: Sequence[NDArray[np.inexact[Any]]], size: float) -> Array:
        """Of a spectrum that changes by the sum of `change` (rows, moves) times `factors` (rows, n_freq)."""
        weight, seen, unseen = np.vstack(factors), change[:, : self.normals], change[:, self.normals :]
        variance = np.sum(weight.conj() * ((seen @ seen.T) @ weight), axis=0).real
        moved = np.abs(unseen.T @ weight).max(axis=0, initial=0.0)
        return np.where(moved > NEGLIGIBLE * size, np.nan, np.sqrt(np.maximum(variance, 0.0)))


@dataclass(frozen=True, eq=False)
class ModalSpectra:
    """Standard deviations of predicted spectra where the damping is by ratios: by modes."""

    modes: Modes
    moves: Perturbations
    rigid_body_mass: Array

    def transmissibility(self, freq: Array) -> Array:
        """Standard deviations, (n_sensors, d, n_freq)."""
        phi, gamma, _, _ = self.modes
        g = gains(freq, self.modes.omega, self.modes.ratios)
        size = np.full((len(phi), gamma.shape[1]), np.max(np.abs(np.einsum("ik,kj,kf->ijf", phi, gamma, g))))
        return self._std(freq, phi, self.moves.phi, np.zeros((*size.shape, self.moves.phi.shape[2])), size)

    def base_force(self, freq: Array) -> Array:
        """Standard deviations, kg, (d, d, n_freq)."""
        weight = np.sqrt(np.diag(self.rigid_body_mass))
        gamma, moved = self.modes.gamma.T, self.moves.gamma.swapaxes(0, 1)
        return self._std(freq, gamma, moved, self.moves.rigid, np.outer(weight, weight))

    def _std(self, freq: Array, left: Array, d_left: Array, d_constant: Array, size: Array) -> Array:
        """Of ``sum_k left_ik g_k gamma_kj + constant_ij``, whose parts move by d_left (a, m, moves), d_constant."""
        gamma, moves = self.modes.gamma, self.moves
        g, slopes = gains_and_slopes(freq, self.modes.omega, self.modes.ratios)
        std = np.empty((*size.shape, g.shape[1]))
        for i, j in np.ndindex(*size.shape):
            residue = np.tile(left[i] * gamma[:, j], 2)[:, None]
            change = np.vstack([d_left[i], moves.gamma[:, j], moves.log_omega, moves.log_ratios, d_constant[i, [j]]])
            factors = [gamma[:, [j]] * g, left[i, :, None] * g, residue * slopes, np.ones((1, g.shape[1]))]
            std[i, j] = moves.std_of_lines(change, factors, float(size[i, j]))
        return std


@dataclass(frozen=True, eq=False)
class DirectSpectra:
    """The same where the damping is a matrix: by direct solves.

    Moves of x are in `steps` (p, moves), `normals` of them of a standard normal each.
    """

    slopes: Slopes
    steps: Array
    normals: int

    def transmissibility(self, freq: Array) -> Array:
        """Standard deviations, (n_sensors, d, n_freq)."""
        X, dX = response_slopes(self.slopes, freq)
        R = self.slopes.structure.recovery
        change = np.einsum("si,fidc->sdfc", R, dX, optimize=True)
        return std_of(change @ self.steps, self.normals, float(np.abs(X).max()))

    def base_force(self, freq: Array) -> Array:
        """Standard deviations, kg, (d, d, n_freq)."""
        s = self.slopes
        X, dX = response_slopes(s, freq)
        change = np.einsum("iec,fid->edfc", s.d_push, X, optimize=True) + s.d_rigid[:, :, None]
        change = change + np.einsum("ie,fidc->edfc", s.push, dX, optimize=True)
        return std_of(change @ self.steps, self.normals, float(np.abs(s.structure.rigid_body_mass).max()))


def changes_of_matrices(structure: Structure, modes: Modes, moves: Perturbations) -> Iterator[tuple[Array, Array]]:
    """Changes of M_SS, K_SS and C at the degrees of freedom, (n, n, moves), and the size of their entries, (n, n).

    Each is ``T^-T D T^-1``, T the modes at the degrees of freedom, D diagonal. Degrees of freedom at a sensor move with
    its row of the mode shapes, modal coordinates stand still; NaN where one is neither.
    """
    T, (_, _, omega, ratios) = structure.normal_modes, modes
    dT = np.zeros((*T.shape, moves.log_omega.shape[1]))
    for j, (sensor, mode) in enumerate(zip(structure.dof_sensors, structure.dof_modes, strict=True)):
        if sensor >= 0:
            dT[j] = moves.phi[sensor]
        elif mode < 0:
            dT[:] = np.nan
    P = np.linalg.inv(T)
    moved = P.T @ (P @ dT.reshape(len(T), -1)).reshape(dT.shape)  # P dT P
    squared, loss = omega**2, 2 * ratios * omega
    for diagonal, change in (
        (np.ones_like(omega), np.zeros_like(moves.log_omega)),
        (squared, 2 * squared[:, None] * moves.log_omega),
        (loss, loss[:, None] * (moves.log_omega + moves.log_ratios)),
    ):
        inner = change[:, None] / 2 * P[:, :, None] - diagonal[:, None, None] * moved
        half = (P.T @ inner.reshape(len(P), -1)).reshape(inner.shape)
        size = np.sqrt(diagonal @ P**2)
        yield half + half.swapaxes(0, 1), np.outer(size, size)
