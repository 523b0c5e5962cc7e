"""The Craig-Bampton form with the base's degrees of freedom first, as finite-element programs order it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sysid.structure.structure import Array, Structure


@dataclass(frozen=True)
class Superelement:
    """A structure in base motions u_0 (d) and modal coordinates q (m), the base first.

    Attributes
    ----------
    mass, stiffness, damping : (d + m, d + m)
        ``[[M_rb, Gamma'], [Gamma, I]]``, ``diag(0, w²)`` and ``diag(0, 2 zeta w)``, the last not diagonal where damping
        is not classical. No term is left out: the base is statically determinate, so that its constraint modes are the
        rigid-body motions, which strain nothing, and all modes of the identified matrices are kept.
    recovery : (n_sensors, d + m)
        ``[G, Phi]``: takes [u_0; q] to the absolute motion of the sensors.

    References
    ----------
    R. R. Craig, M. C. C. Bampton, AIAA J. 6 (1968) 1313-1319.
    """

    mass: Array
    stiffness: Array
    damping: Array
    recovery: Array


def superelement_of(structure: Structure) -> Superelement:
    """`Structure.to_craig_bampton` with the base first."""
    form, n = structure.to_craig_bampton(), structure.n
    order = np.r_[n : n + structure.n_base, :n]
    both = np.ix_(order, order)
    return Superelement(form.mass[both], form.stiffness[both], form.damping[both], form.recovery[:, order])
