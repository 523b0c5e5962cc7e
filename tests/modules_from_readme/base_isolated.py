"""A three-storey frame on a heavy isolation level: rubber bearings, a viscous damper, floors weighed to 3 %, base force measured.

The damping is not classical: Rayleigh damping belongs to the frame alone (on its motion relative to the isolation level),
bearings and damper act between isolation level and table. The test is simulated, hence the truth is known (`TRUE`).
"""

import casadi as ca
import numpy as np

import sysid

NOISE = 0.01  # of the records
ACCURACY = 0.03  # of the weighing, relative standard deviation
FREQ = np.linspace(0.2, 15.0, 600)  # Hz
TRUE = {
    "mass": np.array([3000.0, 1000.0, 1000.0, 800.0]),  # kg: isolation level, floors 1, 2, 3
    "bearing": 2.3e5,  # N/m, all of them together: about 1 Hz
    "storey": np.array([2.4e6, 2.0e6, 1.5e6]),  # N/m
    "alpha": 0.4,  # 1/s
    "beta": 6e-4,  # s
    "isolation damper": 1.0e4,  # N s/m, bearings and damper: about 14 %
}
#                    isolation level, floor 1, 2, 3, base
STRETCH = np.array([
    [1, 0, 0, 0, -1],  # bearings
    [-1, 1, 0, 0, 0],
    [0, -1, 1, 0, 0],
    [0, 0, -1, 1, 0],
])  # fmt: skip
RELATIVE = np.array([[-1, 1, 0, 0], [-1, 0, 1, 0], [-1, 0, 0, 1]])  # floors relative to the isolation level


def matrices(m, bearing, storey, alpha, beta, damper):
    """M and K with the base last, C on the motion relative to the base."""
    M = ca.diag(ca.vertcat(m, 0.0))
    K = STRETCH.T @ ca.diag(ca.vertcat(bearing, storey)) @ STRETCH
    frame = STRETCH[1:, 1:4].T @ ca.diag(storey) @ STRETCH[1:, 1:4]  # the frame held at the isolation level
    C = RELATIVE.T @ (alpha * ca.diag(m[1:]) + beta * frame) @ RELATIVE
    return M, K, C + damper * np.diag([1.0, 0.0, 0.0, 0.0])


def problem(*, data=None, rng=0):
    if data is not None:
        raise ValueError("base_isolated simulates its test and takes no data")
    M, K, C = (np.array(ca.DM(x)) for x in matrices(*TRUE.values()))
    names = ("isolation level", "floor 1", "floor 2", "floor 3")
    sensors = [sysid.Sensor(name, (0, 0, 3.0 * i), "x") for i, name in enumerate(names)]
    truth = sysid.Structure(M, K, damping_matrix=C, n_base=1, sensors=sensors)
    test = sysid.simulate(truth, FREQ, noise=NOISE, force=True, rng=rng)
    weighed = TRUE["mass"] * (1 + ACCURACY * np.random.default_rng([7, rng]).standard_normal(4))

    m = sysid.Variable("mass", 4, lower=0.8 * weighed, upper=1.2 * weighed, guess=weighed, unit="kg")
    bearing = sysid.Variable("bearing", lower=2e4, upper=2e6, log=True, unit="N/m")
    storey = sysid.Variable("storey", 3, lower=2e5, upper=2e7, log=True, unit="N/m")
    alpha = sysid.Variable("alpha", lower=0.0, upper=5.0, unit="1/s")
    beta = sysid.Variable("beta", lower=0.0, upper=0.01, unit="s")
    damper = sysid.Variable("isolation damper", lower=5e2, upper=1e5, log=True, unit="N s/m")
    M, K, C = matrices(m, bearing, storey, alpha, beta, damper)
    # One row of the relative misfit has the standard deviation noise / sqrt(rows): a weighing gets its share of that.
    row_std = NOISE / np.sqrt(2 * 4 * FREQ.size)
    return sysid.Problem(
        test, mass=M, stiffness=K, damping=C, residuals=[row_std / ACCURACY * (m / weighed - 1)], goal=1.5 * NOISE
    )
