"""Poles from the data: number, frequency and damping of the modes, over all sensors and directions at once.

Relaxed vector fitting of the relative accelerations with common poles (Gustavsen and Semlyen 1999; Gustavsen
2006), in the basis ``g_k = w² / (w_k² - w² + 2 i zeta_k w_k w)`` so that errors weigh as accelerations, from more
poles than there can be modes. Those that do not earn their place are removed one by one (the rise of the squared error
without a pole against the noise), and what stays is polished by variable projection over (log w, log zeta) with
real residues.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from sysid.errors import InputError
from sysid.measurement import Measurement
from sysid.response import columns, gains
from sysid.structure import Array, ComplexArray

_SPARE = 6  # poles beyond the number of sensors: without spare ones noise moves true poles
_RELOCATIONS = 6
_ROUNDS = 4
_STEPS = 20
_DEVIATIONS = 12.0  # of the chi-squared law, by which a pole must lower the squared error to stay
_ROUND_OFF = 1e-11  # of the records: what counts as noise where there is none
_DAMPED = 0.5  # a pole with more damping than this is no mode of a structure
_EDGE = 0.1  # how far outside the lines a mode may lie, as a fraction of their ends


@dataclass(frozen=True, eq=False)
class Poles:
    """Modes that stand out of the data.

    Attributes
    ----------
    omega, ratios : (m,)
        Circular frequencies, rad/s, ascending, and damping ratios.
    residual : float
        Relative residual of the modal model with these poles and free real residues.
    """

    omega: Array
    ratios: Array
    residual: float


def find_poles(test: Measurement, *, spare: int = _SPARE) -> Poles:
    """Find the modes that stand out of the noise.

    Parameters
    ----------
    test : Measurement
        Its lines must hold the modes; lines closer than the half-power bandwidth.
    spare : int
        Poles to begin with beyond the number of sensors.

    Raises
    ------
    InputError
        Too few lines for so many poles, or no mode at all.

    References
    ----------
    B. Gustavsen, A. Semlyen, IEEE Trans. Power Delivery 14 (1999) 1052-1061; B. Gustavsen, ibid. 21 (2006)
    1587-1592. G. H. Golub, V. Pereyra, SIAM J. Numer. Anal. 10 (1973) 413-432, with Kaufman's Jacobian (1975).
    """
    count = test.n_sensors + spare
    w = 2 * np.pi * test.freq[test.freq > 0]
    if 2 * w.size < 4 * count + 2:
        raise InputError(
            f"{w.size} lines are too few to look for {count} poles: state natural_frequencies or add lines"
        )
    records = _Records(test)
    omega, ratios = np.geomspace(w[0], w[-1], count), np.full(count, 0.01)
    for _ in range(_RELOCATIONS):
        omega, ratios = _relocate(test, omega, ratios)
    for round_ in range(_ROUNDS):
        before = omega.size
        omega, ratios = _prune(records, omega, ratios)
        if omega.size == 0:
            raise InputError(
                "no mode stands out of the noise between these lines: state natural_frequencies or widen them"
            )
        if round_ == 0 or records.fit(omega, ratios).squared_error < 1e-16 * records.size:
            for _ in range(3):
                omega, ratios = _relocate(test, omega, ratios)
        omega, ratios = _polish(records, omega, ratios)
        if round_ > 0 and omega.size == before:
            break
    order = np.argsort(omega)
    left = np.sqrt(records.fit(omega, ratios).squared_error / records.size)
    return Poles(omega[order], ratios[order], float(left))


@dataclass(frozen=True, eq=False)
class _Fit:
    """Linear least squares of the records on given poles.

    ``Q`` spans the basis; ``residues`` (m, d, n); ``left`` the error; ``gain`` (m,) how much each pole lowers it.
    """

    Q: Array
    residues: Array
    left: Array
    gain: Array

    @property
    def squared_error(self) -> float:
        return float(np.sum(self.left**2))


class _Records:
    """The relative accelerations, real and imaginary parts stacked, and fits of them."""

    def __init__(self, test: Measurement) -> None:
        self.freq, self.w = test.freq, 2 * np.pi * test.freq
        self.runs = test.n_runs
        self.base, relative = columns(test.base), columns(test.relative)
        self.data = np.vstack([relative.T.real, relative.T.imag])
        self.size = float(np.sum(self.data**2))

    def stack(self, gains: ComplexArray) -> Array:
        """Columns of gains (m, n_freq) times base motions, real parts above imaginary, (rows, m * d)."""
        block = np.tile(gains, self.runs)[:, None] * self.base[None]
        columns = block.reshape(-1, self.base.shape[1]).T
        return np.vstack([columns.real, columns.imag])

    def fit(self, omega: Array, ratios: Array) -> _Fit:
        X = self.stack(gains(self.freq, omega, ratios))
        scale = np.linalg.norm(X, axis=0)
        scale[scale == 0] = 1.0
        Q, R = np.linalg.qr(X / scale)
        y = Q.T @ self.data
        beta = scipy.linalg.solve_triangular(R, y)
        d, m = self.base.shape[0], omega.size
        inverse = scipy.linalg.solve_triangular(R, np.eye(R.shape[0]))
        blocks = beta.reshape(m, d, -1)
        # Leaving pole k out raises the squared error by beta_k' [(X'X)^-1]_kk^-1 beta_k.
        covariance = np.einsum("kir,kjr->kij", inverse.reshape(m, d, -1), inverse.reshape(m, d, -1))
        gain = np.einsum("kin,kin->k", blocks, np.linalg.solve(covariance, blocks))
        return _Fit(Q, (beta / scale[:, None]).reshape(m, d, -1), self.data - Q @ y, gain)


def _relocate(test: Measurement, omega: Array, ratios: Array) -> tuple[Array, Array]:
    """One step of relaxed vector fitting: the zeros of sigma in ``sigma a = sum of (r_1 + r_2 i w) g``."""
    w, m = 2 * np.pi * test.freq, omega.size
    g = gains(test.freq, omega, ratios)
    numerators = np.concatenate([g, 1j * w / omega[:, None] * g])
    partial = (omega[:, None] / w) ** 2 * g  # w_k² over the same denominator
    sigma = np.concatenate([np.ones((1, w.size)), partial, 1j * w / omega[:, None] * partial]).T
    relative = test.relative
    rows = []
    for run in range(test.n_runs):
        moving = np.flatnonzero(np.any(test.base[run] != 0, axis=1))
        basis = (numerators[:, None] * test.base[run, moving]).reshape(-1, w.size).T
        basis = np.vstack([basis.real, basis.imag])
        Q = np.linalg.qr(basis / np.maximum(np.linalg.norm(basis, axis=0), np.finfo(float).tiny))[0]
        for record in relative[run]:
            product = record[:, None] * sigma
            stacked = np.vstack([product.real, product.imag])
            stacked = stacked - Q @ (Q.T @ stacked)
            stacked = stacked - Q @ (Q.T @ stacked)  # twice is enough
            rows.append(np.linalg.qr(stacked, mode="r"))
    # Relaxation: the sum of Re sigma over the lines is fixed instead of its constant term.
    weight = np.linalg.norm(relative) / w.size
    system = np.vstack([*rows, weight * sigma.real.sum(axis=0)])
    wanted = np.zeros(len(system))
    wanted[-1] = weight * w.size
    scale = np.maximum(np.linalg.norm(system, axis=0), np.finfo(float).tiny)
    c = np.linalg.lstsq(system / scale, wanted, rcond=1e-14)[0] / scale
    constant = c[0] if abs(c[0]) > 1e-8 else np.copysign(1e-8, c[0])
    # sigma's poles as second-order blocks; its zeros are the eigenvalues after feedback.
    A, b, out = np.zeros((2 * m, 2 * m)), np.zeros(2 * m), np.zeros(2 * m)
    i = 2 * np.arange(m)
    A[i, i + 1], A[i + 1, i], A[i + 1, i + 1] = omega, -omega, -2 * ratios * omega
    b[i + 1], out[i], out[i + 1] = omega, c[1 : m + 1], c[m + 1 :]
    return _as_modes(np.linalg.eigvals(A - np.outer(b, out) / constant))


def _as_modes(eigenvalues: ComplexArray) -> tuple[Array, Array]:
    """Frequency and damping of each conjugate pair; unstable ones mirrored, real ones paired off as overdamped."""
    real = np.abs(eigenvalues.imag) <= 1e-9 * np.abs(eigenvalues)
    pairs = eigenvalues[~real & (eigenvalues.imag > 0)]
    sizes = np.sort(np.abs(eigenvalues[real]))
    sizes = sizes[: 2 * (sizes.size // 2)]
    omega = np.concatenate([np.abs(pairs), np.sqrt(sizes[::2] * sizes[1::2])])
    ratios = np.concatenate([np.abs(pairs.real) / np.abs(pairs), np.full(sizes.size // 2, 0.9)])
    keep = omega > 0
    order = np.argsort(omega[keep])
    return omega[keep][order], np.clip(ratios[keep][order], 1e-5, 0.99)


def _prune(records: _Records, omega: Array, ratios: Array) -> tuple[Array, Array]:
    """Remove poles, the least useful first, until each that stays lowers the error by far more than noise would."""
    low, high = (1 - _EDGE) * records.w[0], (1 + _EDGE) * records.w[-1]
    inside = (omega > low) & (omega < high) & (ratios < _DAMPED)
    while omega.size:
        fit = records.fit(omega, ratios)
        each = fit.residues[0].size + 2  # real parameters that come with a pole
        freedom = max(records.data.size - omega.size * each, 1)
        noise = max(fit.squared_error / freedom, _ROUND_OFF**2 * records.size / records.data.size)
        # What is no mode goes first, whatever it explains.
        worth = np.where(inside, fit.gain / noise, -1.0)
        least = int(np.argmin(worth))
        if worth[least] > each + _DEVIATIONS * np.sqrt(2 * each):
            break
        omega, ratios, inside = (np.delete(values, least) for values in (omega, ratios, inside))
    return omega, ratios


def _polish(records: _Records, omega: Array, ratios: Array) -> tuple[Array, Array]:
    """Variable projection: Levenberg-Marquardt steps over (log w, log zeta), the residues eliminated."""
    m = omega.size
    p = np.log(np.concatenate([omega, ratios]))
    damping = 1e-3
    error, H, slope = _projected(records, p)
    for _ in range(_STEPS):
        step = np.linalg.solve(H + damping * np.diag(np.diag(H)), slope)
        trial = p + np.clip(step, -0.5, 0.5)
        trial[m:] = np.clip(trial[m:], np.log(1e-6), np.log(0.99))
        lower, *model = _projected(records, trial)
        if lower < error:
            done = error - lower < 1e-12 * error
            p, error, (H, slope), damping = trial, lower, model, max(damping / 10, 1e-12)
            if done:
                break
        else:
            damping *= 10
            if damping > 1e6:
                break
    return np.exp(p[:m]), np.exp(p[m:])


def _projected(records: _Records, p: Array) -> tuple[float, Array, Array]:
    """Squared error, Gauss-Newton matrix (2m, 2m) and descent direction of the projected problem at log poles `p`."""
    m = p.size // 2
    omega, ratios = np.exp(p[:m]), np.exp(p[m:])
    fit, w = records.fit(omega, ratios), records.w
    g = gains(records.freq, omega, ratios)
    over = g / w**2  # one over the denominator
    loss = 2j * (ratios * omega)[:, None] * w
    slopes = records.stack(np.concatenate([-g * over * (2 * omega[:, None] ** 2 + loss), -g * over * loss]))
    slopes = slopes - fit.Q @ (fit.Q.T @ slopes)
    residues = np.concatenate([fit.residues, fit.residues]).reshape(slopes.shape[1], -1)
    d = slopes.shape[1] // (2 * m)
    H = ((slopes.T @ slopes) * (residues @ residues.T)).reshape(2 * m, d, 2 * m, d).sum(axis=(1, 3))
    slope = np.sum((slopes.T @ fit.left) * residues, axis=1).reshape(2 * m, d).sum(axis=1)
    return fit.squared_error, H, slope
