"""What a frame is put together from.

Element matrices and geometry, in numbers; then the few matrix operations that numbers and CasADi
expressions do not share by themselves.
"""

from __future__ import annotations

import numbers
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse
from numpy.typing import ArrayLike, NDArray

from sysid.errors import InputError
from sysid.structure.axes import unit_vector

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

_PARALLEL = 1e-6  # sine of the smallest angle between a beam and its orientation vector


def stiffness_patterns(length: float) -> Array:
    """Stiffness of a beam for unit EA, EIy, EIz and GJ.

    Parameters
    ----------
    length : float
        m.

    Returns
    -------
    ndarray, shape (4, 12, 12)
        In local axes; the element's stiffness is their sum weighted with EA, EIy, EIz, GJ.

    References
    ----------
    Przemieniecki, Theory of Matrix Structural Analysis (1968), section 5.6, without shear.
    """
    L = length
    rod = np.array([[1, -1], [-1, 1]]) / L
    bending = (
        np.array(
            [
                [12, 6 * L, -12, 6 * L],
                [6 * L, 4 * L**2, -6 * L, 2 * L**2],
                [-12, -6 * L, 12, -6 * L],
                [6 * L, 2 * L**2, -6 * L, 4 * L**2],
            ]
        )
        / L**3
    )
    return np.stack(
        [
            _placed((_AXIAL, rod)),
            _placed((_BENDING_XZ, _FLIP * bending)),
            _placed((_BENDING_XY, bending)),
            _placed((_TORSION, rod)),
        ]
    )


def mass_patterns(length: float, kind: str) -> Array:
    """Mass of a beam for unit mass per length and unit polar inertia per length.

    Parameters
    ----------
    length : float
        m.
    kind : {"consistent", "lumped"}
        "consistent": cubic deflections, linear stretch and twist. "lumped": half the mass at each
        node; the rotary terms in bending are those of Hinton, Rock and Zienkiewicz (1976), the
        consistent diagonal scaled to the right mass: (mass) L² / 78 a node.

    Returns
    -------
    ndarray, shape (2, 12, 12)
        In local axes; the element's mass is their sum weighted with rho A and rho (Iy + Iz).

    References
    ----------
    Przemieniecki (1968), section 11.4, without the rotary inertia of the cross-section in bending.
    """
    L = length
    if kind == "lumped":
        rod = np.eye(2) * L / 2
        bending = np.diag([L / 2, L**3 / 78, L / 2, L**3 / 78])
    else:
        rod = np.array([[2, 1], [1, 2]]) * L / 6
        bending = (
            np.array(
                [
                    [156, 22 * L, 54, -13 * L],
                    [22 * L, 4 * L**2, 13 * L, -3 * L**2],
                    [54, 13 * L, 156, -22 * L],
                    [-13 * L, -3 * L**2, -22 * L, 4 * L**2],
                ]
            )
            * L
            / 420
        )
    along = _placed((_AXIAL, rod), (_BENDING_XY, bending), (_BENDING_XZ, _FLIP * bending))
    return np.stack([along, _placed((_TORSION, rod))])


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
    if sine < _PARALLEL:
        raise InputError(f"the orientation of {label} is parallel to the beam; it must point out of its axis")
    z = z / sine
    return length, np.stack([x, np.cross(z, x), z])


class WeightedSum:
    """A matrix that is linear in some scalars, sum_k weight_k pattern_k.

    The patterns are always numbers; so the sum is one product of a sparse matrix and a vector,
    the same for numbers and for expressions.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self.weights: list[Scalar] = []
        self.columns: dict[tuple[int, str], int] = {}
        self.entries: list[tuple[NDArray[Any], ...]] = []

    def add(self, key: tuple[int, str], weight: Scalar, dofs: NDArray[np.intp], pattern: Array) -> None:
        """Add `weight` times `pattern` at `dofs`; entries with the same key share their weight."""
        column = self.columns.setdefault(key, len(self.weights))
        if column == len(self.weights):
            self.weights.append(weight)
        pattern = 0.5 * (pattern + pattern.T)  # a rotated element is symmetric only to rounding
        rows, columns = np.nonzero(pattern)
        place = dofs[rows] + self.size * dofs[columns]
        self.entries.append((pattern[rows, columns], place, np.full(len(place), column)))

    def total(self) -> Matrix:
        """Return the sum, (size, size)."""
        weights = self.weights
        if not weights:
            return np.zeros((self.size, self.size))
        values, places, columns = (np.concatenate(part) for part in zip(*self.entries, strict=True))
        patterns = scipy.sparse.csc_matrix((values, (places, columns)), shape=(self.size**2, len(weights)))
        if all(is_number(weight) for weight in weights):
            return (patterns @ np.array(weights)).reshape(self.size, self.size, order="F")
        import casadi as ca

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
    import casadi as ca

    try:
        product = 1.0 * value
    except (TypeError, NotImplementedError):
        product = None
    if not isinstance(product, ca.DM | ca.SX | ca.MX) or not product.is_scalar():
        raise InputError(f"{name} must be a number or a CasADi scalar, got {value!r}")
    return scalar(float(product), name) if isinstance(product, ca.DM) else product


def inertia_entries(inertia: Any, node: int) -> dict[tuple[int, int], Scalar]:
    """Upper triangle of a 3 x 3 inertia; its entries may be numbers or CasADi scalars."""
    label = f"the inertia of the point mass on node {node}"
    # CasADi matrices index like two-dimensional arrays, and do not iterate.
    shape = getattr(inertia, "shape", None)
    if shape is not None and len(shape) == 2:
        rows = [[inertia[i, j] for j in range(shape[1])] for i in range(shape[0])]
        rows = [row[0] for row in rows] if shape[1] == 1 else rows
    else:
        rows = list(inertia) if isinstance(inertia, Sequence | np.ndarray) else []
    if len(rows) == 3 and not any(isinstance(row, Sequence | np.ndarray) and np.ndim(row) == 1 for row in rows):
        return _checked({(i, i): scalar(rows[i], label) for i in range(3)}, label)
    if len(rows) != 3 or any(not isinstance(row, Sequence | np.ndarray) or len(row) != 3 for row in rows):
        raise InputError(f"{label} must be three values or 3 x 3")
    full = {(i, j): scalar(rows[i][j], label) for i in range(3) for j in range(3)}
    for i, j in ((0, 1), (0, 2), (1, 2)):
        pair = full[i, j], full[j, i]
        if is_number(pair[0]) and is_number(pair[1]) and not np.isclose(*pair, rtol=1e-9, atol=0.0):
            raise InputError(f"{label} is not symmetric: {pair[0]:g} and {pair[1]:g}")
    return _checked({(i, j): value for (i, j), value in full.items() if i <= j}, label)


def _checked(upper: dict[tuple[int, int], Scalar], label: str) -> dict[tuple[int, int], Scalar]:
    if all(is_number(value) for value in upper.values()):
        matrix = np.zeros((3, 3))
        for (i, j), value in upper.items():
            matrix[i, j] = matrix[j, i] = value
        lowest, *_, highest = np.linalg.eigvalsh(matrix)
        if lowest < -1e-12 * abs(highest):
            raise InputError(f"{label} is not positive semidefinite: its lowest eigenvalue is {lowest:g} kg m²")
    return upper


def block(matrix: Matrix, dofs: NDArray[np.intp]) -> Matrix:
    """Return the rows and columns `dofs` of a square matrix."""
    return matrix[np.ix_(dofs, dofs)] if isinstance(matrix, np.ndarray) else matrix[dofs.tolist(), dofs.tolist()]


def symmetric(matrix: Matrix) -> Matrix:
    """Return a dense matrix that is symmetric to the last bit."""
    half = 0.5 * (matrix + matrix.T)
    if isinstance(half, np.ndarray):
        return half
    import casadi as ca

    return ca.densify(half)


def placed_rows(matrix: Matrix, rows: NDArray[np.intp], size: int) -> Matrix:
    """Return a matrix of `size` rows that holds `matrix` in its `rows` and zeros elsewhere."""
    if isinstance(matrix, np.ndarray):
        out = np.zeros((size, matrix.shape[1]))
        out[rows] = matrix
        return out
    out = type(matrix).zeros(size, matrix.shape[1])
    out[rows.tolist(), :] = matrix
    return out


def joined(left: Matrix, right: Matrix) -> Matrix:
    """Return two matrices side by side."""
    if isinstance(left, np.ndarray):
        return np.hstack([left, right])
    import casadi as ca

    return ca.horzcat(left, right)


def solve(matrix: Matrix, right: Array) -> Matrix:
    """Solution for a symmetric positive definite matrix of numbers or expressions."""
    if isinstance(matrix, np.ndarray):
        try:
            return scipy.linalg.cho_solve(scipy.linalg.cho_factor(matrix), right)
        except scipy.linalg.LinAlgError:
            raise InputError(SINGULAR) from None
    import casadi as ca

    if isinstance(matrix, ca.SX):
        # Sparse L D L' is a fraction of the operations of SX's own solve, and positive definite needs no pivots.
        return ca.densify(ca.ldl_solve(ca.SX(ca.DM(right)), *ca.ldl(matrix)))
    return ca.solve(matrix, ca.densify(ca.DM(right)), "ldl")
