"""What the data determine: the modal-mass cone.

Base and response accelerations fix frequencies, damping ratios and rank-one residues, and nothing
else. All models that explain them are ``M_SS = P' diag(t) P``, ``K_SS = P' diag(t w²) P``,
``M_S0 = P' diag(t) (Gamma - P G)``, one modal mass t_k > 0 a mode (P the inverse of the mode shapes).
What a measured force or a stated model adds is linear in t, so its rank tells what stays open.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np

from sysid.mass import KnownMass, LumpedMass
from sysid.problem import Problem
from sysid.response import columns
from sysid.stiffness import ChainStiffness
from sysid.structure import Array, Structure

_RANK_TOLERANCE = 1e-7
_SAME_POLE = 1e-9
_INVISIBLE = 1e-6  # of the strongest mode's participation


Pairs = list[tuple[int, int]]


@dataclass(frozen=True)
class Determination:
    """Whether data and stated model fix every entry of M_SS, K_SS and C.

    Attributes
    ----------
    determined : bool
    closed_by : tuple of str
        What closes the cone, in sentences.
    undetermined : tuple of str
        What is left open, in sentences; empty where determined.
    """

    determined: bool
    closed_by: tuple[str, ...]
    undetermined: tuple[str, ...]


def determination(problem: Problem, structure: Structure) -> Determination:
    """Which modal masses of `structure` the measurement and the stated models of `problem` fix."""
    test = problem.measurement
    closed, open_ = [], []
    base = columns(test.base)
    rank = np.linalg.matrix_rank(base, tol=1e-9 * np.linalg.norm(base))
    if rank < test.n_base:
        open_.append(
            f"the base moves in only {rank} of {test.n_base} independent directions: responses to the others are open"
        )
    strength = np.linalg.norm(structure.participation, axis=1)
    for k in np.flatnonzero(strength < _INVISIBLE * strength.max()).tolist():
        open_.append(f"{_mode(structure, k)} is not moved by the base: nothing in these data tells its mass")

    clusters = _clusters(structure)
    unknowns = [pair for cluster in clusters for pair in combinations_with_replacement(cluster, 2)]
    system, sentence = _model_equations(problem, structure, unknowns)
    if sentence:
        closed.append(sentence)
    if test.force is not None:
        system = np.vstack([system, _force_equations(structure, clusters, unknowns)])
        closed.append("the measured base force weighs each mode that the base moves")
    free = _open_modes(system, unknowns)
    if free:
        n = structure.n
        names = ", ".join(_mode(structure, k) for k in free)
        what = f"all {n} modal masses are open" if len(free) == n else f"modal masses are open ({names})"
        open_.append(f"{what}: other mass and stiffness matrices answer identically")
        if problem.unit_mass:
            open_.append("no number with a unit of mass is given: masses are normalised to 1 kg in each base direction")
    return Determination(not open_, () if free else tuple(closed), tuple(open_))


def _clusters(structure: Structure) -> list[list[int]]:
    """Modes of the same frequency and damping: only the sum of their residues is seen."""
    poles = structure.natural_frequencies * (1 + 1j * structure.damping_ratios)
    clusters = [[0]]
    for k in range(1, structure.n):
        if abs(poles[k] - poles[clusters[-1][-1]]) < _SAME_POLE * abs(poles[k]):
            clusters[-1].append(k)
        else:
            clusters.append([k])
    return clusters


def _forms(left: Array, right: Array, unknowns: Pairs) -> Array:
    """Coefficients of the unknowns t in ``left' T right``, (rows of left', columns of right, unknowns).

    T is symmetric, with one entry for each pair of modes in `unknowns`.
    """
    one = np.stack([np.outer(left[k], right[m]) for k, m in unknowns], axis=-1)
    other = np.stack([np.outer(left[m], right[k]) * (k != m) for k, m in unknowns], axis=-1)
    return one + other


def _force_equations(structure: Structure, clusters: list[list[int]], unknowns: Pairs) -> Array:
    """The force fixes ``Gamma' T Gamma`` of each cluster by itself."""
    gamma = structure.participation
    gamma = gamma / np.linalg.norm(gamma, axis=1).max()
    strength = np.linalg.norm(gamma, axis=1, keepdims=True)
    # A weak mode is weighed badly, not never: what counts here is whether it is seen at all.
    gamma = np.where(strength < _INVISIBLE, 0.0, gamma / np.maximum(strength, _INVISIBLE))
    rows = []
    for cluster in clusters:
        mine = np.zeros((structure.n, 1))
        mine[cluster] = 1.0
        rows.append(_forms(gamma * mine, gamma * mine, unknowns).reshape(-1, len(unknowns)))
    return np.vstack(rows)


def _model_equations(problem: Problem, structure: Structure, unknowns: Pairs) -> tuple[Array, str]:
    """Rows of linear equations in t, scaled to order one, that the stated models add."""
    n, G = structure.n, structure.rigid_body
    P = np.linalg.inv(structure.mode_shapes)
    delta = structure.participation - P @ G
    size = np.linalg.norm(P, axis=0)
    mass_entries = _forms(P / size, P / size, unknowns)
    coupling = _forms(P / size, delta / (np.linalg.norm(delta) + size.max()), unknowns)
    rows: list[Array] = []
    sentences = []
    layout, mass = problem.layout, problem.mass
    if isinstance(mass, LumpedMass):
        rows += [mass_entries[np.tril_indices(n, -1)], coupling.reshape(-1, len(unknowns))]
        if mass.total_mass is None:
            sentences.append("the mass is stated to be lumped on the sensors")
        else:
            sentences.append("the mass is stated to be lumped on the sensors, with its total given")
            for i in range(layout.d):
                own = P[:, layout.directions[:n] == i]
                if own.size:
                    rows.append(np.einsum("iiu->u", _forms(own, own, unknowns))[None] / np.sum(own**2))
    elif isinstance(mass, KnownMass):
        rows += [mass_entries.reshape(-1, len(unknowns)), coupling.reshape(-1, len(unknowns))]
        sentences.append("the mass matrix is known")
    if isinstance(problem.stiffness, ChainStiffness):
        omega = 2 * np.pi * structure.natural_frequencies[:, None]
        stiff = np.sqrt(np.diag(structure.stiffness)[:n])
        springs = _forms(P * omega / stiff, P * omega / stiff, unknowns)
        rows.append(springs[np.abs(structure.stiffness[:n, :n]) <= 1e-9 * np.outer(stiff, stiff)])
        sentences.append("the stiffness is stated to be a chain")
    system = np.vstack(rows) if rows else np.zeros((0, len(unknowns)))
    return system, "; ".join(sentences)


def _open_modes(system: Array, unknowns: Pairs) -> list[int]:
    """Modes whose mass takes part in a direction that the equations leave open."""
    padded = np.vstack([system, np.zeros((1, len(unknowns)))])
    _, s, vt = np.linalg.svd(padded)
    null = vt[np.count_nonzero(s > _RANK_TOLERANCE) :]
    taking_part = np.abs(null).max(axis=0, initial=0.0) > 1e-6
    return sorted({k for pair, part in zip(unknowns, taking_part, strict=True) if part for k in pair})


def _mode(structure: Structure, k: int) -> str:
    return f"mode {k + 1} ({structure.natural_frequencies[k]:.4g} Hz)"
