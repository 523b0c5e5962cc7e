"""Relaxed vector fitting with common poles: one step from poles to better ones.

B. Gustavsen, A. Semlyen, IEEE Trans. Power Delivery 14 (1999) 1052-1061; B. Gustavsen, ibid. 21 (2006) 1587-1592.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sysid.modal_analysis.pole_functions import factorised, unit_columns
from sysid.modal_analysis.residues import Records
from sysid.modal_analysis.response import gains_with_velocity, stacked
from sysid.structure.structure import Array, ComplexArray
from sysid.structure.thresholds import EXACT

Blocks = list[tuple[ComplexArray, ComplexArray, ComplexArray]]  # of each: `Records.principal`


def relocate(
    records: Records, blocks: Blocks, omega: Array, ratios: Array, tell: Callable[[], object],
    direct: ComplexArray | None = None,
) -> tuple[Array, Array]:  # fmt: skip
    """One step of relaxed vector fitting: the zeros of sigma in ``sigma a = sum of (r_1 + r_2 i w) g``.

    With `direct` (k, n_freq) functions that no pole has stand beside the sum.
    """
    w = 2 * np.pi * records.freq
    g, velocity = gains_with_velocity(records.freq, omega, ratios)
    numerators = np.concatenate([g, velocity] if direct is None else [g, velocity, direct])
    with np.errstate(divide="ignore", invalid="ignore"):
        partial = np.where(w > 0, (omega[:, None] / w) ** 2 * g, 1.0)  # w_k² over the same denominator
    sigma = np.concatenate([np.ones((1, w.size)), partial, 1j * w / omega[:, None] * partial])
    bases = []
    for base, ends, _ in blocks:
        tell()
        functions = [(numerators[:, None] * base).reshape(-1, w.size), (g[:, None] * ends).reshape(-1, w.size)]
        basis, _ = unit_columns(stacked(np.concatenate(functions)))
        bases.append(factorised(basis)[0])
    rows = _rows_by_squares(blocks, bases, sigma, tell)
    if rows is None:
        rows = _rows_by_factors(blocks, bases, sigma, tell)
    # Relaxation: the sum of Re sigma over the lines is fixed instead of its constant term.
    weight = np.sqrt(records.size) / w.size
    system = np.vstack([rows, weight * sigma.real.sum(axis=1)])
    wanted = np.zeros(len(system))
    wanted[-1] = weight * w.size
    system, size = unit_columns(system)
    c = np.linalg.lstsq(system, wanted, rcond=1e-14)[0] / size
    return _zeros(c, omega, ratios)


def _rows_by_factors(blocks: Blocks, bases: list[Array], sigma: ComplexArray, tell: Callable[[], object]) -> Array:
    """Triangle of the equations for sigma of all channels: what the numerators cannot fit of ``sigma a``."""
    triangle = np.empty((0, len(sigma)))
    for (*_, channels), Q in zip(blocks, bases, strict=True):
        for record in channels:
            tell()
            product = stacked(record * sigma)
            rows = np.vstack([triangle, product - Q @ (Q.T @ product)])
            triangle = np.asarray(np.linalg.qr(rows, mode="r"))
    return triangle


def _rows_by_squares(
    blocks: Blocks, bases: list[Array], sigma: ComplexArray, tell: Callable[[], object]
) -> Array | None:
    """The same, several times faster, from sums of squares; None where round-off would show in them.

    In functions U for which the sum over channels of ``|U a|²`` is one, the matrix of the equations is one less what
    the numerators fit. Its least eigenvalue is the share of noise in ``|sigma a|²``, however close the poles.
    """
    size = np.sqrt(sum(np.sum(np.abs(channels) ** 2, axis=0) for *_, channels in blocks))
    U, triangle = factorised(stacked(size * sigma))
    G = np.eye(len(triangle))
    share = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0)
    functions = _as_rows(U)
    for (*_, channels), Q in zip(blocks, bases, strict=True):
        answers = _as_rows(Q).view(float)
        for record in channels:
            tell()
            answered = answers @ (share * record * functions).view(float).T
            G -= answered.T @ answered
    values, vectors = np.linalg.eigh(G)
    if values[0] < EXACT:
        return None
    return np.sqrt(values)[:, None] * (vectors.T @ triangle)


def _as_rows(columns: Array) -> ComplexArray:
    """Columns, real parts above imaginary ones, as complex rows."""
    real, imaginary = np.split(columns.T, 2, axis=1)
    return np.ascontiguousarray(real + 1j * imaginary)


def _zeros(c: Array, omega: Array, ratios: Array) -> tuple[Array, Array]:
    """Zeros of sigma with coefficients c (1 + 2m,), as modes: eigenvalues of its second-order blocks after feedback."""
    m = omega.size
    constant = np.copysign(max(abs(c[0]), 1e-8), c[0])
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
