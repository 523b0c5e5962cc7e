r"""Three-dimensional frames of Euler-Bernoulli beams, reduced to sensors and a moving base.

::

    nodes, beams, point masses --> matrices()        (6N, 6N)   all motions of all nodes
                               --> condense(...)     (n+d, n+d) sensors S, then base axes 0
                               --> structure(...)    a `Structure`, with damping ratios

A frame's geometry is numbers; the properties of its sections and its point masses are numbers or
CasADi scalars (SX or MX). A matrix that depends on such a scalar is a CasADi expression, a matrix
that does not stays an array.
"""

from __future__ import annotations

import numbers
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from sysid.errors import InputError, shaped_array
from sysid.structure.beam import (
    SINGULAR,
    Array,
    Matrix,
    Scalar,
    WeightedSum,
    block,
    inertia_entries,
    is_number,
    local_axes,
    mass_patterns,
    placed_rows,
    scalar,
    solve_positive_definite,
    stiffness_patterns,
    symmetric,
)
from sysid.structure.sensor import base_columns, rigid_motion, sensor_row, vector3
from sysid.structure.structure import Structure
from sysid.structure.thresholds import EXACT

SensorAxis = tuple[int, str | ArrayLike]
"""Node of a sensor and its axis: a vector (3,), or a string such as "x", "-y", "rz"."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Section:
    """Cross-section and material of a beam; numbers or CasADi scalars.

    Parameters
    ----------
    E, G : scalar
        Young's and shear modulus, Pa.
    A : scalar
        Area, m².
    Iy, Iz : scalar
        Second moments of area about the local y and z axes, m⁴: Iz resists deflection along y.
    J : scalar
        Torsion constant, m⁴ (Iy + Iz for a circle, less for everything else).
    density : scalar
        kg/m³; zero for a massless beam.

    Raises
    ------
    InputError
        If a number is not positive (`density`: is negative).
    """

    E: Scalar
    G: Scalar
    A: Scalar
    Iy: Scalar
    Iz: Scalar
    J: Scalar
    density: Scalar

    def __post_init__(self) -> None:
        for field in fields(self):
            value = scalar(getattr(self, field.name), f"section property {field.name}")
            if is_number(value) and (value < 0 or (value == 0 and field.name != "density")):
                least = "at least zero" if field.name == "density" else "positive"
                raise InputError(f"section property {field.name} must be {least}, got {value:g}")
            object.__setattr__(self, field.name, value)


@dataclass(frozen=True, eq=False)
class Beam:
    """A straight beam between two nodes.

    Parameters
    ----------
    start, end : int
        Nodes; local x runs from `start` to `end`.
    section : Section
        Its cross-section.
    orientation : array_like, shape (3,)
        Any vector in the local x-y plane, on the side of positive y.
    """

    start: int
    end: int
    section: Section
    orientation: ArrayLike


@dataclass(frozen=True, eq=False)
class PointMass:
    """A rigid body on a node.

    Parameters
    ----------
    node : int
        The node that carries it.
    mass : scalar
        kg.
    inertia : sequence, shape (3,) or (3, 3), optional
        About its own centre of mass in global axes, kg m²; three values are a diagonal. Entries
        are numbers or CasADi scalars. None: a particle.
    offset : array_like, shape (3,)
        Centre of mass from the node, m.

    Raises
    ------
    InputError
        If a number is negative, or an inertia not symmetric and positive semidefinite.
    """

    node: int
    mass: Scalar
    inertia: Any = None
    offset: ArrayLike = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        mass = scalar(self.mass, f"the point mass on node {self.node}")
        if is_number(mass) and mass < 0:
            raise InputError(f"the point mass on node {self.node} must be at least zero, got {mass:g} kg")
        object.__setattr__(self, "mass", mass)
        object.__setattr__(self, "offset", vector3(self.offset, f"the offset of the point mass on node {self.node}"))
        if self.inertia is not None:
            object.__setattr__(self, "inertia", inertia_entries(self.inertia, self.node))


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame of Euler-Bernoulli beams with point masses.

    Parameters
    ----------
    nodes : array_like, shape (N, 3)
        Positions, m.
    beams : sequence of Beam
        The elements: no shear deformation, no rotary inertia of the cross-section in bending, shear
        centre on the axis.
    point_masses : sequence of PointMass, optional
        Rigid bodies on nodes.
    mass : {"consistent", "lumped"}
        "consistent": element masses from the element's own displacement functions; frequencies
        converge from above. "lumped": half of each beam's mass on each of its nodes, with rotary terms
        (beam mass) L² / 78 in bending and rho (Iy + Iz) L / 2 in torsion, diagonal in the beam's
        axes. Offset point masses couple translations and rotations in both.

    Raises
    ------
    InputError
        If a node index is out of range, a beam has no length, or an orientation is parallel to
        its beam.

    Notes
    -----
    Six degrees of freedom a node, node by node: x y z rx ry rz in global axes.

    Examples
    --------
    A steel cantilever of 20 x 10 mm, 0.5 m long, shaken across at its root:

    >>> import numpy as np
    >>> from sysid.frame import Beam, Frame, Section
    >>> steel = Section(E=210e9, G=80e9, A=2e-4, Iy=1.667e-9, Iz=6.667e-9, J=4.58e-9, density=7850.0)
    >>> nodes = np.linspace([0, 0, 0], [0.5, 0, 0], 6)
    >>> frame = Frame(nodes, [Beam(i, i + 1, steel, (0, 1, 0)) for i in range(5)])
    >>> bar = frame.structure([(3, "z"), (5, "z")], [0.01, 0.01], base_nodes=[0], base_axes="z")
    >>> print(f"{bar.natural_frequencies[0]:.1f} Hz")
    33.4 Hz
    """

    nodes: ArrayLike
    beams: Sequence[Beam]
    point_masses: Sequence[PointMass] = ()
    mass: Literal["consistent", "lumped"] = "consistent"

    def __post_init__(self) -> None:
        nodes = shaped_array("nodes", self.nodes, "N", 3)
        nodes.flags.writeable = False
        object.__setattr__(self, "nodes", nodes)
        object.__setattr__(self, "beams", tuple(self.beams))
        object.__setattr__(self, "point_masses", tuple(self.point_masses))
        if self.mass not in ("consistent", "lumped"):
            raise InputError(f'mass must be "consistent" or "lumped", got {self.mass!r}')
        for number, beam in enumerate(self.beams):
            start = self._node(beam.start, f"beam {number}")
            end = self._node(beam.end, f"beam {number}")
            local_axes(nodes[start], nodes[end], beam.orientation, f"beam {number}")
        for point in self.point_masses:
            self._node(point.node, "a point mass")

    def matrices(self) -> tuple[Matrix, Matrix]:
        """Mass and stiffness of all nodes, without any support.

        Returns
        -------
        mass, stiffness : (6N, 6N)
            A NumPy array, or a (sparse) CasADi matrix where it depends on a CasADi scalar; each by itself.

        Raises
        ------
        InputError
            If SX and MX are mixed.
        """
        nodes = np.asarray(self.nodes)
        mass, stiffness = WeightedSum(nodes.size * 2), WeightedSum(nodes.size * 2)
        for number, beam in enumerate(self.beams):
            s = beam.section
            length, axes = local_axes(nodes[beam.start], nodes[beam.end], beam.orientation, f"beam {number}")
            turn = np.kron(np.eye(4), axes)
            dofs = np.concatenate([_dofs([beam.start]), _dofs([beam.end])])
            weights = {"EA": s.E * s.A, "EIy": s.E * s.Iy, "EIz": s.E * s.Iz, "GJ": s.G * s.J}
            for (name, weight), pattern in zip(weights.items(), stiffness_patterns(length), strict=True):
                stiffness.add((id(s), name), weight, dofs, turn.T @ pattern @ turn)
            weights = {"rho A": s.density * s.A, "rho Ip": s.density * (s.Iy + s.Iz)}
            for (name, weight), pattern in zip(weights.items(), mass_patterns(length, self.mass), strict=True):
                mass.add((id(s), name), weight, dofs, turn.T @ pattern @ turn)
        for point in self.point_masses:
            dofs = _dofs([point.node])
            motion = rigid_motion(np.array([point.offset]), np.zeros(3))[:3]  # of the centre of mass
            mass.add((id(point), "mass"), point.mass, dofs, motion.T @ motion)
            for (i, j), value in (point.inertia or {}).items():
                pattern = np.zeros((6, 6))
                pattern[3 + i, 3 + j] = pattern[3 + j, 3 + i] = 1.0
                mass.add((id(point), f"{i}{j}"), value, dofs, pattern)
        return mass.total(), stiffness.total()

    def condense(
        self,
        sensors: Sequence[SensorAxis],
        *,
        base_nodes: int | Iterable[int],
        base_axes: str | Iterable[str] = "xyz",
        origin: ArrayLike = (0.0, 0.0, 0.0),
        condensation: Literal["static", "modal"] = "static",
    ) -> tuple[Matrix, Matrix, Array]:
        r"""Mass and stiffness of the sensors' and the base's motion alone.

        The base nodes move as one rigid body, all else follows the sensors:

        .. math:: u = T_S (u_S - G u_0) + R u_0, \qquad T_S = F S' (S F S')^{-1}, \quad F = K_{ff}^{-1},

        with R the rigid-body motion of all nodes, S the sensors' rows and G = S R.

        Parameters
        ----------
        sensors : sequence of (node, axis)
            n sensors; an axis is a vector (3,), of any length, or a string: "x", "-y", "rz".
        base_nodes : int or iterable of int
            The nodes that are fixed to the base, in all six motions.
        base_axes : str or iterable of str
            The d motions of the base, any of x y z rx ry rz ("xyz" is short for three).
        origin : array_like, shape (3,)
            The base point: rotations turn about it, moments refer to it; m.
        condensation : {"static", "modal"}
            "static": Guyan's, in its general form for sensors along any axes; exact for static
            loads at the sensors, frequencies too high. "modal" (numbers only): T_S = Phi_f
            (S Phi_f)^-1 with the n lowest modes on the fixed base, whose frequencies, shapes
            and participations are then exact.

        Returns
        -------
        mass, stiffness : (n + d, n + d)
            Sensors first, then base axes; kg and N/m (with rotations: per rad). The mass at the base
            nodes is in M_00. NumPy arrays, or CasADi matrices where they depend on a CasADi scalar.
        rigid_body : ndarray, shape (n, d)
            G, motion of the sensors for unit base motion.

        Raises
        ------
        InputError
            If a node is out of range or not joined to the base, a sensor sits on the base, two
            sensors measure the same, or the sensors do not tell the n lowest modes apart ("modal").

        References
        ----------
        Guyan, AIAA Journal 3 (1965) 380; O'Callahan, Avitabile, Riemer, SEREP, IMAC VII (1989).
        """
        base = self._base(base_nodes)
        S, _ = self._sensor_rows(sensors, base)
        R = rigid_motion(np.asarray(self.nodes), origin)[:, base_columns(base_axes)]
        if condensation not in ("static", "modal"):
            raise InputError(f'condensation must be "static" or "modal", got {condensation!r}')

        mass, stiffness = self.matrices()
        free = np.setdiff1d(np.arange(len(R)), _dofs(base))
        S_f = S[:, free]
        if condensation == "static":
            flexibility = solve_positive_definite(block(stiffness, free), S_f.T)
            K_SS = solve_positive_definite(symmetric(S_f @ flexibility), np.eye(len(S)))
            T_f = flexibility @ K_SS
        else:
            T_f, K_SS = _modal(block(mass, free), block(stiffness, free), S_f)

        G = S @ R
        # [u_S; u_0] to the motion of the sensors relative to the base, and of all nodes.
        relative = np.hstack([np.eye(len(S)), -G])
        T = placed_rows(T_f, free, len(R)) @ relative + np.hstack([np.zeros((len(R), len(S))), R])
        # K R = 0 exactly, so the base's rows follow from K_SS; T' K T would leave rounding in them.
        return symmetric(T.T @ (mass @ T)), symmetric(relative.T @ K_SS @ relative), G

    def structure(
        self,
        sensors: Sequence[SensorAxis],
        damping_ratios: ArrayLike,
        *,
        base_nodes: int | Iterable[int],
        base_axes: str | Iterable[str] = "xyz",
        origin: ArrayLike = (0.0, 0.0, 0.0),
        condensation: Literal["static", "modal"] = "static",
        descriptions: Sequence[Any] | None = None,
    ) -> Structure:
        """`condense` as a `Structure`, with modal damping.

        Parameters
        ----------
        sensors, base_nodes, base_axes, origin, condensation
            As for `condense`.
        damping_ratios : float or array_like, shape (n,)
            Fractions of critical damping, in ascending order of frequency; one number for all modes.
        descriptions : sequence of Sensor, optional
            Descriptions of the sensors, kept as the structure's `sensors`.

        Returns
        -------
        Structure
            n sensors, d base directions.

        Raises
        ------
        InputError
            As for `condense`; or if a property is a CasADi expression.
        """
        mass, stiffness, G = self.condense(
            sensors, base_nodes=base_nodes, base_axes=base_axes, origin=origin, condensation=condensation
        )
        if not (isinstance(mass, np.ndarray) and isinstance(stiffness, np.ndarray)):
            raise InputError("a Structure holds numbers, but a property of the frame is a CasADi expression")
        n, d = G.shape
        ratios = np.full(n, damping_ratios) if np.ndim(damping_ratios) == 0 else damping_ratios
        return Structure(mass, stiffness, ratios, n_base=d, rigid_body=G, sensors=descriptions)

    def sensor_geometry(self, sensors: Sequence[SensorAxis]) -> tuple[Array, Array]:
        """Positions (n, 3) in m and unit axes (n, 3) of sensors (node, axis); rotations have none."""
        rows, nodes = self._sensor_rows(sensors, ())
        picked = np.array([row[_dofs([node])] for row, node in zip(rows, nodes, strict=True)])
        turning = np.flatnonzero(np.any(picked[:, 3:], axis=1))
        if turning.size:
            raise InputError(f"sensor {turning[0]} measures a rotation, which has no position and axis")
        return np.asarray(self.nodes)[nodes], picked[:, :3]

    def _node(self, node: int, owner: str) -> int:
        count = len(np.asarray(self.nodes))
        if not isinstance(node, numbers.Integral) or not 0 <= node < count:
            raise InputError(f"{owner} is on node {node!r}, but the nodes are 0 to {count - 1}")
        return int(node)

    def _base(self, base_nodes: int | Iterable[int]) -> tuple[int, ...]:
        """Return the base nodes; an error where another node is not joined to them.

        Beams hold their nodes in all six motions, so K_ff is singular exactly when a node has no
        path to the base; that can be told without section properties.
        """
        given = [int(base_nodes)] if isinstance(base_nodes, int | np.integer) else list(base_nodes)
        base = tuple(sorted({self._node(node, "the base") for node in given}))
        if not base:
            raise InputError("base_nodes is empty; at least one node must be fixed to the base")
        count = len(np.asarray(self.nodes))
        links = [(beam.start, beam.end) for beam in self.beams] + [(base[0], node) for node in base[1:]]
        ends = np.array(links, dtype=int).reshape(-1, 2)
        graph = scipy.sparse.coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count))
        labels = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
        loose = np.flatnonzero(labels != labels[base[0]])
        if loose.size:
            raise InputError(
                f"the frame is a mechanism: no beams join node {loose[0]} ({loose.size} such nodes) to the base"
            )
        return base

    def _sensor_rows(self, sensors: Sequence[SensorAxis], base: Sequence[int]) -> tuple[Array, list[int]]:
        """Return S (n, 6N), the rows of the sensors in the motions of all nodes, and the sensors' nodes."""
        rows = np.zeros((len(sensors), np.asarray(self.nodes).size * 2))
        nodes: list[int] = []
        for number, sensor in enumerate(sensors):
            try:
                node, axis = sensor
            except (TypeError, ValueError):
                raise InputError(f"sensor {number} must be a pair (node, axis), got {sensor!r}") from None
            nodes.append(self._node(node, f"sensor {number}"))
            if node in base:
                raise InputError(f"sensor {number} is on base node {node}, where nothing moves relative to the base")
            rows[number, _dofs([node])] = sensor_row(axis, f"sensor {number}")
            together = np.flatnonzero(np.array(nodes) == node)
            if np.linalg.matrix_rank(rows[together][:, _dofs([node])]) < len(together):
                raise InputError(f"sensor {number} measures what the sensors before it on node {node} already give")
        if not nodes:
            raise InputError("sensors is empty; at least one (node, axis) is needed")
        return rows, nodes


def _dofs(nodes: Iterable[int]) -> NDArray[np.intp]:
    return (6 * np.asarray(list(nodes), dtype=np.intp)[:, None] + np.arange(6)).ravel()


def _modal(mass: Matrix, stiffness: Matrix, S: Array) -> tuple[Array, Array]:
    """T_S and K_SS that keep the n lowest modes."""
    if not (isinstance(mass, np.ndarray) and isinstance(stiffness, np.ndarray)):
        raise InputError('condensation="modal" needs numbers; with CasADi expressions use "static"')
    n, size = len(S), len(mass)
    # M phi = (1/w²) K phi: motions without mass then do no harm, and the low modes are the accurate ones.
    try:
        inverse, shapes = scipy.linalg.eigh(mass, stiffness, subset_by_index=[size - n, size - 1])
    except scipy.linalg.LinAlgError:
        raise InputError(SINGULAR) from None
    if inverse[0] <= 1e-14 * inverse[-1]:
        raise InputError(f"the frame has fewer than {n} modes with mass; take fewer sensors")
    seen = S @ (shapes / np.sqrt(inverse))  # mass-normalised
    singular = np.linalg.svd(seen, compute_uv=False)
    if singular[-1] <= EXACT * singular[0]:
        raise InputError(f'the sensors do not tell the {n} lowest modes apart; move one, or use condensation="static"')
    back = np.linalg.inv(seen)
    return (shapes / np.sqrt(inverse)) @ back, symmetric(back.T @ np.diag(1 / inverse) @ back)
