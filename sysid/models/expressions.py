"""Matrices as CasADi expressions: what a user gives, brought to them and checked, and triangles from their entries."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from sysid.errors import InputError, finite_array, listed, refuse
from sysid.models.complex_expressions import ComplexExpression
from sysid.models.unknowns import NO_COMPLEX, Variable, expression_of, refuse_complex, user_site, variable_of
from sysid.structure.structure import Array


def is_expression(value: Any) -> bool:
    """True where a matrix is written in variables, rather than a model or numbers."""
    if isinstance(value, list | tuple):
        return any(map(is_expression, value))
    return isinstance(value, Variable | ca.MX | ca.SX) or _is_objects(value)


def _is_objects(value: Any) -> bool:
    """True where a value is an array of Python objects, such as NumPy makes of lists of expressions."""
    return isinstance(value, np.ndarray) and value.dtype == object


def as_matrix(name: str, value: Any) -> ca.MX:
    """An expression, numbers or rows of both, as an expression."""
    value = _without_sx(name, value)
    if isinstance(value, ComplexExpression):
        raise InputError(f"{name} ({user_site()}): {NO_COMPLEX}")
    if isinstance(value, ca.MX | ca.DM):
        return ca.MX(value)
    if _is_objects(value):
        value = value.tolist()
    if isinstance(value, list | tuple) and is_expression(value):
        refuse_complex(value)
        rows = [row if isinstance(row, list | tuple) else [row] for row in value]
        entries = [[_entry(name, entry) for entry in row] for row in rows]
        try:
            return ca.blockcat(entries)
        except (RuntimeError, NotImplementedError):
            sizes = ", ".join(str(len(row)) for row in rows)
            raise InputError(
                f"{name} ({user_site()}): its rows do not fit together; they have {sizes} entries"
            ) from None
    return ca.MX(ca.sparsify(ca.DM(np.atleast_1d(finite_array(name, value)))))


def _entry(name: str, value: Any) -> Any:
    """An entry of a matrix that is given by rows."""
    value = _without_sx(name, value)
    refuse_complex([value])
    if isinstance(value, ca.MX | ca.DM | np.ndarray) or (np.isscalar(value) and not isinstance(value, str | bytes)):
        return value
    raise InputError(
        f"{name} ({user_site()}) holds a {type(value).__name__} in its rows: numbers and expressions are needed"
    )


def _without_sx(name: str, value: Any) -> Any:
    """The symbol of a variable, the numbers of a constant SX, and anything else as it is."""
    if not isinstance(value, ca.SX):
        return expression_of(value)
    if value.is_constant():
        return ca.DM(value)
    raise InputError(
        f"{name} ({user_site()}) is a CasADi SX with symbols of its own: write it in sysid.Variable (or MX)"
    )


def square(name: str, value: Any) -> ca.MX:
    """A matrix of the user's as an expression; refused where it is not square, finite and symmetric."""
    matrix = as_matrix(name, value)
    if matrix.size1() != matrix.size2():
        raise InputError(f"{name} is {size_of(matrix)}, and a square matrix is needed{written_in(matrix)}")
    at_guess = at_point(name, matrix, None)
    check_finite(name, at_guess, matrix)
    for place, numbers in (("at the guess", at_guess), ("away from the guess", at_point(name, matrix, 0.37))):
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
    """Refuse what is no number at the guess: a matrix, or the numbers (size,) of a column."""
    bad = np.argwhere(~np.isfinite(numbers)).tolist()
    if bad:
        at = bad[0]
        where = f"{at} " if numbers.size > 1 else ""
        entry = expression[tuple([*at, 0][:2])]
        raise InputError(f"{name} {where}is {numbers[tuple(at)]:g} at the guess{written_in(entry)}")


def written_in(expression: ca.MX, lead: str = "; it is") -> str:
    """The variables of an expression with their declarations, for the end of a message."""
    found = [v for v in map(variable_of, ca.symvar(expression)) if v is not None]
    if not found:
        return ""
    return f"{lead} written in " + listed([f"{v.name!r} ({v.declared})" for v in found])


def at_point(name: str, expression: ca.MX, share: float | None) -> Array:
    """Numbers of an expression with its variables at their guesses, or at this share of their search space."""
    symbols = ca.symvar(expression)
    variables = variables_of(name, symbols)
    values = [v.guess if share is None else v.lower + share * (v.upper - v.lower) for v in variables]
    shaped = [ca.reshape(ca.DM(value), *symbol.shape) for value, symbol in zip(values, symbols, strict=True)]
    return np.asarray(ca.densify(ca.Function("at", symbols, [expression]).call(shaped)[0]))


def variables_of(name: str, symbols: Sequence[ca.MX]) -> list[Variable]:
    """The variables that symbols stand for; refused where one stands for none."""
    free = [repr(symbol.name()) for symbol in symbols if variable_of(symbol) is None]
    if free:
        raise InputError(
            f"{', '.join(free)} in {name} ({user_site()}) is a free CasADi symbol: declare it as a sysid.Variable "
            "with bounds"
        )
    return [variable for variable in map(variable_of, symbols) if variable is not None]


def cholesky(M: ca.SX | ca.MX) -> ca.SX | ca.MX:
    """Lower-triangular factor of an expression."""
    A = ca.SX.sym("A", *M.shape)
    return ca.Function("cholesky", [A], [ca.densify(ca.chol(A).T)])(M)


def is_column(damping: Any) -> bool:
    """True where a matrix was given in one dimension, as damping ratios are."""
    if isinstance(damping, list | tuple):
        return not any(isinstance(entry, list | tuple) for entry in damping)
    return len(getattr(damping, "shape", ())) == 1


def check_size(name: str, matrix: ca.MX, n: int, d: int) -> None:
    """Refuse a matrix that is neither (n, n) nor (n + d, n + d)."""
    if matrix.size1() not in (n, n + d):
        ratios = ", or one ratio a mode" if name == "damping" else ""
        raise InputError(
            f"{name} is {size_of(matrix)} ({user_site()}); ({n}, {n}) or, with the base, ({n + d}, {n + d}) "
            f"is needed{ratios}, or recovery= beside it, from degrees of freedom to {n} sensors{written_in(matrix)}"
        )


def check_base_last(name: str, numbers: Array, n: int) -> None:
    """Refuse the numbers of a whole mass matrix where the rows of the base, which has no mass, stand first."""
    d = len(numbers) - n
    refuse(
        (
            d and not np.any(numbers[:d]) and np.any(numbers[n:]),
            f"{name} ({user_site()}) has no mass in its first row{'s' * (d > 1)}: rows and columns of the base stand "
            "last, those of the structure first",
        )
    )


def size_of(matrix: ca.MX) -> str:
    """The size of a matrix in words."""
    return f"{matrix.size1()} x {matrix.size2()}"


def lower_triangle(entries: ca.SX | ca.MX, size: int) -> ca.SX | ca.MX:
    """Lower-triangular expression from its entries, row by row."""
    rows, columns = np.tril_indices(size)
    return type(entries)(ca.Sparsity.lower(size), entries[np.lexsort((rows, columns)).tolist()])


def lower_entries(matrix: ca.SX | ca.MX) -> ca.SX | ca.MX:
    """Entries of an expression's lower triangle, row by row."""
    rows, columns = np.tril_indices(matrix.size1())
    return ca.vec(ca.densify(matrix))[(columns * matrix.size1() + rows).tolist()]


def triangle(entries: Array, size: int) -> Array:
    """Lower-triangular matrix of numbers from its entries, row by row."""
    matrix = np.zeros((size, size))
    matrix[np.tril_indices(size)] = entries
    return matrix


def triangle_entries(matrix: Array) -> Array:
    """Entries of a matrix's lower triangle, row by row."""
    return matrix[np.tril_indices(len(matrix))]
