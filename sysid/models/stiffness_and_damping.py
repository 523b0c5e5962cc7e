"""Stiffness and damping models: by the spectrum (Cerini et al. 2024, 3.2.4), chains of springs; ratios, Rayleigh's."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sysid.errors import InputError, as_float, finite_array, refuse, shown
from sysid.models.expressions import (
    as_matrix,
    at_point,
    check_finite,
    is_column,
    lower_triangle,
    triangle_entries,
    written_in,
)
from sysid.models.model import FACTOR_FLOOR, FieldTree, Geometry, MassBlocks, Stated, StiffnessBlocks, Written
from sysid.models.spectrum import by_ipopt, nearest_factors
from sysid.models.unknowns import Unknown, log_sampling, lower_of, upper_of, user_site
from sysid.structure.structure import Array, Structure

FREQUENCY_WINDOW = 0.05  # relative; what a stated frequency, read off a peak, may be wrong by


@dataclass(frozen=True, eq=False)
class SpectralStiffness(FieldTree):
    """A full stiffness matrix through ``H = L^-1 K_SS L^-T = L_H L_H'``, L the Cholesky factor of M_SS.

    The spectrum of H is the structure's squared frequencies, so it can be searched without
    knowing the size of any stiffness, and replaced by the measured spectrum (refinement).

    Parameters
    ----------
    natural_frequencies : array_like, optional
        Hz, the measured ones in ascending order; repeated ones repeated. Without them a Problem finds
        those that stand out of its measurement. With a full mass of any total the modal strategy answers with these
        modes alone, and what stands for modes beyond the lines.
    max_frequency : float, optional
        Hz, of searches with as many modes as sensors: at or above the highest of *all* frequencies that the model has.
        The highest given one by default, which supposes that all n are given; with fewer the last line.

    References
    ----------
    Cerini, Yotov, Aglietti, Mech. Syst. Signal Process. 209 (2024) 111084, eq. 26-32 (28b mended), 36-37.
    """

    natural_frequencies: ArrayLike | None = None
    max_frequency: float | None = None

    def __post_init__(self) -> None:
        highest = 0.0
        if self.natural_frequencies is not None:
            given = np.atleast_1d(finite_array("natural_frequencies", self.natural_frequencies))
            refuse(
                (
                    given.ndim != 1 or given.size == 0 or np.any((given <= 0) | (given > 1e12)),
                    "natural_frequencies must be a list of positive numbers in Hz",
                ),
                (np.any(np.diff(given) < 0), "natural_frequencies must be in ascending order"),
            )
            highest = given[-1]
        if self.max_frequency is not None:
            limit = as_float("max_frequency", self.max_frequency, "a positive number of Hz", above=0, below=1e12)
            self._check_limit(limit, highest)

    def _check_limit(self, limit: float, highest: float) -> None:
        if limit < highest:
            raise InputError(
                f"max_frequency = {limit:g} Hz is below the given natural frequency {highest:g} Hz: the truth would "
                "lie outside the search space"
            )

    def targets(self, geometry: Geometry) -> Array:
        """Circular frequencies that are stated, else those that stand out of the data, rad/s, ascending, at most n."""
        if self.natural_frequencies is None:
            return geometry.natural_frequencies
        given, n = np.atleast_1d(np.array(self.natural_frequencies, dtype=float)), geometry.n
        if given.size > n:
            raise InputError(f"{given.size} natural frequencies are given for {n} sensors; at most {n} fit")
        return 2 * np.pi * given

    def limit(self, geometry: Geometry) -> float:
        """Bound on the frequencies of an n-degree-of-freedom model, rad/s (w_lim of eq. 37)."""
        targets, n = self.targets(geometry), geometry.n
        if self.max_frequency is not None:
            self._check_limit(float(self.max_frequency), targets[-1] / (2 * np.pi))
            return 2 * np.pi * float(self.max_frequency)
        if targets.size == n:
            return float(targets[-1])
        # With fewer modes than sensors nothing tells the model's other frequencies.
        return float(max(2 * np.pi * geometry.test.freq[-1], targets[-1]))

    def unknowns(self, geometry: Geometry) -> tuple[Unknown, ...]:
        """Entries of L_H, row by row, rad/s (eq. 37)."""
        rows, columns = np.tril_indices(geometry.n)
        limit = self.limit(geometry)
        lower = np.where(rows == columns, FACTOR_FLOOR * limit, -limit)
        return (Unknown("stiffness_factor", lower, np.full(rows.size, limit), unit="rad/s"),)

    def blocks(self, geometry: Geometry, y: ca.SX, mass: MassBlocks) -> StiffnessBlocks:
        """``K_SS = L H L'`` and ``H = L_H L_H'``, rad²/s², whatever the mass is."""
        L_H, L = lower_triangle(y, geometry.n), mass.factor
        H = ca.tril2symm(ca.tril(L_H @ L_H.T))  # each entry once
        return StiffnessBlocks(L @ H @ L.T, H)

    def values(self, geometry: Geometry, structure: Structure) -> Array:
        """Entries of L_H."""
        n = geometry.n
        L = np.linalg.cholesky(structure.mass[:n, :n])
        half = np.linalg.solve(L, structure.stiffness[:n, :n])
        H = np.linalg.solve(L, half.T)
        return triangle_entries(np.linalg.cholesky((H + H.T) / 2))

    def with_spectrum(
        self, rows: Array, omega: Array, *, by_solver: bool = False, max_time: float | None = None
    ) -> tuple[Array, tuple[str, ...]]:
        """Entries of L_H (k, size) with the lowest eigenvalues of H at `omega` (m,), rad/s: eq. 31, from each own L_H.

        In closed form, or of each row by IPOPT, `max_time` seconds at most; where IPOPT does not succeed the closed
        form stands. The second answer is IPOPT's status of each row.
        """
        n = (math.isqrt(8 * rows.shape[1] + 1) - 1) // 2
        factors, lower = np.zeros((len(rows), n, n)), np.tril_indices(n)
        factors[:, *lower] = rows
        refined = nearest_factors(factors, omega)[:, *lower]
        if not by_solver:
            return refined, ()
        solved = [by_ipopt(factor, omega, max_time) for factor in factors]
        for row, answer in zip(refined, solved, strict=True):
            row[:] = triangle_entries(answer.factor) if answer.success else row
        return refined, tuple(answer.status for answer in solved)

    def stated(self, geometry: Geometry) -> Stated:
        """The spectrum, stated or found."""
        return Stated(free=True, spectrum=self.targets(geometry))


@dataclass(frozen=True, eq=False)
class ChainStiffness(FieldTree):
    """Springs in series from the base to the last sensor, one chain a base direction.

    The sensors of a direction stand in the order of the chain, the one nearest the base first, each
    along the direction or against it.

    Parameters
    ----------
    lower, upper : array_like, scalar or (n,)
        Search space of the spring stiffnesses, N/m, positive; searched on a logarithmic scale.
    """

    lower: ArrayLike = math.nan
    upper: ArrayLike = math.nan

    def __post_init__(self) -> None:
        for name in ("lower", "upper"):
            if getattr(self, name) is math.nan:
                raise InputError(f"ChainStiffness: {name} is missing; give bounds of the springs, lower and upper, N/m")
        low, high = (finite_array("ChainStiffness: bounds", bound) for bound in (self.lower, self.upper))
        alike = low.ndim < 2 and high.ndim < 2 and (low.shape == high.shape or 1 in (low.size, high.size))
        if not (alike and np.all(low > 0) and np.all(low < high)):
            raise InputError("ChainStiffness: bounds must be one number, or one a sensor, with 0 < lower < upper (N/m)")

    def unknowns(self, geometry: Geometry) -> tuple[Unknown, ...]:
        """One spring a sensor, N/m."""
        try:
            low, high = (np.broadcast_to(np.asarray(v, dtype=float), (geometry.n,)) for v in (self.lower, self.upper))
        except ValueError:
            raise InputError(f"ChainStiffness: bounds are one number, or one a sensor ({geometry.n}), in N/m") from None
        to, back = log_sampling(low, high)
        return (Unknown("spring", low, high, unit="N/m", sampling=to, unsampling=back, scale="log"),)

    def blocks(self, geometry: Geometry, y: ca.SX, mass: MassBlocks) -> ca.SX:
        """K_SS (n, n)."""
        strain = ca.sparsify(ca.DM(_elongations(geometry)))
        return strain.T @ ca.diag(y) @ strain

    def values(self, geometry: Geometry, structure: Structure) -> Array:
        """Spring stiffnesses of a chain's stiffness matrix."""
        n = geometry.n
        return np.einsum("sij,ij->s", _spring_weights(geometry), structure.stiffness[:n, :n])

    def stated(self, geometry: Geometry) -> Stated:
        """Zeros where no spring couples; springs that do not push."""
        strain = np.abs(_elongations(geometry))
        pattern = strain.T @ strain
        # The first spring of a chain ties its sensor to the base.
        to_base = np.where(_previous(geometry)[:, None] < 0, np.abs(geometry.rigid_body), 0.0)
        entries = np.where(np.hstack([pattern, to_base]) > 0, np.nan, 0.0)
        return Stated(
            entries=entries, positive=_spring_weights(geometry), sentence="the stiffness is stated to be a chain"
        )


class WrittenStiffness(Written):
    """A stiffness matrix written in variables or numbers."""

    name = "stiffness"

    def blocks(self, geometry: Geometry, y: ca.MX, mass: MassBlocks) -> ca.MX:
        """K_SS (n, n)."""
        whole = self.whole(geometry)
        if whole.size1() > geometry.n:
            check_rigid(whole, geometry.rigid_body)
        return whole[: geometry.n, : geometry.n]


def check_rigid(stiffness: ca.MX, rigid_body: Array) -> None:
    """Refuse a stiffness with base columns that strains when the base moves as a rigid body."""
    K, d = at_point("stiffness", stiffness, None), rigid_body.shape[1]
    if not _strains(K, rigid_body):
        return
    refuse(
        (
            not _strains(np.roll(K, (-d, -d), (0, 1)), rigid_body),
            f"stiffness ({user_site()}) has the rows and columns of the base first: they stand last, in mass and "
            f"damping too{written_in(stiffness)}",
        ),
        (
            True,
            "stiffness strains when the base moves as a rigid body: K_S0 must be -K_SS G, and K_00 G' K_SS G (a "
            "spring to the base counts in all; are its last rows those of the base?)" + written_in(stiffness),
        ),
    )


def _strains(K: Array, rigid_body: Array) -> bool:
    """True where a stiffness (n + d, n + d) holds a rigid structure to the ground."""
    n = len(rigid_body)
    return bool(np.abs(K[:, :n] @ rigid_body + K[:, n:]).max() > 1e-6 * np.abs(K).max())


def _arms(geometry: Geometry) -> Array:
    """Motion of each sensor for unit motion of its floor along the chain, (n,): 1, or -1 where it points back."""
    groups = geometry.directions[: geometry.n]
    if np.any(groups < 0):
        at = int(np.argmax(groups < 0))
        raise InputError(f"ChainStiffness: sensor {at + 1} is moved by no base direction; a chain cannot hold it")
    arms = geometry.rigid_body[np.arange(geometry.n), groups]
    rest = np.linalg.norm(geometry.rigid_body, axis=1) - np.abs(arms)
    if np.any(np.abs(np.abs(arms) - 1) > 1e-6) or np.any(rest > 1e-6):
        raise InputError(
            "ChainStiffness: each sensor must point along one base direction (entries 1 or -1 in rigid_body)"
        )
    return arms


def _previous(geometry: Geometry) -> NDArray[np.int_]:
    """The sensor below each one in its chain, (n,); -1 for the base."""
    groups = geometry.directions[: geometry.n].tolist()
    return np.array([max((j for j in range(i) if groups[j] == group), default=-1) for i, group in enumerate(groups)])


def _elongations(geometry: Geometry) -> Array:
    """Elongation of each spring for unit motion of each sensor, (n, n)."""
    arms, below = _arms(geometry), _previous(geometry)
    strain, between = np.diag(arms), np.flatnonzero(below >= 0)
    strain[between, below[between]] = -arms[below[between]]
    return strain


def _spring_weights(geometry: Geometry) -> Array:
    """Weights W with ``spring_i = sum(W_i * K_SS)``, (n, n, n)."""
    weights, arms, below = np.zeros((geometry.n,) * 3), _arms(geometry), _previous(geometry)
    # A spring is minus the coupling to the sensor below, or what the row adds up to at the base.
    between, first = np.flatnonzero(below >= 0), np.flatnonzero(below < 0)
    weights[between, between, below[between]] = -arms[between] * arms[below[between]]
    weights[first, first] = np.outer(arms[first], arms)
    return weights


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
    """Damping written in variables or numbers: C (n, n) on the motion relative to the base, or one ratio a mode, (n,).

    Base rows of C are cut off.
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
