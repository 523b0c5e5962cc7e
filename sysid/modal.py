"""The modal strategy: poles from the data, residues by linear least squares, modal masses by what is known."""

from __future__ import annotations

import numpy as np

from sysid.damping import ModalDamping
from sysid.errors import InputError
from sysid.local import Modes, is_modal, rank_one
from sysid.poles import find_poles
from sysid.problem import Problem
from sysid.response import columns, gains, linear_residues
from sysid.structure import Array

_LEAST = 1e-3  # of the largest modal mass: none may vanish, or M_SS would be singular


def modes_from_data(problem: Problem) -> tuple[Modes, Array]:
    """Modal model that the data suggest, and the rigid-body mass (d, d) that its modes do not carry.

    Raises
    ------
    InputError
        For models that are not full mass, spectral stiffness and modal damping, and where other than
        n modes stand out of the data of n sensors.
    """
    if not (is_modal(problem) and isinstance(problem.damping, ModalDamping)):
        raise InputError(
            "strategy 'modal' needs FullMass, SpectralStiffness and ModalDamping; use 'swarm' for this problem"
        )
    test, n = problem.measurement, problem.layout.n
    poles = problem.poles or find_poles(test)
    if poles.omega.size != n:
        found = ", ".join(f"{f:.4g}" for f in poles.omega / (2 * np.pi))
        raise InputError(
            f"strategy 'modal': {poles.omega.size} modes stand out of the data ({found} Hz) for {n} sensors; "
            "as many modes as sensors are needed: leave sensors out, add some, or use 'swarm'"
        )
    residues, _ = linear_residues(test, poles.omega, poles.ratios)
    modes = rank_one(residues, poles.omega, poles.ratios, np.full(n, 1 / np.sqrt(problem.totals.max())))
    if test.force is None:
        t = _nearest_lumped(problem, modes)
        remainder = np.diag(problem.totals)
    else:
        t, rigid = _weigh(problem, modes)
        lam, vectors = np.linalg.eigh(rigid - (modes.gamma.T * t) @ modes.gamma)
        remainder = (vectors * np.maximum(lam, 0.0)) @ vectors.T
    root = np.sqrt(t)
    return modes._replace(phi=modes.phi / root, gamma=modes.gamma * root[:, None]), remainder


def _weigh(problem: Problem, modes: Modes) -> tuple[Array, Array]:
    """Modal masses t (n,) > 0 and rigid-body mass (d, d): the base force is linear in both."""
    from scipy.optimize import lsq_linear

    test, d = problem.measurement, problem.layout.d
    assert test.force is not None
    n = modes.omega.size
    base = columns(test.base)
    g = np.tile(gains(test.freq, modes.omega, modes.ratios), test.n_runs)
    parts = [np.outer(modes.gamma[k], modes.gamma[k]) @ (base * g[k]) for k in range(n)]
    pairs = [(i, j) for i in range(d) for j in range(i, d)]
    for i, j in pairs:
        unit = np.zeros((d, d))
        unit[i, j] = unit[j, i] = 1.0
        parts.append(unit @ base)
    design = np.array([part.ravel() for part in parts]).T
    force = columns(test.force).ravel()
    scale = np.linalg.norm(design, axis=0)
    stacked = np.vstack([design.real, design.imag]) / scale
    lower = np.concatenate([np.zeros(n), np.full(len(pairs), -np.inf)])
    answer = lsq_linear(stacked, np.concatenate([force.real, force.imag]), (lower, np.inf), tol=1e-14).x / scale
    rigid = np.zeros((d, d))
    for (i, j), mass in zip(pairs, answer[n:], strict=True):
        rigid[i, j] = rigid[j, i] = mass
    t = answer[:n]
    return np.maximum(t, 1e-9 * t.max()), rigid


def _nearest_lumped(problem: Problem, modes: Modes) -> Array:
    """Modal masses whose mass matrix is nearest to a lumped, uncoupled one: nothing else tells them."""
    from scipy.optimize import lsq_linear

    G, n = problem.layout.rigid_body, modes.omega.size
    P = np.linalg.inv(modes.phi)
    delta = modes.gamma - P @ G
    below = np.tril_indices(n, -1)
    off = np.einsum("ki,kj->ijk", P, P)[below]
    coupling = np.einsum("ki,kj->ijk", P, delta).reshape(-1, n)
    # The sum of the diagonal sets the scale; the totals are fitted afterwards.
    trace = np.sum(P**2, axis=1)
    rows = np.vstack([off, coupling, 10.0 * trace[None]])
    wanted = np.zeros(len(rows))
    wanted[-1] = 10.0 * problem.totals.max()
    size = np.linalg.norm(rows, axis=0)
    t = lsq_linear(rows / size, wanted, (0.0, np.inf)).x / size
    return np.maximum(t, _LEAST * t.max())
