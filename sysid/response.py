"""The frequency-domain residual as CasADi expressions, bilinear in mode shapes and participations."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from sysid.structure import Array, ComplexArray


@dataclass(frozen=True, eq=False)
class Target:
    """What a model must reproduce: relative accelerations, and the base force where it was measured.

    Attributes
    ----------
    freq : (n_freq,) Hz
    base : complex (runs, d, n_freq)
    relative : complex (runs, n, n_freq)
    force : complex (runs, d, n_freq) or None
    """

    freq: Array
    base: ComplexArray
    relative: ComplexArray
    force: ComplexArray | None = None


def _columns(record: ComplexArray) -> ComplexArray:
    """(runs, channels, n_freq) → (channels, runs * n_freq)."""
    return np.moveaxis(record, 0, 1).reshape(record.shape[1], -1)


def _parts(record: ComplexArray) -> tuple[ca.DM, ca.DM]:
    """Real and imaginary part; zeros are structural, so that real unit runs cost no imaginary arithmetic."""
    columns = _columns(record)
    return ca.sparsify(ca.DM(columns.real)), ca.sparsify(ca.DM(columns.imag))


def modal_gains(omega: ca.MX, ratios: ca.MX, freq: Array) -> tuple[ca.MX, ca.MX]:
    """Real and imaginary part of ``g_k = w² / (w_k² - w² + 2 i zeta_k w_k w)``, (m, n_freq) each (eq. 14)."""
    w = ca.DM(2 * np.pi * freq).T
    squared = ca.repmat(w**2, omega.numel(), 1)
    detuning = omega**2 @ ca.DM.ones(1, freq.size) - squared
    loss = (2 * ratios * omega) @ w
    size = squared / (detuning**2 + loss**2)
    return size * detuning, -size * loss


def residual(
    target: Target, phi: ca.MX, gamma: ca.MX, omega: ca.MX, ratios: ca.MX, rigid_body_mass: ca.MX | None = None
) -> ca.MX:
    """Relative residuals, stacked: their sum of squares is the squared relative error of each record.

    Parameters
    ----------
    target : Target
    phi : (n, m)
        Mode shapes at the sensors.
    gamma : (m, d)
        Participations.
    omega, ratios : (m, 1)
        Circular frequencies, rad/s, and damping ratios.
    rigid_body_mass : (d, d), kg
        Needed where the target has a force.

    Returns
    -------
    MX, a column
        ``(A_estimated - A_target) / ‖A_target‖`` (eq. 15), real then imaginary parts, then the
        same of the base force.
    """
    runs = target.base.shape[0]
    g_re, g_im = modal_gains(omega, ratios, target.freq)
    if runs > 1:
        g_re, g_im = ca.repmat(g_re, 1, runs), ca.repmat(g_im, 1, runs)
    u_re, u_im = _parts(target.base)
    push_re, push_im = gamma @ u_re, gamma @ u_im
    q_re, q_im = g_re * push_re - g_im * push_im, g_re * push_im + g_im * push_re
    scale = np.linalg.norm(target.relative)
    a_re, a_im = _parts(target.relative)
    pieces = [(phi @ q_re - a_re) / scale, (phi @ q_im - a_im) / scale]
    if target.force is not None:
        assert rigid_body_mass is not None
        scale = np.linalg.norm(target.force)
        f_re, f_im = _parts(target.force)
        pieces += [
            (gamma.T @ q_re + rigid_body_mass @ u_re - f_re) / scale,
            (gamma.T @ q_im + rigid_body_mass @ u_im - f_im) / scale,
        ]
    return ca.vertcat(*(ca.vec(ca.densify(piece)) for piece in pieces))
