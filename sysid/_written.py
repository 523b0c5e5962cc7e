"""What a user gives as matrices, models, numbers or expressions, brought to blocks of CasADi expressions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from sysid.damping import DampingModel, ModalDamping
from sysid.direct import Motion, Response, absolute_response, relative_misfit, relative_response
from sysid.errors import InputError
from sysid.layout import Layout
from sysid.mass import FullMass, KnownMass, LumpedMass
from sysid.measurement import Measurement
from sysid.stiffness import StiffnessModel
from sysid.structure import Array, finite_array
from sysid.variables import Block, Variable, call_site, expression_of, user_frame, variable_of


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
        if value.is_constant():
            return ca.MX(ca.DM(value))
        raise InputError(f"{name} is a CasADi SX with symbols of its own: write it in sysid.Variable (or MX)")
    if isinstance(value, np.ndarray) and value.dtype == object:
        value = value.tolist()
    if isinstance(value, list | tuple) and is_expression(value):
        rows = [row if isinstance(row, list | tuple) else [row] for row in value]
        try:
            return ca.blockcat([[expression_of(entry) for entry in row] for row in rows])
        except RuntimeError:
            raise InputError(
                f"{name}: its rows do not fit together; every row needs the same number of entries"
            ) from None
    if isinstance(value, ca.DM):
        return ca.MX(value)
    return ca.MX(ca.sparsify(ca.DM(np.atleast_1d(finite_array(name, value)))))


def blocks_of(given: Given, layout: Layout, test: Measurement) -> Blocks:
    """The blocks of the matrices as expressions."""
    symbols: list[tuple[Block, ca.MX]] = []
    d = layout.d

    def unknowns(blocks: Sequence[Block]) -> ca.MX:
        new = [(block, ca.MX.sym(block.name, block.size)) for block in blocks]
        symbols.extend(new)
        return ca.vertcat(ca.MX(0, 1), *(symbol for _, symbol in new))

    factor: ca.MX | None = None
    if isinstance(given.mass, FullMass | LumpedMass | KnownMass) and not (
        isinstance(given.mass, KnownMass) and given.recovery is not None
    ):
        y = unknowns(given.mass.variables(layout))
        sx = ca.SX.sym("y", y.numel())
        factor, coupling, base = ca.Function("mass", [sx], [ca.densify(b) for b in given.mass.blocks(layout, sx)])(y)
        M = factor @ factor.T
    else:
        whole = square("mass", given.mass.matrix if isinstance(given.mass, KnownMass) else given.mass)
        n = dofs_of(given, layout, whole)
        if whole.size1() not in (n, n + d):
            raise InputError(f"mass is {_size(whole)}; ({n}, {n}) or, with the base, ({n + d}, {n + d}) is needed")
        M, coupling, base = ca.MX(whole[:n, :n]), ca.MX(n, d), ca.MX(d, d)
        if whole.size1() > n:
            coupling, base = whole[:n, n:], whole[n:, n:]
    n = M.size1()

    if isinstance(given.stiffness, StiffnessModel):
        if given.recovery is not None:
            raise InputError("a stiffness model has one degree of freedom a sensor: with recovery write K yourself")
        y = unknowns(given.stiffness.variables(layout))
        L = cholesky(M) if factor is None else factor
        sx, sl = ca.SX.sym("y", y.numel()), ca.SX.sym("L", ca.Sparsity.lower(n))
        H = ca.densify(given.stiffness.mass_normalised(layout, sx, sl))
        K = ca.Function("stiffness", [sx, sl], [sl @ H @ sl.T])(y, ca.tril(L))
        G = layout.rigid_body
    else:
        whole = square("stiffness", given.stiffness)
        if whole.size1() not in (n, n + d):
            raise InputError(f"stiffness is {_size(whole)}; ({n}, {n}) or, with the base, ({n + d}, {n + d}) is needed")
        K = whole[:n, :n]
        G = rigid_body_dofs(given, layout, whole, n)

    by_ratios = False
    if isinstance(given.damping, ModalDamping):
        y = unknowns(given.damping.variables(layout if n == layout.n else _sized(layout, n)))
        C, by_ratios = y, True
    elif isinstance(given.damping, DampingModel):
        y = unknowns(given.damping.variables(layout))
        C = y[0] * M + y[1] * K
    else:
        C = as_matrix("damping", given.damping)
        if C.size2() == 1 and C.size1() == n > 1:
            by_ratios = True
        else:
            C = square("damping", C)
            if C.size1() not in (n, n + d):
                raise InputError(f"damping is {_size(C)}; a matrix ({n}, {n}), or one ratio a mode ({n},), is needed")
            C = C[:n, :n]
    recovery = np.eye(n) if given.recovery is None else finite_array("recovery", given.recovery)
    moved = np.abs(recovery @ G - test.rigid_body).max()
    if moved > 1e-6 * max(1.0, np.abs(test.rigid_body).max()):
        raise InputError(
            f"recovery @ rigid_body_dofs differs from the measurement's rigid_body by up to {moved:.3g}: the order of "
            "the degrees of freedom, or signs and axes of the sensors, are not what the matrices have"
        )
    by_matrix = ca.veccat(M, coupling, base), ca.vec(K), ca.vec(C)
    L = cholesky(M) if factor is None else factor
    return Blocks(Motion(M, coupling, base, K, C, G, recovery), L, by_ratios, symbols, by_matrix)


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


def dofs_of(given: Given, layout: Layout, mass: ca.MX) -> int:
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
        left = np.abs(K[:n, :n] @ G + K[:n, n:]).max()
        if left > 1e-6 * np.abs(K).max():
            raise InputError(
                "stiffness strains when the base moves as a rigid body: K_S0 must be -K_SS G (a spring to the base "
                "counts in both; are its last rows those of the base?)" + written_in(stiffness)
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
            f"{', '.join(map(repr, free))} in {name} ({call_site(user_frame())}) is a free CasADi symbol: declare it "
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
