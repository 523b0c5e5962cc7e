"""Tower with two arms and a tuned mass: masses, springs and dampers of a branched structure (simulated).

A tuned mass hangs on the top by its own spring and damper (J. P. Den Hartog, Mechanical Vibrations, the dynamic
vibration absorber), unequal arms branch off two floors. A list of elements, each between two masses, is the whole
structure: M = diag(m), K = T' diag(k) T, C = T' diag(c) T. The tuned mass was weighed before it was mounted: one mass
known is what determines all others, as everything is coupled.
"""

import casadi as ca
import numpy as np

import sysid

NAMES = ("floor 1", "floor 2", "top", "arm on 1", "arm on 2", "tuned mass")
ELEMENTS = [(6, 0), (0, 1), (1, 2), (0, 3), (1, 4), (2, 5)]  # from, to; 6 is the base
MASSES = np.array([900.0, 800.0, 600.0, 150.0, 90.0, 30.0])  # kg
SPRINGS = np.array([2.0e6, 1.6e6, 1.1e6, 4.0e5, 1.2e5, 8.4e3])  # N/m
DAMPERS = np.array([3000.0, 2500.0, 2000.0, 300.0, 120.0, 110.0])  # N s/m
N = MASSES.size
T = np.array([np.eye(N + 1)[upper] - np.eye(N + 1)[lower] for lower, upper in ELEMENTS])  # elongations


def tower():
    """The true structure."""
    return sysid.Structure(
        np.diag(np.append(MASSES, 0.0)),
        T.T @ np.diag(SPRINGS) @ T,
        damping_matrix=T[:, :N].T @ np.diag(DAMPERS) @ T[:, :N],
        n_base=1,
        sensors=[sysid.Sensor(name, (0.0, 0.0, 0.0), "x") for name in NAMES],
    )


def problem(*, data=None, rng=0, noise=0.0):
    if data is not None:
        raise sysid.InputError("spring_mass_branched is simulated and takes no --data")
    truth = tower()
    test = sysid.simulate(truth, np.geomspace(1.2, 16.0, 250), noise=noise, rng=rng)
    # The guesses tell floors from arms, no more.
    m = sysid.Variable("mass", N - 1, lower=20, upper=2000, guess=[700, 700, 700, 100, 100], log=True, unit="kg")
    k = sysid.Variable("spring", N, lower=1e3, upper=1e7, guess=[1e6] * 3 + [2e5] * 2 + [1e4], log=True, unit="N/m")
    c = sysid.Variable("damper", N, lower=10, upper=1e4, guess=[1000] * 3 + [200] * 3, log=True, unit="N s/m")
    return sysid.Problem(
        test,
        mass=ca.diag(ca.vertcat(m, MASSES[-1])),
        stiffness=T.T @ ca.diag(k) @ T,
        damping=T[:, :N].T @ ca.diag(c) @ T[:, :N],
        reference=truth,
        goal=1e-6 if noise == 0 else 1.05 * test.residual(truth),  # or 5 % above the noise floor
    )
