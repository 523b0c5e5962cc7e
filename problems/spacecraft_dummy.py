"""Spacecraft dummy: a three-dimensional frame with equipment masses, shaken in three directions (simulated).

A braced mast on a square adapter carries a propellant tank, an equipment deck and an antenna off the axis;
x, y and z are measured at four of its nodes: n = 12, d = 3. Rotations and the other nodes are condensed
statically. The physical mass is known and the frequencies are given to four digits, as a test would give them.
"""

import numpy as np

import sysid
from sysid.frame import Beam, Frame, PointMass, Section

# Adapter corners (the base), then waist, tank, deck, antenna.
NODES = [(0.6, 0.6, 0), (-0.6, 0.6, 0), (-0.6, -0.6, 0), (0.6, -0.6, 0), (0, 0, 0.5), (0.1, -0.05, 1.1), (0, 0.1, 1.9)]
NODES += [(0.7, 0.3, 2.2)]
MEASURED = {"waist": 4, "tank": 5, "deck": 6, "antenna": 7}
MASSES = {4: 90.0, 5: 220.0, 6: 130.0, 7: 25.0}
INERTIAS = {4: (8.0, 8.0, 12.0), 5: (14.0, 14.0, 10.0), 6: (9.0, 9.0, 15.0), 7: (0.6, 0.8, 0.7)}


def tube(radius, wall):
    """Circular aluminium tube."""
    inertia = np.pi * radius**3 * wall
    area = 2 * np.pi * radius * wall
    return Section(E=70e9, G=26e9, A=area, Iy=inertia, Iz=inertia, J=2 * inertia, density=2700.0)


def dummy():
    """The true structure."""
    legs = [Beam(i, 4, tube(0.04, 0.003), (0, 0, 1)) for i in range(4)]
    mast = [Beam(4, 5, tube(0.09, 0.004), (1, 0, 0)), Beam(5, 6, tube(0.08, 0.003), (1, 0, 0))]
    brace = [Beam(0, 5, tube(0.02, 0.002), (0, 0, 1)), Beam(6, 7, tube(0.035, 0.003), (0, 0, 1))]
    masses = [PointMass(node, kg, inertia=INERTIAS[node]) for node, kg in MASSES.items()]
    sensors = [(node, axis) for node in MEASURED.values() for axis in "xyz"]
    named = [sysid.Sensor(f"{name} {axis}", NODES[node], axis) for name, node in MEASURED.items() for axis in "xyz"]
    return Frame(NODES, legs + mast + brace, masses).structure(
        sensors, np.linspace(0.008, 0.03, 12), base_nodes=range(4), base_axes="xyz", descriptions=named
    )


def problem(*, data=None, rng=0, noise=0.0):
    if data is not None:
        raise sysid.InputError("spacecraft_dummy is simulated and takes no --data")
    truth = dummy()
    given = [float(f"{f:.4g}") for f in truth.natural_frequencies]
    freq = np.geomspace(0.5 * given[0], 1.2 * given[-1], 240)
    test = sysid.simulate(truth, freq, noise=noise, rng=rng)
    return sysid.Problem(
        test,
        mass=sysid.FullMass(np.diag(truth.rigid_body_mass), healing="rigid_body"),
        stiffness=sysid.SpectralStiffness(given, max_frequency=1.05 * given[-1]),
        reference=truth,
        goal=1e-3 if noise == 0 else 1.05 * test.residual(truth),  # or 5 % above the noise floor
    )
