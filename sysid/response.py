"""The frequency-domain residual as CasADi expressions, bilinear in mode shapes and participations."""

from __future__ import annotations

import casadi as ca
import numpy as np

from sysid.measurement import Measurement
from sysid.structure import Array, ComplexArray


def columns(record: ComplexArray) -> ComplexArray:
    """All runs side by side: (runs, channels, n_freq) → (channels, runs * n_freq)."""
    return np.moveaxis(record, 0, 1).reshape(record.shape[1], -1)


def _parts(record: ComplexArray) -> tuple[ca.DM, ca.DM]:
    """Real and imaginary part; zeros are structural, so that real unit runs cost no imaginary arithmetic."""
    flat = columns(record)
    return ca.sparsify(ca.DM(flat.real)), ca.sparsify(ca.DM(flat.imag))


def modal_gains(omega: ca.MX, ratios: ca.MX, freq: Array) -> tuple[ca.MX, ca.MX]:
    """Real and imaginary part of ``g_k = w² / (w_k² - w² + 2 i zeta_k w_k w)``, (m, n_freq) each (eq. 14)."""
    w = ca.DM(2 * np.pi * freq).T
    squared = ca.repmat(w**2, omega.numel(), 1)
    detuning = omega**2 @ ca.DM.ones(1, freq.size) - squared
    loss = (2 * ratios * omega) @ w
    size = squared / (detuning**2 + loss**2)
    return size * detuning, -size * loss


def residual(test: Measurement, phi: ca.MX, gamma: ca.MX, omega: ca.MX, ratios: ca.MX, rigid_body_mass: ca.MX) -> ca.MX:
    """Relative residuals, stacked: their sum of squares is the squared relative error of each record.

    Parameters
    ----------
    test : Measurement
    phi : (n, m)
        Mode shapes at the sensors.
    gamma : (m, d)
        Participations.
    omega, ratios : (m, 1)
        Circular frequencies, rad/s, and damping ratios.
    rigid_body_mass : (d, d), kg
        Read only where the test has a force.

    Returns
    -------
    MX, a column
        ``(A_estimated - A_target) / ‖A_target‖`` (eq. 15), real then imaginary parts, then the
        same of the base force.
    """
    runs = test.base.shape[0]
    g_re, g_im = modal_gains(omega, ratios, test.freq)
    if runs > 1:
        g_re, g_im = ca.repmat(g_re, 1, runs), ca.repmat(g_im, 1, runs)
    u_re, u_im = _parts(test.base)
    push_re, push_im = gamma @ u_re, gamma @ u_im
    q_re, q_im = g_re * push_re - g_im * push_im, g_re * push_im + g_im * push_re
    scale = np.linalg.norm(test.relative)
    a_re, a_im = _parts(test.relative)
    pieces = [(phi @ q_re - a_re) / scale, (phi @ q_im - a_im) / scale]
    if test.force is not None:
        scale = np.linalg.norm(test.force)
        f_re, f_im = _parts(test.force)
        pieces += [
            (gamma.T @ q_re + rigid_body_mass @ u_re - f_re) / scale,
            (gamma.T @ q_im + rigid_body_mass @ u_im - f_im) / scale,
        ]
    return ca.vertcat(*(ca.vec(ca.densify(piece)) for piece in pieces))


def linear_residues(test: Measurement, omega: Array, ratios: Array) -> tuple[Array, float]:
    """Residues of given poles by linear least squares, whatever their rank.

    Parameters
    ----------
    test : Measurement
    omega, ratios : (m,)
        Circular frequencies, rad/s, and damping ratios.

    Returns
    -------
    residues : (m, n, d)
    residual : float
        Relative residual that they leave, with that of the base force (its residues free too) as in
        `residual`: no modal model with these poles has a smaller one.
    """
    design, records = _modal_basis(test, omega, ratios), columns(test.relative).T
    answer = _real_least_squares(design, records)
    left = np.linalg.norm(design @ answer - records) / np.linalg.norm(records)
    if test.force is not None:
        weighing, force = np.hstack([columns(test.base).T, design]), columns(test.force).T
        missed = weighing @ _real_least_squares(weighing, force) - force
        left = np.hypot(left, np.linalg.norm(missed) / np.linalg.norm(force))
    return answer.reshape(omega.size, test.n_base, -1).transpose(0, 2, 1), float(left)


def weighed_mass(test: Measurement, omega: Array, ratios: Array) -> Array:
    """Rigid-body mass (d, d) that the base force tells, its modal part free at the given poles; kg."""
    assert test.force is not None
    design = np.hstack([columns(test.base).T, _modal_basis(test, omega, ratios)])
    return _real_least_squares(design, columns(test.force).T)[: test.n_base].T


def gains(freq: Array, omega: Array, ratios: Array) -> ComplexArray:
    """Numbers of ``g_k = w² / (w_k² - w² + 2 i zeta_k w_k w)`` at lines in Hz, (m, n_freq)."""
    w = 2 * np.pi * freq
    return w**2 / (omega[:, None] ** 2 - w**2 + 2j * (ratios * omega)[:, None] * w)


def _modal_basis(test: Measurement, omega: Array, ratios: Array) -> ComplexArray:
    """Response of each mode to each base direction, (runs * n_freq, m * d)."""
    g = gains(test.freq, omega, ratios)
    u = columns(test.base)
    return (np.tile(g, test.n_runs)[:, None] * u[None]).reshape(-1, u.shape[1]).T


def _real_least_squares(design: ComplexArray, records: ComplexArray) -> Array:
    stacked = np.vstack([design.real, design.imag])
    return np.linalg.lstsq(stacked, np.vstack([records.real, records.imag]), rcond=None)[0]
