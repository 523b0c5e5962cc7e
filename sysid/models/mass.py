"""Mass matrices as CasADi expressions: full with healing (Cerini et al. 2024, section 3.2.3), lumped, known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from sysid.errors import InputError, choice, finite_array, lowest_eigenvalue, numbers, refuse, shown
from sysid.models.expressions import at_point, check_base_last, lower_triangle, triangle_entries
from sysid.models.model import (
    FACTOR_FLOOR,
    FactoredMass,
    FieldTree,
    Geometry,
    MassBlocks,
    Stated,
    Totals,
    Written,
    check_sane,
    check_total_mass,
    constant,
)
from sysid.models.unknowns import Unknown
from sysid.structure.structure import Array, Structure
from sysid.structure.thresholds import ROUND_OFF


def sampling_exponent(k: int, c: float = 1.0) -> float:
    """Exponent alpha of eq. 18 for a row of k entries (eq. 20, with its misprinted 2 mended to 4).

    It is the root of eq. 19, ``∫_{-1}^{1} y² dx = c / k``: every row of the Cholesky factor then has the
    same expected squared norm.

    >>> round(float(sampling_exponent(1)), 4)
    1.7808
    """
    return (3 * c + np.sqrt(c**2 + 16 * c * k)) / (4 * (2 * k - c))


def spread_rows(x: ca.SX | Array, exponents: Array) -> ca.SX | Array:
    """Eq. 18: ``y = sgn(x) (1 - (1 - |x|)^alpha)``, from the swarm's uniform coordinates to factor entries."""
    if isinstance(x, np.ndarray):
        left = np.abs(1 - np.abs(x))
        return np.copysign(1 - np.power(left, exponents, out=left), x)
    left = ca.fabs(1 - ca.fabs(x))  # a round-off beyond 1 would have the logarithm of a negative number
    return ca.copysign(1 - ca.exp(exponents * ca.log(left)), x)  # faster than a power, and as exact


def gather_rows(y: Array, exponents: Array) -> Array:
    """Inverse of `spread_rows` on numbers."""
    return spread_rows(y, 1 / exponents)


@dataclass(frozen=True, eq=False)
class FullMass(FieldTree):
    """A full mass matrix over sensors and base, through its Cholesky factor.

    Parameters
    ----------
    total_mass : float, array_like (d,) or (d, d), optional
        kg a base direction (kg m² where it is a rotation); a matrix is the whole rigid-body mass, from a mass
        properties report. All that moves with the base counts, base mass too. Without it, and without a measured
        base force or a known mass, masses are normalised to 1 kg a direction, and the result says so.
    healing : {"trace", "rigid_body"}
        What the total is: "trace", the sum of diag M over the direction's sensors and its base row
        (eq. 21-22 of the paper: right for lumped masses on orthogonal axes); "rigid_body", the
        physical ``M_rb[i, i]``; the only one for a matrix.
    known : array_like (n, n) or (n, n + d), optional
        Entries of ``M_SS``, or of ``[M_SS, M_S0]``, that are known, NaN where they are not: weighed parts, zeros
        between what cannot be coupled. They are adjusted together with the records, by weighted least squares, and
        the result says what they close, and which of them contradict the rest. The modal strategy can do it, the swarm
        cannot. They need one mode a sensor.
    known_std : float or array_like, optional
        Standard deviations of the known entries, kg, in the shape of `known` or one for all; 0, as without it, where
        an entry is exact.
    total_std : float or array_like, optional
        Standard deviations of `total_mass`, in its shape or one for all. With a measured base force they weigh the
        total beside the records; without one a total only bounds masses.

    References
    ----------
    Cerini, Yotov, Aglietti, Mech. Syst. Signal Process. 209 (2024) 111084, eq. 17-25.
    """

    total_mass: ArrayLike | None = None
    healing: Literal["trace", "rigid_body"] = "trace"
    known: ArrayLike | None = None
    known_std: ArrayLike | None = None
    total_std: ArrayLike | None = None

    def __post_init__(self) -> None:
        choice("FullMass: healing", self.healing, ("trace", "rigid_body"))
        check_total_mass(self.total_mass)
        if self.known is not None:
            given = numbers("FullMass: known", self.known)
            if given.ndim != 2:
                raise InputError(f"FullMass: known is {given.shape}; (n, n) or (n, n + d) is needed")
            refuse(
                (np.any(np.isinf(given)), "FullMass: known is infinite somewhere; NaN is what is not known"),
                (np.any(np.diag(given) <= 0), "FullMass: known masses must be positive"),
            )
            check_sane("FullMass: known", np.diag(given))
        if self.total_mass is not None and np.ndim(self.total_mass) == 2 and self.healing != "rigid_body":
            raise InputError("a matrix of total mass is the rigid-body mass: state healing='rigid_body' with it")
        _deviations("FullMass: known_std", self.known_std, "known", self.known)
        _deviations("FullMass: total_std", self.total_std, "total_mass", self.total_mass)

    def known_entries(self, geometry: Geometry) -> Array:
        """Known entries of ``[M_SS, M_S0]``, (n, n + d); NaN where nothing is."""
        n, d = geometry.n, geometry.d
        entries = np.full((n, n + d), np.nan)
        if self.known is None:
            return entries
        given = numbers("FullMass: known", self.known)
        if given.shape not in ((n, n), (n, n + d)):
            raise InputError(f"FullMass: known is {given.shape}; ({n}, {n}) or ({n}, {n + d}) is needed")
        entries[:, : given.shape[1]] = given
        across = np.where(np.isnan(entries[:, :n]), entries[:, :n].T, entries[:, :n])
        if np.nanmax(np.abs(across - across.T), initial=0.0) > 1e-9 * np.nanmax(np.abs(across), initial=0.0):
            raise InputError("FullMass: known is not symmetric over the sensors")
        entries[:, :n] = across
        return entries

    def unknowns(self, geometry: Geometry) -> tuple[Unknown, ...]:
        """Entries of the factor's lower triangle, row by row, in [-1, 1] (eq. 35)."""
        exponents, lower = _spread(geometry)
        return (
            *geometry.total_unknowns(self.total_mass),
            Unknown(
                "mass_factor",
                lower,
                np.ones(lower.size),
                sampling=lambda x: _above_floor(spread_rows(x, exponents), lower),
                unsampling=lambda y: gather_rows(y, exponents),
                scale="by row",
            ),
        )

    def blocks(self, geometry: Geometry, y: ca.SX) -> MassBlocks:
        """Healed mass blocks of the factor entries `y`; positive definite for every `y` in the box."""
        n = geometry.n
        totals, entries = geometry.split_totals(self.total_mass, y)
        healed = heal(lower_triangle(entries, n + geometry.d), geometry, totals, self.healing)
        return FactoredMass.of(healed, n)

    def values(self, geometry: Geometry, structure: Structure) -> Array:
        """Factor entries that `blocks` takes back to the structure's mass, which has the stated totals."""
        n, mass = geometry.n, structure.mass
        L = np.linalg.cholesky(mass[:n, :n])
        low = np.linalg.solve(L, mass[:n, n:]).T
        remainder = mass[n:, n:] - low @ low.T
        lam, vectors = np.linalg.eigh((remainder + remainder.T) / 2)
        # A semidefinite remainder has a triangular factor too: by QR of any square root.
        root = (vectors * np.sqrt(np.maximum(lam, 0.0))).T
        base = np.linalg.qr(root)[1].T
        base = base * np.where(np.diag(base) < 0, -1.0, 1.0)
        factor = np.block([[L, np.zeros((n, geometry.d))], [low, base]])
        entries = triangle_entries(factor)
        # Half the box: near its edge the sampling transform loses what it is given to round-off.
        entries = entries / (2 * np.abs(entries).max())
        if self.total_mass is not None or not geometry.weighs:
            return entries
        return np.concatenate([total_of(geometry, mass, self.healing), entries])

    def total(self, geometry: Geometry, mass: Array) -> Array:
        """Total of `mass`, (n + d, n + d), in the sense of this healing: (d,)."""
        return total_of(geometry, mass, self.healing)

    def stated(self, geometry: Geometry) -> Stated:
        """Known entries, and totals of its kind."""
        known = self.known_entries(geometry)
        if not np.any(np.isfinite(known)):
            return Stated(free=True, totals=self._stated_totals(geometry))
        count = np.count_nonzero(np.triu(np.isfinite(known[:, : geometry.n])))
        count += np.count_nonzero(np.isfinite(known[:, geometry.n :]))
        sentence = f"{count} {'entry' if count == 1 else 'entries'} of the mass matrix stated to be known"
        return Stated(
            True, known, self._stated_totals(geometry), sentence=sentence, entries_std=self._entries_std(known)
        )

    def _entries_std(self, known: Array) -> Array | None:
        """Deviations of the known entries (n, n + d); the larger of two that are given for one entry."""
        std = _deviations("FullMass: known_std", self.known_std, "known", self.known)
        if std is None:
            return None
        n, whole = len(known), np.zeros_like(known)
        whole[:, : std.shape[1]] = np.nan_to_num(std)
        whole[:, :n] = np.maximum(whole[:, :n], whole[:, :n].T)
        return whole

    def _stated_totals(self, geometry: Geometry) -> Totals | None:
        if self.total_mass is None:
            return None
        whole = geometry.rigid_total(self.total_mass)
        totals = geometry.totals(self.total_mass) if whole is None else whole
        std = _deviations("FullMass: total_std", self.total_std, "total_mass", self.total_mass)
        return Totals(totals, self.healing, None if std is None else np.broadcast_to(std, totals.shape))


@dataclass(frozen=True, eq=False)
class LumpedMass(FieldTree):
    """A diagonal mass matrix on the sensors, without coupling to the base and without base mass.

    Parameters
    ----------
    total_mass : float or array_like (d,), optional
        kg summed over the sensors of a direction; normalised to 1 kg, and said so, where None.
    """

    total_mass: ArrayLike | None = None

    def __post_init__(self) -> None:
        check_total_mass(self.total_mass)

    def unknowns(self, geometry: Geometry) -> tuple[Unknown, ...]:
        """Shares of the masses, scaled afterwards to their direction's total."""
        share = Unknown("mass_share", np.full(geometry.n, FACTOR_FLOOR), np.ones(geometry.n), relative=True)
        return (*geometry.total_unknowns(self.total_mass), share)

    def blocks(self, geometry: Geometry, y: ca.SX) -> MassBlocks:
        """Diagonal blocks; the base rows are zero."""
        groups = geometry.directions[: geometry.n]
        totals, share = geometry.split_totals(self.total_mass, y)
        scales = {
            i: totals[i] / ca.sum1(share[np.flatnonzero(groups == i).tolist()]) for i in set(groups.tolist()) - {-1}
        }
        free = sum(scales.values()) / len(scales) if scales else 1.0
        masses = [share[j] * scales.get(g, free) for j, g in enumerate(groups.tolist())]
        return MassBlocks(
            ca.diag(ca.sqrt(ca.vertcat(*masses))), ca.SX(geometry.n, geometry.d), ca.SX(geometry.d, geometry.d)
        )

    def values(self, geometry: Geometry, structure: Structure) -> Array:
        """Shares that `blocks` takes back to the structure's mass."""
        m, groups = np.diag(structure.mass)[: geometry.n], geometry.directions[: geometry.n]
        if self.total_mass is not None or not geometry.weighs:
            return m / m.max()
        totals = [m[groups == i].sum() or geometry.totals(None)[i] for i in range(geometry.d)]
        return np.concatenate([totals, m / m.max()])

    def stated(self, geometry: Geometry) -> Stated:
        """Zeros off the diagonal, and the total over the sensors."""
        entries = np.where(np.eye(geometry.n, geometry.n + geometry.d) > 0, np.nan, 0.0)
        sentence = "the mass is stated to be lumped on the sensors"
        if self.total_mass is None:
            return Stated(entries=entries, sentence=sentence)
        totals = Totals(geometry.totals(self.total_mass), "sensors")
        return Stated(entries=entries, totals=totals, sentence=f"{sentence}, with its total given")


@dataclass(frozen=True, eq=False)
class KnownMass(FieldTree):
    """A mass matrix that is known, kg: (n + d, n + d), or (n, n) with no mass on the base rows."""

    matrix: ArrayLike

    def __post_init__(self) -> None:
        matrix = finite_array("the known mass matrix", self.matrix)
        if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or not matrix.size:
            raise InputError(f"the known mass matrix is {matrix.shape}; a square one is needed")
        if np.abs(matrix - matrix.T).max() > 1e-9 * np.abs(matrix).max():
            raise InputError("the known mass matrix is not symmetric")
        check_sane("the diagonal of the known mass matrix", np.diag(matrix))

    def unknowns(self, geometry: Geometry) -> tuple[Unknown, ...]:
        """No unknowns."""
        return ()

    def blocks(self, geometry: Geometry, y: ca.SX) -> MassBlocks:
        """Constant blocks."""
        full = self.full(geometry)
        n = geometry.n
        try:
            L = np.linalg.cholesky(full[:n, :n])
        except np.linalg.LinAlgError:
            raise InputError("the known mass matrix is not positive definite over the sensors") from None
        return MassBlocks(*map(constant, (L, full[:n, n:], full[n:, n:])))

    def values(self, geometry: Geometry, structure: Structure) -> Array:
        """Nothing to tell."""
        return np.zeros(0)

    def stated(self, geometry: Geometry) -> Stated:
        """All entries."""
        return Stated(entries=self.full(geometry)[: geometry.n], sentence="the mass matrix is known")

    def full(self, geometry: Geometry) -> Array:
        """The matrix over sensors and base, (n + d, n + d)."""
        matrix = np.array(self.matrix, dtype=float)
        n, size = geometry.n, geometry.n + geometry.d
        if matrix.shape == (n, n):
            matrix = np.pad(matrix, (0, geometry.d))
        if matrix.shape != (size, size):
            raise InputError(f"the known mass matrix is {matrix.shape}; ({n}, {n}) or ({size}, {size}) is needed")
        check_base_last("the known mass matrix", matrix, n)
        if np.any(np.abs(matrix[n:][np.diag(matrix)[n:] == 0]) > 1e-9 * np.abs(matrix).max()):
            raise InputError(
                "the known mass matrix couples a base direction that has no mass: its diagonal entry is 0, others of "
                "its row are not; state its mass there, or make the whole row and column 0"
            )
        if np.any(np.diag(matrix)[:n] <= 0) or lowest_eigenvalue(matrix) < -1e-8:
            raise InputError(
                "the known mass matrix is not positive semidefinite (M_00 >= M_S0' M_SS^-1 M_S0), "
                "or a sensor has no mass"
            )
        return matrix


class WrittenMass(Written):
    """A mass matrix written in variables."""

    name = "mass"

    def blocks(self, geometry: Geometry, y: ca.MX) -> ca.MX:
        """The expression; no coupling and no base mass where it has no base rows."""
        whole = self.whole(geometry)
        check_base_last(self.name, at_point(self.name, whole, None), geometry.n)
        return whole


def _deviations(name: str, std: ArrayLike | None, of: str, values: ArrayLike | None) -> Array | None:
    """Standard deviations in the shape of the values; None where all are exact.

    Refused where they are negative, not finite beside a value, of another shape, or there are no values.
    """
    if std is None:
        return None
    if values is None:
        raise InputError(f"{name} is given without {of}: state what it is the deviation of")
    value, given = numbers(f"{name}'s {of}", values), numbers(name, std)
    if given.shape not in ((), value.shape):
        raise InputError(f"{name} is {given.shape}; one number or {value.shape}, the shape of {of}, is needed")
    given = np.broadcast_to(given, value.shape)
    wrong = np.isfinite(value) & ~((given >= 0) & (given < np.inf))
    if np.any(wrong):
        raise InputError(f"{name} = {shown(given[wrong].tolist())}: deviations of 0 or above are needed")
    return np.array(given)


def _spread(geometry: Geometry) -> tuple[Array, Array]:
    """Exponent of eq. 18 and lower bound of each entry of the factor, row by row."""
    size = geometry.n + geometry.d
    rows, columns = np.tril_indices(size)
    exponents = np.array([sampling_exponent(k) for k in range(1, size + 1)])[rows]
    return exponents, np.where(rows == columns, FACTOR_FLOOR, -1.0)


def _above_floor(y: ca.SX, lower: Array) -> ca.SX:
    """Factor entries (size,), those of the diagonal kept off zero; the others are in [-1, 1] as they are."""
    entries = zip(ca.vertsplit(y), lower.tolist(), strict=True)
    return ca.vertcat(*(entry if low < 0 else ca.fmax(entry, low) for entry, low in entries))


def total_of(geometry: Geometry, mass: Array, kind: str) -> Array:
    """Total of `mass` (n + d, n + d) in the sense of a kind of healing, (d,)."""
    if kind == "rigid_body":  # the diagonal of [G; I]' M [G; I]
        rigid = np.vstack([geometry.rigid_body, np.eye(geometry.d)])
        return np.einsum("ni,nm,mi->i", rigid, mass, rigid)
    return np.array([mass.diagonal()[geometry.directions == i].sum() for i in range(geometry.d)])


def heal(factor: ca.SX, geometry: Geometry, totals: ca.SX | Array, kind: str) -> ca.SX:
    """Scale the factor's rows, one scale a base direction, so that M has the stated totals (eq. 21-22).

    Rows of no direction take the mean of the scales: their mass has no total to obey.
    """
    d, groups = geometry.d, geometry.directions
    if kind == "rigid_body":
        scales = _rigid_body_scales(factor, geometry, totals)
    else:
        members = [np.flatnonzero(groups == i).tolist() for i in range(d)]
        scales = [ca.sqrt(totals[i] / ca.sumsqr(factor[rows, :])) for i, rows in enumerate(members)]
    of_groups = [*scales, sum(scales) / d]  # -1, no direction, is the last
    return ca.diag(ca.vertcat(*(of_groups[g] for g in groups.tolist()))) @ factor


def _rigid_parts(geometry: Geometry) -> tuple[Array, bool]:
    """Part of r_i in group a, (d, d, n + d) with i first and a second; and whether any is not zero where a is not i.

    r_i is column i of [G; I]; rows of no direction have an equal part in each group.
    """
    d, groups = geometry.d, geometry.directions
    rigid = np.vstack([geometry.rigid_body, np.eye(d)])
    shares = np.where(groups < 0, 1 / d, groups == np.arange(d)[:, None])
    across = np.where(groups != np.arange(d)[:, None], rigid.T, 0.0)
    return shares * rigid.T[:, None], bool(np.abs(across).max() > ROUND_OFF * np.abs(rigid).max())


def _rigid_body_scales(factor: ca.SX, geometry: Geometry, totals: ca.SX | Array) -> list[ca.SX]:
    """Scales s with ``r_i' D(s) M D(s) r_i = totals[i]`` for every direction i, r_i column i of [G; I].

    Where no sensor's row of G has two entries the equations are uncoupled and closed. Otherwise
    they are d quadratics, solved by Newton's method inside the expression; where that has not
    converged, mostly because no positive scales exist, they are NaN, and the candidate is passed over.
    """
    d, (parts_of, coupled) = geometry.d, _rigid_parts(geometry)
    # Total i is |sum_a s_a row_a|² with row_a = (part of r_i in group a)' L; Gram matrices hold all.
    parts = [constant(part) @ factor for part in parts_of]
    grams = [part @ part.T / totals[i] for i, part in enumerate(parts)]
    uncoupled = ca.vertcat(*(1 / ca.sqrt(gram[i, i]) for i, gram in enumerate(grams)))
    if not coupled:
        return ca.vertsplit(uncoupled)
    z, q = ca.SX.sym("z", d), ca.SX.sym("q", d, d * d)
    # In logarithms scales stay positive and the equations are nearly linear; long steps are cut.
    s = ca.exp(z)
    miss = ca.vertcat(*(ca.log(s.T @ gram @ s) for gram in ca.horzsplit(q, d)))
    change = ca.solve(ca.jacobian(miss, z), miss)
    step = ca.Function("newton", [z, q], [z - change / ca.fmax(1, ca.norm_inf(change))])
    error = ca.Function("miss", [z, q], [ca.norm_inf(miss)])
    # One scale for all is where a mass with the right totals starts, and stays.
    uniform = ca.sqrt(d / sum(ca.sum1(ca.sum2(gram)) for gram in grams))
    given, log_scale = ca.horzcat(*grams), ca.repmat(ca.log(uniform), d, 1)
    for _ in range(20):  # quadratic from a good start
        log_scale = step(log_scale, given)
    return ca.vertsplit(ca.if_else(error(log_scale, given) < 1e-10, ca.exp(log_scale), np.nan))
