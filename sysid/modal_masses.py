"""What the data determine: the modal-mass cone.

Base and response accelerations fix frequencies, damping ratios and rank-one residues, and nothing
else. All models that explain them are ``M_SS = P' diag(t) P``, ``K_SS = P' diag(t w²) P``,
``M_S0 = P' diag(t) (Gamma - P G)``, one modal mass t_k > 0 a mode (P the inverse of the mode shapes).
What a measured force or a stated model adds is linear in t, so its rank tells what stays open.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sysid.mass import FullMass, KnownMass, LumpedMass
from sysid.problem import Problem
from sysid.stiffness import ChainStiffness
from sysid.structure import Array, Structure

_RANK_TOLERANCE = 1e-7
_INVISIBLE = 1e-6  # of the strongest mode's participation


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
    n, test = structure.n, problem.measurement
    closed, open_ = [], []
    columns = np.moveaxis(test.base, 1, 0).reshape(test.n_base, -1)
    rank = np.linalg.matrix_rank(columns, tol=1e-9 * np.linalg.norm(columns))
    if rank < test.n_base:
        open_.append(
            f"the base moves in only {rank} of {test.n_base} independent directions: responses to the others are open"
        )
    strength = np.linalg.norm(structure.participation, axis=1) / np.sqrt(problem.totals.max())
    hidden = np.flatnonzero(strength < _INVISIBLE * strength.max()).tolist()
    for k in hidden:
        open_.append(f"{_mode(structure, k)} is not moved by the base: nothing in these data tells its mass")

    rows: list[Array] = []
    if test.force is not None:
        rows.append(np.eye(n)[strength >= _INVISIBLE * strength.max()])
        closed.append("the measured base force weighs each mode that the base moves")
    equations, sentence = _model_equations(problem, structure)
    if sentence:
        rows.append(equations)
        closed.append(sentence)
    system = np.vstack(rows) if rows else np.zeros((0, n))
    missing = n - np.linalg.matrix_rank(system, tol=_RANK_TOLERANCE) if system.size else n
    if missing:
        free = _open_modes(system, n)
        names = ", ".join(_mode(structure, k) for k in free)
        what = (
            f"{missing} of the {n} modal masses are open ({names})" if missing < n else f"all {n} modal masses are open"
        )
        open_.append(f"{what}: other mass and stiffness matrices answer identically")
        if problem.normalised:
            open_.append("no number with a unit of mass is given: masses are normalised to 1 kg in each base direction")
    return Determination(not open_, tuple(closed) if not missing else (), tuple(open_))


def _model_equations(problem: Problem, structure: Structure) -> tuple[Array, str]:
    """Rows of linear equations in t, scaled to order one at t = 1, that the stated models add."""
    n, G = structure.n, structure.rigid_body
    P = np.linalg.inv(structure.mode_shapes)
    delta = structure.participation - P @ G
    size = np.linalg.norm(P, axis=0)
    outer = np.einsum("ki,kj->ijk", P, P) / np.multiply.outer(size, size)[:, :, None]
    coupling = np.einsum("ki,kj->ijk", P, delta) / size[:, None, None] / (np.linalg.norm(delta) + size.max())
    below = np.tril_indices(n, -1)
    rows: list[Array] = []
    sentence = ""
    layout, mass = problem.layout, problem.mass
    if isinstance(mass, LumpedMass):
        rows += [outer[below], coupling.reshape(-1, n)]
        sentence = "the mass is stated to be lumped on the sensors"
        if mass.total_mass is not None:
            groups = layout.directions[:n]
            rows += [
                np.sum(P[:, groups == i] ** 2, axis=1)[None] / np.sum(P[:, groups == i] ** 2)
                for i in range(layout.d)
                if np.any(groups == i)
            ]
            sentence += ", with its total given"
    elif isinstance(mass, KnownMass):
        rows += [outer.reshape(-1, n), coupling.reshape(-1, n)]
        sentence = "the mass matrix is known"
    elif not isinstance(mass, FullMass):  # pragma: no cover - the union is closed
        raise TypeError(type(mass))
    if isinstance(problem.stiffness, ChainStiffness):
        w2 = (2 * np.pi * structure.natural_frequencies) ** 2
        stiff = np.sqrt(np.diag(structure.stiffness)[:n])
        springs = np.einsum("ki,kj,k->ijk", P, P, w2) / np.multiply.outer(stiff, stiff)[:, :, None]
        absent = np.abs(structure.stiffness[:n, :n]) <= 1e-9 * np.outer(stiff, stiff)
        rows.append(springs[absent])
        sentence += (" and " if sentence else "") + "the stiffness is stated to be a chain"
    system = np.vstack(rows) if rows else np.zeros((0, n))
    return system, sentence


def _open_modes(system: Array, n: int) -> list[int]:
    """Modes whose mass takes part in a direction that the equations leave open."""
    if not system.size:
        return list(range(n))
    _, s, vt = np.linalg.svd(system)
    null = vt[np.sum(s > _RANK_TOLERANCE) :]
    return [int(k) for k in np.flatnonzero(np.abs(null).max(axis=0) > 1e-6)]


def _mode(structure: Structure, k: int) -> str:
    return f"mode {k + 1} ({structure.natural_frequencies[k]:.4g} Hz)"
