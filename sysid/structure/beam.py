"""Element matrices and geometry of beams, and matrix operations on numbers and CasADi expressions alike."""

from __future__ import annotations

import numbers
from typing import Any

import casadi as ca
import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from sysid.errors import InputError
from sysid.structure.sensor import unit_vector
from sysid.structure.thresholds import NEGLIGIBLE

Array = NDArray[np.float64]
Scalar = Any
"""A real number, or a scalar casadi.SX or casadi.MX."""
Matrix = Any
"""A NumPy array of floats, or a casadi.SX or casadi.MX of the same shape."""

SINGULAR = (
    "the stiffness on the fixed base is singular to working precision; "
    "look for beams of very different stiffness or length"
)

# Local degrees of freedom, start then end: u v w (along x y z), then the rotations about x y z.
_AXIAL = np.array([0, 6])
_TORSION = np.array([3, 9])
_BENDING_XY = np.array([1, 5, 7, 11])  # v and the rotation about z
_BENDING_XZ = np.array([2, 4, 8, 10])  # w and the rotation about y
# dw/dx is minus the rotation about y, where dv/dx is plus the rotation about z.
_FLIP = np.outer([1, -1, 1, -1], [1, -1, 1, -1])

# Of a rod and of bending, for unit length: EA/L, EI/L³ and rho A L times these, with rotations multiplied by L.
_ROD = np.array([[1, -1], [-1, 1]])
_BENDING = np.array([[12, 6, -12, 6], [6, 4, -6, 2], [-12, -6, 12, -6], [6, 2, -6, 4]])
_MASS = {
    "consistent": (
        np.array([[2, 1], [1, 2]]) / 6,
        np.array([[156, 22, 54, -13], [22, 4, 13, -3], [54, 13, 156, -22], [-13, -3, -22, 4]]) / 420,
    ),
    "lumped": (np.eye(2) / 2, np.diag([1 / 2, 1 / 78, 1 / 2, 1 / 78])),
}


def stiffness_patterns(length: float) -> Array:
    """Stiffness of a beam of this length, m, for unit EA, EIy, EIz and GJ, in local axes, (4, 12, 12).

    The element's stiffness is their sum weighted with EA, EIy, EIz, GJ (Przemieniecki, Theory of Matrix Structural
    Analysis (1968), section 5.6, without shear).
    """
    rod, bending = _ROD / length, _BENDING * _turns(length) / length**3
    parts = [(_AXIAL, rod), (_BENDING_XZ, _FLIP * bending), (_BENDING_XY, bending), (_TORSION, rod)]
    return np.stack([_placed(part) for part in parts])


def mass_patterns(length: float, kind: str) -> Array:
    """Mass of a beam for unit mass per length and unit polar inertia per length, in local axes, (2, 12, 12).

    The element's mass is their sum weighted with rho A and rho (Iy + Iz). "consistent": cubic deflections, linear
    stretch and twist (Przemieniecki (1968), section 11.4, without the rotary inertia of the cross-section in bending).
    "lumped": half the mass at each node; the rotary terms in bending are those of Hinton, Rock and Zienkiewicz (1976),
    the consistent diagonal scaled to the right mass: (mass) L² / 78 a node.
    """
    rod, bending = (length * matrix for matrix in _MASS[kind])
    bending = bending * _turns(length)
    along = _placed((_AXIAL, rod), (_BENDING_XY, bending), (_BENDING_XZ, _FLIP * bending))
    return np.stack([along, _placed((_TORSION, rod))])


def _turns(length: float) -> Array:
    """Factors of the entries in bending, a rotation times the length being a deflection."""
    return np.outer([1, length, 1, length], [1, length, 1, length])


def _placed(*blocks: tuple[NDArray[np.intp], Array]) -> Array:
    matrix = np.zeros((12, 12))
    for dofs, block in blocks:
        matrix[np.ix_(dofs, dofs)] += block
    return matrix


def local_axes(start: Array, end: Array, orientation: ArrayLike, label: str) -> tuple[float, Array]:
    """Length of a beam and its axes as rows, (3, 3): x along it, y in the plane of `orientation`.

    `label` names the beam in the error for a beam without length or a parallel orientation.
    """
    along = end - start
    length = float(np.linalg.norm(along))
    if length <= 1e-12 * max(1.0, float(np.max(np.abs([start, end])))):
        raise InputError(f"{label} has zero length: both its nodes are at {tuple(start.tolist())}")
    x = along / length
    z = np.cross(x, unit_vector(orientation, f"the orientation of {label}"))
    sine = float(np.linalg.norm(z))
    if sine < NEGLIGIBLE:
        raise InputError(f"the orientation of {label} is parallel to the beam; it must point out of its axis")
    z = z / sine
    return length, np.stack([x, np.cross(z, x), z])


class WeightedSum:
    """A square matrix that is linear in some scalars, sum_k weight_k pattern_k.

    The patterns are always numbers; so the sum is one product of a sparse matrix and a vector,
    the same for numbers and for expressions.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self.weights: dict[tuple[int, str], Scalar] = {}
        self.columns: dict[tuple[int, str], int] = {}
        # Values, places and columns of the patterns; none to begin with, so that a sum of nothing is zero.
        self.entries: list[tuple[NDArray[Any], ...]] = [(np.empty(0), np.empty(0, int), np.empty(0, int))]

    def add(self, key: tuple[int, str], weight: Scalar, dofs: NDArray[np.intp], pattern: Array) -> None:
        """Add `weight` times `pattern` at `dofs`; entries with the same key share their weight."""
        column = self.columns.setdefault(key, len(self.columns))
        self.weights.setdefault(key, weight)
        pattern = 0.5 * (pattern + pattern.T)  # a rotated element is symmetric only to rounding
        rows, columns = np.nonzero(pattern)
        place = dofs[rows] + self.size * dofs[columns]
        self.entries.append((pattern[rows, columns], place, np.full(len(place), column)))

    def total(self) -> Matrix:
        """Return the sum, (size, size)."""
        weights = list(self.weights.values())
        values, places, columns = (np.concatenate(part) for part in zip(*self.entries, strict=True))
        patterns = scipy.sparse.csc_matrix((values, (places, columns)), shape=(self.size**2, len(weights)))
        if all(is_number(weight) for weight in weights):
            return (patterns @ np.array(weights)).reshape(self.size, self.size, order="F")
        try:
            stacked = ca.vertcat(*weights)
        except NotImplementedError:
            raise InputError("the properties of a frame mix casadi.SX and casadi.MX; use one kind") from None
        return ca.reshape(ca.mtimes(ca.DM(patterns), stacked), self.size, self.size)


def is_number(value: Scalar) -> bool:
    """Tell the floats that `scalar` returns from its expressions."""
    return isinstance(value, float)


def scalar(value: Any, name: str) -> Scalar:
    """Return a float, or what a CasADi scalar (or an object that acts as one) becomes in a product."""
    if isinstance(value, numbers.Real) or (isinstance(value, np.ndarray) and value.ndim == 0):
        number = float(value)
        if not np.isfinite(number):
            raise InputError(f"{name} must be finite, got {number}")
        return number
    try:
        product = 1.0 * value
    except (TypeError, NotImplementedError):
        product = None
    if not isinstance(product, ca.DM | ca.SX | ca.MX) or not product.is_scalar():
        raise InputError(f"{name} must be a number or a CasADi scalar, got {value!r}")
    return scalar(float(product), name) if isinstance(product, ca.DM) else product


def inertia_entries(inertia: Any, node: int) -> dict[tuple[int, int], Scalar]:
    """Upper triangle of a 3 x 3 inertia; its entries may be numbers or CasADi scalars. Zeros beside the diagonal go."""
    label = f"the inertia of the point mass on node {node}"
    shape: tuple[int, ...] = getattr(inertia, "shape", ())
    if len(shape) == 2:  # CasADi matrices index like two-dimensional arrays, and do not iterate
        rows = [[inertia[i, j] for j in range(shape[1])] for i in range(shape[0])]
    else:
        rows = [list(row) if np.iterable(row) else [row] for row in inertia] if np.iterable(inertia) else []
    lengths = [len(row) for row in rows]
    if lengths == [1, 1, 1]:
        rows = [[row[0] if i == j else 0.0 for j in range(3)] for i, row in enumerate(rows)]
    elif lengths != [3, 3, 3]:
        raise InputError(f"{label} must be three values or 3 x 3")
    full = [[scalar(value, label) for value in row] for row in rows]
    known = np.array([[value if is_number(value) else np.nan for value in row] for row in full])
    unequal = np.argwhere(np.abs(known - known.T) > 1e-9 * np.abs(known.T))
    if unequal.size:
        i, j = unequal[0]
        raise InputError(f"{label} is not symmetric: {known[i, j]:g} and {known[j, i]:g}")
    if np.all(np.isfinite(known)):
        lowest, *_, highest = np.linalg.eigvalsh(known)
        if lowest < -1e-12 * abs(highest):
            raise InputError(f"{label} is not positive semidefinite: its lowest eigenvalue is {lowest:g} kg m²")
    return {(i, j): full[i][j] for i in range(3) for j in range(i, 3) if i == j or known[i, j] != 0}


def block(matrix: Matrix, dofs: NDArray[np.intp]) -> Matrix:
    """Return the rows and columns `dofs` of a square matrix."""
    return matrix[dofs, :][:, dofs]


def symmetric(matrix: Matrix) -> Matrix:
    """Return a dense matrix that is symmetric to the last bit."""
    half = 0.5 * (matrix + matrix.T)
    return half if isinstance(half, np.ndarray) else ca.densify(half)


def placed_rows(matrix: Matrix, rows: NDArray[np.intp], size: int) -> Matrix:
    """Return a matrix of `size` rows that holds `matrix` in its `rows` and zeros elsewhere."""
    zeros = np.zeros if isinstance(matrix, np.ndarray) else type(matrix).zeros
    out = zeros((size, matrix.shape[1]))
    out[rows, :] = matrix
    return out


def solve_positive_definite(matrix: Matrix, right: Array) -> Matrix:
    """Solution for a symmetric positive definite matrix of numbers or expressions."""
    if isinstance(matrix, np.ndarray):
        try:
            return scipy.linalg.cho_solve(scipy.linalg.cho_factor(matrix), right)
        except scipy.linalg.LinAlgError:
            raise InputError(SINGULAR) from None
    if isinstance(matrix, ca.SX):
        # Sparse L D L' is a fraction of the operations of SX's own solve, and positive definite needs no pivots.
        return ca.densify(ca.ldl_solve(ca.SX(ca.DM(right)), *ca.ldl(matrix)))
    return ca.solve(matrix, ca.densify(ca.DM(right)), "ldl")
