"""Chain of five masses, springs and dampers, all of them unknown, the total mass known (simulated).

The equations of a shear building under ground motion, as every text on structural dynamics has them (R. W. Clough,
J. Penzien, Dynamics of Structures), written element by element: M = diag(m), K = T' diag(k) T, C = T' diag(c) T with
the elongations T u of springs and dampers. Accelerations leave a common factor of m, k and c open; the total mass,
a constraint, closes it.
"""

import casadi as ca
import numpy as np

import sysid

MASSES = np.array([420.0, 380.0, 350.0, 300.0, 210.0])  # kg
SPRINGS = np.array([9.0e5, 8.2e5, 7.1e5, 6.5e5, 4.8e5])  # N/m
DAMPERS = np.array([1500.0, 900.0, 1200.0, 600.0, 700.0])  # N s/m
N, TOTAL = MASSES.size, MASSES.sum()
# Elongation of each element: its upper end less its lower one; the base, last, is the lower end of the first.
T = np.eye(N, N + 1) - np.eye(N, N + 1, k=-1) - np.outer(np.eye(N)[0], np.eye(N + 1)[N])


def chain():
    """The true structure."""
    return sysid.Structure(
        np.diag(np.append(MASSES, 0.0)),
        T.T @ np.diag(SPRINGS) @ T,
        damping_matrix=T[:, :N].T @ np.diag(DAMPERS) @ T[:, :N],
        n_base=1,
        sensors=[sysid.Sensor(f"mass {i + 1}", (0.0, 0.0, 3.0 * (i + 1)), "x") for i in range(N)],
    )


def problem(*, data=None, rng=0, noise=0.0):
    if data is not None:
        raise sysid.InputError("spring_mass_chain is simulated and takes no --data")
    truth = chain()
    test = sysid.simulate(truth, np.geomspace(0.8, 18.0, 250), noise=noise, rng=rng)
    m = sysid.Variable("mass", N, lower=50.0, upper=1000.0, guess=TOTAL / N, unit="kg")
    k = sysid.Variable("spring", N, lower=1e5, upper=1e7, log=True, unit="N/m")
    c = sysid.Variable("damper", N, lower=50.0, upper=1e4, log=True, unit="N s/m")
    return sysid.Problem(
        test,
        mass=ca.diag(m),
        stiffness=T.T @ ca.diag(k) @ T,
        damping=T[:, :N].T @ ca.diag(c) @ T[:, :N],
        constraints=[ca.sum1(m) == TOTAL],
        healing={m: m * TOTAL / ca.sum1(m)},
        reference=truth,
        goal=1e-6 if noise == 0 else 1.05 * test.residual(truth),  # or 5 % above the noise floor
    )
