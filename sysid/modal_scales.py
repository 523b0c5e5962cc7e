"""The scale of each mode, its modal mass, by whatever is known: each a small linear problem.

Accelerations leave all modal masses open (the modal-mass cone, see `modal_masses`). A measured base force, a known
mass matrix or a lumped one with its total fix them; with nothing known the member nearest to a lumped mass is taken.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from sysid.errors import InputError
from sysid.mass import FullMass
from sysid.measurement import Measurement
from sysid.modal_fit import Modes, Ties
from sysid.problem import Problem
from sysid.response import columns, gains
from sysid.structure import Array

_SPARE = 1e-3  # least share of a total mass that is left to the base
_LEAST = 0.1  # of an equal share of the mass, that each mode keeps where nothing tells modal masses


def weigh(test: Measurement, modes: Modes) -> tuple[Array, Array]:
    """Modal masses t (m,) > 0 and rigid-body mass (d, d): the base force is linear in both.

    Raises
    ------
    InputError
        Where the force wants negative masses: a wrong sign.
    """
    from scipy.optimize import lsq_linear

    d, m = test.n_base, modes.omega.size
    assert test.force is not None
    base, force = columns(test.base), columns(test.force)
    g = np.tile(gains(test.freq, modes.omega, modes.ratios), test.n_runs)
    pairs = [(i, j) for i in range(d) for j in range(i, d)]
    pushes = (modes.gamma @ base) * g
    parts = [np.outer(modes.gamma[k], pushes[k]) for k in range(m)]
    for i, j in pairs:
        unit = np.zeros((d, d))
        unit[i, j] = unit[j, i] = 1.0
        parts.append(unit @ base)
    # Moments and forces count in units of their own records.
    size = np.linalg.norm(force, axis=1, keepdims=True)
    size[size == 0] = 1.0
    design = np.array([(part / size).ravel() for part in parts]).T
    wanted = (force / size).ravel()
    scale = np.linalg.norm(design, axis=0)
    scale[scale == 0] = 1.0
    stacked = np.vstack([design.real, design.imag]) / scale
    target = np.concatenate([wanted.real, wanted.imag])
    lower = np.concatenate([np.zeros(m), np.full(len(pairs), -np.inf)])
    # The triangular factor stands for all lines.
    Q, R = np.linalg.qr(stacked)
    plain = Q.T @ target
    free = np.linalg.lstsq(R, plain, rcond=None)[0]
    strength = np.abs(free[:m])
    if np.sum(free[:m] * strength) < -0.5 * np.sum(strength**2):
        raise InputError(
            "the base force answers to the modes with negative masses: check its sign (it is the base's on the "
            "structure, in phase with the base acceleration at low frequency)"
        )
    answer = (free if np.all(free[:m] > 0) else lsq_linear(R, plain, (lower, np.inf), tol=1e-14).x) / scale
    rigid = np.zeros((d, d))
    for (i, j), mass in zip(pairs, answer[m:], strict=True):
        rigid[i, j] = rigid[j, i] = mass
    t = answer[:m]
    return np.maximum(t, 1e-9 * t.max()), rigid


def stated_totals(problem: Problem) -> Ties | None:
    """Equalities that hold the stated total mass where the base force would set another."""
    layout, mass, totals = problem.layout, problem.mass, problem.totals
    if problem.measurement.force is None or not isinstance(mass, FullMass) or mass.total_mass is None:
        return None

    def ties(phi: ca.MX, gamma: ca.MX, rigid: ca.MX) -> list[ca.MX]:
        if mass.healing == "rigid_body" or phi.size1() != phi.size2():
            return [ca.diag(rigid) / totals - 1]
        P = ca.inv(phi)
        delta = gamma - P @ ca.DM(layout.rigid_body)
        rows = ca.diag(P.T @ P)
        base = ca.diag(rigid - gamma.T @ gamma + delta.T @ delta)
        groups = layout.directions[: layout.n]
        own = [ca.sum1(rows[np.flatnonzero(groups == i).tolist()]) for i in range(layout.d)]
        return [(own[i] + base[i]) / totals[i] - 1 for i in range(layout.d)]

    return ties


def to_stated_totals(
    problem: Problem, P: Array, gamma: Array, G: Array, groups: Array, remainder: Array
) -> tuple[float, Array]:
    """Common modal-mass factor t and base remainder (d, d) with which a full mass has the stated totals.

    Scaling all modal masses by one t changes no response; the remainder is invisible in accelerations. It keeps its
    correlations, and takes what mass the modes leave.

    Parameters
    ----------
    P : (m, m)
        Inverse of the mode shapes at the degrees of freedom.
    gamma, G : (m, d)
        Participations, and rigid motion of the degrees of freedom.
    groups : (m,)
        Base direction of each degree of freedom, -1 for none.
    """
    if isinstance(problem.mass, FullMass) and problem.mass.healing == "rigid_body":
        used = np.sum(gamma**2, axis=0)
    else:
        rows = np.sum(P**2, axis=0)
        own = [rows[groups == i].sum() for i in range(G.shape[1])]
        used = np.array(own) + np.sum((gamma - P @ G) ** 2, axis=0)
    t = min(1.0, float(np.min((1 - _SPARE) * problem.totals / used)))
    share = np.sqrt((problem.totals - t * used) / np.maximum(np.diag(remainder), np.finfo(float).tiny))
    return t, remainder * np.outer(share, share)


def nearest_lumped(problem: Problem, P: Array, gamma: Array, G: Array, groups: Array) -> Array:
    """Modal masses (m,) whose mass matrix is nearest to a lumped, uncoupled one with the stated totals.

    Parameters
    ----------
    P, gamma, G, groups :
        As in `to_stated_totals`.
    """
    from scipy.optimize import lsq_linear

    m = len(P)
    delta = gamma - P @ G
    off = np.einsum("ki,kj->ijk", P, P)[np.tril_indices(m, -1)]
    coupling = np.einsum("ki,kj->ijk", P, delta).reshape(-1, m)
    totals = [(np.sum(P[:, groups == i] ** 2, axis=1), problem.totals[i]) for i in range(G.shape[1])]
    known = [(row, total) for row, total in totals if np.any(row > 0)] or [(np.sum(P**2, axis=1), 1.0)]
    weight = max(total for _, total in known)
    rows = np.vstack([off, coupling, *(row[None] * weight / total for row, total in known)])
    wanted = np.zeros(len(rows))
    wanted[-len(known) :] = weight
    size = np.maximum(np.linalg.norm(rows, axis=0), np.finfo(float).tiny)
    # No modal mass vanishes, or M_SS would be singular: each keeps a share of what it could be by itself.
    share = np.max([row / total for row, total in known], axis=0)
    least = _LEAST / m * size / np.maximum(share, 1e-9 * share.max())
    return np.maximum(lsq_linear(rows / size, wanted, (least, np.inf), tol=1e-14).x, least) / size


def of_known_mass(mass: Array, P: Array, gamma: Array, G: Array) -> Array:
    """Modal masses (n,) with which the modes have a known mass matrix (n + d, n + d)."""
    from scipy.optimize import nnls

    n = len(P)
    rows = np.concatenate([P, gamma - P @ G], axis=1)[:, None, :] * P[:, :, None]
    t = nnls(rows.reshape(n, -1).T, mass[:n].ravel())[0]
    return np.maximum(t, np.finfo(float).eps * t.max())
