"""What a user gives as matrices, models, numbers or expressions, brought to blocks of CasADi expressions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from sysid.errors import InputError
from sysid.measurement.measurement import Measurement
from sysid.models.damping import DampingModel, ModalDamping, ProportionalDamping
from sysid.models.geometry import Layout
from sysid.models.mass import FullMass, KnownMass, LumpedMass
from sysid.models.stiffness import StiffnessModel
from sysid.models.unknowns import Block, Variable, expression_of, user_site, variable_of
from sysid.problem.direct_response import Motion, Response, absolute_response, relative_misfit, relative_response
from sysid.structure.structure import Array, finite_array


class Given(NamedTuple):
    """What a problem was given, as `Problem` has it."""

    mass: Any
    stiffness: Any
    damping: Any
    residuals: Sequence[Any]
    constraints: Sequence[Any]
    misfit: Any
    recovery: Any
    rigid_body_dofs: Any
    healing: Mapping[Variable, Any]


@dataclass(frozen=True, eq=False)
class Misfit:
    """The misfit of a further test, for the `residuals` of a problem: of the structure as it was then.

    Parameters
    ----------
    measurement : Measurement
        May have other sensors, lines and base motion than the problem's own.
    mass, stiffness, damping : expression or array_like
        (n, n), or (n + d, n + d) with the base's rows last, in the variables of the problem; damping (n, n).
    recovery, rigid_body_dofs : array_like, optional
        As in `Problem`.
    """

    measurement: Measurement
    mass: Any = field(kw_only=True)
    stiffness: Any = field(kw_only=True)
    damping: Any = field(kw_only=True)
    recovery: Any = field(default=None, kw_only=True)
    rigid_body_dofs: Any = field(default=None, kw_only=True)

    def blocks(self) -> Blocks:
        """The blocks of its matrices."""
        if not isinstance(self.measurement, Measurement):
            raise InputError(f"Misfit: measurement is a {type(self.measurement).__name__}, not a sysid.Measurement")
        for name in ("mass", "stiffness", "damping"):
            if isinstance(getattr(self, name), FullMass | LumpedMass | StiffnessModel | DampingModel):
                raise InputError(f"Misfit: {name} is a model; write the matrix in the variables of the problem")
        test = self.measurement
        given = Given(
            self.mass, self.stiffness, self.damping, (), (), None, self.recovery, self.rigid_body_dofs, {}
        )  # fmt: skip
        blocks = blocks_of(given, Layout(test.rigid_body, test.translational), test)
        if blocks.by_ratios:
            raise InputError("Misfit: damping must be a matrix (n, n)")
        return blocks

    @property
    def response(self) -> Response:
        """Absolute accelerations of the sensors as expressions, (n_sensors, runs * n_freq)."""
        return absolute_response(self.measurement, self.blocks().motion)

    @property
    def force(self) -> Response:
        """The base force as expressions, (d, runs * n_freq)."""
        return relative_response(self.measurement, self.blocks().motion)[1]

    @property
    def expression(self) -> ca.MX:
        """Relative residuals of accelerations and, where measured, of force, one below the other."""
        return relative_misfit(self.measurement, self.blocks().motion, weighted=True)


@dataclass(frozen=True, eq=False)
class Known:
    """Something known to some accuracy, for the `residuals` of a problem: it counts as one more measurement.

    Parameters
    ----------
    expression : Variable or expression
        What is known: a variable, or any column of numbers written in variables.
    value : array_like
        Its value, broadcast to it.
    std : array_like
        Standard deviation of the value, in the same unit.

    Examples
    --------
    >>> import sysid
    >>> m = sysid.Variable("floor", 2, lower=100.0, upper=900.0, unit="kg")
    >>> weighed = sysid.Known(m, [410.0, 395.0], std=12.0)
    """

    expression: Any
    value: Any
    std: Any

    def rows(self, name: str) -> tuple[ca.MX, Array, Array]:
        """The expression as a column, its values and standard deviations, (rows,) each."""
        column = ca.vec(ca.densify(as_matrix(name, self.expression)))
        given = []
        for what, numbers in (("value", self.value), ("std", self.std)):
            array = finite_array(f"{name}: {what}", numbers).ravel(order="F")
            if array.size not in (1, column.numel()):
                raise InputError(f"{name}: {what} holds {array.size} numbers for {column.numel()}{written_in(column)}")
            given.append(np.broadcast_to(array, (column.numel(),)))
        if np.any(given[1] <= 0):
            raise InputError(
                f"{name}: std = {given[1].min():g}; standard deviations must be positive{written_in(column)}"
            )
        return column, given[0], given[1]


class Blocks(NamedTuple):
    """The blocks as expressions, L with ``M_SS = L L'``, and the variables of the models with their symbols."""

    motion: Motion
    factor: ca.MX
    by_ratios: bool
    symbols: list[tuple[Block, ca.MX]]
    by_matrix: tuple[ca.MX, ca.MX, ca.MX]


def is_expression(value: Any) -> bool:
    """Whether a matrix is written in variables, rather than a model or numbers."""
    if isinstance(value, Variable | ca.MX | ca.SX):
        return True
    if isinstance(value, list | tuple):
        return any(is_expression(entry) for entry in value)
    return isinstance(value, np.ndarray) and value.dtype == object


def as_matrix(name: str, value: Any) -> ca.MX:
    """An expression, numbers or rows of both, as an expression."""
    value = expression_of(value)
    if isinstance(value, ca.MX):
        return value
    if isinstance(value, ca.SX):
        return ca.MX(ca.DM(_constant(name, value)))
    if isinstance(value, np.ndarray) and value.dtype == object:
        value = value.tolist()
    if isinstance(value, list | tuple) and is_expression(value):
        rows = [row if isinstance(row, list | tuple) else [row] for row in value]
        entries = [[_entry(name, entry) for entry in row] for row in rows]
        try:
            return ca.blockcat(entries)
        except (RuntimeError, NotImplementedError):
            sizes = ", ".join(str(len(row)) for row in rows)
            raise InputError(
                f"{name} ({user_site()}): its rows do not fit together; they have {sizes} entries"
            ) from None
    if isinstance(value, ca.DM):
        return ca.MX(value)
    return ca.MX(ca.sparsify(ca.DM(np.atleast_1d(finite_array(name, value)))))


def _entry(name: str, value: Any) -> Any:
    """An entry of a matrix that is given by rows."""
    value = expression_of(value)
    if isinstance(value, ca.SX):
        return ca.DM(_constant(name, value))
    if isinstance(value, ca.MX | ca.DM | np.ndarray) or (np.isscalar(value) and not isinstance(value, str | bytes)):
        return value
    raise InputError(
        f"{name} ({user_site()}) holds a {type(value).__name__} in its rows: numbers and expressions are needed"
    )


def _constant(name: str, value: ca.SX) -> ca.SX:
    if not value.is_constant():
        raise InputError(
            f"{name} ({user_site()}) is a CasADi SX with symbols of its own: write it in sysid.Variable (or MX)"
        )
    return value


class _Models:
    """The unknowns of the models among the matrices, with their symbols."""

    def __init__(self) -> None:
        self.symbols: list[tuple[Block, ca.MX]] = []

    def unknowns(self, blocks: Sequence[Block]) -> ca.MX:
        """New symbols for blocks, one below the other."""
        new = [(block, ca.MX.sym(block.name, block.size)) for block in blocks]
        self.symbols += new
        return ca.vertcat(ca.MX(0, 1), *(symbol for _, symbol in new))


def blocks_of(given: Given, layout: Layout, test: Measurement) -> Blocks:
    """The blocks of the matrices as expressions."""
    models = _Models()
    M, coupling, base, factor = _mass(given, layout, models)
    K, G = _stiffness(given, layout, models, factor)
    C, by_ratios = _damping(given, layout, models, M, K)
    n = M.size1()
    recovery = np.eye(n) if given.recovery is None else finite_array("recovery", given.recovery)
    moved = np.abs(recovery @ G - test.rigid_body).max()
    if moved > 1e-6 * max(1.0, np.abs(test.rigid_body).max()):
        raise InputError(
            f"recovery @ rigid_body_dofs differs from the measurement's rigid_body by up to {moved:.3g}: the order of "
            "the degrees of freedom, or signs and axes of the sensors, are not what the matrices have"
        )
    by_matrix = ca.veccat(M, coupling, base), ca.vec(K), ca.vec(C)
    return Blocks(Motion(M, coupling, base, K, C, G, recovery), factor, by_ratios, models.symbols, by_matrix)


def _mass(given: Given, layout: Layout, models: _Models) -> tuple[ca.MX, ca.MX, ca.MX, ca.MX]:
    """M_SS, M_S0, M_00 and the factor of the first."""
    d, mass = layout.d, given.mass
    if isinstance(mass, FullMass | LumpedMass) or (isinstance(mass, KnownMass) and given.recovery is None):
        if given.recovery is not None:
            raise InputError("a mass model has one degree of freedom a sensor: with recovery write M yourself")
        y = models.unknowns(mass.variables(layout))
        sx = ca.SX.sym("y", y.numel())
        factor, coupling, base = ca.Function("mass", [sx], [ca.densify(b) for b in mass.blocks(layout, sx)])(y)
        return factor @ factor.T, coupling, base, factor
    whole = square("mass", mass.matrix if isinstance(mass, KnownMass) else mass)
    n = dofs_of(given, layout)
    _check_size("mass", whole, n, d)
    M = ca.MX(whole[:n, :n])
    if whole.size1() == n:
        return M, ca.MX(n, d), ca.MX(d, d), cholesky(M)
    return M, whole[:n, n:], whole[n:, n:], cholesky(M)


def _stiffness(given: Given, layout: Layout, models: _Models, factor: ca.MX) -> tuple[ca.MX, Array]:
    """K_SS, and the motion of the degrees of freedom with a rigid base."""
    n = factor.size1()
    if not isinstance(given.stiffness, StiffnessModel):
        whole = square("stiffness", given.stiffness)
        _check_size("stiffness", whole, n, layout.d)
        return whole[:n, :n], rigid_body_dofs(given, layout, whole, n)
    if given.recovery is not None:
        raise InputError("a stiffness model has one degree of freedom a sensor: with recovery write K yourself")
    y = models.unknowns(given.stiffness.variables(layout))
    sx, L = ca.SX.sym("y", y.numel()), ca.SX.sym("L", ca.Sparsity.lower(n))
    H = ca.densify(given.stiffness.mass_normalised(layout, sx, L))
    return ca.Function("stiffness", [sx, L], [L @ H @ L.T])(y, ca.tril(factor)), layout.rigid_body


def _damping(given: Given, layout: Layout, models: _Models, M: ca.MX, K: ca.MX) -> tuple[ca.MX, bool]:
    """C, or ratios and True."""
    n, damping = M.size1(), given.damping
    if isinstance(damping, ModalDamping):
        return models.unknowns(damping.variables(layout if n == layout.n else _sized(layout, n))), True
    if isinstance(damping, ProportionalDamping):
        y = models.unknowns(damping.variables(layout))
        return y[0] * M + y[1] * K, False
    C = as_matrix("damping", damping)
    if C.size2() == 1 and C.size1() == n and (n > 1 or _is_list(damping)):
        column = at_point("damping", C, None)
        check_finite("damping ratio", column.ravel(), C)
        if np.any(column < 0):
            raise InputError(f"damping: the ratio {column.min():.3g} at the guess is negative{written_in(C)}")
        return C, True
    C = square("damping", damping)
    _check_size("damping", C, n, layout.d)
    return C[:n, :n], False


def _is_list(damping: Any) -> bool:
    """Whether damping was given in one dimension, as ratios are."""
    if isinstance(damping, Variable):
        return len(damping.shape) == 1
    if isinstance(damping, list | tuple):
        return not any(isinstance(entry, list | tuple) for entry in damping)
    return isinstance(damping, np.ndarray) and damping.ndim == 1


def _check_size(name: str, matrix: ca.MX, n: int, d: int) -> None:
    if matrix.size1() not in (n, n + d):
        ratios = ", or one ratio a mode" if name == "damping" else ""
        raise InputError(
            f"{name} is {_size(matrix)} ({user_site()}); ({n}, {n}) or, with the base, ({n + d}, {n + d}) "
            f"is needed{ratios}, or recovery= beside it, from degrees of freedom to {n} sensors{written_in(matrix)}"
        )


def square(name: str, value: Any) -> ca.MX:
    """A matrix of the user's as an expression; refused where it is not square, finite and symmetric."""
    matrix = as_matrix(name, value)
    if matrix.size1() != matrix.size2():
        raise InputError(f"{name} is {_size(matrix)}, and a square matrix is needed{written_in(matrix)}")
    for place, numbers in (
        ("at the guess", at_point(name, matrix, None)),
        ("away from the guess", at_point(name, matrix, 0.37)),
    ):
        if place == "at the guess":
            check_finite(name, numbers, matrix)
        size = np.sqrt(np.abs(np.diag(numbers)))
        off = np.abs(numbers - numbers.T)
        if np.any(off > 1e-9 * (np.outer(size, size) + np.abs(numbers).max())):
            i, j = np.unravel_index(int(np.argmax(off)), off.shape)
            pair = ca.veccat(matrix[int(i), int(j)], matrix[int(j), int(i)])
            raise InputError(
                f"{name} is not symmetric: {place} [{i}, {j}] is {numbers[i, j]:.6g} and [{j}, {i}] is "
                f"{numbers[j, i]:.6g}{written_in(pair) or written_in(matrix)}"
            )
    return matrix


def check_finite(name: str, numbers: Array, expression: ca.MX) -> None:
    """Refuse what is no number at the guess."""
    bad = np.argwhere(~np.isfinite(numbers))
    if bad.size:
        at = tuple(int(i) for i in bad[0])
        entry = expression[at[0], at[1]] if len(at) == 2 else expression[at[0]]
        where = f"[{', '.join(map(str, at))}] " if numbers.size > 1 else ""
        raise InputError(f"{name} {where}is {numbers[tuple(bad[0])]:g} at the guess{written_in(entry)}")


def written_in(expression: ca.MX) -> str:
    """The variables of an expression with their declarations, for the end of a message."""
    found = [v for v in map(variable_of, ca.symvar(expression)) if v is not None]
    if not found:
        return ""
    named = ", ".join(f"{v.name!r} ({v.declared})" for v in found[:6])
    return f"; it is written in {named}" + (f" and {len(found) - 6} more" if len(found) > 6 else "")


def dofs_of(given: Given, layout: Layout) -> int:
    """Number of degrees of freedom."""
    if given.recovery is None:
        return layout.n
    recovery = finite_array("recovery", given.recovery)
    if recovery.ndim != 2 or len(recovery) != layout.n:
        raise InputError(f"recovery is {recovery.shape}; ({layout.n}, n) takes n degrees of freedom to the sensors")
    return int(recovery.shape[1])


def rigid_body_dofs(given: Given, layout: Layout, stiffness: ca.MX, n: int) -> Array:
    """G of the degrees of freedom, (n, d): stated, of the sensors, or what the stiffness with its base columns has."""
    if given.rigid_body_dofs is not None:
        G = finite_array("rigid_body_dofs", given.rigid_body_dofs)
        if G.shape != (n, layout.d):
            raise InputError(f"rigid_body_dofs is {G.shape}; ({n}, {layout.d}) is needed")
    elif given.recovery is None:
        G = layout.rigid_body
    elif stiffness.size1() > n:
        K = at_point("stiffness", stiffness, None)
        G = -np.linalg.lstsq(K[:n, :n], K[:n, n:], rcond=None)[0]
    else:
        raise InputError(
            "with recovery, and a stiffness without its base columns, state rigid_body_dofs (n, d): the motion of the "
            "degrees of freedom with a rigid base"
        )
    if stiffness.size1() > n:
        K = at_point("stiffness", stiffness, None)
        left = np.abs(K[:, :n] @ G + K[:, n:]).max()
        if left > 1e-6 * np.abs(K).max():
            raise InputError(
                "stiffness strains when the base moves as a rigid body: K_S0 must be -K_SS G, and K_00 G' K_SS G (a "
                "spring to the base counts in all; are its last rows those of the base?)" + written_in(stiffness)
            )
    return G


def at_point(name: str, expression: ca.MX, share: float | None) -> Array:
    """Numbers of an expression with its variables at their guesses, or at this share of their search space."""
    symbols = ca.symvar(expression)
    found = [variable_of(symbol) for symbol in symbols]
    check_free(name, symbols, found)
    values = [v.guess if share is None else v.lower + share * (v.upper - v.lower) for v in found if v is not None]
    shaped = [ca.reshape(ca.DM(value), *symbol.shape) for value, symbol in zip(values, symbols, strict=True)]
    return np.asarray(ca.densify(ca.Function("at", symbols, [expression]).call(shaped)[0]))


def check_free(name: str, symbols: Sequence[ca.MX], found: Sequence[Variable | None]) -> None:
    """Refuse symbols that are no variables."""
    free = [symbol.name() for symbol, variable in zip(symbols, found, strict=True) if variable is None]
    if free:
        raise InputError(
            f"{', '.join(map(repr, free))} in {name} ({user_site()}) is a free CasADi symbol: declare it "
            "as a sysid.Variable with bounds"
        )


def cholesky(M: ca.MX) -> ca.MX:
    """Lower-triangular factor of an expression."""
    A = ca.SX.sym("A", M.size1(), M.size1())
    return ca.Function("cholesky", [A], [ca.densify(ca.chol(A).T)])(M)


def _sized(layout: Layout, n: int) -> Layout:
    """A layout for models that read nothing but the number of degrees of freedom."""
    return Layout(np.zeros((n, layout.d)), layout.translational)


def _size(matrix: ca.MX) -> str:
    return f"{matrix.size1()} x {matrix.size2()}"
