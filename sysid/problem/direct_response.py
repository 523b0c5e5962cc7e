r"""The response of a structure by direct solves, line by line for any damping; derivatives of all that x stands for.

As CasADi expressions, of written matrices:

.. math:: (-\omega^2 M_{SS} + i \omega C + K_{SS})\, a = \omega^2 B \ddot u_0, \qquad B = M_{SS} G + M_{S0}

(eq. 13 of Cerini et al. 2024, with damping), a the accelerations relative to the base. In numbers, exact and of first
order: with :math:`Z = -\omega^2 M + i\omega C + K` and :math:`X = Z^{-1} \omega^2 B` (unit base motion), an unknown
moves the accelerations by :math:`dX = Z^{-1} (\omega^2 dB - dZ\, X)`; modes follow by first-order perturbation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
import numpy as np

from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.misfit import inflation_of, noise_records
from sysid.modal_analysis.modal_estimate import ModalEstimate, independent_rows, index_of, matched, theta_of
from sysid.modal_analysis.modal_fit import Modes
from sysid.modal_analysis.response import parts_of, records_of, weights_of_test
from sysid.models.complex_expressions import ComplexExpression
from sysid.problem.matrices import Matrices, Motion
from sysid.problem.residual_terms import ResidualTerms
from sysid.structure.structure import Array, ComplexArray, Structure
from sysid.structure.thresholds import ROUND_OFF

_SOLVER = "lapacklu"  # of the wheels' plugins the fastest on small dense systems


def relative_response(
    test: Measurement, motion: Motion, *, shift: float = 0.0
) -> tuple[ComplexExpression, ComplexExpression]:
    """Accelerations of the degrees of freedom relative to the base under a test's base motion, and the base force.

    (n, runs * n_freq) in m/s², and (d, runs * n_freq) in N. With `shift`, 1/s, at the complex frequencies
    ``s = shift + i w`` in the place of ``i w``: as if all poles had so much more decay.
    """
    n, d = motion.rigid_body_dofs.shape
    F = test.freq.size
    per_line = _one_line(n, d, shift).map(F)
    flat = [
        ca.repmat(ca.densify(matrix), 1, F) for matrix in (motion.mass, motion.damping, motion.stiffness, motion.push)
    ]
    answer = per_line(ca.DM(2 * np.pi * test.freq).T, *flat)  # (2n, d * F), the directions of a line side by side
    u_re, u_im = parts_of(test.base)
    real: list[ca.MX] = []
    imag: list[ca.MX] = []
    for run in range(test.n_runs):
        at = slice(run * F, (run + 1) * F)
        re, im = ca.MX.zeros(n, F), ca.MX.zeros(n, F)
        for j in range(d):
            H_re, H_im = answer[:n, j::d], answer[n:, j::d]
            x_re, x_im = (ca.repmat(part[j, at], n, 1) for part in (u_re, u_im))
            re, im = re + H_re * x_re - H_im * x_im, im + H_re * x_im + H_im * x_re
        real.append(re)
        imag.append(im)
    a = ComplexExpression(ca.horzcat(*real), ca.horzcat(*imag))
    push, rigid = motion.push, motion.rigid_body_mass
    return a, ComplexExpression(push.T @ a.real + rigid @ u_re, push.T @ a.imag + rigid @ u_im)


def absolute_response(test: Measurement, motion: Motion) -> ComplexExpression:
    """Absolute accelerations of the sensors under a test's base motion, (n_sensors, runs * n_freq), m/s²."""
    a, _ = relative_response(test, motion)
    R, G = ca.DM(motion.recovery), ca.DM(test.rigid_body)
    u_re, u_im = parts_of(test.base)
    return ComplexExpression(R @ a.real + G @ u_re, R @ a.imag + G @ u_im)


def relative_misfit(test: Measurement, motion: Motion, *, weighted: bool = False, shift: float = 0.0) -> ca.MX:
    """Relative residuals, stacked, as `response.residual` has them: of accelerations, then of a measured force."""
    a, f = relative_response(test, motion, shift=shift)
    R = ca.DM(motion.recovery)
    found, weights = (ComplexExpression(R @ a.real, R @ a.imag), f), weights_of_test(test, weighted=weighted)
    pieces: list[ca.MX] = []
    for (record, _), predicted, (weight, scale) in zip(records_of(test), found, weights, strict=False):
        real, imag = parts_of(record)
        pieces += [ca.DM(weight / scale) * part for part in (predicted.real - real, predicted.imag - imag)]
    return ca.vertcat(*(ca.vec(ca.densify(piece)) for piece in pieces))


def _one_line(n: int, d: int, shift: float) -> ca.Function:
    """Relative acceleration of one line for unit base motion, real over imaginary part, (2n, d)."""
    w = ca.MX.sym("w")
    M, C, K, B = ca.MX.sym("M", n, n), ca.MX.sym("C", n, n), ca.MX.sym("K", n, n), ca.MX.sym("B", n, d)
    # s² M + s C + K, and -s² B on the right: where nothing moves at rest, s = 0, that is zero too.
    real, imag = K + shift * C - (w**2 - shift**2) * M, w * C + 2 * shift * w * M
    dynamic = ca.blockcat([[real, -imag], [imag, real]])
    right = ca.vertcat((w**2 - shift**2) * B, -2 * shift * w * B)
    return ca.Function("line", [w, M, C, K, B], [ca.solve(dynamic, right, _SOLVER)])


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

    The shapes of modes of one frequency are not turned within their plane, unless `omega` (n,), rad/s, sets them apart.
    """
    structure = matrices.structure(x, test)
    symbol, p = ca.MX.sym("x", x.size), x.size
    every = matrices.function(symbol)
    # Beside C, or the ratios at given frequencies.
    w = 2 * np.pi * structure.natural_frequencies
    last = matrices.ratio_function(symbol, ca.DM(w)) if matrices.by_ratios else every[4]
    function = ca.Function("matrices", [symbol], [ca.densify(part) for part in (*every[:4], last)])
    # One forward sweep an unknown: a Jacobian of all entries as a graph takes far longer to build.
    sweeps = function.forward(1).map(p)
    here = (ca.repmat(ca.DM(part), 1, p) for part in (x, *function(x)))
    dM, dM_S0, dM_00, dK, dC = (
        np.asarray(wide).reshape(wide.shape[0], p, -1).swapaxes(1, 2) for wide in sweeps(*here, ca.DM.eye(p))
    )
    n = len(matrices.rigid_body)
    dM, dM_00, dK = ((part + part.swapaxes(0, 1)) / 2 for part in (dM, dM_00, dK))
    G = matrices.rigid_body
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
    apart = np.abs(gap) > ROUND_OFF * lam.max()
    # Modes of one frequency, and each mode itself, stay normalised to unit mass.
    turn = np.where(apart[:, :, None], moved / np.where(apart, gap, 1.0)[:, :, None], -by_mass / 2)
    k = np.arange(n)
    d_shapes = np.einsum("il,lkc->ikc", phi, turn)
    d_log_omega = moved[k, k] / (2 * lam[:, None])
    if matrices.by_ratios:
        # C = P' diag(2 zeta w) P with P = Phi^-1, so that dP = -turn P.
        P, loss = phi.T @ M, 2 * ratios * omega
        d_ratios = dC[:, 0] + _ratio_slopes(matrices, x, w) @ (omega[:, None] * d_log_omega)
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


def _ratio_slopes(matrices: Matrices, x: Array, omega: Array) -> Array:
    """Derivatives of the damping ratios by the circular frequencies, (n, n)."""
    w = ca.MX.sym("w", omega.size)
    ratios = matrices.ratio_function(ca.DM(x), w)
    return np.asarray(ca.densify(ca.Function("slopes", [w], [ca.jacobian(ratios, w)])(omega)))


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
    modal: ModalEstimate, s: Slopes, unknowns: int, beyond: ResidualTerms, *, share: float = 1.0,
    as_stated: bool = False,
) -> list[Rows]:  # fmt: skip
    """Rows of the accelerations and, where it was measured, of the force, as the local phase weighs them.

    Noise that is larger than stated, or shared by neighbouring lines, counts as the misfit shows it; with `as_stated`
    it is not, as where a test is planned. What modes `beyond` the lines explain is left out.
    """
    test = modal.records
    if s.structure.modal_damping:
        of_modes = _rows_of_modes(modal, s, unknowns, share=share, as_stated=as_stated)
        if of_modes is not None:
            return of_modes
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
    rows: list[Rows] = []
    unknowns += beyond.size
    records = noise_records(test, s.structure, unknowns)
    inflation = 1.0 if as_stated else inflation_of(test, records, unknowns)
    every = zip(records, parts, weights_of_test(test, weighted=True), strict=True)
    for i, (record, change, (weight, scale)) in enumerate(every):
        weights = share * weight / scale
        both = weights[..., None] * np.concatenate([-record.misfit[..., None], change], axis=2)
        both = beyond.without(i, both)
        left, flat = both[..., 0].ravel(), both[..., 1:].reshape(-1, change.shape[-1])
        std = inflation * (weights * record.std).ravel() / np.sqrt(2)
        rows.append(Rows(_real(left), _real(flat), np.concatenate([std, std])))
    return rows


def _rows_of_modes(
    estimate: ModalEstimate, s: Slopes, unknowns: int, *, share: float, as_stated: bool
) -> list[Rows] | None:
    """Rows of a test's modes in the place of its lines; None where none were fitted, or the structure has fewer."""
    test, structure = estimate.records, s.structure
    chosen = matched(estimate, 2 * np.pi * structure.natural_frequencies)
    if chosen is None:
        return None
    index = index_of(estimate)
    phi, gamma = structure.mode_shapes[:, chosen], structure.participation[chosen]
    d_phi = np.einsum("si,ikc->skc", structure.recovery, s.d_shapes[:, chosen])
    d_gamma = s.d_participation[chosen]
    size = np.sum(estimate.gamma**2, axis=1)
    scale = np.sum(gamma * estimate.gamma, axis=1) / size
    d_scale = np.einsum("kdc,kd->kc", d_gamma, estimate.gamma) / size[:, None]
    if test.force is not None:
        scale, d_scale = np.sign(scale), np.zeros_like(d_scale)
    # In the scale of the estimate, which accelerations leave open.
    d_phi = d_phi * scale[:, None] + phi[:, :, None] * d_scale
    d_gamma = (d_gamma - gamma[:, :, None] * (d_scale / scale[:, None])[:, None]) / scale[:, None, None]
    modes = Modes(
        phi * scale, gamma / scale[:, None], 2 * np.pi * structure.natural_frequencies[chosen],
        structure.damping_ratios[chosen],
    )  # fmt: skip
    corner = np.array([s.d_rigid[i, j] for i, j in index.pairs])
    slope = np.concatenate([
        d_phi.reshape(-1, d_phi.shape[-1]), d_gamma.reshape(-1, d_phi.shape[-1]), s.d_log_omega[chosen],
        s.d_log_ratios[chosen], corner,
    ])  # fmt: skip
    estimated = estimate.modes
    off = theta_of(modes, structure.rigid_body_mass, index) - theta_of(estimated, estimate.rigid, index)
    weight = share / weights_of_test(test, weighted=True)[0][1]
    factor, std = independent_rows(estimate)
    factor = weight * factor
    inflation = (
        1.0 if as_stated else inflation_of(test, noise_records(test, structure, unknowns), unknowns, estimate.scattered)
    )
    std = weight * inflation * std
    return [Rows(factor @ off, factor @ slope, std)]


def _real(z: ComplexArray) -> Array:
    return np.concatenate([z.real, z.imag])


def stacked_rows(rows: list[Rows]) -> Rows:
    """Several records one below the other."""
    return Rows(*(np.concatenate(part) for part in zip(*((r.residuals, r.jacobian, r.std) for r in rows), strict=True)))
