"""Two electronics boxes stacked on a bracket, shaken along x, y and z with the base force measured.

Each box is a point mass with three translations (n = 6). The bracket has springs kx, ky, kz and a coupling kxz, the mounts
between the boxes kx, ky, kz. The damping is proportional to each stiffness with a factor of its own, C = b1 K_bracket +
b2 K_mount, which is not classical. Nothing is weighed: the base force determines the masses.
"""

import numpy as np

import sysid

AXES = "xyz"
ORDER = np.eye(9).reshape(3, 3, 9)  # lower box, upper box, base; x, y, z of each
LOWER, UPPER, BASE = ORDER  # (3, 9): rows of each body among the degrees of freedom
UNIT = np.eye(3)
COUPLING = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])  # x with z


def patterns(stretch, extra=()):
    """A (9, 9) matrix for each spring along x, y, z (and for what is in extra), per N/m."""
    return [stretch.T @ block @ stretch for block in (*(np.diag(row) for row in UNIT), *extra)]


BRACKET = patterns(LOWER - BASE, [COUPLING])  # kx, ky, kz, kxz
MOUNT = patterns(UPPER - LOWER)  # kx, ky, kz
MASS = [LOWER.T @ LOWER, UPPER.T @ UPPER]

TRUE = {
    "mass": np.array([12.0, 7.5]),  # kg
    "bracket": np.array([1.6e6, 2.4e6, 6.0e6]),  # N/m
    "kxz": 7.0e5,  # N/m
    "mount": np.array([2.2e6, 1.3e6, 5.0e6]),  # N/m
    "b": np.array([1.2e-4, 4.0e-5]),  # s, bracket and mount
}


def matrices(mass, bracket, kxz, mount, b):
    """M, K, C with the base's rows, of numbers or of variables alike."""
    M = mass[0] * MASS[0] + mass[1] * MASS[1]
    K_bracket = bracket[0] * BRACKET[0] + bracket[1] * BRACKET[1] + bracket[2] * BRACKET[2] + kxz * BRACKET[3]
    K_mount = mount[0] * MOUNT[0] + mount[1] * MOUNT[1] + mount[2] * MOUNT[2]
    return M, K_bracket + K_mount, b[0] * K_bracket + b[1] * K_mount


def problem(*, data=None, rng=0):
    """The problem, of a simulated test with 1 % noise."""
    M, K, C = matrices(*TRUE.values())
    places = [("lower", (0.0, 0.0, 0.15)), ("upper", (0.0, 0.0, 0.40))]
    sensors = [sysid.Sensor(f"{name} {axis}", place, axis) for name, place in places for axis in AXES]
    truth = sysid.Structure(M, K, damping_matrix=C[:6, :6], n_base=3, sensors=sensors)
    test = sysid.simulate(truth, np.arange(10.0, 220.0, 0.25), noise=0.01, force=True, rng=rng)

    mass = sysid.Variable("mass", 2, lower=1.0, upper=50.0, unit="kg")
    bracket = sysid.Variable("bracket", 3, lower=1e5, upper=1e8, log=True, unit="N/m")
    kxz = sysid.Variable("bracket kxz", lower=-5e6, upper=5e6, unit="N/m")
    mount = sysid.Variable("mount", 3, lower=1e5, upper=1e8, log=True, unit="N/m")
    b = sysid.Variable("damping factor", 2, lower=1e-6, upper=1e-3, log=True, unit="s")
    M, K, C = matrices(mass, bracket, kxz, mount, b)
    stable = bracket[0] * bracket[2] >= kxz**2  # the bracket holds
    return sysid.Problem(test, mass=M, stiffness=K, damping=C, constraints=[stable], reference=truth)
