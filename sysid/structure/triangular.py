"""Lower-triangular matrices and their entries, row by row, in numbers and in CasADi expressions."""

from __future__ import annotations

import casadi as ca
import numpy as np

from sysid.structure.structure import Array


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
