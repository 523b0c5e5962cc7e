"""What the data determine: the modal-mass cone.

Base and response accelerations fix frequencies, damping ratios and rank-one residues, and nothing
else. All models that explain them are ``M_SS = P' diag(t) P``, ``K_SS = P' diag(t w²) P``,
``M_S0 = P' diag(t) (Gamma - P G)``, one modal mass t_k > 0 a mode (P the inverse of the mode shapes).
What a measured force or a stated model adds is linear in t, so its rank tells what stays open.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np

from sysid.mass import KnownMass, LumpedMass
from sysid.measurement import Measurement
from sysid.problem import Problem
from sysid.response import columns, gains
from sysid.stiffness import ChainStiffness
from sysid.structure import Array, Structure

_RANK_TOLERANCE = 1e-7
_SAME_POLE = 1e-6  # relative distance of poles that count as one even without a misfit
_UNRESOLVED = 20.0  # misfits, in parts of the half-power half-width, by which resolved poles differ
_CLEAR = 3.0  # misfits above which a mode's share of the responses is seen
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
    """Which modal masses of `structure` the measurement and the stated models of `problem` fix.

    What counts as seen is judged against the misfit that the structure leaves: a mode whose share of
    the records is not clearly above it, poles that it cannot tell apart, and base directions that
    differ by less than it are not taken as known.
    """
    test = problem.measurement
    misfit = test.residual(structure)
    closed, open_ = [], list(_unseen(problem, structure, misfit))
    clusters = _clusters(structure, misfit)
    for cluster in clusters:
        if len(cluster) > 1:
            names = " and ".join(_mode(structure, k) for k in cluster)
            open_.append(f"{names} are too close to be told apart: only the sum of their residues is known")
    unknowns = [pair for cluster in clusters for pair in combinations_with_replacement(cluster, 2)]
    system, sentence = _model_equations(problem, structure, unknowns)
    if sentence:
        closed.append(sentence)
    if test.force is not None:
        system = np.vstack([system, _force_equations(structure, clusters, unknowns)])
        closed.append("the measured base force weighs each mode that the base moves")
    null = _null_space(system)
    taking_part = np.abs(null).max(axis=0, initial=0.0) > 1e-6
    free = sorted({k for pair, part in zip(unknowns, taking_part, strict=True) if part for k in pair})
    if free:
        n = structure.n
        names = ", ".join(_mode(structure, k) for k in free)
        if len(null) == 1 and len(free) == n > 1:
            what = "one common scale of mass, stiffness and damping is open"
        else:
            what = "all modal masses are open" if len(free) == n else f"modal masses are open ({names})"
        open_.append(f"{what}: other mass and stiffness matrices answer identically")
        if problem.unit_mass:
            open_.append("no number with a unit of mass is given: masses are normalised to 1 kg in each base direction")
    elif all(len(cluster) == 1 for cluster in clusters) or test.force is not None:
        # Equations on a cluster as a block were enough: its modes need not be told apart.
        open_ = [sentence for sentence in open_ if "too close" not in sentence]
    return Determination(not open_, () if free else tuple(closed), tuple(open_))


def _unseen(problem: Problem, structure: Structure, misfit: float) -> Iterator[str]:
    """What the records do not show, in sentences."""
    test = problem.measurement
    base = columns(test.base)
    sizes = np.linalg.norm(base, axis=1, keepdims=True)
    spread = np.linalg.svd(base / np.where(sizes > 0, sizes, 1.0), compute_uv=False)
    rank = int(np.count_nonzero(spread > max(1e-9, min(misfit, 0.5)) * spread[0]))
    if rank < test.n_base:
        yield f"the base moves in only {rank} of {test.n_base} independent directions: responses to the others are open"
    if 2 * test.response.size < problem.n_variables:
        yield f"{2 * test.response.size} measured numbers cannot fix {problem.n_variables} unknowns"
    share, force_share = _shares(test, structure)
    for k in range(structure.n):
        f = structure.natural_frequencies[k]
        if share[k] < _INVISIBLE:
            yield f"{_mode(structure, k)} is not moved by the base: nothing in these data tells its mass"
        elif share[k] < _CLEAR * misfit:
            yield (
                f"{_mode(structure, k)} makes {100 * share[k]:.2g} % of the response, which does not stand out of the "
                f"misfit of {100 * misfit:.2g} %: its mass is not known"
            )
        elif not test.freq[0] <= f <= test.freq[-1]:
            yield f"{_mode(structure, k)} lies outside the lines ({test.freq[0]:.4g} to {test.freq[-1]:.4g} Hz)"
        elif force_share is not None and force_share[k] < (test.force_residual(structure) or 0.0):
            yield f"{_mode(structure, k)} does not stand out of the misfit of the base force: its mass is not weighed"


def _shares(test: Measurement, structure: Structure) -> tuple[Array, Array | None]:
    """Relative size of each mode's part in the responses and in the base force, (n,) each."""
    g = gains(test.freq, 2 * np.pi * structure.natural_frequencies, structure.damping_ratios)
    push = np.einsum("kd,rdf->rkf", structure.participation, test.base) * g
    size = np.linalg.norm(push, axis=(0, 2))
    share = size * np.linalg.norm(structure.mode_shapes, axis=0) / np.linalg.norm(test.relative)
    if test.force is None:
        return share, None
    return share, size * np.linalg.norm(structure.participation, axis=1) / np.linalg.norm(test.force)


def _clusters(structure: Structure, misfit: float) -> list[list[int]]:
    """Modes that the misfit cannot tell apart: of them only the sum of the residues is seen."""
    poles = structure.natural_frequencies * (1 + 1j * structure.damping_ratios)
    clusters = [[0]]
    for k in range(1, structure.n):
        apart = abs(poles[k] - poles[clusters[-1][-1]])
        width = structure.damping_ratios[k] * structure.natural_frequencies[k]
        if apart < max(_SAME_POLE * abs(poles[k]), min(_UNRESOLVED * misfit, 1.0) * width):
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
        # A floor that no spring ties to the base is at rest in a rigid motion.
        at_base = _forms(P * omega / stiff, P @ G * omega / np.linalg.norm(P @ G * omega, axis=0), unknowns)
        rigid = structure.stiffness[:n, :n] @ G
        rows.append(at_base[np.abs(rigid) <= 1e-9 * stiff[:, None] * stiff.max()])
        sentences.append("the stiffness is stated to be a chain")
    system = np.vstack(rows) if rows else np.zeros((0, len(unknowns)))
    return system, "; ".join(sentences)


def _null_space(system: Array) -> Array:
    """Directions of the unknowns that the equations leave open, one a row."""
    padded = np.vstack([system, np.zeros((1, system.shape[1]))])
    _, s, vt = np.linalg.svd(padded)
    return vt[np.count_nonzero(s > _RANK_TOLERANCE) :]


def _mode(structure: Structure, k: int) -> str:
    return f"mode {k + 1} ({structure.natural_frequencies[k]:.4g} Hz)"
