r"""Cramér-Rao bound of whole records of a base-shake test, at the true structure, with transients and noise everywhere.

At a line w of a record of N samples and duration T the modal accelerations are

.. math:: A_k = \frac{w^2 \gamma_k U + \alpha_k + i w \beta_k}{w_k^2 - w^2 + 2 i \zeta_k w_k w},

with two free numbers a mode and run; sensors record Phi A + G U, load cells Gamma' A + M_rb U. The base motion U is
unknown too, and measured with noise. Eliminating it leaves the information ``2 Re(J^H S^-1 J)`` of each line,
``S = N (diag(s_y², s_F²) + [H; Z] diag(s_u²) [H; Z]^H)``. Levels share no information with the rest. Of the
identification nothing is used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import sysid
from benchmarks.records.simulated import Levels, Modes, Run


@dataclass(frozen=True, eq=False)
class Bound:
    """Least standard deviations that an unbiased estimate can have.

    Attributes
    ----------
    natural_frequencies : (n,)
        Hz.
    damping_ratios : (n,)
    mass, stiffness, damping : (n, n)
        Entries of M_SS, K_SS and C.
    """

    natural_frequencies: np.ndarray
    damping_ratios: np.ndarray
    mass: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Unknowns beside the damping ratios; the matrices are linear in them.

    Attributes
    ----------
    mass : (p, n, n)
        Changes of M_SS, one an unknown.
    coupling : (q, n, d)
        Of M_S0.
    stiffness : (r, n, n)
        Of K_SS.
    base : (s, d, d)
        Of M_00, which counts only where the base force is measured.
    """

    mass: np.ndarray
    coupling: np.ndarray
    stiffness: np.ndarray
    base: np.ndarray


def symmetric(n: int, entries: list[tuple[int, int]] | None = None) -> np.ndarray:
    """Unit changes of some entries of a symmetric matrix, all of them by default, (entries, n, n)."""
    pairs = list(zip(*np.triu_indices(n), strict=True)) if entries is None else entries
    units = np.zeros((len(pairs), n, n))
    for unit, (i, j) in zip(units, pairs, strict=True):
        unit[i, j] = unit[j, i] = 1
    return units


def all_entries(n: int, d: int) -> Unknowns:
    """Nothing is stated."""
    return Unknowns(symmetric(n), np.eye(n * d).reshape(n * d, n, d), symmetric(n), symmetric(d))


def bound(
    structure: sysid.Structure, tests: list[tuple[Run, Levels]], band: tuple[float, float], unknowns: Unknowns, *,
    force: bool,
) -> Bound:  # fmt: skip
    """Bound of runs of one structure, whose degrees of freedom are the sensors.

    What records and statement leave open has no bound: of it the figures mean nothing.
    """
    modes = Modes.of(structure)
    known = information(modes, tests, band, force=force)
    T, slopes = _slopes(structure, modes, unknowns, weighed=force)
    fisher = T.T @ known @ T
    scale = np.sqrt(np.diag(fisher))
    covariance = np.linalg.pinv(fisher / np.outer(scale, scale), rcond=1e-12, hermitian=True) / np.outer(scale, scale)

    def std(name: str) -> np.ndarray:
        jacobian = slopes[name]
        return np.sqrt(np.maximum(np.einsum("...p,pq,...q->...", jacobian, covariance, jacobian), 0))

    return Bound(*(std(name) for name in slopes))


def information(modes: Modes, tests: list[tuple[Run, Levels]], band: tuple[float, float], *, force: bool) -> np.ndarray:
    """Information (p, p) about (Phi row by row, Gamma row by row, log w, log zeta, upper triangle of M_rb)."""
    total = np.zeros((_size(modes), _size(modes)))
    for run, levels in tests:
        J, _ = whitened(modes, run, levels, band, force=force)
        all_ = 2 * (J.conj().T @ J).real
        size = len(total)
        across = all_[:size, size:]
        total += all_[:size, :size] - across @ np.linalg.solve(all_[size:, size:], across.T)
    return total


def whitened(
    modes: Modes, run: Run, levels: Levels, band: tuple[float, float], *, force: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of one run's spectra by theta and its transients, (numbers, p + 2n), and modal parts, (numbers, n).

    Both are in deviations of the noise; the parts are what each mode adds to the records.
    """
    w, A, U, den = modal_spectra(modes, run, band)
    n, d = modes.gamma.shape
    sensors = len(modes.shapes)
    size = _size(modes)
    at_gamma, at_omega, at_zeta, at_rigid = sensors * n + n * np.array([0, d, d + 1, d + 2])
    J = np.zeros((w.size, sensors + d, size + 2 * n), dtype=complex)
    out = np.vstack([modes.shapes, modes.gamma.T])  # what a unit of each modal acceleration does to the channels
    loss = 2j * (modes.zeta * modes.omega)[:, None] * w
    for k in range(n):
        J[:, np.arange(sensors), np.arange(sensors) * n + k] = A[k][:, None]
        changes = {at_gamma + k * d + j: w**2 * U[j] for j in range(d)}
        changes[at_omega + k] = -A[k] * (2 * modes.omega[k] ** 2 + loss[k])
        changes[at_zeta + k] = -A[k] * loss[k]
        changes[size + k], changes[size + n + k] = modes.omega[k] * np.ones(w.size), 1j * w
        for column, change in changes.items():
            J[:, :, column] = (change / den[k])[:, None] * out[:, k]
        J[:, sensors + np.arange(d), at_gamma + k * d + np.arange(d)] += A[k][:, None]
    for p, (a, b) in enumerate(zip(*np.triu_indices(d), strict=True)):
        J[:, sensors + a, at_rigid + p] = U[b]
        J[:, sensors + b, at_rigid + p] = U[a]
    parts = A.T[:, None] * out
    factor = np.linalg.cholesky(_noise(modes, run, levels, w, den))
    if not force:
        J, parts, factor = (x[:, :sensors] for x in (J, parts, factor))
        factor = factor[:, :, :sensors]
    channels = J.shape[1] * w.size
    return np.linalg.solve(factor, J).reshape(channels, -1), np.linalg.solve(factor, parts).reshape(channels, -1)


def modal_spectra(
    modes: Modes, run: Run, band: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Lines, rad/s; modal accelerations (n, lines), base (d, lines) and denominators of a run, by the unscaled FFT."""
    count, rate = run.motion.samples, run.motion.sample_rate
    freq = np.arange(count // 2 + 1) * rate / count
    keep = (freq >= band[0]) & (freq <= band[1])
    w = 2 * np.pi * freq[keep]
    U = np.fft.rfft(run.motion.in_time(run.motion.amplitudes))[:, keep]
    (q0, v0), (q1, v1) = run.state(0.0), run.state(count / rate)
    beta = modes.omega**2 * (q1 - q0) + 2 * modes.zeta * modes.omega * (v1 - v0)
    transient = rate * ((modes.omega**2 * (v1 - v0))[:, None] + 1j * w * beta[:, None])
    den = (modes.omega**2)[:, None] - w**2 + 2j * (modes.zeta * modes.omega)[:, None] * w
    return w, (w**2 * (modes.gamma @ U) + transient) / den, U, den


def _noise(modes: Modes, run: Run, levels: Levels, w: np.ndarray, den: np.ndarray) -> np.ndarray:
    """S, (lines, channels, channels)."""
    g = (w**2 / den).T[:, None]
    H = (modes.shapes * g) @ modes.gamma + modes.rigid_body
    Z = (modes.gamma.T * g) @ modes.gamma + modes.rigid_body_mass
    both = np.concatenate([H, Z], axis=1) * levels.base
    own = np.diag(np.concatenate([levels.response, levels.force]) ** 2)
    return run.motion.samples * (own + both @ np.swapaxes(both, 1, 2).conj())


def _size(modes: Modes) -> int:
    n, d = modes.gamma.shape
    return n * (len(modes.shapes) + d + 2) + d * (d + 1) // 2


def _slopes(
    structure: sysid.Structure, modes: Modes, unknowns: Unknowns, *, weighed: bool
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Derivatives of theta, (p, unknowns), and of the quantities of `Bound`, by all unknowns.

    Slopes of modes by Fox and Kapoor (AIAA J. 6 (1968) 2426-2429): ``d(w_k²) = phi_k' (dK - w_k² dM) phi_k``.
    """
    n, d = modes.gamma.shape
    phi, squares, c = modes.shapes, modes.omega**2, 2 * modes.zeta * modes.omega
    M, G = structure.mass[:n, :n], modes.rigid_body
    B = M @ G + structure.mass[:n, n:]
    base = unknowns.base if weighed else unknowns.base[:0]
    groups = (unknowns.mass, unknowns.coupling, unknowns.stiffness, base, np.eye(n))
    dM, dS, dK, d_base, log_zeta = _side_by_side(groups)
    total = len(dM)
    dB = dM @ G + dS
    d_rigid = G.T @ dB + np.swapaxes(dS, 1, 2) @ G + d_base

    mass, stiffness = phi.T @ dM @ phi, phi.T @ dK @ phi
    driven = stiffness - mass * squares  # [unknown, l, k]
    log_omega = np.einsum("pkk->pk", driven) / (2 * squares)
    apart = squares - squares[:, None] + np.diag(np.full(n, np.inf))
    d_phi = phi @ (driven / apart - np.einsum("pkk->pk", mass)[:, None] / 2 * np.eye(n))
    d_gamma = np.swapaxes(d_phi, 1, 2) @ B + phi.T @ dB
    Q = M @ phi
    dQ = dM @ phi + M @ d_phi
    half = (dQ * c) @ Q.T
    dC = half + np.swapaxes(half, 1, 2) + (Q * (c * (log_omega + log_zeta))[:, None]) @ Q.T
    theta = [d_phi.reshape(total, -1), d_gamma.reshape(total, -1), log_omega, log_zeta]
    theta.append(d_rigid[:, *np.triu_indices(d)])
    slopes = {
        "natural_frequencies": log_omega * modes.omega / (2 * np.pi), "damping_ratios": log_zeta * modes.zeta,
        "mass": dM, "stiffness": dK, "damping": dC,
    }  # fmt: skip
    return np.hstack(theta).T, {name: np.moveaxis(slope, 0, -1) for name, slope in slopes.items()}


def _side_by_side(groups: tuple[np.ndarray, ...]) -> list[np.ndarray]:
    """Each group of changes as one of all unknowns: zero where another group changes."""
    ends = np.cumsum([len(group) for group in groups])
    spread = [np.zeros((int(ends[-1]), *group.shape[1:])) for group in groups]
    for whole, group, end in zip(spread, groups, ends, strict=True):
        whole[end - len(group) : end] = group
    return spread
