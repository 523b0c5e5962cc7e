"""Rigid equipment box on two unequal vertical isolators and a horizontal one, shaken along x and z.

Degrees of freedom: x and z of the box's geometric centre, rotation about +y (m, m, rad), then the base's x and z.
A point (px, pz) of the box moves by x + pz * ry along x and by z - px * ry along z. The box was weighed; its inertia,
its centre of gravity, the isolators' stiffnesses and dampers are unknown. The test is simulated, with 1 % noise.
"""

import casadi as ca
import numpy as np

import sysid

MASS = 80.0  # kg, from weighing
X1, X2, ZH = -0.25, 0.25, -0.20  # m, where the isolators hold the box, from its geometric centre
TRUE = {
    "inertia": 4.0,  # kg m^2, about the centre of gravity
    "cg offset": np.array([0.03, 0.04]),  # m, along x and z, from the geometric centre
    "spring": np.array([4.0e5, 2.5e5, 3.0e5]),  # N/m: vertical 1, vertical 2, horizontal
    "damper": np.array([250.0, 180.0, 300.0]),  # N s/m
}
#                    x    z    ry   base x, base z
STRETCH = np.array([
    [0.0, 1.0, -X1, 0.0, -1.0],  # vertical isolator 1
    [0.0, 1.0, -X2, 0.0, -1.0],  # vertical isolator 2
    [1.0, 0.0, ZH, -1.0, 0.0],  # horizontal isolator
])  # fmt: skip
SENSORS = [
    sysid.Sensor("top left x", (-0.3, 0.0, 0.2), "x"),
    sysid.Sensor("top left z", (-0.3, 0.0, 0.2), "z"),
    sysid.Sensor("bottom right x", (0.3, 0.0, -0.2), "x"),
    sysid.Sensor("bottom right z", (0.3, 0.0, -0.2), "z"),
]
RECOVERY = np.array([[1.0, 0.0, 0.2], [0.0, 1.0, 0.3], [1.0, 0.0, -0.2], [0.0, 1.0, -0.3]])  # sensors by x, z, ry


def matrices(J, cg, k, c):
    """Mass and stiffness with the base's rows, damping without; numbers or variables."""
    a, h = cg[0], cg[1]
    J_o = J + MASS * (a**2 + h**2)  # about the geometric centre
    M3 = ca.vertcat(
        ca.horzcat(MASS, 0.0, MASS * h),
        ca.horzcat(0.0, MASS, -MASS * a),
        ca.horzcat(MASS * h, -MASS * a, J_o),
    )
    M = ca.diagcat(M3, np.zeros((2, 2)))  # the base has no mass of its own
    K = STRETCH.T @ ca.diag(k) @ STRETCH
    C = (STRETCH.T @ ca.diag(c) @ STRETCH)[:3, :3]
    return M, K, C


def problem(*, data=None, rng=0):
    freq = np.linspace(3.0, 35.0, 500)  # Hz
    M, K, C = (np.array(ca.DM(A)) for A in matrices(*TRUE.values()))
    truth = sysid.Structure(M, K, damping_matrix=C, n_base=2, sensors=SENSORS, recovery=RECOVERY)
    test = sysid.simulate(truth, freq, noise=0.01, rng=rng)

    J = sysid.Variable("inertia", lower=0.5, upper=40.0, log=True, unit="kg m^2")
    cg = sysid.Variable("cg offset", 2, lower=-0.15, upper=0.15, unit="m")
    k = sysid.Variable("spring", 3, lower=1e4, upper=1e7, log=True, unit="N/m")
    c = sysid.Variable("damper", 3, lower=10.0, upper=1e4, log=True, unit="N s/m")
    M, K, C = matrices(J, cg, k, c)
    return sysid.Problem(test, mass=M, stiffness=K, damping=C, recovery=RECOVERY)
