"""Damping models: ratios free mode by mode, or proportional to mass and stiffness."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from sysid.errors import InputError
from sysid.models.geometry import Layout
from sysid.models.unknowns import Block
from sysid.structure.structure import Array


@dataclass(frozen=True, eq=False)
class ModalDamping:
    """One damping ratio a mode; the bounds are the swarm's search space (eq. 38 of Cerini et al. 2024)."""

    lower: float = 0.005
    upper: float = 0.05

    def variables(self, layout: Layout) -> tuple[Block, ...]:
        """Damping ratios, in ascending order of frequency."""
        if not 0 < self.lower < self.upper < 1:
            raise InputError(f"ModalDamping: 0 < lower < upper < 1 is needed, not {self.lower} and {self.upper}")
        return (Block("damping_ratio", np.full(layout.n, self.lower), np.full(layout.n, self.upper)),)

    def ratios(self, y: ca.SX, omega: ca.SX) -> ca.SX:
        """Damping ratios (n,) at the circular frequencies `omega`."""
        return y

    def values(self, ratios: Array, omega: Array) -> Array:
        """Unknowns that give these ratios."""
        return ratios


@dataclass(frozen=True, eq=False)
class ProportionalDamping:
    """Rayleigh damping ``C = alpha M_SS + beta K_SS``: ``zeta_k = alpha / (2 w_k) + beta w_k / 2``.

    Parameters
    ----------
    alpha : (lower, upper), 1/s
    beta : (lower, upper), s
    """

    alpha: tuple[float, float]
    beta: tuple[float, float]

    def variables(self, layout: Layout) -> tuple[Block, ...]:
        """The two factors; alpha in 1/s, beta in s."""
        for name, (low, high) in (("alpha", self.alpha), ("beta", self.beta)):
            if not 0 <= low < high < np.inf:
                raise InputError(f"ProportionalDamping: {name} needs 0 <= lower < upper, not ({low}, {high})")
        lower, upper = np.array([self.alpha, self.beta], dtype=float).T
        return (Block("rayleigh_factor", lower, upper, unit="1/s, s"),)

    def ratios(self, y: ca.SX, omega: ca.SX) -> ca.SX:
        """Damping ratios (n,) at the circular frequencies `omega`."""
        return y[0] / (2 * omega) + y[1] * omega / 2

    def values(self, ratios: Array, omega: Array) -> Array:
        """Least-squares alpha and beta for these ratios."""
        return np.linalg.lstsq(np.column_stack([1 / (2 * omega), omega / 2]), ratios, rcond=None)[0]


DampingModel = ModalDamping | ProportionalDamping


def physical_damping(mass: ca.SX, mode_shapes: ca.SX, omega: ca.SX, ratios: ca.SX) -> ca.SX:
    """Physical damping matrix ``C = M Phi diag(2 zeta w) Phi' M`` of mass-normalised modes.

    Equal to ``Phi^-T diag(2 zeta w) Phi^-1`` (eq. 33) where there are as many modes as sensors;
    with fewer, the modes that are left out are undamped. N s/m.
    """
    momentum = mass @ mode_shapes
    return momentum @ ca.diag(2 * ratios * omega) @ momentum.T
