"""Stiffness matrices as CasADi expressions: by their spectrum (Cerini et al. 2024, 3.2.4), or a chain of springs."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from sysid.errors import InputError
from sysid.models.geometry import FACTOR_FLOOR, Layout
from sysid.models.unknowns import Block, log_sampling
from sysid.structure.structure import Array, finite_array
from sysid.structure.triangular import lower_triangle, triangle_entries


@dataclass(frozen=True, eq=False)
class SpectralStiffness:
    """A full stiffness matrix through ``H = L^-1 K_SS L^-T = L_H L_H'``, L the Cholesky factor of M_SS.

    The spectrum of H is the structure's squared frequencies, so it can be searched without
    knowing the size of any stiffness, and replaced by the measured spectrum (refinement).

    Parameters
    ----------
    natural_frequencies : array_like, optional
        Hz, the measured ones in ascending order; repeated ones repeated. Without them a Problem finds
        those that stand out of its measurement.
    max_frequency : float, optional
        Hz, at or above the highest of *all* frequencies that the model has; the highest given
        one by default, which supposes that all n are given.

    References
    ----------
    Cerini, Yotov, Aglietti, Mech. Syst. Signal Process. 209 (2024) 111084, eq. 26-32 (28b mended), 36-37.
    """

    natural_frequencies: ArrayLike | None = None
    max_frequency: float | None = None

    @property
    def targets(self) -> Array:
        """Measured circular frequencies, rad/s, ascending."""
        if self.natural_frequencies is None:
            raise InputError("no natural_frequencies (Hz): state them, or let a Problem find them in its data")
        given = np.atleast_1d(finite_array("natural_frequencies", self.natural_frequencies))
        if given.ndim != 1 or given.size == 0 or np.any(given <= 0):
            raise InputError("natural_frequencies must be a list of positive numbers in Hz")
        if np.any(np.diff(given) < 0):
            raise InputError("natural_frequencies must be in ascending order")
        return 2 * np.pi * given

    def limit(self, n: int) -> float:
        """Bound on the frequencies of an n-degree-of-freedom model, rad/s (w_lim of eq. 37)."""
        targets = self.targets
        if targets.size > n:
            raise InputError(f"{targets.size} natural frequencies are given or found for {n} sensors; at most {n} fit")
        if self.max_frequency is None:
            if targets.size < n:
                raise InputError(
                    f"{targets.size} natural frequencies are given or found for {n} sensors: "
                    "state max_frequency (Hz), at or above the highest frequency of the whole model"
                )
            return float(targets[-1])
        limit = 2 * np.pi * float(self.max_frequency)
        if not np.isfinite(limit) or limit < targets[-1]:
            raise InputError(
                f"max_frequency = {self.max_frequency:g} Hz is below the given natural frequency "
                f"{targets[-1] / (2 * np.pi):g} Hz: the truth would lie outside the search space"
            )
        return limit

    def variables(self, layout: Layout) -> tuple[Block, ...]:
        """Entries of L_H, row by row, rad/s (eq. 37)."""
        rows, columns = np.tril_indices(layout.n)
        limit = self.limit(layout.n)
        lower = np.where(rows == columns, FACTOR_FLOOR * limit, -limit)
        return (Block("stiffness_factor", lower, np.full(rows.size, limit), unit="rad/s"),)

    def mass_normalised(self, layout: Layout, y: ca.SX, factor: ca.SX) -> ca.SX:
        """``H`` (n, n), rad²/s², whatever the mass is."""
        L = lower_triangle(y, layout.n)
        return L @ L.T

    def values(self, layout: Layout, H: Array, stiffness: Array) -> Array:
        """Entries of L_H for a given positive definite `H`."""
        return triangle_entries(np.linalg.cholesky(H))


@dataclass(frozen=True, eq=False)
class ChainStiffness:
    """Springs in series from the base to the last sensor, one chain a base direction.

    The sensors of a direction stand in the order of the chain, the one nearest the base first, each
    along the direction or against it.

    Parameters
    ----------
    lower, upper : array_like, scalar or (n,)
        Search space of the spring stiffnesses, N/m, positive; searched on a logarithmic scale.
    """

    lower: ArrayLike
    upper: ArrayLike

    def variables(self, layout: Layout) -> tuple[Block, ...]:
        """One spring a sensor, N/m."""
        try:
            low, high = (np.broadcast_to(np.asarray(v, dtype=float), (layout.n,)) for v in (self.lower, self.upper))
        except (TypeError, ValueError):
            raise InputError(f"ChainStiffness: bounds are one number, or one a sensor ({layout.n}), in N/m") from None
        if not (np.all(np.isfinite(high)) and np.all(low > 0) and np.all(low < high)):
            raise InputError("ChainStiffness: bounds must be finite with 0 < lower < upper (N/m)")
        sampling, unsampling = log_sampling(low, high)
        return (
            Block(
                "spring", low, high, unit="N/m", sampling=sampling, unsampling=unsampling,
            ),
        )  # fmt: skip

    def mass_normalised(self, layout: Layout, y: ca.SX, factor: ca.SX) -> ca.SX:
        """``H = L^-1 K_SS L^-T`` (n, n), with L the Cholesky factor of M_SS."""
        K = _chain_pattern(layout)
        K_SS = sum((y[i] * ca.SX(ca.sparsify(ca.DM(K[i]))) for i in range(layout.n)), ca.SX(layout.n, layout.n))
        half = ca.solve(factor, K_SS)
        return ca.solve(factor, half.T)

    def values(self, layout: Layout, H: Array, stiffness: Array) -> Array:
        """Spring stiffnesses of a chain's stiffness matrix."""
        n, arms = layout.n, _arms(layout)
        K = stiffness[:n, :n] * np.outer(arms, arms)
        # A spring is minus the coupling to the sensor below, or what the row adds up to at the base.
        return np.array([K[i].sum() if below < 0 else -K[i, below] for i, below in enumerate(_previous(layout))])


StiffnessModel = SpectralStiffness | ChainStiffness


def _arms(layout: Layout) -> Array:
    """Motion of each sensor for unit motion of its floor along the chain, (n,): 1, or -1 where it points back."""
    groups = layout.directions[: layout.n]
    if np.any(groups < 0):
        at = int(np.argmax(groups < 0))
        raise InputError(f"ChainStiffness: sensor {at + 1} is moved by no base direction; a chain cannot hold it")
    arms = layout.rigid_body[np.arange(layout.n), groups]
    rest = np.linalg.norm(layout.rigid_body, axis=1) - np.abs(arms)
    if np.any(np.abs(np.abs(arms) - 1) > 1e-6) or np.any(rest > 1e-6):
        raise InputError(
            "ChainStiffness: each sensor must point along one base direction (entries 1 or -1 in rigid_body)"
        )
    return arms


def _previous(layout: Layout) -> list[int]:
    """The sensor below each one in its chain; -1 for the base."""
    groups = layout.directions[: layout.n].tolist()
    return [max((j for j in range(i) if groups[j] == groups[i]), default=-1) for i in range(layout.n)]


def _chain_pattern(layout: Layout) -> Array:
    """Stiffness of each unit spring, (n, n, n)."""
    patterns, arms = np.zeros((layout.n,) * 3), _arms(layout)
    for i, below in enumerate(_previous(layout)):
        elongation = np.zeros(layout.n)
        elongation[i] = arms[i]
        if below >= 0:
            elongation[below] = -arms[below]
        patterns[i] = np.outer(elongation, elongation)
    return patterns
