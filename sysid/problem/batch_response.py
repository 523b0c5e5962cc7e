"""Responses of many candidates at once."""

from __future__ import annotations

import numpy as np

from sysid.structure.structure import Array, ComplexArray


def by_states(M: Array, K: Array, C: Array, B: Array, freq: Array, shift: float) -> ComplexArray:
    """Relative acceleration for unit base motion, from the eigenvalues of the state space: ``a = s² v``."""
    count, n, d = B.shape
    A = np.zeros((count, 2 * n, 2 * n))
    A[:, :n, n:] = np.eye(n)
    A[:, n:, :n], A[:, n:, n:] = -np.linalg.solve(M, K), -np.linalg.solve(M, C)
    push = np.concatenate([np.zeros((count, n, d)), -np.linalg.solve(M, B)], axis=1)
    s = shift + 2j * np.pi * freq
    lam, vectors = np.linalg.eig(A)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        try:
            strength = np.linalg.solve(vectors, push.astype(complex))
        except np.linalg.LinAlgError:  # a defective candidate among them: each by least squares
            strength = np.linalg.pinv(vectors) @ push
        poles = s**2 / (s - lam[:, :, None])
        return np.einsum("pik,pkd,pkf->pidf", vectors[:, :n], strength, poles, optimize=True)
