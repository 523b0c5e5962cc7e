"""Modes of many candidates at once, from the factors of their matrices by batched products and LAPACK's `eigh`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sysid.structure.structure import Array
from sysid.structure.triangular import inverse_triangles


class BatchModes(NamedTuple):
    """Mass-normalised modes of many candidates, those of a candidate in ascending order of frequency.

    Attributes
    ----------
    shapes : (count, n, n)
        One mode a row.
    loads : (count, n, d)
        Participations.
    base : (count, d, n + d)
        ``[G; I]' L_M``.
    """

    shapes: Array
    loads: Array
    base: Array

    @property
    def rigid_body_mass(self) -> Array:
        """``[G; I]' M [G; I]``, (count, d, d)."""
        return self.base @ np.array(self.base).swapaxes(1, 2)


def batch_modes(mass_factors: Array, stiffness_factors: Array, rigid_body: Array) -> BatchModes:
    """Modes of ``M = L_M L_M'`` and ``K_SS = L H L'``, ``H = L_H L_H'``, L the leading block of L_M.

    With ``H = Psi Lambda Psi'``, ``L_M = [[L, 0], [Z, L_00]]`` and G the rigid-body motion, the modes are
    ``Phi = L^-T Psi`` and their participations ``Phi' (M_SS G + M_S0) = Psi' (L' G + Z')``. In brackets are the first
    n rows of ``L_M' [G; I]``.

    Parameters
    ----------
    mass_factors : (n + d, n + d, count)
        The L_M.
    stiffness_factors : (count, n, n)
        The L_H. A candidate with numbers that are not finite has modes that are no numbers.
    rigid_body : (n, d)
    """
    n, d = rigid_body.shape
    rigid = np.vstack([rigid_body, np.eye(d)])
    moved = (rigid.T @ mass_factors.reshape(n + d, -1)).reshape(d, n + d, -1)
    right = np.empty((len(stiffness_factors), n, n + d))
    right[..., :n] = inverse_triangles(mass_factors[:n, :n]).transpose(2, 0, 1)
    right[..., n:] = moved[:, :n].transpose(2, 1, 0)
    # A copy, because BLAS's kernel for products of small matrices is faster than that for a matrix with itself.
    H = stiffness_factors @ np.array(stiffness_factors).swapaxes(1, 2)
    broken = ~np.isfinite(np.einsum("pii->p", H))  # the trace of a square with a number that is not finite is not
    H[broken] = np.eye(n)  # must not stop the eigensolver for the others
    psi = np.linalg.eigh(H)[1]
    psi[broken] = np.nan
    made = psi.swapaxes(1, 2) @ right
    return BatchModes(made[..., :n], made[..., n:], moved.transpose(2, 0, 1))
