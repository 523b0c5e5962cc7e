"""The one contract of a matrix model, what a model states of its matrix, and trees of models that are their fields.

A matrix model makes one matrix of unknowns. Those of this package stand beside this file; any other class with the
methods of `MatrixModel` can be given to a `Problem` as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, Self, runtime_checkable

import casadi as ca
import numpy as np

from sysid.errors import InputError
from sysid.models.expressions import as_matrix, check_size, cholesky, square
from sysid.models.geometry import Geometry
from sysid.models.unknowns import Unknown, variable_of
from sysid.structure.structure import Array, Structure


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
    """A number, an array of numbers, a text or None as a tree holds it.

    Raises
    ------
    TypeError, ValueError
        Where it is none of these.
    """
    if value is None or isinstance(value, str):
        return value
    numbers = np.asarray(value, dtype=float)
    return numbers if numbers.ndim else float(numbers)


@dataclass(frozen=True, eq=False)
class Totals:
    """Stated total masses.

    Attributes
    ----------
    values : (d,) or (d, d)
        kg a base direction (kg m² for rotations), or the whole rigid-body mass.
    kind : {"trace", "rigid_body", "sensors"}
        What is summed: the diagonal over the direction's sensors and its base row; ``M_rb``; or the diagonal over the
        sensors alone.
    std : (d,) or (d, d) or None
        Standard deviations; None where all are exact.
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
    """Blocks of a mass whose Cholesky factor over sensors and base is known: ``M = whole whole'``.

    Attributes
    ----------
    whole : expression (n + d, n + d) or None
        The lower-triangular factor. A swarm takes participations and rigid-body mass from it, because ``L^-1 M_S0``
        loses the digits of ``M_S0 = L Z'`` where L is ill-conditioned. None where blocks were changed afterwards.
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
        """The unknowns that stand for a structure's matrix: the inverse of `blocks`.

        Raises
        ------
        InputError
            Where there is none.
        """

    def stated(self, geometry: Geometry) -> Stated:
        """Statement about the matrix."""


@dataclass(frozen=True, eq=False)
class Written:
    """A matrix written in variables or numbers; each subclass has the blocks of one matrix.

    Parameters
    ----------
    written : expression or array_like
        (n, n), or with the base's rows last (n + d, n + d).
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
    """All blocks of a mass, where its model gives the matrix alone.

    Raises
    ------
    InputError
        Where a block has another shape, here and below.
    """
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
