"""A problem in its own unknowns: matrices, residuals and constraints as CasADi functions of one vector x.

::

    models, arrays, expressions --> Blocks (MX)  --symbols--> variables, in the order of x
                                                 --Function-> matrices(x), residuals(x), constraints(x), healing(x)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from sysid.errors import InputError
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.complex_frequency import noise_level
from sysid.modal_analysis.response import residual
from sysid.models.geometry import Layout
from sysid.models.unknowns import Block, Variable, expression_of, user_site, variable_of
from sysid.problem.blocks import (
    Blocks,
    Given,
    Known,
    Misfit,
    as_matrix,
    at_point,
    blocks_of,
    check_finite,
    check_free,
    written_in,
)
from sysid.problem.direct_response import Motion, relative_misfit
from sysid.structure.structure import Array, Structure

MATRICES = ("mass", "stiffness", "damping")


class Constraints(NamedTuple):
    """``lower <= function(x) <= upper``; `sources` names the constraint of each row, and its variables."""

    function: ca.Function
    lower: Array
    upper: Array
    sources: tuple[str, ...]


class Numbers(NamedTuple):
    """The blocks of the matrices; `damping` is C (n, n), or one ratio a mode (n,)."""

    mass: Array
    coupling: Array
    base: Array
    stiffness: Array
    damping: Array


@dataclass(frozen=True, eq=False)
class Matrices:
    """Matrices of the unknowns.

    Attributes
    ----------
    function : casadi.Function
        x to M_SS (n, n), M_S0 (n, d), M_00 (d, d), K_SS (n, n), C (n, n), or ratios (n, 1) where `by_ratios`, and the
        Cholesky factor L (n, n) of M_SS.
    by_ratios : bool
    rigid_body_dofs : (n, d)
    recovery : (n_sensors, n)
    """

    function: ca.Function
    by_ratios: bool
    rigid_body_dofs: Array
    recovery: Array

    def numbers(self, x: Array) -> Numbers:
        """The blocks at `x`."""
        M, M_S0, M_00, K, damping = (np.asarray(ca.densify(part)) for part in self.function(x)[:5])
        C = damping.ravel() if self.by_ratios else (damping + damping.T) / 2
        return Numbers((M + M.T) / 2, M_S0, (M_00 + M_00.T) / 2, (K + K.T) / 2, C)

    def motion(self, x: ca.MX) -> Motion:
        """The same as expressions of the symbol `x`; where damping is by ratios they stand in the place of C."""
        M, M_S0, M_00, K, C = self.function(x)[:5]
        return Motion(M, M_S0, M_00, K, C, self.rigid_body_dofs, self.recovery)

    def factors(self, x: ca.MX) -> tuple[ca.MX, ca.MX]:
        """L with ``M_SS = L L'`` and its inverse."""
        factor = self.function(x)[5]
        L = ca.SX.sym("L", ca.Sparsity.lower(factor.size1()))
        inverse = ca.Function("inverse", [L], [ca.densify(ca.solve(L, ca.SX.eye(L.size1())))])
        return factor, inverse(ca.tril(factor))

    def structure(self, x: Array, test: Measurement) -> Structure:
        """The structure that `x` stands for."""
        M, M_S0, M_00, K, damping = self.numbers(x)
        G = self.rigid_body_dofs
        K_S0 = -K @ G
        at_sensors = np.array_equal(self.recovery, np.eye(len(G)))
        return Structure(
            np.block([[M, M_S0], [M_S0.T, M_00]]),
            np.block([[K, K_S0], [K_S0.T, -G.T @ K_S0]]),
            damping if self.by_ratios else None,
            damping_matrix=None if self.by_ratios else damping,
            n_base=G.shape[1],
            recovery=None if at_sensors else self.recovery,
            rigid_body=None if at_sensors else test.rigid_body,
            sensors=test.sensors,
        )


@dataclass(frozen=True, eq=False)
class Formulation:
    """Matrices, residuals and constraints as functions of the unknowns.

    Attributes
    ----------
    variables : tuple of Block or Variable
        Those that are searched: x is their entries, one after the other.
    fixed : tuple of Variable
        Those held at their guess.
    matrices : Matrices
    others : tuple of (Measurement, Matrices)
        Further tests, fitted beside the problem's own.
    residuals : casadi.Function or None
        x to a column: residuals beside the misfit of the measurement.
    known : casadi.Function or None
        x to a column: what is known to some accuracy, less its value, in standard deviations.
    known_names : tuple of str
        What each of its rows is called.
    shares : tuple of float
        What the misfit of each further test is multiplied by, so that all tests count by their noise.
    level : float
        Standard deviation of a real number of the measurement's relative residual: what one of them counts.
    misfit : casadi.Function or None
        x to a column: what stands in the place of the misfit of the measurement.
    constraints : Constraints or None
    healing : casadi.Function or None
        x to x: what the swarm's candidates pass through.
    members : tuple of (str, tuple of str)
        Names of the variables in each matrix, and in residuals and constraints where there are any.
    declarations : dict of str
        For each matrix what it is written in, for messages.
    """

    variables: tuple[Block | Variable, ...]
    fixed: tuple[Variable, ...]
    matrices: Matrices
    others: tuple[tuple[Measurement, Matrices], ...]
    residuals: ca.Function | None
    known: ca.Function | None
    known_names: tuple[str, ...]
    shares: tuple[float, ...]
    level: float
    misfit: ca.Function | None
    constraints: Constraints | None
    healing: ca.Function | None
    members: tuple[tuple[str, tuple[str, ...]], ...]
    declarations: dict[str, str]

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return sum(variable.size for variable in self.variables)

    @property
    def lower(self) -> Array:
        """Lower bounds, (size,)."""
        return np.concatenate([np.zeros(0), *(v.lower for v in self.variables)])

    @property
    def upper(self) -> Array:
        """Upper bounds, (size,)."""
        return np.concatenate([np.zeros(0), *(v.upper for v in self.variables)])

    @property
    def guess(self) -> Array:
        """Guesses, the middle of the search space where none is given, (size,)."""
        return np.concatenate([np.zeros(0), *(guess_of(v) for v in self.variables)])

    @property
    def guessed(self) -> bool:
        """Whether the author gave every unknown a guess."""
        return all(isinstance(v, Variable) and v.has_guess for v in self.variables)

    @property
    def labels(self) -> tuple[str, ...]:
        """A name an entry of x."""
        return tuple(label for v in self.variables for label in labels_of(v))


def relative_error(test: Measurement, matrices: Matrices, x: Array) -> float:
    """Relative residual of accelerations and, where it was measured, of force, weighed by their stated noise.

    With a damping matrix also where that is no structure's; NaN where modes are needed and there are none.
    """
    symbol = ca.MX.sym("x", x.size)
    motion = matrices.motion(symbol)
    if not matrices.by_ratios:
        return float(ca.Function("error", [symbol], [ca.norm_2(relative_misfit(test, motion, weighted=True))])(x))
    try:
        s = matrices.structure(x, test)
    except InputError:  # modes of what is no structure
        return float("nan")
    modes = (s.mode_shapes, s.participation, 2 * np.pi * s.natural_frequencies[:, None], s.damping_ratios[:, None])
    phi, gamma, omega, ratios = (ca.MX(ca.DM(part)) for part in modes)
    rigid = ca.MX(ca.DM(s.rigid_body_mass))
    return float(ca.evalf(ca.norm_2(residual(test, phi, gamma, omega, ratios, rigid, weighted=True))))


def guess_of(variable: Block | Variable) -> Array:
    """Where a search may start."""
    if isinstance(variable, Variable):
        return variable.guess
    return sampled(variable, (variable.lower + variable.upper) / 2)


def sampled(variable: Block | Variable, s: Array) -> Array:
    """Numbers of the variable that the swarm's coordinates `s`, (size,), stand for."""
    return s if variable.sampling is None else np.asarray(sampling_function(variable)(s)).ravel()


def sampling_function(variable: Block | Variable) -> ca.Function:
    """The variable of the swarm's coordinates, (size,) each."""
    s = ca.SX.sym("s", variable.size)
    return ca.Function("sampling", [s], [s if variable.sampling is None else ca.densify(variable.sampling(s))])


def labels_of(variable: Block | Variable) -> tuple[str, ...]:
    """A name an entry."""
    if isinstance(variable, Variable):
        return variable.labels
    return (variable.name,) if variable.size == 1 else tuple(f"{variable.name}[{i}]" for i in range(variable.size))


def formulate(given: Given, layout: Layout, test: Measurement) -> Formulation:
    """Functions of what a problem was given.

    Raises
    ------
    InputError
        Where a matrix, residual or constraint is not what it must be; named with the variables that it is written in.
    """
    blocks = blocks_of(given, layout, test)
    others = [(other, other.blocks()) for other in given.residuals if isinstance(other, Misfit)]
    stated = [k.rows(f"residual {i}") for i, k in enumerate(given.residuals, start=1) if isinstance(k, Known)]
    known = [(column - ca.DM(value)) / ca.DM(std) for column, value, std in stated]
    residuals = [
        _column(f"residual {i}", r) for i, r in enumerate(given.residuals, start=1) if not isinstance(r, Misfit | Known)
    ]
    misfit = None if given.misfit is None else _column("misfit", given.misfit)
    relations = [row for i, c in enumerate(given.constraints, start=1) for row in _relation(i, c)]
    healing = {variable: as_matrix("healing", expression) for variable, expression in given.healing.items()}
    tests = [part for _, other in others for part in other.by_matrix]
    written = [
        *blocks.by_matrix,
        *tests,
        *residuals,
        *known,
        *([] if misfit is None else [misfit]),
        *(g for g, _, _ in relations),
    ]

    models = {symbol.__hash__(): block for block, symbol in blocks.symbols}
    found: dict[int, Variable] = {}
    for expression in (*written, *healing.values()):
        symbols = [symbol for symbol in ca.symvar(expression) if symbol.__hash__() not in models]
        variables = [variable_of(symbol) for symbol in symbols]
        check_free("healing", symbols, variables)
        found |= {symbol.__hash__(): v for symbol, v in zip(symbols, variables, strict=True) if v is not None}
    own = sorted(found.values(), key=lambda variable: variable.order)
    _check_names(own, [block for block, _ in blocks.symbols])
    free, fixed = [v for v in own if not v.fixed], tuple(v for v in own if v.fixed)
    for variable, expression in healing.items():
        if not any(variable is v for v in free):
            raise InputError(f"healing: {variable!r} is no unknown of this problem")
        if expression.shape != variable.symbol.shape:
            raise InputError(
                f"healing of {variable.name!r} ({variable.declared}) has the shape {expression.shape}; that of the "
                f"variable is {variable.symbol.shape}"
            )
    symbols = [symbol for _, symbol in blocks.symbols] + [v.symbol for v in free]
    searched: tuple[Block | Variable, ...] = (*(block for block, _ in blocks.symbols), *free)
    if not searched:
        raise InputError("this problem has no unknowns: nothing is to be identified")

    def function(name: str, expressions: Sequence[ca.MX]) -> ca.Function:
        return _function(name, symbols, fixed, expressions)

    def matrices(part: Blocks) -> Matrices:
        motion = part.motion
        return Matrices(
            function("matrices", [*motion[:5], part.factor]), part.by_ratios, motion.rigid_body_dofs, motion.recovery
        )

    if known and misfit is not None:
        raise InputError("Known beside a misfit of your own: put it into that misfit, in the units of its rows")
    level = noise_level(test) if known or others else 0.0
    constraints = None
    if relations:
        rows = [expression for expression, _, _ in relations]
        constraints = Constraints(
            function("constraints", [ca.vertcat(*rows)]),
            np.concatenate([np.full(g.numel(), 0.0 if equal else -np.inf) for g, equal, _ in relations]),
            np.zeros(sum(g.numel() for g in rows)),
            tuple(source for g, _, source in relations for _ in range(g.numel())),
        )
    healed = [healing.get(v, v.symbol) if isinstance(v, Variable) else None for v in searched]
    groups = [*zip(MATRICES, blocks.by_matrix, strict=True)]
    groups += [("further tests", _stacked(tests)), ("residuals", _stacked(residuals + known))]
    groups += [("misfit", _stacked([] if misfit is None else [misfit]))]
    groups += [("constraints", _stacked([g for g, _, _ in relations]))]
    members = [(name, tuple(v.name for v in searched if _uses(part, v, blocks.symbols))) for name, part in groups]
    return Formulation(
        variables=searched,
        fixed=fixed,
        matrices=matrices(blocks),
        others=tuple((other.measurement, matrices(part)) for other, part in others),
        residuals=function("residuals", [ca.vertcat(*residuals)]) if residuals else None,
        known=function("known", [ca.vertcat(*known)]) if known else None,
        known_names=tuple(_name_of(column, i) for column, _, _ in stated for i in range(column.numel())),
        shares=tuple(1.0 if misfit is not None else level / noise_level(other.measurement) for other, _ in others),
        level=level if known else 0.0,
        misfit=None if misfit is None else function("misfit", [misfit]),
        constraints=constraints,
        healing=function("healing", [ca.veccat(*(s if h is None else h for h, s in zip(healed, symbols, strict=True)))])
        if healing
        else None,
        members=tuple((name, names) for name, names in members if names),
        declarations={name: written_in(part) for name, part in zip(MATRICES, blocks.by_matrix, strict=True)},
    )


def _name_of(column: ca.MX, row: int) -> str:
    """What a row of something known is called: its variable's entry, or the variables that it is written in."""
    entry = column[row]
    names = [v for v in map(variable_of, ca.symvar(entry)) if v is not None]
    if len(names) == 1:
        _, entries = ca.jacobian_sparsity(entry, names[0].symbol).get_triplet()
        if len(entries) == 1:
            return names[0].labels[entries[0]]
    return "a relation of " + ", ".join(v.name for v in names)


def _stacked(expressions: Sequence[ca.MX]) -> ca.MX:
    return ca.vertcat(ca.MX(0, 1), *(ca.vec(e) for e in expressions))


def _column(name: str, value: Any) -> ca.MX:
    column = ca.vec(ca.densify(as_matrix(name, value)))
    check_finite(name, at_point(name, column, None).ravel(), column)
    if not ca.symvar(column):
        raise InputError(f"{name} ({user_site()}) holds no variable: there is nothing that it could move")
    return column


def _relation(number: int, value: Any) -> list[tuple[ca.MX, bool, str]]:
    """Rows ``expression <= 0`` or ``== 0`` (flag) of a constraint, and what messages call it."""
    relation = expression_of(value)
    name = f"constraint {number}"
    kinds = {ca.OP_LE: False, ca.OP_LT: False, ca.OP_EQ: True}
    kind = next((k for k in kinds if isinstance(relation, ca.MX) and relation.is_op(k)), None)
    if kind is None:
        what = type(value).__name__ if not isinstance(value, ca.MX) else f"the expression {str(value)[:60]}"
        raise InputError(
            f"{name} is {what} ({user_site()}): a constraint is a relation of variables, such as "
            f"k[0] <= k[1] or ca.sum1(m) == 9{written_in(relation) if isinstance(relation, ca.MX) else ''}"
        )
    left, right = relation.dep(0), relation.dep(1)
    row = _column(name, left - right)
    return [(row, kinds[kind], name + written_in(relation).replace("; it is", ","))]


def _check_names(variables: Sequence[Variable], models: Sequence[Block]) -> None:
    for i, variable in enumerate(variables):
        if any(block.name == variable.name for block in models):
            raise InputError(
                f"variable {variable.name!r} ({variable.declared}) has the name of a model's unknowns: rename it"
            )
        for other in variables[:i]:
            if other.name == variable.name:
                raise InputError(
                    f"two variables are called {variable.name!r} ({other.declared}; {variable.declared}): tables and "
                    "results need a name each"
                )


def _uses(expression: ca.MX, variable: Block | Variable, symbols: Sequence[tuple[Block, ca.MX]]) -> bool:
    symbol = variable.symbol if isinstance(variable, Variable) else next(s for b, s in symbols if b is variable)
    return any(symbol.__hash__() == other.__hash__() for other in ca.symvar(expression))


def _function(
    name: str, symbols: Sequence[ca.MX], fixed: Sequence[Variable], expressions: Sequence[ca.MX]
) -> ca.Function:
    """Expressions of the symbols as a function of the vector x; fixed variables are numbers in it."""
    inner = ca.Function(name, [*symbols, *(v.symbol for v in fixed)], list(expressions))
    x = ca.MX.sym("x", sum(symbol.numel() for symbol in symbols))
    ends = np.cumsum([0, *(symbol.numel() for symbol in symbols)]).tolist()
    pieces = [ca.reshape(x[a:b], *symbol.shape) for (a, b), symbol in zip(pairwise(ends), symbols, strict=True)]
    constants = [ca.reshape(ca.MX(ca.DM(v.guess)), *v.symbol.shape) for v in fixed]
    return ca.Function(name, [x], inner.call([*pieces, *constants], True, False))
