"""Cantilever tower with a tip mass, shaken in two directions (simulated; the default problem).

Five consistent-mass beam elements along z, translations along x and y measured at each node above the base:
n = 10, d = 2. The principal axes of bending are turned by 25 degrees, so that x and y couple in every mode.
Records have 1 % noise, and a base force is measured, which determines all matrices. With ``force=False`` they leave the
modal masses open; then the physical mass is known and the frequencies are given to four digits, as a test would give
them.
"""

import numpy as np

import sysid
from sysid.frame import Beam, Frame, PointMass, Section

HEIGHT, TURN = 3.0, np.deg2rad(25)


def tower(elements=5):
    """The true structure: an aluminium box section, 80 x 120 mm, 4 mm wall, with 25 kg on top."""
    section = Section(E=70e9, G=26e9, A=1.536e-3, Iy=1.636e-6, Iz=3.090e-6, J=3.24e-6, density=2700.0)
    nodes = [(0, 0, HEIGHT * i / elements) for i in range(elements + 1)]
    beams = [Beam(i, i + 1, section, (np.cos(TURN), np.sin(TURN), 0)) for i in range(elements)]
    sensors = [(node, axis) for node in range(1, elements + 1) for axis in "xy"]
    return Frame(nodes, beams, [PointMass(elements, 25.0)]).structure(
        sensors,
        np.linspace(0.008, 0.02, 2 * elements),
        base_nodes=0,
        base_axes="xy",
        descriptions=[sysid.Sensor(f"{axis}{node}", tuple(nodes[node]), axis) for node, axis in sensors],
    )


def problem(*, data=None, rng=0, elements=5, noise=0.01, force=True):
    if data is not None:
        raise sysid.InputError("cantilever_tower is simulated and takes no --data")
    truth = tower(elements)
    given = [float(f"{f:.4g}") for f in truth.natural_frequencies]
    freq = np.geomspace(0.5 * given[0], 1.2 * given[-1], 200)
    test = sysid.simulate(truth, freq, noise=noise, force=force, rng=rng)
    goal = 1e-6 if noise == 0 else 1.05 * test.residual(truth)  # or 5 % above the noise floor
    if force:
        return sysid.Problem(test, mass=sysid.FullMass(), reference=truth, goal=goal)
    return sysid.Problem(
        test,
        mass=sysid.FullMass(np.diag(truth.rigid_body_mass), healing="rigid_body"),
        stiffness=sysid.SpectralStiffness(given, max_frequency=1.05 * given[-1]),
        damping=sysid.ModalDamping(0.005, 0.05),
        reference=truth,
        goal=goal,
    )
