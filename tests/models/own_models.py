"""Two matrix models that are not of the package: a ring of springs, and masses of known form and unknown density.

They have the methods of `sysid.MatrixModel` and no more, and all of the package takes them as it takes its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sysid import InputError, Stated, Unknown

_SAME = 1e-6  # of the largest entry: what counts as the same matrix


@dataclass(frozen=True, eq=False)
class CirculantStiffness:
    """Equal sectors in a ring, each on a spring to the base and coupled to the sectors at every distance.

    K_SS is circulant in its springs. The base's row is free: it follows from K_SS and the motion with a rigid base.

    Parameters
    ----------
    ground, ring : (lower, upper), N/m
        Search space of the springs to the base, all alike, and of those between sectors, one a distance.
    """

    ground: Any
    ring: Any

    def unknowns(self, geometry):
        count = geometry.n // 2
        low, high = (np.full(count, bound) for bound in self.ring)
        return Unknown("ground_spring", *self.ground, unit="N/m"), Unknown("ring_spring", low, high, unit="N/m")

    def blocks(self, geometry, y, mass):
        one = np.eye(geometry.n)
        K = y[0] * one
        for distance in range(1, geometry.n // 2 + 1):
            K = K + y[distance] * _ring(geometry.n, distance)
        return K

    def values(self, geometry, structure):
        n = geometry.n
        K = structure.stiffness[:n, :n]
        # Opposite sectors of an even ring are neighbours at n / 2 both ways round.
        ring = [-K[0, j] / (2 if 2 * j == n else 1) for j in range(1, n // 2 + 1)]
        y = np.array([K[0].sum(), *ring])
        made = y[0] * np.eye(n) + sum(k * _ring(n, j) for j, k in enumerate(ring, start=1))
        if np.abs(made - K).max() > _SAME * np.abs(K).max():
            raise InputError("the stiffness of the structure is not circulant")
        return y

    def stated(self, geometry):
        return Stated(sentence="the stiffness is stated to be that of equal sectors in a ring")


def _ring(n, distance):
    """Stiffness of unit springs between all sectors at a distance; from opposite ones there are two each."""
    turned = np.roll(np.eye(n), distance, axis=0)
    return 2 * np.eye(n) - turned - turned.T


@dataclass(frozen=True, eq=False)
class ComponentMass:
    """Components of known form and unknown density: M is the sum of density times mass for unit density.

    Parameters
    ----------
    forms : (components, n + d, n + d), m³
        Mass over sensors and base for unit density.
    lower, upper : (components,), kg/m³
    """

    forms: Any
    lower: Any
    upper: Any

    def unknowns(self, geometry):
        return (Unknown("density", self.lower, self.upper, unit="kg/m³"),)

    def blocks(self, geometry, y):
        forms = np.asarray(self.forms)
        M = y[0] * forms[0]
        for i in range(1, len(forms)):
            M = M + y[i] * forms[i]
        return M

    def values(self, geometry, structure):
        forms = np.asarray(self.forms)
        columns = forms.reshape(len(forms), -1).T
        y = np.linalg.lstsq(columns, structure.mass.ravel(), rcond=None)[0]
        if np.abs(columns @ y - structure.mass.ravel()).max() > _SAME * np.abs(structure.mass).max():
            raise InputError("the mass of the structure is not made of these components")
        return y

    def stated(self, geometry):
        return Stated(sentence="the mass is stated to be that of components of uniform density")
