"""Equivalent forces in place of the mass coupling: one free matrix F drives the structure (simulated).

Earlier work of the authors of the published method (Cerini, Yotov, Aglietti 2024, section 3.2.1, on their reference
44): (-w² M_SS + i w C + K_SS) a = w² F u0, F (n, d) free (there a vector), a the relative acceleration, is eq. 13 with
M_S0 = F - M_SS G. The base's own mass is the least that leaves M semidefinite, M_00 = M_S0' M_SS^-1 M_S0.

Determined are frequencies, damping and M_SS^-1 [K_SS, C, F], but no matrix and not F: how each of the n modes splits
its residue into shape and force is open. The known trace of M_SS removes one of these n freedoms, no more. With the
base force measured, `force=True`, nothing is left open.
"""

import casadi as ca
import numpy as np

import sysid
from sysid.frame import Beam, Frame, PointMass, Section


def mast():
    """The true structure, condensed: the consistent mass of its lowest element couples node 1 to the base."""
    section = Section(E=70e9, G=26e9, A=1.536e-3, Iy=1.636e-6, Iz=3.090e-6, J=3.24e-6, density=2700.0)
    nodes = [(0.0, 0.0, float(z)) for z in range(4)]
    beams = [Beam(i, i + 1, section, (1, 0, 0)) for i in range(3)]
    whole = Frame(nodes, beams, [PointMass(1, 20.0), PointMass(2, 10.0)]).structure(
        [(1, "x"), (2, "x"), (3, "x")], [0.01, 0.012, 0.015], base_nodes=0, base_axes="x"
    )
    M, n = whole.mass.copy(), whole.n
    M[n:, n:] = M[n:, :n] @ np.linalg.solve(M[:n, :n], M[:n, n:])  # no mass that only the base carries
    return sysid.Structure(M, whole.stiffness, whole.damping_ratios, n_base=whole.n_base)


def problem(*, data=None, rng=0, noise=0.0, force=False):
    if data is not None:
        raise sysid.InputError("equivalent_forces is simulated and takes no --data")
    truth = mast()
    n, G = truth.n, truth.rigid_body
    test = sysid.simulate(truth, np.geomspace(4.0, 150.0, 150), noise=noise, force=force, rng=rng)
    diagonal = np.equal(*ca.Sparsity.lower(n).get_triplet())  # of the entries of L, column by column
    entries = sysid.Variable(
        "mass factor", diagonal.size, lower=np.where(diagonal, 0.3, -6.0), upper=6.0,
        guess=np.where(diagonal, 3.0, 0.5), unit="kg^1/2",
    )  # fmt: skip
    F = sysid.Variable("force", G.shape, lower=0.0, upper=50.0, unit="kg")
    L = ca.MX(ca.Sparsity.lower(n), entries)
    M_SS, total = L @ L.T, np.trace(truth.mass[:n, :n])
    M_S0 = F - M_SS @ G
    return sysid.Problem(
        test,
        mass=[[M_SS, M_S0], [M_S0.T, M_S0.T @ ca.solve(M_SS, M_S0)]],
        stiffness=sysid.SpectralStiffness(),  # full, its natural frequencies taken from the data
        constraints=[] if force else [ca.trace(M_SS) == total],
        healing={} if force else {entries: entries * ca.sqrt(total / ca.sumsqr(entries))},
        reference=truth,
        goal=1e-6 if noise == 0 else 1.05 * test.residual(truth),  # or 5 % above the noise floor
    )
