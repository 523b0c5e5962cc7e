r"""Beams, thin plates, rigid masses and springs to a moving base: mass, stiffness and modes, by NumPy and SciPy alone.

A node has six degrees of freedom: displacements (m) along, and rotations (rad) about, the global axes. A base that
moves rigidly by u0 about the origin carries clamped nodes and the feet of springs with it. With R the motion of all
degrees of freedom for unit base motion, and v = q - R u0 the motion relative to the base,

.. math:: M v'' + K v = -B u_0'', \qquad B = M R, \qquad f_0 = B' v'' + M_{rb} u_0'', \qquad M_{rb} = R' M R

(Clough and Penzien, Dynamics of Structures, 2nd ed., sections 17-5 and 27-2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import perm
from typing import NamedTuple

import numpy as np
import scipy.linalg
from numpy.polynomial.legendre import leggauss

AXES = ("x", "y", "z", "rx", "ry", "rz")


class Material(NamedTuple):
    """Young's modulus, Pa, Poisson's ratio, density, kg/m³."""

    young: float
    poisson: float
    density: float


class Section(NamedTuple):
    """A beam's cross-section.

    Attributes
    ----------
    material : Material
    area : float
        m².
    about_y, about_z : float
        Second moments of area about its own axes, m⁴: `about_y` resists bending along its z.
    torsion : float
        Torsion constant, m⁴.
    """

    material: Material
    area: float
    about_y: float
    about_z: float
    torsion: float

    @classmethod
    def rectangle(cls, material: Material, width: float, height: float) -> Section:
        """Solid rectangle, `width` along its y, `height` along its z, m.

        The torsion constant is that of Roark's Formulas for Stress and Strain, 7th ed., table 10.1, case 4.
        """
        a, b = max(width, height), min(width, height)
        torsion = a * b**3 * (1 / 3 - 0.21 * b / a * (1 - (b / a) ** 4 / 12))
        return cls(material, width * height, width * height**3 / 12, height * width**3 / 12, torsion)


@dataclass(eq=False)
class Model:
    """Nodes, and the matrices of what was added between them.

    Attributes
    ----------
    nodes : (n_nodes, 3)
        m.
    mass, stiffness : (6 n_nodes, 6 n_nodes)
        SI units.
    """

    nodes: np.ndarray
    mass: np.ndarray = field(init=False)
    stiffness: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.nodes = np.asarray(self.nodes, dtype=float)
        self.mass, self.stiffness = np.zeros((2, 6 * len(self.nodes), 6 * len(self.nodes)))

    @property
    def rigid_motion(self) -> np.ndarray:
        """R, (6 n_nodes, 6): displacements e + theta x r, rotations theta."""
        return np.vstack([carried(position) for position in self.nodes])

    def beam(self, first: int, second: int, section: Section, up: Sequence[float] = (0, 0, 1)) -> None:
        """Add a straight beam between two nodes; the section's z lies in the plane of the beam and `up`."""
        along = self.nodes[second] - self.nodes[first]
        length = float(np.linalg.norm(along))
        x = along / length
        y = np.cross(up, x)
        y /= np.linalg.norm(y)
        T = np.kron(np.eye(4), np.vstack([x, y, np.cross(x, y)]))
        M, K = beam_matrices(section, length)
        self._add([first, second], range(6), T.T @ M @ T, T.T @ K @ T)

    def plate(self, corners: Sequence[int], thickness: float, material: Material) -> None:
        """Add a rectangle of thin plate parallel to x and y: corners at (-, -), (+, -), (+, +), (-, +)."""
        sides = np.ptp(self.nodes[list(corners), :2], axis=0)
        self._add(corners, (2, 3, 4), *plate_matrices(*sides, thickness, material))

    def rigid_mass(
        self, node: int, mass: float, inertia: Sequence[float] = (0, 0, 0), offset: Sequence[float] = (0, 0, 0)
    ) -> None:
        """Add a rigid body, kg: moments of inertia about its centre, kg m², and the centre's place from its node, m."""
        own = np.diag([mass, mass, mass, *inertia])
        at_centre = carried(offset)
        self._add([node], range(6), at_centre.T @ own @ at_centre, np.zeros((6, 6)))

    def spring(self, node: int, stiffness: Sequence[float]) -> None:
        """Add springs between a node and the base, N/m along x, y, z and N m/rad about them."""
        self._add([node], range(6), np.zeros((6, 6)), np.diag(np.asarray(stiffness, dtype=float)))

    def _add(self, nodes: Sequence[int], axes: Sequence[int], M: np.ndarray, K: np.ndarray) -> None:
        at = np.add.outer(6 * np.asarray(nodes), np.asarray(axes)).ravel()
        self.mass[np.ix_(at, at)] += M
        self.stiffness[np.ix_(at, at)] += K

    def on_base(self, base: Sequence[str], clamped: Sequence[int] = (), moving: Sequence[str] = AXES) -> OnBase:
        """Give the structure on a base that moves along the axes `base`.

        Parameters
        ----------
        clamped : sequence of int
            Nodes that move with the base.
        moving : sequence of str
            Axes along which nodes move at all: "x", "z", "ry" for a plane frame.
        """
        free = np.zeros((len(self.nodes), 6), dtype=bool)
        free[:, [AXES.index(axis) for axis in moving]] = True
        counted = np.flatnonzero(free)
        free[list(clamped)] = False
        at = np.flatnonzero(free)
        R = self.rigid_motion[:, [AXES.index(axis) for axis in base]]
        load = self.mass[np.ix_(counted, counted)] @ R[counted]
        return OnBase(
            self.mass[np.ix_(at, at)], self.stiffness[np.ix_(at, at)], load[np.isin(counted, at)], R[at],
            R[counted].T @ load, tuple((int(i // 6), AXES[i % 6]) for i in at),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class OnBase:
    """Matrices of a structure on a moving base, in motion relative to it.

    Attributes
    ----------
    mass, stiffness : (n, n)
    load : (n, d)
        B, the inertia load of unit base acceleration.
    rigid : (n, d)
        Motion of the degrees of freedom for unit base motion.
    rigid_body_mass : (d, d)
    freedoms : tuple of (node, axis)
    """

    mass: np.ndarray
    stiffness: np.ndarray
    load: np.ndarray
    rigid: np.ndarray
    rigid_body_mass: np.ndarray
    freedoms: tuple[tuple[int, str], ...]

    def modes(self) -> tuple[np.ndarray, np.ndarray]:
        """All natural frequencies, rad/s, and mass-normalised shapes, (n, n).

        The problem is solved for 1/w², so that the lowest frequencies, not the highest, are exact to round-off. What
        the mass does not reach (a rotation without inertia) has no mode.
        """
        inverse_squares, vectors = scipy.linalg.eigh(self.mass, self.stiffness)
        real = inverse_squares > 1e-14 * inverse_squares[-1]
        inverse_squares, vectors = inverse_squares[real][::-1], vectors[:, real][:, ::-1]
        return 1 / np.sqrt(inverse_squares), vectors / np.sqrt(inverse_squares)

    def row(self, node: int, axis: str, offset: Sequence[float]) -> np.ndarray:
        """Motion along an axis at `offset`, m, from a node, by the degrees of freedom, (n,)."""
        motion = dict(zip(AXES, carried(offset)[AXES.index(axis)], strict=True))
        return np.array([motion[its] if at == node else 0.0 for at, its in self.freedoms])


def carried(offset: Sequence[float]) -> np.ndarray:
    """Motion, (6, 6), of a point of a rigid body at `offset`, m, by the body's motion at its reference point."""
    x, y, z = offset
    motion = np.eye(6)
    motion[:3, 3:] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
    return motion


def beam_matrices(section: Section, length: float) -> tuple[np.ndarray, np.ndarray]:
    """Consistent mass and stiffness, (12, 12), of an Euler-Bernoulli beam along its x.

    Przemieniecki, Theory of Matrix Structural Analysis, eqs. 5.116 and 11.20, without shear and rotatory inertia.
    """
    L, (E, poisson, density), A = length, section.material, section.area
    M, K = np.zeros((2, 12, 12))
    bar = np.array([[1, -1], [-1, 1]])
    line = np.array([[2, 1], [1, 2]])
    polar = section.about_y + section.about_z
    for axis, rigidity, inertia in ((0, E * A, A), (3, E / (2 * (1 + poisson)) * section.torsion, polar)):
        at = np.ix_([axis, 6 + axis], [axis, 6 + axis])
        K[at], M[at] = rigidity / L * bar, density * inertia * L / 6 * line
    for (across, turning), sign, second in (((1, 5), 1, section.about_z), ((2, 4), -1, section.about_y)):
        s = np.array([1, sign * L, 1, sign * L])  # along z, a positive rotation about y is a negative slope
        at = np.ix_([across, turning, 6 + across, 6 + turning], [across, turning, 6 + across, 6 + turning])
        bending = np.array([[12, 6, -12, 6], [6, 4, -6, 2], [-12, -6, 12, -6], [6, 2, -6, 4]])
        moving = np.array([[156, 22, 54, -13], [22, 4, 13, -3], [54, 13, 156, -22], [-13, -3, -22, 4]])
        K[at], M[at] = E * second / L**3 * bending * np.outer(s, s), density * A * L / 420 * moving * np.outer(s, s)
    return M, K


GAUSS = 4  # points along each side: exact to the seventh power


def plate_matrices(a: float, b: float, thickness: float, material: Material) -> tuple[np.ndarray, np.ndarray]:
    """Consistent mass and stiffness, (12, 12), of a thin rectangle a x b, m, in (w, theta_x, theta_y) of its corners.

    The element of Adini, Clough and Melosh (Zienkiewicz and Taylor, The Finite Element Method, vol. 2, section 4.3):
    twelve terms of a polynomial, with slopes across its sides that are not continuous.
    """
    half = np.array([a, b]) / 2
    x, y = np.array([-1.0, 1.0, 1.0, -1.0]), np.array([-1.0, -1.0, 1.0, 1.0])  # in half sides from the centre
    turns = [_terms(x, y, 0, 0), _terms(x, y, 0, 1) / half[1], -_terms(x, y, 1, 0) / half[0]]  # w, dw/dy, -dw/dx
    inverse = np.linalg.inv(np.stack(turns, axis=1).reshape(12, 12))
    points, weights = leggauss(GAUSS)
    x, y = (grid.ravel() for grid in np.meshgrid(points, points))
    area = np.outer(weights, weights).ravel() * half[0] * half[1]
    shape = _terms(x, y, 0, 0) @ inverse
    bend = [_terms(x, y, 2, 0) / half[0] ** 2, _terms(x, y, 0, 2) / half[1] ** 2]
    curvature = np.stack([*bend, 2 * _terms(x, y, 1, 1) / (half[0] * half[1])], axis=1) @ inverse
    rigidity = material.young * thickness**3 / (12 * (1 - material.poisson**2))
    D = rigidity * np.array([[1, material.poisson, 0], [material.poisson, 1, 0], [0, 0, (1 - material.poisson) / 2]])
    M = material.density * thickness * np.einsum("p,pi,pj->ij", area, shape, shape)
    return M, np.einsum("p,pai,ab,pbj->ij", area, curvature, D, curvature, optimize=True)


def _terms(x: np.ndarray, y: np.ndarray, by_x: int, by_y: int) -> np.ndarray:
    """Derivatives of the twelve terms of the plate's polynomial at points, (points, 12)."""
    powers = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3), (3, 1), (1, 3))
    return np.column_stack([
        perm(p, by_x) * perm(q, by_y) * x ** max(p - by_x, 0) * y ** max(q - by_y, 0) for p, q in powers
    ])  # fmt: skip
