"""Mass, stiffness and damping as functions of the vector x of all unknowns."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from sysid.errors import InputError, numbers, refuse, shaped_array
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.modal_analysis.response import columns, weighed_mass
from sysid.models.expressions import at_point, check_size, is_expression, square
from sysid.models.mass import KnownMass, WrittenMass
from sysid.models.model import (
    FactoredMass,
    Geometry,
    MassBlocks,
    MatrixModel,
    StiffnessBlocks,
    check_shape,
    mass_blocks,
    ratios_of,
    stiffness_blocks,
)
from sysid.models.stiffness_and_damping import WrittenDamping, WrittenStiffness
from sysid.models.unknowns import Unknown, Variable, user_site
from sysid.problem.residual_terms import ResidualTerms
from sysid.structure.structure import Array, Structure

MATRICES = ("mass", "stiffness", "damping")
_WRITTEN: dict[str, Any] = {"mass": WrittenMass, "stiffness": WrittenStiffness, "damping": WrittenDamping}
_DIMENSIONS = {"mass": (2,), "stiffness": (2,), "damping": (1, 2)}  # one ratio a mode
_WANTED = {
    "mass": "a model such as FullMass(kg) or a matrix",
    "stiffness": "a stiffness model of sysid, an expression or a matrix",
    "damping": "a damping model of sysid, an expression or a matrix",
}


def as_models(mass: Any, stiffness: Any, damping: Any) -> tuple[MatrixModel, MatrixModel, MatrixModel]:
    """Models as they are, numbers and expressions as models; refused where something is none of these."""
    if (
        isinstance(damping, tuple)
        and len(damping) == 2
        and all(isinstance(v, Variable | ca.MX) and np.prod(v.shape) == 1 for v in damping)
    ):
        names = ", ".join(str(getattr(v, "symbol", v)) for v in damping)
        raise InputError(
            f"damping=({names}) ({user_site()}) may mean one ratio a mode or two factors: "
            "write a list, [a, b], for ratios, and a * M + b * K for factors of mass and stiffness"
        )
    found: list[Any] = []
    for name, value in zip(MATRICES, (mass, stiffness, damping), strict=True):
        if is_expression(value):
            value = _WRITTEN[name](value)
        elif not _is_model(value, len(found)):
            value = (_WRITTEN | {"mass": KnownMass})[name](_numbers(name, value))
        found.append(value)
    return found[0], found[1], found[2]


def _is_model(value: object, before: int) -> bool:
    """True where a value has the methods of a matrix model whose blocks follow those of so many others."""
    if isinstance(value, type) or not isinstance(value, MatrixModel):
        return False
    try:
        inspect.signature(value.blocks).bind("geometry", "y", *range(before))
    except TypeError:
        return False
    return True


def _numbers(name: str, value: Any) -> Array:
    try:
        matrix = numbers(name, value, complex)
    except InputError:
        matrix = np.zeros(())
    refuse(
        (
            np.any(matrix.imag),
            f"Problem: {name} ({user_site()}) is complex, and a matrix of a structure is real: give its real part; "
            "a loss factor eta of a complex stiffness is a damping ratio eta / 2 of each mode, damping=[eta / 2, ...]",
        ),
        (matrix.ndim not in _DIMENSIONS[name], f"Problem: {name} is a {type(value).__name__}; give {_WANTED[name]}"),
    )
    return matrix.real.copy()


def geometry_of(
    modal: ModalEstimate,
    stiffness: MatrixModel,
    recovery: Any = None,
    rigid_body_dofs: Any = None,
    weighed: Callable[[], Array] | None = None,
) -> Geometry:
    """Geometry of the degrees of freedom of a problem or of a further test, of which the modal estimate is.

    Refused where recovery, rigid_body_dofs and the sensors do not fit together.
    """
    test = modal.records
    for name, given in (("recovery", recovery), ("rigid_body_dofs", rigid_body_dofs)):
        refuse(
            (
                is_expression(given),
                f"{name} ({user_site()}) is written in variables, and it must be numbers: what is not known of the "
                "degrees of freedom belongs into mass, stiffness and damping, written in those of the sensors",
            )
        )
    R = np.eye(test.n_sensors) if recovery is None else shaped_array("recovery", recovery, test.n_sensors, "n")
    G = _rigid_body_dofs(test, stiffness, R, recovery is not None, rigid_body_dofs)
    moved = np.abs(R @ G - test.rigid_body).max()
    if moved > 1e-6 * max(1.0, np.abs(test.rigid_body).max()):
        raise InputError(
            f"recovery @ rigid_body_dofs differs from the measurement's rigid_body by up to {moved:.3g}: the order of "
            "the degrees of freedom, or signs and axes of the sensors, are not what the matrices have"
        )
    return Geometry(modal, G, R, weighed)


def _rigid_body_dofs(test: Measurement, stiffness: MatrixModel, R: Array, other: bool, stated: Any) -> Array:
    """G of the degrees of freedom, (n, d): stated, or what a stiffness with its base columns has."""
    n, d = R.shape[1], test.n_base
    if stated is not None:
        return shaped_array("rigid_body_dofs", stated, n, d)
    if not other:
        return test.rigid_body
    whole = square("stiffness", stiffness.written) if isinstance(stiffness, WrittenStiffness) else ca.MX(n, n)
    if whole.size1() <= n:
        raise InputError(
            "with recovery, and a stiffness without its base columns, state rigid_body_dofs (n, d): the motion of the "
            "degrees of freedom with a rigid base"
        )
    check_size("stiffness", whole, n, d)
    K = at_point("stiffness", whole, None)
    return -np.linalg.lstsq(K[:n, :n], K[:n, n:], rcond=None)[0]


def rough_mass(test: Measurement, geometry: Geometry, stated: Array | None) -> Array:
    """Rough rigid-body mass of each base direction from the base force, (d,): it only places the search.

    Beside modes of `stated` circular frequencies, rad/s; where there are none, of the poles in the data. Refused where
    the force weighs a negative mass, with lines far below the first mode.
    """
    assert test.force is not None
    if stated is None:
        quiet, ratios = test, geometry.pole_ratios
        omega: Array = geometry.poles.omega if ratios.size else np.zeros(0)
    else:
        omega, ratios = stated, np.full(stated.size, 0.01)
        # Away from resonance the damping, which is not known, hardly matters.
        away = np.all(np.abs(2 * np.pi * test.freq / omega[:, None] - 1) > 0.1, axis=0)
        quiet = test if np.count_nonzero(away) < 2 * (omega.size + 1) else test.at(away)
    mass = np.diag(weighed_mass(quiet, omega, ratios))
    if np.all(mass > 0):
        return mass
    if omega.size and test.freq[0] < 0.3 * omega[0] / (2 * np.pi):
        raise InputError(
            f"the base force gives a mass of {mass.min():.3g} kg, with lines well below the first mode: check its "
            "sign (it is the base's on the structure, in phase with the base acceleration at low frequency) and "
            "its unit"
        )
    return np.linalg.norm(columns(test.force), axis=1) / np.linalg.norm(columns(test.base), axis=1)


class Motion(NamedTuple):
    """Equations of motion: CasADi expressions, and the numbers that geometry fixes.

    ``mass`` M_SS and ``stiffness`` K_SS (n, n), N s/m ``damping`` C (n, n), ``coupling`` M_S0 (n, d), ``base`` M_00
    (d, d); ``rigid_body_dofs`` (n, d), motion of the degrees of freedom with a rigid base; ``recovery``
    (n_sensors, n) from degrees of freedom to sensors.
    """

    mass: ca.MX
    coupling: ca.MX
    base: ca.MX
    stiffness: ca.MX
    damping: ca.MX
    rigid_body_dofs: Array
    recovery: Array

    @property
    def push(self) -> ca.MX:
        """``B = M_SS G + M_S0``, (n, d)."""
        return self.mass @ ca.DM(self.rigid_body_dofs) + self.coupling

    @property
    def rigid_body_mass(self) -> ca.MX:
        """``[G; I]' M [G; I]``, (d, d)."""
        G = ca.DM(self.rigid_body_dofs)
        return G.T @ self.push + self.coupling.T @ G + self.base


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

    `function` takes x to M_SS (n, n), M_S0 (n, d), M_00 (d, d), K_SS (n, n), C (n, n) or nothing, the Cholesky factor L
    (n, n) of M_SS, and ``H = L^-1 K_SS L^-T`` (n, n); `ratio_function` x and circular frequencies (n,) to damping
    ratios (n,), or to nothing where C tells them; `whole_factor` x to the Cholesky factor of the whole mass (n + d, n +
    d), or to nothing where the model has none. M is `semidefinite` where its model makes it positive semidefinite for
    every x. `beyond` are the terms of modes beyond the lines, which follow x. `rigid_body` (n, d)
    is the motion of the degrees of freedom for unit base motion, `recovery` (n_sensors, n) takes them to the sensors.
    """

    function: ca.Function
    ratio_function: ca.Function
    rigid_body: Array
    recovery: Array
    whole_factor: ca.Function
    semidefinite: bool
    beyond: ResidualTerms

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
        """`own_structure`, with the residual modes, if it has any, that explain the test best."""
        own = self.own_structure(x, test)
        return own.with_residual(self.beyond.of(test).fitted(own))

    def own_structure(self, x: Array, test: Measurement) -> Structure:
        """The structure that `x` stands for, with the sensors of a test; refused where it stands for none."""
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


def blocks_of_modes(
    P: Array, gamma: Array, omega: Array, G: Array, remainder: Array
) -> tuple[Array, Array, Array, Array]:
    """M_SS, M_S0, M_00 and K_SS of modes: P (n, n) the inverse of their shapes at the degrees of freedom, rad/s.

    `gamma` and G (n, d) are participations and rigid motion, `remainder` (d, d) the rigid-body mass that no mode
    carries.
    """
    delta = gamma - P @ G
    return P.T @ P, P.T @ delta, delta.T @ delta + remainder, (P.T * omega**2) @ P


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
