"""Responses of many candidates at once, from LAPACK's batched eigensolvers and linear solvers.

All take matrices of ``count`` candidates: mass M and stiffness K (count, n, n), load vectors B (count, n, d), lines in
Hz and a shift of the complex frequencies ``s = shift + i w``, 1/s; all return relative accelerations for unit base
motion, (count, n, d, n_freq). What one candidate gives does not depend on the others, to the last bit.
"""

from __future__ import annotations

import contextlib

import numpy as np

from sysid.structure.structure import Array, ComplexArray
from sysid.structure.thresholds import EPSILON, ROUND_OFF


def by_states(M: Array, K: Array, C: Array, B: Array, freq: Array, shift: float) -> ComplexArray:
    """Response from the eigenvalues of the state space, ``a = s² v``, the damping a matrix (count, n, n).

    Candidates whose eigenvectors (nearly) fall together are solved `by_lines`.
    """
    count, n, d = B.shape
    rates = -np.linalg.solve(M, np.concatenate([K, C, B], axis=2))
    A = np.zeros((count, 2 * n, 2 * n))
    A[:, :n, n:] = np.eye(n)
    A[:, n:] = rates[..., : 2 * n]
    s = shift + 2j * np.pi * freq
    lam, vectors = np.linalg.eig(A)
    right = np.zeros((count, 2 * n, d + 2 * n), dtype=complex)
    right[:, n:, :d] = rates[..., 2 * n :]
    right[..., d:] = np.eye(2 * n)
    solved = _solved(vectors, right)  # of the load vectors, and the inverse
    strength, inverse = solved[..., :d], solved[..., d:]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        poles = s**2 / (s - lam[:, :, None])
        response = np.einsum("pik,pkd,pkf->pidf", vectors[:, :n], strength, poles, optimize=True)
        # Structures have some hundreds; the condition of the eigenvectors of a state matrix, its rows scaled, rises
        # without bound where they fall together, as at critical damping.
        ill = ~(_squared_condition(vectors, inverse) < (ROUND_OFF / EPSILON) ** 2)
    if np.any(ill):
        response[ill] = by_lines(M[ill], K[ill], C[ill], B[ill], freq, shift)
    return response


def by_lines(M: Array, K: Array, C: Array, B: Array, freq: Array, shift: float) -> ComplexArray:
    """Response by one linear system a line, the damping a matrix: slower, and exact for every damping.

    NaN where a candidate without damping has a natural frequency on a line.
    """
    s = (shift + 2j * np.pi * freq)[:, None, None]
    response = np.full((*B.shape, freq.size), np.nan, dtype=complex)
    for p in range(len(M)):  # one candidate at a time: the systems of all lines of all would fill the memory
        with contextlib.suppress(np.linalg.LinAlgError):
            v = np.linalg.solve(s**2 * M[p] + s * C[p] + K[p], -B[p, None].astype(complex))
            response[p] = np.moveaxis(s**2 * v, 0, -1)
    return response


def _solved(matrices: ComplexArray, right: ComplexArray) -> ComplexArray:
    """Solutions of each system; NaN where a matrix is singular."""
    try:
        return np.linalg.solve(matrices, right)
    except np.linalg.LinAlgError:  # one among them, which must not stop the others
        out = np.full_like(right, np.nan)
        for p in range(len(matrices)):
            with contextlib.suppress(np.linalg.LinAlgError):
                out[p] = np.linalg.solve(matrices[p], right[p])
        return out


def _squared_condition(vectors: ComplexArray, inverse: ComplexArray) -> Array:
    """Square of the condition number in the Frobenius norm, each row of the vectors scaled to a largest entry of one.

    So that it depends on no unit: displacements stand above velocities.
    """
    squares = vectors.real**2 + vectors.imag**2
    size = squares.max(axis=2, keepdims=True)
    of_inverse = (inverse.real**2 + inverse.imag**2).sum(axis=1)
    return (squares / size).sum(axis=(1, 2)) * (of_inverse * size[..., 0]).sum(axis=1)
