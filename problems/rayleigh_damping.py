"""Proportional damping written by hand, C = alpha M + beta K, with diagonal mass and full stiffness (simulated).

The second setting of the authors of the published method (Cerini, Yotov, Aglietti 2024, sections 1.3 and 3.2.5, on
their reference 43). The stiffness is full and positive definite: K = D L L' D with D² = M, so that the entries of L
are bounded by the highest frequency (eq. 29-30, 36). A total mass, a constraint, closes the scale; with
`masses_known` the masses are no unknowns, and none is needed.
"""

import casadi as ca
import numpy as np

import sysid

MASSES = np.array([12.0, 10.0, 9.0, 7.0])  # kg
K = 1e4 * np.array([[9.0, -4.5, 0.8, -0.2], [-4.5, 8.0, -3.6, 0.3], [0.8, -3.6, 6.5, -2.5], [-0.2, 0.3, -2.5, 2.6]])
ALPHA, BETA = 0.3, 2.5e-4  # 1/s, s
N, TOTAL, LIMIT = MASSES.size, MASSES.sum(), 2 * np.pi * 25.0  # kg, rad/s: above all frequencies


def building():
    """The true structure."""
    G = np.ones((N, 1))
    return sysid.Structure(
        np.diag(np.append(MASSES, 0.0)),
        np.block([[K, -K @ G], [-G.T @ K, G.T @ K @ G]]),
        damping_matrix=ALPHA * np.diag(MASSES) + BETA * K,
        n_base=1,
    )


def problem(*, data=None, rng=0, noise=0.0, masses_known=False):
    if data is not None:
        raise sysid.InputError("rayleigh_damping is simulated and takes no --data")
    truth = building()
    test = sysid.simulate(truth, np.linspace(1.0, 22.0, 300), noise=noise, rng=rng)
    m = sysid.Variable(
        "mass", N, lower=1.0, upper=TOTAL, guess=MASSES if masses_known else TOTAL / N, fixed=masses_known, unit="kg"
    )
    diagonal = np.equal(*ca.Sparsity.lower(N).get_triplet())  # of the entries of L, column by column
    entries = sysid.Variable(
        "factor", diagonal.size, lower=np.where(diagonal, 1.0, -LIMIT), upper=LIMIT,
        guess=np.where(diagonal, 80.0, -20.0), unit="rad/s",
    )  # fmt: skip
    alpha = sysid.Variable("alpha", lower=0.0, upper=3.0, unit="1/s")
    beta = sysid.Variable("beta", lower=0.0, upper=1e-2, unit="s")
    M, L = ca.diag(m), ca.MX(ca.Sparsity.lower(N), entries)
    D = ca.sqrt(M)
    K_SS = D @ L @ L.T @ D
    return sysid.Problem(
        test,
        mass=M,
        stiffness=K_SS,
        damping=alpha * M + beta * K_SS,
        constraints=[] if masses_known else [ca.sum1(m) == TOTAL],
        healing={} if masses_known else {m: m * TOTAL / ca.sum1(m)},
        reference=truth,
        goal=1e-6 if noise == 0 else 1.05 * test.residual(truth),  # or 5 % above the noise floor
    )
