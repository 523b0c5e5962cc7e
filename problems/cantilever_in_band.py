"""Cantilever with an eccentric tip mass: eight accelerometers, four modes in the band (simulated).

A real structure has more modes than any test has lines. Here 20 beam elements make 42 modes in x and y, of which four
lie below the last line, a third of the way from the fourth mode to the fifth. The base force is measured, records have
0.5 % noise. M, K and C are those of four modes on four sensors; what modes above add is kept as residual modes, which
are part of every response and of the exported superelement (docs/modes_beyond_the_band.md).
"""

import numpy as np

import sysid
from sysid.frame import Beam, Frame, PointMass, Section

HEIGHT, ELEMENTS = 2.0, 20
LEVELS = (5, 10, 15, 20)  # nodes with an accelerometer in x and one in y


def mast():
    """The true structure: a steel tube, 60 x 40 mm, 3 mm wall, with 12 kg beside its axis on top."""
    section = Section(E=205e9, G=79e9, A=5.64e-4, Iy=1.37e-7, Iz=2.63e-7, J=2.9e-7, density=7850.0)
    nodes = [(0.0, 0.0, HEIGHT * i / ELEMENTS) for i in range(ELEMENTS + 1)] + [(0.08, 0.05, HEIGHT)]
    beams = [Beam(i, i + 1, section, (1.0, 0.3, 0.0)) for i in range(ELEMENTS)]
    arm = Section(E=205e9, G=79e9, A=5e-3, Iy=5e-6, Iz=5e-6, J=5e-6, density=1.0)
    beams.append(Beam(ELEMENTS, ELEMENTS + 1, arm, (0.0, 0.0, 1.0)))
    everywhere = [(node, axis) for node in range(1, ELEMENTS + 2) for axis in "xy"]
    ratios = np.linspace(0.006, 0.02, len(everywhere))
    whole = Frame(nodes, beams, [PointMass(ELEMENTS + 1, 12.0)]).structure(
        everywhere, ratios, base_nodes=0, base_axes="xy"
    )
    at = [everywhere.index((node, axis)) for node in LEVELS for axis in "xy"]
    described = [sysid.Sensor(f"{axis} {nodes[node][2]:.1f} m", nodes[node], axis) for node in LEVELS for axis in "xy"]
    return sysid.Structure(
        whole.mass, whole.stiffness, ratios, n_base=2, recovery=np.eye(len(everywhere))[at],
        rigid_body=whole.rigid_body[at], sensors=described,
    )  # fmt: skip


def problem(*, data=None, rng=0, noise=0.005, force=True, modes=4):
    if data is not None:
        raise sysid.InputError("cantilever_in_band is simulated and takes no --data")
    truth = mast()
    f = truth.natural_frequencies
    freq = np.linspace(0.4 * f[0], f[modes - 1] + (f[modes] - f[modes - 1]) / 3, 400)
    return sysid.Problem(sysid.simulate(truth, freq, noise=noise, force=force, rng=rng), mass=sysid.FullMass())
