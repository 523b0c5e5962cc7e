"""Five-storey shear building on a shaker table before and after an earthquake: which storey lost how much stiffness?

Masses are known. Both tests share the undamaged storey stiffnesses; in the second each storey keeps the share 1 - damage.
Damping is Rayleigh, different in both tests. Accelerometers on floors 1, 3 and 5 only, 1 % noise, identified together.
"""

import casadi as ca
import numpy as np

import sysid

#                    floor 1, 2, 3, 4, 5, base
STRETCH = np.array([
    [1, 0, 0, 0, 0, -1],
    [-1, 1, 0, 0, 0, 0],
    [0, -1, 1, 0, 0, 0],
    [0, 0, -1, 1, 0, 0],
    [0, 0, 0, -1, 1, 0],
])  # fmt: skip
MASS = np.diag([120.0, 110.0, 110.0, 110.0, 90.0, 0.0])  # kg, weighed
RECOVERY = np.eye(5)[[0, 2, 4]]  # sensors on floors 1, 3, 5
SENSORS = [sysid.Sensor(f"floor {i}", (0, 0, i), "x") for i in (1, 3, 5)]
FREQ = np.linspace(1.0, 24.0, 1000)  # Hz

TRUE = {
    "stiffness": np.array([5.0e5, 4.5e5, 4.0e5, 4.0e5, 3.5e5]),  # N/m
    "damage": np.array([0.40, 0.15, 0.0, 0.25, 0.05]),  # lost share of each storey
    "alpha": np.array([0.3, 0.6]),  # 1/s, before and after
    "beta": np.array([2e-4, 4e-4]),  # s
}


def storeys(k):
    return STRETCH.T @ np.diag(k) @ STRETCH


def tested(k, alpha, beta, rng):
    K = storeys(k)
    C = (alpha * MASS + beta * K)[:5, :5]
    building = sysid.Structure(MASS, K, damping_matrix=C, n_base=1, sensors=SENSORS, recovery=RECOVERY)
    return sysid.simulate(building, FREQ, noise=0.01, rng=rng)


def problem(*, data=None, rng=0):
    rng = np.random.default_rng(rng)
    k, d, a, b = TRUE.values()
    before = tested(k, a[0], b[0], rng)
    after = tested(k * (1 - d), a[1], b[1], rng)

    stiffness = sysid.Variable("stiffness", 5, lower=5e4, upper=5e6, log=True, unit="N/m")
    damage = sysid.Variable("damage", 5, lower=0.0, upper=0.8)
    alpha = sysid.Variable("alpha", 2, lower=0.0, upper=3.0, unit="1/s")
    beta = sysid.Variable("beta", 2, lower=0.0, upper=5e-3, unit="s")

    K1 = STRETCH.T @ ca.diag(stiffness) @ STRETCH
    K2 = STRETCH.T @ ca.diag(stiffness * (1 - damage)) @ STRETCH
    return sysid.Problem(
        before,
        mass=MASS,
        stiffness=K1,
        damping=alpha[0] * MASS + beta[0] * K1,
        recovery=RECOVERY,
        residuals=[
            sysid.FurtherTest(after, mass=MASS, stiffness=K2, damping=alpha[1] * MASS + beta[1] * K2, recovery=RECOVERY)
        ],
    )
