"""Mass, stiffness and damping as functions of the vector x of all unknowns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from sysid.measurement.measurement import Measurement
from sysid.models.geometry import Geometry
from sysid.models.model import (
    FactoredMass,
    MassBlocks,
    MatrixModel,
    StiffnessBlocks,
    check_shape,
    mass_blocks,
    ratios_of,
    stiffness_blocks,
)
from sysid.models.unknowns import Unknown
from sysid.problem.direct_response import Motion
from sysid.structure.structure import Array, Structure


class Numbers(NamedTuple):
    """The blocks of the matrices at one x; `damping` is C (n, n), or empty where damping is by ratios."""

    mass: Array
    coupling: Array
    base: Array
    stiffness: Array
    damping: Array
    mass_normalised: Array


@dataclass(frozen=True, eq=False)
class Matrices:
    """Matrices of the unknowns.

    Attributes
    ----------
    function : casadi.Function
        x to M_SS (n, n), M_S0 (n, d), M_00 (d, d), K_SS (n, n), C (n, n) or nothing, the Cholesky factor L (n, n) of
        M_SS, and ``H = L^-1 K_SS L^-T`` (n, n).
    ratio_function : casadi.Function
        x and circular frequencies (n,) to damping ratios (n,), or to nothing where C tells them.
    rigid_body : (n, d)
        Motion of the degrees of freedom for unit base motion.
    recovery : (n_sensors, n)
    whole_factor : casadi.Function
        x to the Cholesky factor of the whole mass (n + d, n + d), or to nothing where the model has none.
    semidefinite : bool
        M is positive semidefinite for every x, as its model makes it so.
    """

    function: ca.Function
    ratio_function: ca.Function
    rigid_body: Array
    recovery: Array
    whole_factor: ca.Function
    semidefinite: bool = False

    @property
    def by_ratios(self) -> bool:
        """True where the damping of each mode is a function of its frequency, so that the response needs the modes."""
        return bool(self.ratio_function.numel_out(0))

    @property
    def at_sensors(self) -> bool:
        """True where the degrees of freedom are the sensors."""
        return np.array_equal(self.recovery, np.eye(len(self.rigid_body)))

    def numbers(self, x: Array) -> Numbers:
        """The blocks at `x`."""
        M, M_S0, M_00, K, C, _, H = (np.asarray(ca.densify(part)) for part in self.function(x))
        symmetric = lambda A: (A + A.T) / 2  # noqa: E731
        return Numbers(symmetric(M), M_S0, symmetric(M_00), symmetric(K), symmetric(C), symmetric(H))

    def motion(self, x: ca.MX) -> Motion:
        """The same as expressions of the symbol `x`."""
        return Motion._make([*self.function(x)[:5], self.rigid_body, self.recovery])

    def inverse(self, factor: ca.MX) -> ca.MX:
        """Inverse of the Cholesky factor, an expression."""
        L = ca.SX.sym("L", ca.Sparsity.lower(factor.size1()))
        inverse = ca.Function("inverse", [L], [ca.densify(ca.solve(L, ca.SX.eye(L.size1())))])
        return inverse(ca.tril(factor))

    def of_modes(self, x: ca.MX) -> list[ca.MX]:
        """Expressions from which the modes of a candidate follow.

        The lower triangle of ``H = L^-1 K_SS L^-T`` (n, n); ``[L^-1, L^-1 B]`` (n, n + d), ``B = M_SS G + M_S0``, whose
        products with the eigenvectors of H are shapes and participations; and the rigid-body mass (d, d). Where M may
        be indefinite also ``L^-1 M_S0`` (n, d) and M_00 (d, d).
        """
        M, M_S0, M_00, _, _, L, H = self.function(x)
        G, (n, d) = ca.DM(self.rigid_body), self.rigid_body.shape
        inverse, whole, base = self.inverse(L), self.whole_factor(x), []
        if whole.numel():
            moved = ca.horzcat(G.T, ca.DM.eye(d)) @ whole  # [G; I]' L_M, whose first columns are (L^-1 B)'
            loads, rigid = moved[:, :n].T, moved @ moved.T
        else:
            coupling = inverse @ M_S0
            loads, rigid = ca.tril(L).T @ G + coupling, G.T @ (M @ G + M_S0) + M_S0.T @ G + M_00
            base = [] if self.semidefinite else [coupling, M_00]
        return [ca.tril((H + H.T) / 2), ca.horzcat(inverse, loads), rigid, *base]

    def factors(self, x: ca.MX) -> tuple[ca.MX, ca.MX]:
        """L with ``M_SS = L L'`` and its inverse."""
        factor = self.function(x)[5]
        return factor, self.inverse(factor)

    def structure(self, x: Array, test: Measurement) -> Structure:
        """The structure that `x` stands for, with the sensors of a test.

        Raises
        ------
        InputError
            Where it stands for none.
        """
        M, M_S0, M_00, K, C, H = self.numbers(x)
        G, ratios = self.rigid_body, None
        if self.by_ratios:
            with np.errstate(invalid="ignore"):
                omega = np.sqrt(np.linalg.eigvalsh(H)) if np.all(np.isfinite(H)) else np.full(len(H), np.nan)
            ratios = np.asarray(self.ratio_function(x, omega)).ravel()
        return assemble(
            M, M_S0, M_00, K, G, ratios=ratios, damping=None if self.by_ratios else C,
            recovery=None if self.at_sensors else self.recovery, test=test,
        )  # fmt: skip


def assemble(
    M_SS: Array, M_S0: Array, M_00: Array, K_SS: Array, G: Array, *, test: Measurement,
    ratios: Array | None = None, damping: Array | None = None, recovery: Array | None = None,
) -> Structure:  # fmt: skip
    """Structure from its blocks; the base rows of K follow from ``K_S0 = -K_SS G``."""
    K_S0 = -K_SS @ G
    return Structure(
        np.block([[M_SS, M_S0], [M_S0.T, M_00]]),
        np.block([[K_SS, K_S0], [K_S0.T, -G.T @ K_S0]]),
        ratios,
        damping_matrix=damping,
        n_base=G.shape[1],
        recovery=recovery,
        rigid_body=None if recovery is None else test.rigid_body,
        sensors=test.sensors,
    )


class Blocks(NamedTuple):
    """The matrices as expressions.

    `damping` and `ratios` are empty where there is none, as `whole_factor` is; `omega` is the symbol of the circular
    frequencies in `ratios`.
    """

    mass: MassBlocks
    stiffness: StiffnessBlocks
    damping: ca.MX
    ratios: ca.MX
    omega: ca.MX
    whole_factor: ca.MX

    @property
    def by_matrix(self) -> tuple[ca.MX, ca.MX, ca.MX]:
        """All entries of mass, stiffness and damping, a column each."""
        mass = self.mass
        return (
            ca.veccat(mass.factor, mass.coupling, mass.base), ca.vec(self.stiffness.stiffness),
            ca.veccat(self.damping, self.ratios),
        )  # fmt: skip

    def motion(self, geometry: Geometry) -> Motion:
        """Equations of motion for direct solves of the response."""
        return Motion._make([*self.outputs[:5], geometry.rigid_body, geometry.recovery])

    @property
    def outputs(self) -> list[ca.MX]:
        """Outputs of `Matrices.function`."""
        (L, coupling, base, M), (K, H) = self.mass, self.stiffness
        return [L @ L.T if M is None else M, coupling, base, K, self.damping, L, H]


def blocks_of(
    models: Sequence[MatrixModel], geometry: Geometry, symbols: Sequence[Sequence[ca.MX]] = ((), (), ())
) -> Blocks:
    """The matrices of mass, stiffness and damping as expressions.

    They are written in the `symbols` of each model's unknowns, and in the variables of models without.
    """
    mass, stiffness, damping = models
    n = geometry.n
    y_mass, y_stiffness, y_damping = (ca.vertcat(ca.MX(0, 1), *group) for group in symbols)

    *parts, whole = _evaluated(lambda y: _with_factor(mass_blocks(mass.blocks(geometry, y), geometry)), y_mass, ())
    M = MassBlocks(*parts)
    L = M.factor
    of_mass = M._replace(factor=ca.tril(L), mass=L @ L.T if M.mass is None else M.mass)
    K = StiffnessBlocks(
        *_evaluated(
            lambda y, *m: stiffness_blocks(stiffness.blocks(geometry, y, MassBlocks(*m)), m[0]), y_stiffness, of_mass
        )
    )
    (C,) = _evaluated(
        lambda y, *b: (damping.blocks(geometry, y, MassBlocks(*b[:4]), StiffnessBlocks(*b[4:])),), y_damping,
        (*of_mass, *K),
    )  # fmt: skip
    omega = ca.MX.sym("omega", n)
    (ratios,) = _evaluated(lambda y, w: (ratios_of(damping, geometry, y, w),), y_damping, (omega,))
    C, ratios = (
        ca.MX(0, 0) if part is None else check_shape("damping", part, shape)
        for part, shape in ((C, (n, n)), (ratios, (n, 1)))
    )
    return Blocks(M, K, C, ratios, omega, ca.MX(0, 0) if whole is None else whole)


def _with_factor(blocks: MassBlocks) -> tuple[Any, ...]:
    """The blocks, and the factor of the whole mass where the model has one."""
    return (*blocks, blocks.whole if isinstance(blocks, FactoredMass) else None)


def _evaluated(expressions: Any, y: ca.MX, before: tuple[ca.MX, ...]) -> list[ca.MX | None]:
    """Blocks of a model by its unknowns and the blocks before it.

    A model with unknowns sees scalar symbols, whose operations run fastest.
    """
    if not y.numel():
        return [None if part is None else ca.MX(part) for part in expressions(y, *before)]
    symbols = [ca.SX.sym("y", y.numel()), *(ca.SX.sym(f"b{i}", part.sparsity()) for i, part in enumerate(before))]
    parts = expressions(*symbols)
    there = [i for i, part in enumerate(parts) if part is not None]
    function = ca.Function("model", symbols, [ca.densify(ca.SX(parts[i])) for i in there])
    values = dict(zip(there, function.call([y, *before]), strict=True))
    return [values.get(i) for i in range(len(parts))]


def symbols_in(
    models: Sequence[MatrixModel], of_models: Sequence[Sequence[Unknown]], geometry: Geometry
) -> list[list[ca.MX]]:
    """The symbols of variables that mass, stiffness and damping are written in; a model with unknowns has none."""
    n, d = geometry.n, geometry.d
    mass = MassBlocks(*(ca.MX.sym("mass", *shape) for shape in ((n, n), (n, d), (d, d), (n, n))))
    stiffness = StiffnessBlocks(ca.MX.sym("stiffness", n, n), ca.MX.sym("stiffness", n, n))
    omega, y = ca.MX.sym("omega", n), ca.MX(0, 1)
    given = {symbol.__hash__() for symbol in (*mass, *stiffness, omega)}
    found: list[list[ca.MX]] = []
    for model, unknowns, before in zip(models, of_models, ((), (mass,), (mass, stiffness)), strict=True):
        blocks = [] if unknowns else [model.blocks(geometry, y, *before)]
        if blocks and len(before) == 2 and hasattr(model, "ratios"):
            blocks.append(model.ratios(geometry, y, omega))
        parts = [part for block in blocks for part in (block if isinstance(block, tuple) else (block,))]
        symbols = [symbol for part in parts if isinstance(part, ca.MX) for symbol in ca.symvar(part)]
        found.append([symbol for symbol in symbols if symbol.__hash__() not in given])
    return found
