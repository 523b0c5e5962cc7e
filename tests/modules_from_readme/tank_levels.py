"""An elevated water tank on a two-storey frame, tested empty, half full and full.

The three tests are identified together. Of the water, one share (impulsive) moves with the tank; the other (convective)
sloshes on a spring and a damper of its own, both in proportion to its mass. No sensor sees the water. Only the mass of the
water is known in kilograms: it is what weighs the frame.
"""

import casadi as ca
import numpy as np

import sysid

WATER = 60.0  # kg, the full tank
LEVELS = (0.0, 0.5, 1.0)
#                    floor 1, floor 2, tank, sloshing water, base
STRETCH = np.array([
    [1, 0, 0, 0, -1],  # storey 1
    [-1, 1, 0, 0, 0],  # storey 2
    [0, -1, 1, 0, 0],  # the stand of the tank
    [0, 0, -1, 1, 0],  # the sloshing water on the tank
])  # fmt: skip
TRUE = {
    "frame mass": np.array([80.0, 70.0, 25.0]),  # kg: floor 1, floor 2, empty tank
    "storey": np.array([9e4, 7e4, 4e4]),  # N/m
    "damper": np.array([120.0, 90.0, 60.0]),  # N s/m
    "convective share": 0.6,
    "slosh spring": 25.0,  # N/m per kg of convective water (0.8 Hz)
    "slosh damping": 0.02,
}


def matrices(mass, spring, damper, share, per_kg, ratio, water):
    """M and K (with the base) and C (without), of numbers or of variables; the empty tank has no row for the water."""
    if water == 0.0:
        stretch = STRETCH[:3][:, [0, 1, 2, 4]]
        masses, springs, dampers = ca.vertcat(mass, 0.0), spring, damper
    else:
        stretch, sloshing = STRETCH, share * water
        masses = ca.vertcat(mass[0], mass[1], mass[2] + (1 - share) * water, sloshing, 0.0)
        springs = ca.vertcat(spring, sloshing * per_kg)
        dampers = ca.vertcat(damper, 2 * ratio * sloshing * ca.sqrt(per_kg))
    n = len(stretch)
    return ca.diag(masses), stretch.T @ ca.diag(springs) @ stretch, (stretch.T @ ca.diag(dampers) @ stretch)[:n, :n]


def problem(*, data=None, rng=0):
    if data is not None:
        raise ValueError("tank_levels simulates its tests and reads no data")
    freq = np.linspace(0.4, 12.0, 1000)  # Hz
    sensors = [sysid.Sensor(name, (0, 0, z), "x") for name, z in (("floor 1", 1), ("floor 2", 2), ("tank", 3))]
    truths, tests, recoveries = [], [], []
    for i, level in enumerate(LEVELS):
        M, K, C = (np.array(ca.DM(matrix)) for matrix in matrices(*TRUE.values(), level * WATER))
        recoveries.append(np.eye(len(C))[:3])  # floors and tank, not the water
        truths.append(sysid.Structure(M, K, damping_matrix=C, n_base=1, sensors=sensors, recovery=recoveries[i]))
        tests.append(sysid.simulate(truths[i], freq, noise=0.01, rng=3 * rng + i))

    unknowns = (
        sysid.Variable("frame mass", 3, lower=5.0, upper=500.0, log=True, unit="kg"),
        sysid.Variable("storey", 3, lower=1e3, upper=1e6, log=True, unit="N/m"),
        sysid.Variable("damper", 3, lower=1.0, upper=5e3, log=True, unit="N s/m"),
        sysid.Variable("convective share", lower=0.05, upper=0.95),
        sysid.Variable("slosh spring", lower=2.0, upper=300.0, log=True, unit="N/m/kg"),
        sysid.Variable("slosh damping", lower=1e-3, upper=0.2, log=True),
    )
    (M, K, C), *filled = (matrices(*unknowns, level * WATER) for level in LEVELS)
    residuals = [
        sysid.FurtherTest(test, mass=m, stiffness=k, damping=c, recovery=recovery)
        for test, recovery, (m, k, c) in zip(tests[1:], recoveries[1:], filled, strict=True)
    ]
    return sysid.Problem(
        tests[0], mass=M, stiffness=K, damping=C, recovery=recoveries[0], residuals=residuals, reference=truths[0]
    )
