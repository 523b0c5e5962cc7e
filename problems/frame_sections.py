"""Finite-element mast whose bending stiffness, elastic foot and tip mass are the unknowns (simulated).

Updating of a finite-element model by physical parameters (Friswell, Mottershead, Finite Element Model Updating in
Structural Dynamics (1995)): a steel tube on an elastic foot, modelled as a short, soft beam, carries a box on its tip.
Young's modulus of the foot, of the lower and of the upper half (welds and doors soften them), the mass of the box and
one damping ratio for all modes are fitted in x and y; the density is known and gives the scale. The frame is
condensed to the sensors (Guyan), in the unknowns as in the truth.
"""

import casadi as ca
import numpy as np

import sysid
from sysid.frame import Beam, Frame, PointMass, Section

HEIGHTS = [0.0, 0.05, 0.8, 1.6, 2.4, 3.2]  # m
FOOT, LOWER, UPPER, TIP, RATIO = 8e9, 205e9, 170e9, 30.0, 0.012  # Pa, Pa, Pa, kg, and of critical damping
SENSORS = [(node, axis) for node in (2, 3, 5) for axis in "xy"]


def tube(E):
    """Rectangular steel tube, 100 x 60 mm, 4 mm wall."""
    return Section(E=E, G=79e9, A=1.216e-3, Iy=1.63e-6, Iz=7.22e-7, J=1.52e-6, density=7850.0)


def mast(foot, lower, upper, tip):
    """Mass, stiffness and rigid-body motion of the sensors, of numbers or of variables."""
    sections = [tube(foot), *[tube(lower)] * 2, *[tube(upper)] * 2]
    beams = [Beam(i, i + 1, section, (1.0, 0.0, 0.0)) for i, section in enumerate(sections)]
    frame = Frame([(0.0, 0.0, z) for z in HEIGHTS], beams, [PointMass(5, tip, inertia=(0.8, 0.8, 0.5))])
    return frame.condense(SENSORS, base_nodes=0, base_axes="xy")


def problem(*, data=None, rng=0, noise=0.0):
    if data is not None:
        raise sysid.InputError("frame_sections is simulated and takes no --data")
    M, K, _ = mast(FOOT, LOWER, UPPER, TIP)
    described = [sysid.Sensor(f"{axis}{node}", (0.0, 0.0, HEIGHTS[node]), axis) for node, axis in SENSORS]
    truth = sysid.Structure(M, K, [RATIO] * 6, n_base=2, sensors=described)
    freq = np.geomspace(0.5 * truth.natural_frequencies[0], 1.2 * truth.natural_frequencies[-1], 80)
    test = sysid.simulate(truth, freq, noise=noise, rng=rng)
    foot = sysid.Variable("foot modulus", lower=1e9, upper=100e9, log=True, unit="Pa")
    lower = sysid.Variable("lower modulus", lower=100e9, upper=300e9, unit="Pa")
    upper = sysid.Variable("upper modulus", lower=100e9, upper=300e9, unit="Pa")
    tip = sysid.Variable("tip mass", lower=5.0, upper=100.0, unit="kg")
    ratio = sysid.Variable("damping ratio", lower=0.002, upper=0.05)
    M, K, _ = mast(foot, lower, upper, tip)
    return sysid.Problem(
        test,
        mass=M,
        stiffness=K,
        damping=ca.repmat(ratio, 6),
        reference=truth,
        goal=1e-6 if noise == 0 else 1.05 * test.residual(truth),  # or 5 % above the noise floor
    )
