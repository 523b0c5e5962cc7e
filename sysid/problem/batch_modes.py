"""Modes of many candidates at once, from what their models' expressions gave."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sysid.structure.structure import Array
from sysid.structure.thresholds import ROUND_OFF


class BatchModes(NamedTuple):
    """Mass-normalised modes of many candidates, those of a candidate in ascending order of frequency.

    Attributes
    ----------
    shapes : (count, n, n)
        One mode a row.
    loads : (count, n, d)
        Participations.
    rigid_body_mass : (count, d, d)
        ``[G; I]' M [G; I]``.
    """

    shapes: Array
    loads: Array
    rigid_body_mass: Array


def batch_modes(H: Array, right: Array, rigid: Array, *base: Array) -> tuple[Array, BatchModes]:
    """Squared circular frequencies (count, n), ascending, and modes; a candidate that is no structure has NaN.

    With ``H = Psi Lambda Psi'`` and L the Cholesky factor of M_SS, the modes are ``Phi = L^-T Psi`` and their
    participations ``Phi' B = Psi' L^-1 B``, ``B = M_SS G + M_S0``.

    Parameters
    ----------
    H : (count, n, n)
        ``L^-1 K_SS L^-T``, the lower triangle at least; overwritten where it is not finite.
    right : (count, n, n + d)
        ``[L^-1, L^-1 B]``.
    rigid : (count, d, d)
        Rigid-body mass.
    *base : (count, n, d), (count, d, d)
        ``L^-1 M_S0`` and M_00, where the whole mass may be indefinite.
    """
    n = H.shape[1]
    broken = ~np.isfinite(np.einsum("pij->p", H))
    H[broken] = np.eye(n)  # must not stop the eigensolver for the others
    lam, psi = np.linalg.eigh(H)
    if base:
        broken |= base_is_light(*base)
    lam[broken], psi[broken] = np.nan, np.nan
    projected = psi.swapaxes(1, 2) @ right
    return lam, BatchModes(projected[..., :n], projected[..., n:], rigid)


def base_is_light(low: Array, base: Array) -> Array:
    """True where M_00 is less than ``M_S0' M_SS^-1 M_S0``, ``low = L^-1 M_S0``, which no structure's is, (count,)."""
    size = np.abs(base).max(axis=(1, 2)) + np.abs(low).max(axis=(1, 2)) ** 2
    return least(base - low.swapaxes(1, 2) @ low) < -ROUND_OFF * size


def least(stack: Array) -> Array:
    """Least eigenvalue of each symmetric matrix; minus infinity where it is no number."""
    bad = ~np.all(np.isfinite(stack), axis=(1, 2))
    clean = np.where(bad[:, None, None], 0.0, (stack + stack.swapaxes(1, 2)) / 2)
    return np.where(bad, -np.inf, np.linalg.eigvalsh(clean)[:, 0])
