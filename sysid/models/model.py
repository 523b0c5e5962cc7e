"""The geometry of a test as matrix models see it, their one contract, and what a model states of its matrix.

A matrix model makes one matrix of unknowns. Those of this package stand beside this file; any other class with the
methods of `MatrixModel` can be given to a `Problem` as well.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, Self, runtime_checkable

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from sysid.errors import InputError, finite_array, refuse, shaped_array, shown
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.modal_estimate import ModalEstimate, estimated_poles
from sysid.modal_analysis.residues import Records
from sysid.modal_analysis.vector_fitting import Poles
from sysid.models.expressions import as_matrix, check_size, cholesky, square
from sysid.models.unknowns import Unknown, variable_of
from sysid.structure.structure import Array, Structure

# A Cholesky diagonal of zero makes the mode shapes infinite; one of 1e-3 already spans a
# condition number of 1e6, more than any test resolves.
FACTOR_FLOOR = 1e-3
_LIGHTEST, _HEAVIEST = 1e-12, 1e15  # kg or kg m²: beyond them no unit is right, and squares leave the range of floats


def check_total_mass(total_mass: ArrayLike | None) -> None:
    """Refuse a stated total that is wrong for any base: see `Geometry.totals` and `Geometry.rigid_total`."""
    if total_mass is None:
        return
    given = finite_array("total_mass", total_mass)
    masses = np.diag(given) if given.ndim == 2 else given
    refuse(
        (given.ndim > 2 or not given.size, f"total_mass has shape {given.shape}; one number, (d,) or (d, d) is needed"),
        (np.any(masses <= 0), f"total_mass = {shown(masses.tolist())}: masses must be positive"),
    )
    check_sane("total_mass", masses)


def check_sane(name: str, masses: Array) -> None:
    """Refuse masses that no structure has; zeros pass."""
    if np.any((masses != 0) & ((np.abs(masses) < _LIGHTEST) | (np.abs(masses) > _HEAVIEST))):
        raise InputError(
            f"{name} = {shown(masses.tolist())} is outside {_LIGHTEST:g} to {_HEAVIEST:g}; the unit is kg "
            "(kg m² where the base rotates)"
        )


class Geometry:
    """The geometry of a test's degrees of freedom, and what its records tell before any model is fitted.

    Poles and weights are found when they are first asked for, once. `rigid_body` (n, d), G, is the motion of the
    degrees of freedom for unit base motion, `recovery` (n_sensors, n) takes them to the sensors; by default they are
    the sensors. `weighed` is the rigid-body mass a direction (d,), or what finds it, that a measured base force
    suggests: a total that is not stated is then an unknown, searched around it.
    """

    def __init__(
        self,
        modal: ModalEstimate,
        rigid_body: Array | None = None,
        recovery: Array | None = None,
        weighed: Array | Callable[[], Array] | None = None,
    ) -> None:
        self.modal, self.translational = modal, modal.records.translational
        self.rigid_body = modal.records.rigid_body if rigid_body is None else rigid_body
        self.recovery = np.eye(len(self.rigid_body)) if recovery is None else recovery
        self._weighed = weighed
        self.monitor: Callable[[int, float], object] | None = None  # of a search for poles

    @property
    def test(self) -> Measurement:
        """The records that are fitted."""
        return self.modal.records

    @cached_property
    def poles(self) -> Poles:
        """Poles that stand out of the records."""
        return estimated_poles(self.modal, self.monitor)

    @cached_property
    def pole_ratios(self) -> Array:
        """Damping ratios of the poles that stand out of the records, by ascending frequency; (0,) where none does."""
        try:
            return self.poles.ratios
        except InputError:  # too few lines, or none stands out: who needs poles asks for them, and is told
            return np.zeros(0)

    @cached_property
    def natural_frequencies(self) -> Array:
        """Circular frequencies of the modes that stand out of the records, rad/s, ascending, at most n.

        A pole counts as often as its residue has rank, where the model has room for all.
        """
        omega, test = self.poles.omega, self.test
        if omega.size < self.n and test.n_base > 1 and not self.modal.by_modes:
            records = Records(test)
            free = records.fit(omega, self.poles.ratios)
            ranks = free.ranks(records.noise(free.left, free.residues.size), test.n_sensors, test.n_base)
            omega = np.repeat(omega, ranks) if ranks.sum() <= self.n else omega
        return omega[: self.n]

    @property
    def found(self) -> Poles | None:
        """The poles where they were found already; None where they were not."""
        return vars(self).get("poles")

    @cached_property
    def weighed(self) -> Array | None:
        """Rigid-body mass a direction that the base force suggests, (d,); None where nothing is weighed."""
        return self._weighed() if callable(self._weighed) else self._weighed

    def unsearched(self) -> Geometry:
        """The same with made-up poles and weights, to check what is declared before anything is searched."""
        other = Geometry(self.modal, self.rigid_body, self.recovery, None if self._weighed is None else np.ones(self.d))
        low = 1e-6 * self.test.freq[-1]  # within any limit that is stated
        other.poles = Poles(np.full(self.n, low), np.full(self.n, 0.01), 0.0)
        return other

    def weighing(self, totals: Array) -> Geometry:
        """The same with totals, where none are stated, as unknowns that are searched around these (d,)."""
        other = copy(self)
        other.__dict__.pop("weighed", None)
        other._weighed = totals
        return other

    @property
    def weighs(self) -> bool:
        """True where a total that is not stated is an unknown."""
        return self._weighed is not None

    @property
    def at_sensors(self) -> bool:
        """True where the degrees of freedom are the sensors."""
        return np.array_equal(self.recovery, np.eye(len(self.rigid_body)))

    @property
    def n(self) -> int:
        """Number of degrees of freedom."""
        return int(self.rigid_body.shape[0])

    @property
    def d(self) -> int:
        """Number of base directions."""
        return int(self.rigid_body.shape[1])

    @property
    def directions(self) -> Array:
        """Base direction of each row of the full mass matrix, (n + d,); -1 for none.

        A sensor belongs to the translation that moves it most, the first on a tie; a sensor that
        no translation moves belongs to none. A base row belongs to its own direction.
        """
        strength = np.abs(self.rigid_body) * self.translational
        # Direction cosines that differ by round-off are a tie.
        ties = strength >= strength.max(axis=1, keepdims=True) * (1 - 1e-9)
        groups = np.where(strength.max(axis=1) > 0, np.argmax(ties, axis=1), -1)
        return np.concatenate([groups, np.arange(self.d)])

    def total_unknowns(self, total_mass: ArrayLike | None) -> tuple[Unknown, ...]:
        """The totals as unknowns, where they are not stated and the base force tells them."""
        if total_mass is not None or not self.weighs:
            return ()
        moved = np.any(self.test.base, axis=(0, 2))
        if self.test.force is not None and not np.all(moved):
            raise InputError(
                f"the base moves in only {np.count_nonzero(moved)} of {self.d} independent directions: the base force "
                "weighs nothing in the others; add runs that move them, describe the test by the directions that move, "
                "or state total_mass"
            )
        assert self.weighed is not None
        # Skew sensors may all belong to one direction, which then carries what the force weighs in all.
        upper = np.where(self.translational, self.weighed[self.translational].sum(), self.weighed)
        return (Unknown("total_mass", self.weighed / 4, upper * 4, unit="kg"),)

    def split_totals(self, total_mass: ArrayLike | None, y: ca.SX) -> tuple[ca.SX | Array, ca.SX]:
        """Totals, stated or the first of the unknowns `y`, and the unknowns left."""
        if total_mass is None and self.weighs:
            return y[: self.d], y[self.d :]
        return self.totals(total_mass), y

    def totals(self, total_mass: ArrayLike | None) -> Array:
        """Total mass in each base direction, (d,): kg, or kg m² where the direction is a rotation."""
        if total_mass is None and self.weighed is not None:
            return self.weighed
        if total_mass is None:  # unit mass; a rotation carries it at the radius of gyration of the sensors
            lever = np.where(self.translational, 1.0, np.sqrt(np.mean(self.rigid_body**2, axis=0)))
            return np.where(lever > 0, lever**2, 1.0)
        check_total_mass(total_mass)
        given = np.array(total_mass, dtype=float)
        whole = self.rigid_total(given)
        if whole is not None:
            return np.diag(whole)
        refuse(
            (
                given.ndim == 0 and not np.all(self.translational),
                f"total_mass = {given} kg is one number but the base also rotates; give {self.d} numbers, kg for "
                "translations and kg m² for rotations",
            ),
            (
                given.shape not in ((), (self.d,)),
                f"total_mass has shape {given.shape}; one number, ({self.d},) or ({self.d}, {self.d}) is needed",
            ),
        )
        return np.full(self.d, given)

    def rigid_total(self, total_mass: ArrayLike | None) -> Array | None:
        """The rigid-body mass (d, d) where all of it is stated, else None."""
        if total_mass is None or np.ndim(total_mass) < 2:
            return None
        given = shaped_array("total_mass", total_mass, self.d, self.d)
        size = np.sqrt(np.diag(given))
        scaled = given / np.outer(size, size)
        if np.abs(scaled - scaled.T).max() > 1e-9 or np.linalg.eigvalsh(scaled)[0] <= 0:
            raise InputError("total_mass is no rigid-body mass: it must be symmetric and positive definite")
        return given


class FieldTree:
    """`to_tree` and `from_tree` of a dataclass whose fields are numbers, arrays of them, texts or None."""

    def to_tree(self) -> dict[str, Any]:
        """Give the fields as numbers, arrays and texts; `from_tree` takes them back."""
        return {field.name: plain(getattr(self, field.name)) for field in fields(self)}  # type: ignore[arg-type]

    @classmethod
    def from_tree(cls, tree: dict[str, Any]) -> Self:
        """Give the model of a tree that `to_tree` made."""
        return cls(**tree)


def plain(value: Any) -> Any:
    """A number, an array of numbers, a text or None as a tree holds it; TypeError or ValueError where it is none."""
    if value is None or isinstance(value, str):
        return value
    numbers = np.asarray(value, dtype=float)
    return numbers if numbers.ndim else float(numbers)


@dataclass(frozen=True, eq=False)
class Totals:
    """Stated total masses, (d,) kg a base direction (kg m² for rotations), or the whole rigid-body mass (d, d).

    `kind` is what is summed: "trace", the diagonal over the direction's sensors and its base row; "rigid_body",
    ``M_rb``; "sensors", the diagonal over the sensors alone. `std` are standard deviations, None where all are exact.
    """

    values: Array
    kind: Literal["trace", "rigid_body", "sensors"]
    std: Array | None = None

    @property
    def by_direction(self) -> Array:
        """One total a base direction, (d,)."""
        return np.diag(self.values) if self.values.ndim == 2 else self.values

    @property
    def std_by_direction(self) -> Array:
        """Their standard deviations, (d,)."""
        if self.std is None:
            return np.zeros(len(self.values))
        return np.diag(self.std) if self.std.ndim == 2 else self.std


@dataclass(frozen=True, eq=False)
class Stated:
    """Statement of a model about its matrix: strategies, determination and checks read it, and never the model's type.

    Attributes
    ----------
    free : bool
        Every positive definite matrix that has the stated entries and totals is in the model.
    entries : (n, n + d) or None
        Entries of ``[M_SS, M_S0]`` or ``[K_SS, K_S0]`` that have one value in the whole model, NaN where they vary.
        A model that is not free has nothing beyond its entries, totals and `positive`; where it has, None.
    totals : Totals or None
        Of a mass.
    spectrum : (k,) or None
        Of a stiffness: natural frequencies that are stated or were found, rad/s, ascending.
    positive : (p, n, n) or None
        Weights W of sums ``sum(W * matrix)`` that are never negative, such as the springs of a chain.
    sentence : str
        "the mass is stated to be lumped on the sensors"; empty where nothing is stated.
    entries_std : (n, n + d) or None
        Standard deviations of the entries, 0 where one is exact; None where all are.
    """

    free: bool = False
    entries: Array | None = None
    totals: Totals | None = None
    spectrum: Array | None = None
    positive: Array | None = None
    sentence: str = ""
    entries_std: Array | None = None

    @property
    def weighs(self) -> bool:
        """True where entries or totals of a free mass are adjusted together with the records."""
        with_std = self.totals is not None and self.totals.std is not None
        return self.free and (self.entries is not None or with_std)

    @property
    def rigid_total(self) -> Array | None:
        """Rigid-body mass (d, d) where all of it is stated, else None."""
        return self.totals.values if self.totals is not None and self.totals.values.ndim == 2 else None


class MassBlocks(NamedTuple):
    """Expressions: Cholesky factor L of M_SS (n, n), M_S0 (n, d), M_00 (d, d), and M_SS (n, n).

    Without M_SS, which then is ``L L'``, the whole mass is positive semidefinite for every value of the unknowns.
    """

    factor: Any
    coupling: Any
    base: Any
    mass: Any = None


class FactoredMass(MassBlocks):
    """Blocks of a mass whose Cholesky factor over sensors and base is known: ``M = whole whole'``, (n + d, n + d).

    A swarm takes participations and rigid-body mass from `whole`, because ``L^-1 M_S0`` loses the digits of
    ``M_S0 = L Z'`` where L is ill-conditioned. None where blocks were changed afterwards.
    """

    whole: Any = None

    @classmethod
    def of(cls, whole: Any, n: int) -> FactoredMass:
        """The blocks of a factor ``[[L, 0], [Z, L_00]]``, n the rows of L."""
        L, low, base = whole[:n, :n], whole[n:, :n], whole[n:, n:]
        blocks = cls(L, L @ low.T, low @ low.T + base @ base.T)
        blocks.whole = whole
        return blocks


class StiffnessBlocks(NamedTuple):
    """Expressions: K_SS (n, n), and ``H = L^-1 K_SS L^-T`` (n, n), L the Cholesky factor of M_SS."""

    stiffness: Any
    mass_normalised: Any


@runtime_checkable
class MatrixModel(Protocol):
    """Mass, stiffness or damping as variables and expressions.

    Symbols are CasADi SX in a model with unknowns, and MX (as those of `sysid.Variable` s) in one without. A damping
    whose ratios are a function of the frequency has one method more, ``ratios(geometry, y, omega)``: one ratio a mode,
    (n,), at the circular frequencies `omega` (n,), in ascending order; None where C tells them. A stiffness that can
    give its unknowns a spectrum has ``with_spectrum``, see `SpectralStiffness`; the swarm then refines its candidates.

    IPOPT and the swarm both evaluate these expressions, and nothing else of a model.
    """

    def unknowns(self, geometry: Geometry) -> Sequence[Unknown]:
        """Unknowns of the model; none where the matrix is written in variables or numbers."""

    def blocks(self, geometry: Geometry, y: Any, *before: Any) -> Any:
        """The matrix of the unknowns `y`, all in one column, as expressions.

        A mass gives `MassBlocks`, or the matrix alone, (n, n) or with the base's rows last (n + d, n + d); a
        stiffness, after the mass's blocks, `StiffnessBlocks`, or K_SS alone; a damping, after both, C (n, n), or None
        where it has no matrix but ratios only.
        """

    def values(self, geometry: Geometry, structure: Structure) -> Array:
        """The unknowns that stand for a structure's matrix: the inverse of `blocks`; refused where there is none."""

    def stated(self, geometry: Geometry) -> Stated:
        """Statement about the matrix."""


@dataclass(frozen=True, eq=False)
class Written:
    """A matrix that is `written` in variables or numbers, (n, n), or with the base's rows last (n + d, n + d).

    Each subclass has the blocks of one matrix.
    """

    written: Any

    name: ClassVar[str]  # of the matrix

    def unknowns(self, geometry: Geometry) -> tuple[Unknown, ...]:
        """None of its own: its variables are the problem's."""
        return ()

    def whole(self, geometry: Geometry) -> ca.MX:
        """The matrix as it is written, square, symmetric and finite at the guess."""
        matrix = square(self.name, self.written)
        check_size(self.name, matrix, geometry.n, geometry.d)
        return matrix

    def values(self, geometry: Geometry, structure: Structure) -> Array:
        """None of its own; refused where it is written in variables, because an expression has no inverse."""
        found = map(variable_of, ca.symvar(as_matrix(self.name, self.written)))
        if any(v is not None and not v.fixed for v in found):
            raise InputError(f"a {self.name} written in expressions has no inverse: give the unknowns, not a Structure")
        return np.zeros(0)

    def stated(self, geometry: Geometry) -> Stated:
        """Nothing that is read off an expression."""
        return Stated()


def mass_blocks(given: Any, geometry: Geometry) -> MassBlocks:
    """All blocks of a mass, where its model gives the matrix alone; refused where one has another shape."""
    n, d = geometry.n, geometry.d
    if isinstance(given, MassBlocks):
        for part, shape in zip(given[:3], ((n, n), (n, d), (d, d)), strict=True):
            check_shape("mass", part, shape)
        return given
    check_shape("mass", given, (n, n), (n + d, n + d))
    at_sensors = given[:n, :n]
    coupling, base = (given[:n, n:], given[n:, n:]) if given.shape[0] > n else (ca.DM(n, d), ca.DM(d, d))
    return MassBlocks(cholesky(at_sensors), coupling, base, at_sensors)


def stiffness_blocks(given: Any, factor: Any) -> StiffnessBlocks:
    """Both blocks of a stiffness, where its model gives K_SS alone."""
    if isinstance(given, StiffnessBlocks):
        return given
    n = factor.shape[0]
    check_shape("stiffness", given, (n, n))
    L, K = ca.SX.sym("L", ca.Sparsity.lower(n)), ca.SX.sym("K", n, n)
    half = ca.solve(L, K)
    mass_normalised = ca.Function("mass_normalised", [L, K], [ca.densify(ca.solve(L, half.T))])
    return StiffnessBlocks(given, mass_normalised(ca.tril(factor), given))


def check_shape(name: str, given: Any, *shapes: tuple[int, int]) -> Any:
    """Refuse what a matrix model gives where it has another shape."""
    if tuple(given.shape) not in shapes:
        needed = " or ".join(map(str, shapes))
        raise InputError(f"the {name} model gives a matrix of the shape {tuple(given.shape)}; {needed} is needed")
    return given


def ratios_of(damping: MatrixModel, geometry: Geometry, y: Any, omega: Any) -> Any:
    """Damping ratios (n,) of a damping model at circular frequencies `omega` (n,); None where it has a matrix alone."""
    of_modes = getattr(damping, "ratios", None)
    return None if of_modes is None else of_modes(geometry, y, omega)


def constant(matrix: Array) -> ca.DM:
    """Numbers as a CasADi matrix, zeros left out."""
    return ca.sparsify(ca.DM(np.atleast_2d(matrix)))
