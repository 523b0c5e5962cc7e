"""Physical damping: all of C unknown, known masses, unknown springs, one strong damper (simulated).

Modes decouple only where C M^-1 K is symmetric (T. K. Caughey, M. E. J. O'Kelly, J. Appl. Mech. 32 (1965) 583-588); a
damper in one storey breaks that, and no modal damping ratios hold it. C = L L' is free and positive semidefinite
through its Cholesky factor. The masses are known, the springs of the storeys are not.
"""

import casadi as ca
import numpy as np

import sysid

MASSES = np.array([800.0, 760.0, 700.0, 520.0])  # kg
SPRINGS = np.array([1.6e6, 1.4e6, 1.1e6, 0.8e6])  # N/m
N = MASSES.size
# Elongation of each storey: its upper floor less its lower one; the base stands last.
T = np.eye(N, N + 1) - np.eye(N, N + 1, k=-1) - np.outer(np.eye(N)[0], np.eye(N + 1)[N])
DAMPER = 10000.0 * np.outer(T[1, :N], T[1, :N])  # N s/m, in the second storey


def building():
    """The true structure: a little proportional damping, and the damper."""
    K = T.T @ np.diag(SPRINGS) @ T
    return sysid.Structure(
        np.diag(np.append(MASSES, 0.0)), K, damping_matrix=5e-4 * K[:N, :N] + DAMPER, n_base=1,
        sensors=[sysid.Sensor(f"floor {i + 1}", (0.0, 0.0, 3.0 * (i + 1)), "x") for i in range(N)],
    )  # fmt: skip


def problem(*, data=None, rng=0, noise=0.0):
    if data is not None:
        raise sysid.InputError("physical_damping is simulated and takes no --data")
    truth = building()
    test = sysid.simulate(truth, np.geomspace(1.0, 16.0, 250), noise=noise, rng=rng)
    k = sysid.Variable("spring", N, lower=1e5, upper=1e7, log=True, unit="N/m")
    diagonal = np.equal(*ca.Sparsity.lower(N).get_triplet())  # of the entries of L, column by column
    entries = sysid.Variable(
        "damping factor", diagonal.size, lower=np.where(diagonal, 0.0, -200.0), upper=200.0,
        guess=np.where(diagonal, 30.0, 0.0), unit="(N s/m)^1/2",
    )  # fmt: skip
    L = ca.MX(ca.Sparsity.lower(N), entries)
    return sysid.Problem(
        test,
        mass=np.diag(MASSES),
        stiffness=T.T @ ca.diag(k) @ T,
        damping=L @ L.T,
        reference=truth,
        goal=1e-6 if noise == 0 else 1.05 * test.residual(truth),  # or 5 % above the noise floor
    )
