"""Damping models: ratios free mode by mode, or proportional to mass and stiffness."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from sysid.errors import InputError, as_float, finite_array, shown
from sysid.models.expressions import as_matrix, at_point, check_finite, is_column, written_in
from sysid.models.model import FieldTree, Geometry, MassBlocks, Stated, StiffnessBlocks, Written
from sysid.models.unknowns import Unknown, lower_of, upper_of
from sysid.structure.structure import Array, Structure

_MISSING = (math.nan, math.nan)  # no default
LEAST, MOST = 1e-6, 0.95  # a vibration that hardly dies away, and one that hardly swings
_USUAL = (0.005, 0.05)  # the swarm's search space, eq. 38
_DECADE = 10.0  # from end to end of that, and of what is searched about a pole outside


@dataclass(frozen=True, eq=False)
class ModalDamping(FieldTree):
    """One damping ratio a mode.

    Parameters
    ----------
    lower, upper : float
        Bounds of all ratios, which every strategy keeps. Those of any vibrating structure by default: then a swarm
        searches 0.005 to 0.05 (eq. 38 of Cerini et al. 2024) and, where poles of the data have other ratios, half a
        decade either way of these.
    """

    lower: float = LEAST
    upper: float = MOST

    def __post_init__(self) -> None:
        lower, upper = (as_float(f"ModalDamping: {name}", getattr(self, name)) for name in ("lower", "upper"))
        if not 0 < lower < upper < 1:
            raise InputError(f"ModalDamping: 0 < lower < upper < 1 is needed, not {lower} and {upper}")

    def unknowns(self, geometry: Geometry) -> tuple[Unknown, ...]:
        """Damping ratios, in ascending order of frequency."""
        lower, upper = (np.full(geometry.n, float(end)) for end in (self.lower, self.upper))
        if self.lower != LEAST and self.upper != MOST:
            return (Unknown("damping_ratio", lower, upper),)
        low, high = _box(geometry)
        # A bound that is stated is an end of the box, which is a decade long where the other end would lie beyond.
        low, high = np.where(lower == LEAST, low, lower), np.where(upper == MOST, high, upper)
        low = np.where(low < high, low, np.maximum(np.minimum(low, high / _DECADE), lower))
        high = np.where(low < high, high, np.minimum(low * _DECADE, upper))
        return (Unknown("damping_ratio", lower, upper, box=(low, high), note=_why(low, high, _poles(geometry))),)

    def blocks(self, geometry: Geometry, y: ca.SX, mass: MassBlocks, stiffness: StiffnessBlocks) -> None:
        """No matrix: ratios only."""
        return None

    def ratios(self, geometry: Geometry, y: ca.SX, omega: ca.SX) -> ca.SX:
        """Damping ratios (n,), in ascending order of frequency."""
        return y

    def values(self, geometry: Geometry, structure: Structure) -> Array:
        """Damping ratios of a structure."""
        return structure.damping_ratios

    def stated(self, geometry: Geometry) -> Stated:
        """Any ratios."""
        return Stated(free=True)


@dataclass(frozen=True, eq=False)
class ProportionalDamping(FieldTree):
    """Rayleigh damping ``C = alpha M_SS + beta K_SS``: ``zeta_k = alpha / (2 w_k) + beta w_k / 2``.

    Parameters
    ----------
    alpha : (lower, upper), 1/s
    beta : (lower, upper), s
    """

    alpha: tuple[float, float] = _MISSING
    beta: tuple[float, float] = _MISSING

    def __post_init__(self) -> None:
        for name, unit in (("alpha", "1/s"), ("beta", "s")):
            if getattr(self, name) is _MISSING:
                raise InputError(f"ProportionalDamping: {name} is missing; give its bounds (lower, upper), {unit}")
            pair = finite_array(f"ProportionalDamping: {name}", getattr(self, name))
            if pair.shape != (2,) or not 0 <= pair[0] < pair[1]:
                raise InputError(f"ProportionalDamping: {name} needs 0 <= lower < upper, not {shown(pair.tolist())}")

    @classmethod
    def from_tree(cls, tree: dict[str, Any]) -> ProportionalDamping:
        """Give the model of a tree that `to_tree` made; its fields are pairs."""
        return cls(*(tuple(tree[name].tolist()) for name in ("alpha", "beta")))

    def unknowns(self, geometry: Geometry) -> tuple[Unknown, ...]:
        """The two factors."""
        return Unknown("rayleigh_alpha", *self.alpha, unit="1/s"), Unknown("rayleigh_beta", *self.beta, unit="s")

    def blocks(self, geometry: Geometry, y: ca.SX, mass: MassBlocks, stiffness: StiffnessBlocks) -> ca.SX:
        """C (n, n)."""
        return y[0] * mass.mass + y[1] * stiffness.stiffness

    def ratios(self, geometry: Geometry, y: ca.SX, omega: ca.SX) -> ca.SX:
        """Damping ratios (n,) at the circular frequencies `omega`."""
        return y[0] / (2 * omega) + y[1] * omega / 2

    def values(self, geometry: Geometry, structure: Structure) -> Array:
        """Least-squares alpha and beta for a structure's ratios: inside the search space where these leave it."""
        from scipy.optimize import lsq_linear

        omega = 2 * np.pi * structure.natural_frequencies
        columns = np.column_stack([1 / (2 * omega), omega / 2])
        free = np.linalg.lstsq(columns, structure.damping_ratios, rcond=None)[0]
        unknowns = self.unknowns(geometry)
        lower, upper = lower_of(unknowns), upper_of(unknowns)
        if np.all((free >= lower) & (free <= upper)) or np.any(lower >= upper):
            return free
        # In units of the bounds, which are decades apart.
        unit = upper * np.linalg.norm(columns * upper)
        held = lsq_linear(columns * unit, structure.damping_ratios, (lower / unit, upper / unit), tol=1e-15)
        return np.clip(held.x * unit, lower, upper)

    def stated(self, geometry: Geometry) -> Stated:
        """Nothing that the modes would tell."""
        return Stated()


class WrittenDamping(Written):
    """Damping written in variables or numbers.

    Parameters
    ----------
    written : expression or array_like
        C (n, n) on the motion relative to the base, base rows are cut off; or one ratio a mode, (n,).
    """

    name = "damping"

    def blocks(self, geometry: Geometry, y: ca.MX, mass: MassBlocks, stiffness: StiffnessBlocks) -> ca.MX | None:
        """C (n, n), or None where ratios are written."""
        if self._by_ratios(geometry):
            return None
        return self.whole(geometry)[: geometry.n, : geometry.n]

    def ratios(self, geometry: Geometry, y: ca.MX, omega: ca.MX) -> ca.MX | None:
        """The ratios (n,); None where C is written."""
        if not self._by_ratios(geometry):
            return None
        column = as_matrix("damping", self.written)
        numbers = at_point("damping", column, None)
        check_finite("damping ratio", numbers.ravel(), column)
        if np.any(numbers < 0):
            raise InputError(f"damping: the ratio {numbers.min():.3g} at the guess is negative{written_in(column)}")
        return column

    def _by_ratios(self, geometry: Geometry) -> bool:
        given, n = as_matrix("damping", self.written), geometry.n
        return given.shape == (n, 1) and (n > 1 or is_column(self.written))


def _poles(geometry: Geometry) -> Array:
    """Damping ratios of the poles in the data, as far as a vibrating structure has such, (poles,)."""
    return np.clip(geometry.pole_ratios, LEAST, MOST)


def _beyond_usual(ratios: Array) -> NDArray[np.bool_]:
    return (ratios < _USUAL[0]) | (ratios > _USUAL[1])


def _box(geometry: Geometry) -> tuple[Array, Array]:
    """Lower and upper ends of what a swarm searches for free ratios, (n,) each."""
    (lower, upper), half, ratios = _USUAL, np.sqrt(_DECADE), _poles(geometry)
    outside = _beyond_usual(ratios)
    low = np.maximum(np.where(outside, ratios / half, lower), LEAST)
    high = np.minimum(np.where(outside, ratios * half, upper), MOST)
    if ratios.size != geometry.n:  # which mode has which is not known
        low, high = np.full(geometry.n, low.min(initial=lower)), np.full(geometry.n, high.max(initial=upper))
    return low, high


def _why(low: Array, high: Array, ratios: Array) -> str:
    """Why a box (n,) is not the usual one, in words; empty where all poles have usual ratios."""
    if not np.any(_beyond_usual(ratios)):
        return ""
    return (
        f"damping ratios are searched from {100 * low.min():.3g} to {100 * high.max():.3g} %, as the poles of the data "
        f"have {100 * ratios.min():.3g} to {100 * ratios.max():.3g} %, beyond the usual 0.5 to 5 %"
    )
