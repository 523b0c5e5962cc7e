"""A finite-element spacecraft dummy: 14 accelerometers, a base that moves in six directions, 20 modes to 200 Hz.

A tapered truss stands on an adapter ring and carries a propellant tank, two decks, a reflector on a boom and two
solar-array stubs. Its exact truth is the Craig-Bampton form with the 20 lowest modes; what the modes above would carry
stays, rigid, in the base's mass. Beside the 14 sensors there are thus six degrees of freedom that no sensor shows.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg

import sysid
from sysid.frame import Beam, Frame, PointMass, Section

AXES = ("x", "y", "z", "rx", "ry", "rz")
MODES = 20
BAND = (8.0, 200.0)  # Hz
DAMPING = (0.01, 0.02)  # from the first mode to the last

# Adapter ring (the base), lower deck, upper deck (four corners each), tank, top, boom tip, two arrays.
NODES = [(0.55, 0.5, 0), (-0.55, 0.5, 0), (-0.55, -0.5, 0), (0.55, -0.5, 0)]
NODES += [(0.5, 0.45, 0.7), (-0.5, 0.45, 0.7), (-0.5, -0.45, 0.7), (0.5, -0.45, 0.7)]
NODES += [(0.42, 0.4, 1.5), (-0.42, 0.4, 1.5), (-0.42, -0.4, 1.5), (0.42, -0.4, 1.5)]
NODES += [(0.02, -0.03, 1.05), (0.05, 0.02, 2.1), (0.65, 0.15, 2.3), (0.1, 1.05, 1.35), (0.0, -1.0, 1.35)]
BASE = range(4)
MASSES = {
    4: 18.0, 5: 14.0, 6: 20.0, 7: 15.0, 8: 11.0, 9: 16.0, 10: 12.0, 11: 9.0,
    12: 160.0, 13: 30.0, 14: 9.0, 15: 7.0, 16: 6.0,
}  # fmt: skip
INERTIAS = {12: (9.0, 8.0, 7.0), 13: (1.5, 1.2, 1.0), 14: (0.3, 0.4, 0.35), 15: (0.3, 0.15, 0.3), 16: (0.25, 0.12, 0.2)}
SENSORS = [(4, "x"), (5, "y"), (6, "z"), (8, "x"), (9, "y"), (10, "z"), (11, "y"), (12, "x"), (12, "y"), (12, "z")]
SENSORS += [(13, "x"), (14, "y"), (15, "z"), (16, "x")]


def dummy() -> tuple[sysid.Structure, float]:
    """The truth, and the length by which rotations of its base are scaled.

    Returns
    -------
    structure : sysid.Structure
        20 modal degrees of freedom, 14 sensors, base directions x y z and L·rx L·ry L·rz.
    length : float
        L, m: the radius of gyration about the base point, the root mean square over the three axes. A
        rotation of one unit, 1/L rad, then moves the masses about as far as a translation of one unit does, moments are
        recorded as M/L in N, and all six directions weigh alike.
    """
    frame = _frame()
    mass, stiffness = frame.matrices()
    assert isinstance(mass, np.ndarray) and isinstance(stiffness, np.ndarray)
    rigid = _rigid_motion(np.asarray(NODES))
    rigid_mass = rigid.T @ mass @ rigid
    length = float(np.sqrt(np.trace(rigid_mass[3:, 3:]) / np.trace(rigid_mass[:3, :3])))
    rigid = rigid / np.repeat([1.0, length], 3)

    free = np.arange(6 * len(BASE), 6 * len(NODES))
    lam, shapes = scipy.linalg.eigh(
        stiffness[np.ix_(free, free)], mass[np.ix_(free, free)], subset_by_index=[0, MODES - 1]
    )
    participation = shapes.T @ (mass @ rigid)[free]
    seen = np.array([6 * node + AXES.index(axis) for node, axis in SENSORS])
    M = np.block([[np.eye(MODES), participation], [participation.T, rigid.T @ mass @ rigid]])
    K = scipy.linalg.block_diag(np.diag(lam), np.zeros((6, 6)))
    structure = sysid.Structure(
        M, K, np.linspace(*DAMPING, MODES), n_base=6, rigid_body=rigid[seen], recovery=shapes[seen - free[0]],
        sensors=[sysid.Sensor(f"node {node} {axis}", NODES[node], axis) for node, axis in SENSORS],
    )  # fmt: skip
    return structure, length


def spacecraft(modes: int, channels: int = 18) -> sysid.Structure:
    """The dummy on a base that moves in x, y and z, with so many modes and accelerometers, three at a node."""
    frame = _frame()
    mass, stiffness = (np.asarray(matrix) for matrix in frame.matrices())
    rigid = _rigid_motion(np.asarray(NODES))[:, :3]
    free = np.arange(6 * len(BASE), 6 * len(NODES))
    lam, shapes = scipy.linalg.eigh(
        stiffness[np.ix_(free, free)], mass[np.ix_(free, free)], subset_by_index=[0, modes - 1]
    )
    participation = shapes.T @ (mass @ rigid)[free]
    nodes = (13, 12, 14, 15, 16, 8, 5, 10)
    at = [(node, axis) for node in nodes for axis in "xyz"][:channels]
    seen = np.array([6 * node + AXES.index(axis) for node, axis in at])
    M = np.block([[np.eye(modes), participation], [participation.T, rigid.T @ mass @ rigid]])
    K = scipy.linalg.block_diag(np.diag(lam), np.zeros((3, 3)))
    return sysid.Structure(
        M, K, np.linspace(*DAMPING, modes), n_base=3, rigid_body=rigid[seen], recovery=shapes[seen - free[0]],
        sensors=[sysid.Sensor(f"node {node} {axis}", NODES[node], axis) for node, axis in at],
    )  # fmt: skip


def _frame() -> Frame:
    main, brace = _tube(0.056, 0.0029), _tube(0.043, 0.0019)
    deck, boom, arm = _tube(0.063, 0.0029), _tube(0.056, 0.0029), _tube(0.046, 0.0023)
    beams = []
    for level in (0, 4):
        for i in range(4):
            beams.append(Beam(level + i, level + 4 + i, main, (0, 1, 0)))
            beams.append(Beam(level + i, level + 4 + (i + 1) % 4, brace, (0, 0.3, 1)))
            beams.append(Beam(level + 4 + i, level + 4 + (i + 1) % 4, deck, (0, 0, 1)))
    for i in range(4):
        beams += [Beam(4 + i, 12, deck, (0, 0, 1)), Beam(8 + i, 12, brace, (0, 0, 1)), Beam(8 + i, 13, deck, (0, 1, 0))]
    beams += [Beam(13, 14, boom, (0, 1, 0)), Beam(8, 15, arm, (0, 0, 1)), Beam(9, 15, arm, (0, 0, 1))]
    beams += [Beam(10, 16, arm, (0, 0, 1)), Beam(11, 16, arm, (0, 0, 1))]
    return Frame(NODES, beams, [PointMass(node, kg, inertia=INERTIAS.get(node)) for node, kg in MASSES.items()])


def _tube(radius: float, wall: float) -> Section:
    """A circular aluminium tube."""
    inertia = np.pi * radius**3 * wall
    return Section(E=69e9, G=26e9, A=2 * np.pi * radius * wall, Iy=inertia, Iz=inertia, J=2 * inertia, density=2700.0)


def _rigid_motion(points: np.ndarray) -> np.ndarray:
    """Motion of points (n, 3) for unit motions of the origin along and about each axis, (6 n, 6)."""
    motion = np.tile(np.eye(6), (len(points), 1, 1))
    motion[:, :3, 3:] = np.cross(np.eye(3), points[:, None]).swapaxes(1, 2)  # theta × r
    return motion.reshape(-1, 6)
