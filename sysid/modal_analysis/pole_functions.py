"""Functions of poles at the lines of all runs, and their orthonormal basis.

The motion at the ends of a run makes functions that are zero outside it. They are eliminated within their run, so that
runs share the functions of the base's motion alone: the cost grows with the number of runs, not with its square.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from sysid.structure.structure import Array
from sysid.structure.thresholds import ROUND_OFF


class OfRun(NamedTuple):
    """Columns that are zero outside one run: their rows (k,), inputs (i,), and values there (k, m * i)."""

    rows: NDArray[np.intp]
    inputs: NDArray[np.intp]
    columns: Array


class PoleFunctions(NamedTuple):
    """Columns of m poles, pole by pole, real parts of all lines above imaginary ones.

    Attributes
    ----------
    shared : (rows, m * k)
        For the inputs of all runs.
    inputs : (k,)
        Where these stand among all inputs.
    by_run : sequence of OfRun
        For the inputs of one run each.
    """

    shared: Array
    inputs: NDArray[np.intp]
    by_run: Sequence[OfRun] = ()

    @property
    def per_pole(self) -> int:
        """Inputs of a pole."""
        return self.inputs.size + sum(one.inputs.size for one in self.by_run)

    @property
    def size(self) -> int:
        """Number of columns."""
        return self.shared.shape[1] // self.inputs.size * self.per_pole

    @property
    def places(self) -> list[NDArray[np.intp]]:
        """Where the columns of each run, and last the shared ones, stand pole by pole with all inputs in order."""
        starts = np.arange(0, self.size, self.per_pole)[:, None]
        return [(starts + inputs).ravel() for inputs in (*(one.inputs for one in self.by_run), self.inputs)]

    def in_order(self, parts: Sequence[Array]) -> Array:
        """Rows that belong to the columns of each run, and last to the shared ones, pole by pole."""
        return np.concatenate(parts)[np.argsort(np.concatenate(self.places))]

    def squares(self) -> Array:
        """Sums of squares of the columns, (columns,)."""
        return self.in_order([np.sum(part**2, axis=0) for part in (*(one.columns for one in self.by_run), self.shared)])

    def dense(self) -> Array:
        """All columns written out, (rows, m * inputs)."""
        out = np.zeros((len(self.shared), self.size))
        *by_run, shared = self.places
        out[:, shared] = self.shared
        for one, place in zip(self.by_run, by_run, strict=True):
            out[np.ix_(one.rows, place)] = one.columns
        return out


class Basis(NamedTuple):
    """Orthonormal columns: those of each run (rows, columns), then those of all, (rows, k)."""

    by_run: Sequence[tuple[NDArray[np.intp], Array]]
    shared: Array

    def answers(self, data: Array) -> Array:
        """Products with data (rows, c), (columns, c)."""
        return np.concatenate([*(Q.T @ data[rows] for rows, Q in self.by_run), self.shared.T @ data])

    def times(self, answers: Array) -> Array:
        """Sums of the columns, (rows, c)."""
        ends = np.cumsum([Q.shape[1] for _, Q in self.by_run], dtype=int)
        *by_run, shared = np.split(answers, ends)
        out = self.shared @ shared
        for (rows, Q), part in zip(self.by_run, by_run, strict=True):
            out[rows] += Q @ part
        return np.asarray(out)

    def of_run(self, rows: NDArray[np.intp]) -> tuple[Array, NDArray[np.intp]]:
        """Rows of one run, without columns that are zero there, and the numbers of those kept."""
        sizes = [Q.shape[1] for _, Q in self.by_run]
        first = np.cumsum([0, *sizes])
        kept = np.arange(first[-1], first[-1] + self.shared.shape[1])
        for at, (its_rows, Q) in zip(first[:-1], self.by_run, strict=True):
            if its_rows[0] == rows[0]:
                return np.hstack([Q, self.shared[rows]]), np.concatenate([at + np.arange(Q.shape[1]), kept])
        return self.shared[rows], kept

    def beside(self, functions: PoleFunctions) -> Beside:
        """What the basis leaves of other columns of the same runs."""
        shared = functions.shared - self.times(self.answers(functions.shared))
        by_run, mixed = [], []
        for (rows, Q), (_, _, columns) in zip(self.by_run, functions.by_run, strict=True):
            left = columns - Q @ (Q.T @ columns)
            by_run.append((rows, left))
            mixed.append(self.shared[rows].T @ left)
        return Beside(functions, shared, by_run, mixed)

    def explained(self, functions: PoleFunctions, left: Array) -> Array:
        """Squares of what a fit by this basis leaves, (rows, c), that each other column would explain, (columns,)."""
        beside = self.beside(functions)
        squares = beside.squares()
        products = beside.products(beside.shared.T @ left, left)
        return np.asarray(np.sum(products**2, axis=1) / np.maximum(squares, ROUND_OFF * squares.max()))


class Beside(NamedTuple):
    """Columns of pole functions less their projections on a `Basis`.

    Shared ones are projected; those of each run only on the run's own part of the basis, `mixed` being their products
    with its shared part, which are to be taken off.
    """

    functions: PoleFunctions
    shared: Array
    by_run: Sequence[tuple[NDArray[np.intp], Array]]
    mixed: Sequence[Array]

    def gram(self) -> Array:
        """Products of all columns with one another, pole by pole."""
        *places, shared = self.functions.places
        if not places:
            return np.asarray(self.shared.T @ self.shared)
        order, mixed = np.concatenate(places), np.hstack(self.mixed)
        out = np.zeros((order.size + shared.size,) * 2)
        out[np.ix_(order, order)] = -mixed.T @ mixed
        out[np.ix_(shared, shared)] = self.shared.T @ self.shared
        for place, (rows, left) in zip(places, self.by_run, strict=True):
            out[np.ix_(place, place)] += left.T @ left
            cross = left.T @ self.shared[rows]
            out[np.ix_(place, shared)] = cross
            out[np.ix_(shared, place)] = cross.T
        return out

    def squares(self) -> Array:
        """Sums of squares of the columns, (columns,)."""
        pairs = zip(self.by_run, self.mixed, strict=True)
        parts = [np.sum(left**2, axis=0) - np.sum(mixed**2, axis=0) for (_, left), mixed in pairs]
        return self.functions.in_order([*parts, np.sum(self.shared**2, axis=0)])

    def products(self, of_shared: Array, left: Array) -> Array:
        """Products of all columns with what a fit leaves (rows, c), those of the shared ones given, (columns, c)."""
        return self.functions.in_order([*(columns.T @ left[rows] for rows, columns in self.by_run), of_shared])

    def pole_equations(self, products: Array, residues: Array) -> tuple[Array, Array]:
        """Gauss-Newton matrix (2m, 2m) of poles with free residues (m, inputs, channels), and direction of descent.

        The columns are `Records.pole_slopes`, and `products` theirs with what the fit leaves of the data.
        """
        each = np.concatenate([residues, residues]).reshape(products.shape)
        by_pole = (2 * len(residues), residues.shape[1])
        normal = (self.gram() * (each @ each.T)).reshape(by_pole * 2).sum(axis=(1, 3))
        return normal, np.sum(products * each, axis=1).reshape(by_pole).sum(axis=1)


def unit_columns(matrix: Array) -> tuple[Array, Array]:
    """Columns divided by their lengths, and these lengths; one for a column of zeros."""
    size = np.linalg.norm(matrix, axis=0)
    size[size == 0] = 1.0
    return matrix / size, size


def factorised(columns: Array) -> tuple[Array, Array]:
    """Orthonormal basis Q and triangle R of ``columns = Q R``, (rows, k), several times as fast as by reflections.

    By Cholesky's factor of their products, twice (Fukaya et al., ScalA 2014, 31-38), unless the columns are so nearly
    dependent that what the first factor leaves is far from orthonormal.
    """
    Q, R = columns, np.eye(columns.shape[1])
    for again in (False, True):
        products = Q.T @ Q
        far = again and np.linalg.norm(products - np.eye(len(products))) > 0.5
        factor, failed = scipy.linalg.lapack.dpotrf(products)
        if far or failed:
            Q, R = np.linalg.qr(columns)
            break
        Q, R = Q @ scipy.linalg.lapack.dtrtri(factor)[0], factor @ R
    return Q, R


def orthonormal(functions: PoleFunctions) -> tuple[Basis, Array, Array]:
    """Basis of the functions, the triangle R (columns, columns) of their factorisation, and sizes of the columns.

    Columns of ``functions = Q R diag(sizes)`` stand run by run, the shared ones last.
    """
    by_run, sizes, triangles, across = [], [], [], []
    shared, size_of_shared = unit_columns(functions.shared)
    for rows, _, columns in functions.by_run:
        columns, size = unit_columns(columns)
        Q, R = np.linalg.qr(columns)
        lacking = R.shape[1] - len(R)
        if lacking > 0:  # a short run has fewer rows than columns: those beyond are combinations of the others
            Q = np.pad(Q, ((0, 0), (0, lacking)))
            R = np.vstack([R, ROUND_OFF * np.eye(R.shape[1])[-lacking:]])
        by_run.append((rows, Q))
        triangles.append(R)
        sizes.append(size)
        here, crossing = shared[rows], np.zeros((Q.shape[1], shared.shape[1]))
        for _ in range(2):  # once leaves round-off of what is nearly in a run's own functions
            share = Q.T @ here
            here = here - Q @ share
            crossing += share
        shared[rows] = here
        across.append(crossing)
    Q, R = factorised(shared)
    first = sum(map(len, triangles))
    triangle = scipy.linalg.block_diag(*triangles, R)
    if across:
        triangle[:first, first:] = np.concatenate(across)
    return Basis(by_run, Q), triangle, np.concatenate([*sizes, size_of_shared])
