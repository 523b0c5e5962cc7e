r"""Fisher information of a base-shake test about the modal parameters, and deviations of all that follows from them.

The parameters are ``theta = (Phi, Gamma, log w, log zeta, M_rb)``, Phi the shapes at the sensors. The records are

.. math:: a = \sum_k \phi_k g_k \gamma_k u_0, \qquad f_0 = \Big(\sum_k \gamma_k' g_k \gamma_k + M_{rb}\Big) u_0,

so that every column of their Jacobian is a few numbers times a few spectra (`spectra_of`): the information is put
together from the Gram matrix of these, and the Jacobian itself is never formed.

What noise does is kept as columns, each the move that one independent standard normal makes; moves that no record sees
stand beside them. The variance of a quantity is a sum of squares, by the chain rule; it is NaN where something unseen
moves it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.misfit import Record
from sysid.modal_analysis.modal_fit import Index, Modes, force_columns, mode_of_slopes
from sysid.modal_analysis.response import columns, gains, gains_and_slopes, motion_and_slopes
from sysid.problem.direct_response import Slopes, response_slopes
from sysid.structure.structure import Array, ComplexArray, Structure
from sysid.structure.thresholds import NEGLIGIBLE, ROUND_OFF


def spectra_of(test: Measurement, modes: Modes) -> ComplexArray:
    """Spectra of which all columns of the Jacobian are made, (m + m d + 2m + d, runs * n_freq).

    ``q_k = g_k gamma_k u``; ``g_k u_j``; the slopes of q_k by log w_k, then by log zeta_k; ``u_j``.
    """
    u = columns(test.base)
    motion = motion_and_slopes(np.tile(test.freq, test.n_runs), modes.omega, modes.ratios, modes.gamma, u)
    return np.concatenate([motion, u])


def information(modes: Modes, index: Index, grams: list[Iterator[Array]]) -> Array:
    """``Re J' W J`` over theta, from the Gram matrix of the spectra of each sensor and each direction of the force."""
    phi, gamma = modes.phi, modes.gamma
    m, d = gamma.shape
    A = np.zeros((index.size, index.size))
    common, mode = np.arange(index.gamma.start, index.log_ratios.stop), mode_of_slopes(m, d)
    for i, gram in enumerate(grams[0]):
        at = np.concatenate([np.arange(i * m, (i + 1) * m), common])
        factor = np.concatenate([np.ones(m), phi[i, mode]])
        A[np.ix_(at, at)] += np.outer(factor, factor) * gram[: at.size, : at.size]
    at = np.concatenate([common, index.rigid])
    for of_force in grams[1:]:
        for i, gram in enumerate(of_force):
            mix = force_columns(gamma, index, i)
            A[np.ix_(at, at)] += mix.T @ gram @ mix
    return A


def gain_gradients(modes: Modes, index: Index, direct: list[Array], grams: list[Iterator[Array]]) -> Array:
    """``Re J' W y`` over theta, y what a relative error of one of each gain makes of all records.

    (size of theta, n_sensors + 2 d): of the sensors' gains, of the base's, by which all records are less of what they
    are taken to be, and of the force's. `direct` are motion and force beside the modes, (n_sensors, d) and (d, d);
    `grams` as in `information`.
    """
    phi, gamma = modes.phi, modes.gamma
    (s, m), d = phi.shape, gamma.shape[1]
    pulls = np.zeros((index.size, s + 2 * d))
    for kind, (parts, of_record) in enumerate(zip(direct, grams, strict=False)):
        first = (s + d) * kind
        for i, gram in enumerate(of_record):
            shape = gamma[:, i] if kind else phi[i]
            whole = np.concatenate([shape, np.zeros(m * (d + 2)), parts[i]])  # the record, by the spectra
            of_base = np.zeros((whole.size, d))
            by_mode = of_base[m : m + m * d].reshape(m, d, d)
            by_mode[:, np.arange(d), np.arange(d)] = -shape[:, None]
            by_mode *= gamma[..., None]
            of_base[-d:] = -np.diag(parts[i])
            at, made = _gradient_rows(modes, index, kind, i, gram @ np.column_stack([whole, of_base]))
            pulls[at, first + i] += made[:, 0]
            pulls[at, s : s + d] += made[:, 1:]
    return pulls


def _gradient_rows(
    modes: Modes, index: Index, kind: int, i: int, products: NDArray[np.inexact[Any]]
) -> tuple[NDArray[np.intp], Any]:
    """Entries of theta that channel i of the sensors (kind 0) or the force moves, and a gradient by them.

    From the products of the spectra with something of that channel's, (spectra, columns).
    """
    (_, m), common = modes.phi.shape, np.arange(index.gamma.start, index.log_ratios.stop)
    if kind:
        return np.concatenate([common, index.rigid]), force_columns(modes.gamma, index, i).T @ products
    factor = np.concatenate([np.ones(m), modes.phi[i, mode_of_slopes(*modes.gamma.shape)]])
    return np.concatenate([np.arange(i * m, (i + 1) * m), common]), factor[:, None] * products[: factor.size]


def leakage_moves(
    test: Measurement, structure: Structure, modes: Modes, index: Index, records: list[Record], normals: Array
) -> Array:
    r"""Moves of theta by what blocks under Hann's window leak from line to line, of a standard normal each.

    With x_k the lines of a block before the window, the motion of the base is ``X_k = x_k / 2 - (x_k-1 + x_k+1) / 4``,
    and what a channel answers beyond ``H(w_k) X_k`` is ``H'(w_k) h (x_k-1 - x_k+1) / 4``, h the distance of lines. So
    H1 of M blocks, of directions tested one after another, is off by ``H'(w_k) u_k``, ``E|u_k|^2 = h^2 / (3 M)``, in
    all channels at once; with

    .. math:: E[u_k u_l^*] \sim (12, 0, -1), \quad E[u_k u_l] \sim (0, -4, -1) \quad \text{at } |k - l| = 0, 1, 2.

    Of smooth sums the real part vanishes, by which frequencies move; that of the imaginary part, by which damping does,
    is larger than of independent errors, and more channels do not lower it. Coherences count the same errors once more,
    as independent ones: with few channels the sum is on the safe side. No columns for other tests; `normals`
    are those of `spread` where the weights are the noise's, a factor of half the inverse of the information.
    """
    if test.window != "taken off" or test.averaged < 2:
        return np.zeros((index.size, 0))
    spacing, spectra = float(np.diff(test.freq).min()), spectra_of(test, modes).conj()
    pulls = np.zeros((index.size, spectra.shape[1]), complex)
    for kind, (whole, record) in enumerate(zip((test.predict, test.predict_force), records, strict=False)):
        slopes = columns(np.gradient(whole(structure), test.freq, axis=-1))
        for i, (slope, weight) in enumerate(zip(slopes, record.weight, strict=True)):
            at, rows = _gradient_rows(modes, index, kind, i, spectra * (weight**2 * slope))
            pulls[at] += rows
    from scipy.ndimage import convolve1d

    place = np.round((test.freq - test.freq[0]) / spacing).astype(int)  # lines may be left out between
    seen = np.zeros((normals.shape[1], test.n_runs, place[-1] + 1), complex)
    seen[..., place] = (normals.T @ pulls).reshape(normals.shape[1], test.n_runs, -1)
    # Of real and imaginary parts of u, in units of h² / (36 M).
    both = (seen.real, [6.0, -2.0, -1.0]), (seen.imag, [6.0, 2.0, 0.0])
    shared = [convolve1d(x, [*c[:0:-1], *c], mode="constant") for x, c in both]
    variance = sum(np.einsum("arl,brl->ab", x, y) for (x, _), y in zip(both, shared, strict=True))
    lam, turn = np.linalg.eigh(variance * spacing**2 / (36 * test.averaged))
    return 2 * normals @ (turn * np.sqrt(np.maximum(lam, 0.0)))


class Parametrisation(NamedTuple):
    """Slopes of theta by a problem's unknowns.

    ``slope`` (size of theta, unknowns); ``unit`` (unknowns,), a large step of each; ``gauge`` (unknowns, count),
    directions that are known to change no record, one of a mode's own each.
    """

    slope: Array
    unit: Array
    gauge: Array


def spread(A: Array, B: Array | None, path: Parametrisation) -> tuple[Array, Array]:
    """Moves of theta, in columns: what one standard normal each makes, and what no record sees.

    The first are a factor of the covariance: ``A^-1 / 2``, or ``A^-1 B A^-1 / 2`` where the weights are not those of
    the noise (half, as half of a complex error's variance is in its real part). The second are steps of order one.
    """
    unit, gauge = path.unit, path.gauge
    slope = scipy.sparse.csr_array(path.slope)  # mostly an identity, often nothing else
    whole = np.array_equal(path.slope, np.eye(unit.size))
    of_unknowns = lambda matrix: matrix if whole else slope.T @ matrix @ slope  # noqa: E731
    A = of_unknowns(A)
    size = np.sqrt(np.maximum(np.diag(A), 0.0))
    seen = size * unit > ROUND_OFF * np.max(size * unit)
    # The gauge of a mode whose shape is not seen is no direction beside that shape.
    gauge = gauge[:, np.linalg.norm(gauge[~seen] / unit[~seen, None], axis=0) < 0.5]
    fixed = gauge[seen] * size[seen, None]
    fixed = fixed / np.linalg.norm(fixed, axis=0)
    size = size[seen]
    factor, lost = _inverse_factor(A[np.ix_(seen, seen)] / np.outer(size, size) + fixed @ fixed.T)
    factor = factor - fixed @ (fixed.T @ factor)
    if B is not None:
        B = of_unknowns(B)[np.ix_(seen, seen)] / np.outer(size, size)
        variances, turn = np.linalg.eigh(factor.T @ B @ factor)
        factor = (factor @ turn) * np.sqrt(np.maximum(variances, 0.0))
    normals = np.zeros((unit.size, factor.shape[1]))
    normals[seen] = factor / size[:, None] / np.sqrt(2)
    blind = np.zeros((unit.size, lost.shape[1]))
    blind[seen] = lost / size[:, None]
    unseen = np.hstack([blind, np.eye(unit.size)[:, ~seen], gauge])
    unseen = unseen / np.linalg.norm(unseen / unit[:, None], axis=0)
    return slope @ normals, slope @ unseen


def _inverse_factor(matrix: Array) -> tuple[Array, Array]:
    """F with ``F F'`` the inverse of a semidefinite matrix on its range, and an orthonormal basis of the rest.

    Round-off adds up by chance: as the root of the size (Higham and Mary, SIAM J. Sci. Comput. 41 (2019) A2815).
    """
    least = np.sqrt(len(matrix)) * np.finfo(float).eps
    triangle, singular = scipy.linalg.lapack.dpotrf(matrix, lower=1)
    # Where it is regular this takes a tenth of the time of eigenvalues.
    if not singular and scipy.linalg.lapack.dpocon(triangle, np.linalg.norm(matrix, 1), uplo="L")[0] > least:
        inverse, _ = scipy.linalg.lapack.dtrtri(triangle, lower=1, overwrite_c=1)
        return inverse.T, np.zeros((len(matrix), 0))
    lam, vectors = np.linalg.eigh(matrix)
    known = lam > least * lam[-1]
    return vectors[:, known] / np.sqrt(lam[known]), vectors[:, ~known]


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

    def of(self, modes: NDArray[np.bool_]) -> Perturbations:
        """The moves of some of the modes, and of the rigid-body mass."""
        poles = self.log_omega[modes], self.log_ratios[modes]
        return Perturbations(self.normals, self.phi[:, modes], self.gamma[modes], *poles, self.rigid)

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


def changes_of_matrices(
    structure: Structure, modes: Modes, moves: Perturbations, coupling: Array, coupled: Array
) -> Iterator[tuple[Array, Array]]:
    """Changes of M_SS, K_SS and C at the degrees of freedom, (n, n, moves), and the size of their entries, (n, n).

    Each is ``T^-T D T^-1``, T the modes at the degrees of freedom, D diagonal but for the `coupling` (n, n) of modes by
    dampers, which changes by `coupled` (n, n, moves). Degrees of freedom at a sensor move with
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
    for diagonal, change, others in (
        (np.ones_like(omega), np.zeros_like(moves.log_omega), False),
        (squared, 2 * squared[:, None] * moves.log_omega, False),
        (loss, loss[:, None] * (moves.log_omega + moves.log_ratios), bool(np.any(coupling))),
    ):
        inner = change[:, None] / 2 * P[:, :, None]
        inner -= diagonal[:, None, None] * moved
        if others:
            inner += np.einsum("klc,lj->kjc", coupled / 2, P) - np.einsum("kl,ljc->kjc", coupling, moved)
        half = (P.T @ inner.reshape(len(P), -1)).reshape(inner.shape)
        size = np.sqrt(diagonal @ P**2)
        yield half + half.swapaxes(0, 1), np.outer(size, size)
