"""Residues of given poles: weighted linear least squares of the relative accelerations, or of the base force."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from sysid.measurement.measurement import Measurement, unit_runs
from sysid.measurement.noise import separable
from sysid.modal_analysis.response import columns, gains
from sysid.structure.structure import Array, ComplexArray

_DEVIATIONS = 12.0  # of the chi-squared law, by which a squared error must fall to mean something
ROUND_OFF = 1e-11  # of the records: what counts as noise where there is none
_NEIGHBOURS = 3  # lines on either side that may share their noise
_CHANCE = 5.0  # standard deviations of the correlation of white noise
_DEPENDENT = 1e-9  # of the largest singular value of the base records


@dataclass(frozen=True, eq=False)
class ResidueFit:
    """Records fitted on given poles.

    Attributes
    ----------
    Q : (rows, columns)
        Orthonormal basis of what the poles can answer.
    residues : (m, inputs, channels)
    left : (rows, channels)
        What they leave.
    whitened : (m, inputs, channels)
        Residues in units of what white noise of unit variance would scatter them by: the sum of squares of pole
        k is what the squared error would rise by without it.
    spread : (m, inputs, columns)
        Residues that one unit of each column of Q makes: scatter of the residues is ``spread @ spread'``.
    """

    Q: Array
    residues: Array
    left: Array
    whitened: Array
    spread: Array

    @property
    def squared_error(self) -> float:
        """Sum of squares of what is left."""
        return float(np.sum(self.left**2))

    @property
    def gain(self) -> Array:
        """What the squared error would rise by without each pole, (m,)."""
        return np.sum(self.whitened**2, axis=(1, 2))

    def rise_with_one_less(self, poles: NDArray[np.intp]) -> float:
        """What the squared error would at least rise by if one pole less answered for these, and all others stayed.

        A pole answers with one function of frequency for each input, whatever its place.
        """
        spread = self.spread[poles].reshape(-1, self.spread.shape[-1])
        beta = self.residues[poles].reshape(len(spread), -1)
        _, triangle = np.linalg.qr(spread.T)
        both = np.linalg.solve(triangle.T, beta)
        kept = len(both) - self.residues.shape[1]
        return float(np.sum(np.linalg.svd(both, compute_uv=False)[kept:] ** 2))


class Records:
    """Weighted relative accelerations of a test, or its base force; real parts above imaginary ones.

    Each record is ``sum over inputs of residue · gain · base``. Where each run moves the base in
    one direction of its own with unit acceleration, all runs have the same basis, and every pair of sensor and
    direction is one channel of a test with a single input.
    """

    def __init__(self, test: Measurement, *, force: bool = False) -> None:
        self.freq = test.freq
        record, std = (test.force, test.force_std) if force else (test.relative, test.response_std)
        assert record is not None
        self.n_sensors, self.n_base = record.shape[1], test.n_base
        channel, line = separable(std, record.shape)
        relative = record * channel[:, None]
        self.unit = test.n_runs == test.n_base and np.array_equal(test.base, unit_runs(test.n_base, test.freq.size))
        if self.unit:
            size = np.exp(np.log(line).mean(axis=1, keepdims=True))  # of each run
            shared = np.exp(np.log(line / size).mean(axis=0))
            blocks = [(shared[None].astype(complex), (relative * size[:, None] * shared).reshape(-1, test.freq.size))]
            self.channel = (size * channel).ravel()
        else:
            self.moving = independent(test.base)
            base = np.einsum("di,rdf->rif", self.moving, test.base * line[:, None])
            blocks = list(zip(base, relative * line[:, None], strict=True))
            self.channel = channel
        self.blocks = blocks
        self.base = np.concatenate([base for base, _ in blocks], axis=1)
        self.data = stacked(np.concatenate([records for _, records in blocks], axis=1))
        self.size = float(np.sum(self.data**2))

    def basis(self, gains: ComplexArray) -> Array:
        """Columns of gains (k, n_freq) times base motions, (rows, k * inputs)."""
        block = np.tile(gains, len(self.blocks))[:, None] * self.base[None]
        return stacked(block.reshape(-1, self.base.shape[1]))

    def fit(self, omega: Array, ratios: Array, *, velocity: bool = False) -> ResidueFit:
        """Best real residues of ``g``; with `velocity` those of ``i w / w_k g`` too, as further inputs."""
        g = gains(self.freq, omega, ratios)
        if velocity:
            g = np.stack([g, 2j * np.pi * self.freq / omega[:, None] * g], axis=1).reshape(-1, self.freq.size)
        X = self.basis(g)
        scale = np.linalg.norm(X, axis=0)
        scale[scale == 0] = 1.0
        Q, R = np.linalg.qr(X / scale)
        y = Q.T @ self.data
        inverse = scipy.linalg.solve_triangular(R, np.eye(R.shape[0]), check_finite=False)
        m = omega.size
        inverse /= scale[:, None]
        beta = (inverse @ y).reshape(m, -1, self.data.shape[1])
        spread = inverse.reshape(m, beta.shape[1], -1)
        factor = np.linalg.cholesky(np.einsum("kir,kjr->kij", spread, spread))
        whitened = np.linalg.solve(factor, beta)
        return ResidueFit(Q, beta, self.data - Q @ y, whitened, spread)

    def noise(self, left: Array, unknowns: int, *, least: float = ROUND_OFF) -> float:
        """Variance of a real number of the records about a fit of so many unknowns, as smooth functions feel it."""
        freedom = max(self.data.size - unknowns, 1)
        variance = self.line_correlation(left) * float(np.sum(left**2)) / freedom
        return max(variance, least**2 * self.size / self.data.size)

    def line_correlation(self, left: Array) -> float:
        """Factor by which noise weighs more on smooth functions as neighbouring lines share it; one for white noise.

        Windows of averaged spectra smear each error over some lines: of H1 with Hann's it is 1.9.
        """
        rows = len(left) // 2
        error = (left[:rows] + 1j * left[rows:]).reshape(-1, self.freq.size, left.shape[1])
        return line_correlation(np.moveaxis(error, 1, 2))

    def by_sensor(self, residues: Array) -> Array:
        """Residues (m, inputs, channels) of `fit` in the test's own units, (m, n_sensors, d).

        Directions in which the base does not move have none.
        """
        if self.unit:
            plain = (residues / self.channel).reshape(len(residues), self.n_base, self.n_sensors)
            return plain.transpose(0, 2, 1)
        return np.einsum("mic,di->mcd", residues / self.channel, self.moving)


def beyond_chance(freedom: float) -> float:
    """Squared size, in units of the noise's variance, that so many numbers of noise alone do not reach."""
    return float(freedom + _DEVIATIONS * np.sqrt(2 * freedom))


def line_correlation(error: ComplexArray) -> float:
    """Sum of the correlations of errors (..., n_freq) with those of their neighbours, where these are no chance."""
    power = float(np.sum(np.abs(error) ** 2))
    if power == 0 or error.shape[-1] <= 2 * _NEIGHBOURS:
        return 1.0
    factor = 1.0
    for lag in range(1, _NEIGHBOURS + 1):
        shared = float(np.sum(error[..., lag:] * error[..., :-lag].conj()).real) / power
        if shared < _CHANCE / np.sqrt(2 * error.size):
            break
        factor += 2 * shared
    return factor


def independent(base: ComplexArray) -> Array:
    """Combinations D (d, r) of base records (runs, d, n_freq) that are independent inputs ``D' u_0``.

    Each direction counts in units of its own size. What r < d inputs answer is taken to be due to the directions
    that move: residues R by base direction follow as ``R D'``.
    """
    flat = stacked(columns(base))
    size = np.linalg.norm(flat, axis=0)
    size[size == 0] = 1.0
    left, s, _ = np.linalg.svd((flat / size).T, full_matrices=False)
    return left[:, s > _DEPENDENT * s[0]] / size[:, None]


def stacked(record: ComplexArray) -> Array:
    """Channels (c, rows) as columns, real parts above imaginary ones, (2 rows, c)."""
    return np.vstack([record.real.T, record.imag.T])


def linear_residues(test: Measurement, omega: Array, ratios: Array) -> tuple[Array, float]:
    """Residues of given poles by linear least squares, whatever their rank.

    Parameters
    ----------
    test : Measurement
    omega, ratios : (m,)
        Circular frequencies, rad/s, and damping ratios; no two modes with one pole.

    Returns
    -------
    residues : (m, n_sensors, d)
    residual : float
        Relative residual that they leave: no modal model with these poles has a smaller one.
    """
    records = Records(test)
    fit = records.fit(omega, ratios)
    return records.by_sensor(fit.residues), float(np.sqrt(fit.squared_error / records.size))


def force_residual_left(test: Measurement, omega: Array, ratios: Array, *, velocity: bool = False) -> float:
    """Relative residual of the base force with its own residues and rigid-body mass free at given poles."""
    records = Records(test, force=True)
    own = gains(test.freq, omega, ratios)
    turned = [2j * np.pi * test.freq / omega[:, None] * own] if velocity else []
    g = np.concatenate([np.ones((1, test.freq.size)), own, *turned])
    basis = records.basis(g)
    Q = np.linalg.qr(basis / np.maximum(np.linalg.norm(basis, axis=0), np.finfo(float).tiny))[0]
    return float(np.linalg.norm(records.data - Q @ (Q.T @ records.data)) / np.sqrt(records.size))
