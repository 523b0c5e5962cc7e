"""Determination of an answer by data and stated models, and how far the rest may go.

The modal-mass cone speaks where it holds all models that explain the data: exact, and of all of them at once. Elsewhere
the rank of the exact Jacobian does: of small changes of the answer, to first order.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sysid.assessment import modal_mass_cone
from sysid.assessment.modal_mass_cone import left_open
from sysid.assessment.sensitivity import (
    Sensitivity,
    blocks_and_slopes,
    directions_in_words,
    meaningful,
    of_outside,
    outside_variables,
    sensitivity,
    system_matrices,
    with_totals,
)  # fmt: skip
from sysid.assessment.uncertainty import LARGE, uncertainty
from sysid.errors import MOST_LISTED, InputError
from sysid.finding import Finding, Severity, cautions
from sysid.models.unknowns import scales_of, split
from sysid.problem.direct_response import Slopes, slopes_of
from sysid.problem.formulation import Formulation
from sysid.problem.prepared import Prepared
from sysid.structure.structure import Array, Structure
from sysid.structure.thresholds import EXACT, NEGLIGIBLE, SAME_ANSWER, most_deviations

_LOOSE = 1e-2  # of an unknown, by which what is left of exact records may move it
_SAME_MATRICES = "mass, stiffness and damping stay the same all the same"
_NO_SCALE = (
    "without a base force or a known mass the scale of mass, stiffness and damping is not determined: give the force, "
    "or state one mass in kg"
)
BY_CONE = "judged by the modal-mass cone, which holds all models that explain the data"
BY_RANK = "judged by the rank of the Jacobian, to first order about this answer"


@dataclass(frozen=True)
class Determination:
    """Findings on what data and stated model fix of M_SS, K_SS and C, and what they leave open.

    Of kind "open" and "other answers", and "fixed" of what fixes them, or the modal masses where these alone are
    fixed; `judged_by` is `BY_CONE` or `BY_RANK`.
    """

    findings: tuple[Finding, ...]
    judged_by: str

    @property
    def determined(self) -> bool:
        """True where nothing is left open."""
        return not cautions(self.findings)

    @property
    def closed_by(self) -> tuple[str, ...]:
        """Reasons that fix the matrices, in sentences."""
        return tuple(one.sentence for one in self.findings if one.kind == "fixed")

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Sentences on what is left open; empty where determined."""
        return tuple(one.sentence for one in cautions(self.findings))


@dataclass(frozen=True, eq=False)
class Intervals:
    """Extremes of the entries of M_SS and K_SS over all models that explain the data and what was stated, (2, n, n).

    Lower ends, then upper ends, kg and N/m (kg m, kg m² and N, N m where a rotation is involved); infinite where there
    is none.
    """

    mass: Array
    stiffness: Array


def determine(problem: Prepared, structure: Structure, x: Array | None, rivals: Sequence[Array] = ()) -> Determination:
    """Find which entries of M_SS, K_SS and C records, constraints and stated models leave open.

    Parameters
    ----------
    problem : Prepared
    structure : Structure
        The answer.
    x : (n_variables,) or None
        The unknowns that stand for it; None where it has other degrees of freedom than the sensors.
    rivals : sequence of (n_variables,)
        Other unknowns found to explain the data as well.

    Raises
    ------
    InputError
        Where the rank of the Jacobian is asked for, and no x is given.
    """
    if modal_mass_cone.applies(problem.formulation):
        closed, open_ = modal_mass_cone.closed_and_open(problem, structure)
        beside = tuple(_open_outside(problem.formulation, x))
        if open_:  # other answers are members of the cone
            return Determination((*open_, *map(left_open, beside), *_fixed(closed)), BY_CONE)
        others = tuple(_others(problem, structure, x, rivals))
        return Determination((*others, *_fixed(closed if others else (*closed, *beside))), BY_CONE)
    closed, open_ = _by_rank(problem, structure, x)
    return Determination((*open_, *_others(problem, structure, x, rivals)) or _fixed(closed), BY_RANK)


def _fixed(sentences: Sequence[str]) -> tuple[Finding, ...]:
    return tuple(Finding("fixed", Severity.NOTE, sentence) for sentence in sentences)


def intervals(problem: Prepared, structure: Structure, x: Array | None) -> Intervals:
    """Extremes of M_SS and K_SS over what the data leave open, entry by entry; parameters as in `determine`.

    To first order where the cone does not speak: no end is followed along a null direction until a bound stops it, so
    that it is infinite for an entry that something unseen moves.
    """
    if modal_mass_cone.applies(problem.formulation):
        return Intervals(*modal_mass_cone.ends(problem, structure))
    _, _, slopes, known = _about(problem, structure, x)
    ends = []
    for value, slope in blocks_and_slopes(structure, slopes)[:2]:
        open_ = _open_entries(value, slope, known)
        lowest = np.where(np.eye(len(value)), 0.0, -np.inf)
        ends.append(np.stack([np.where(open_, lowest, value), np.where(open_, np.inf, value)]))
    return Intervals(*ends)


def open_masses(problem: Prepared, structure: Structure) -> list[int]:
    """Modes, counted from 0, whose modal mass neither records nor stated models fix; none where no cone tells."""
    return modal_mass_cone.open_modes(problem, structure) if modal_mass_cone.applies(problem.formulation) else []


def scale_is_open(problem: Prepared, structure: Structure, x: Array | None) -> bool:
    """True where one factor common to mass, stiffness and damping is all that is open; parameters as in `determine`."""
    if modal_mass_cone.applies(problem.formulation):
        return modal_mass_cone.only_scale_is_open(problem, structure)
    _, _, slopes, known = _about(problem, structure, x)
    pairs = blocks_and_slopes(structure, slopes)
    return _moving(pairs, known.unit, known.unseen).shape[1] == 1 and _scale_is_open(pairs, known)


# -- by the rank of the Jacobian -----------------------------------------------------------------


def _about(problem: Prepared, structure: Structure, x: Array | None) -> tuple[Formulation, Array, Slopes, Sensitivity]:
    """Formulation and unknowns with all totals, derivatives of the matrices, and the sensitivity to the unknowns."""
    if x is None:
        raise InputError("the rank of the Jacobian is taken at the problem's unknowns: give x beside the structure")
    formulation, x = with_totals(problem, structure, x)
    slopes = slopes_of(formulation.matrices, x, problem.measurement)
    return formulation, x, slopes, sensitivity(formulation, x, slopes)


def _by_rank(problem: Prepared, structure: Structure, x: Array | None) -> tuple[tuple[str, ...], tuple[Finding, ...]]:
    """Reasons that fix the matrices, in sentences, and what is left open."""
    formulation, x, slopes, known = _about(problem, structure, x)
    count, rank = known.free.shape[1], known.rank
    named, factors = _by_name(formulation, known.unseen)
    words = directions_in_words(formulation.unknowns, x, known.unit, named)
    seen = f"the records see {rank} of {count} directions of the {x.size} unknowns; no record sees a change of"
    open_: list[Finding] = []
    pairs = blocks_and_slopes(structure, slopes)
    if any(np.any(_open_entries(*pair, known)) for pair in pairs):
        factors = _moving(pairs, known.unit, factors)
        sentence = f"{seen} {'; nor of '.join([*words, *_factors_in_words(formulation, factors)])}"
        open_.append(left_open(sentence, seen=rank, directions=count, unknowns=x.size, unnamed=factors.shape[1]))
        open_ += [left_open(modal_mass_cone.UNIT_MASS)] if problem.unit_mass else []
        if problem.measurement.force is None and not problem.unit_mass and _scale_is_open(pairs, known):
            open_.append(left_open(_NO_SCALE))
    misfit = formulation.objective(x)
    if rank and misfit < EXACT and misfit > _LOOSE * known.singular_values[rank - 1]:
        (weakest,) = directions_in_words(formulation.unknowns, x, known.unit, known.seen[:, -1:])
        open_.append(left_open(f"the search ended at {misfit:.2g} of the records, by which {weakest} is hardly held"))
    if known.unseen.shape[1]:
        same = (f"{seen} {'; nor of '.join(words)}; {_SAME_MATRICES}",) if words else ()
        return ("the data and the written model fix mass, stiffness and damping", *same), tuple(open_)
    only = rank - sensitivity(formulation, x, slopes, priors=False).rank if formulation.priors else 0
    closed = (
        (x.size, f"the data and the written model fix all {x.size} unknowns"),
        (only, f"{only} of them by what is stated as known alone"),
        (x.size - count, f"{x.size - count} of them by constraints"),
    )
    fixing = ", ".join(sentence for number, sentence in closed if number)
    beyond = modal_mass_cone.beyond_in_words(problem.measurement, structure)
    sentences = f"{fixing} about this answer; what is written as a number counts as exact", beyond
    return sentences[: 1 + bool(structure.residual.count)], tuple(open_)


def _by_name(formulation: Formulation, directions: Array) -> tuple[Array, Array]:
    """The same space (size, count) by directions of unknowns that mean something by themselves, and the others."""
    without = directions[~meaningful(formulation)]
    lam, turn = np.linalg.eigh(without.T @ without)
    return directions @ turn[:, lam < NEGLIGIBLE**2], directions @ turn[:, lam >= NEGLIGIBLE**2]


def _moving(pairs: list[tuple[Array, Array]], unit: Array, directions: Array) -> Array:
    """The part of a space (size, count) that moves matrices: what scales all shares of a total moves none."""
    steps = unit[:, None] * directions
    moved = [
        slope.reshape(-1, len(unit)) @ steps / max(np.abs(matrix).max(), np.finfo(float).tiny)
        for matrix, slope in pairs
    ]
    lam, turn = np.linalg.eigh(sum(change.T @ change for change in moved))
    return directions @ turn[:, lam >= NEGLIGIBLE**2]


def _factors_in_words(formulation: Formulation, directions: Array) -> Iterator[str]:
    """Directions that move entries of factors or shares, which nobody gave: what takes part, and how many there are."""
    count = directions.shape[1]
    if count:
        moved = split(formulation.unknowns, np.abs(directions).max(axis=1) > NEGLIGIBLE)
        titles = [unknown.title for unknown, part in zip(formulation.unknowns, moved, strict=True) if np.any(part)]
        yield f"{', '.join(titles)} together, in {count} {'way' if count == 1 else 'ways'}"


def _scale_is_open(pairs: list[tuple[Array, Array]], known: Sensitivity) -> bool:
    """True where one factor for mass, stiffness and damping together is among what nothing sees."""
    sizes = [max(np.abs(matrix).max(), np.finfo(float).tiny) for matrix, _ in pairs]
    common = np.concatenate([matrix.ravel() / size for (matrix, _), size in zip(pairs, sizes, strict=True)])
    steps = known.unit[:, None] * known.unseen
    moved = np.concatenate([
        (slope @ steps).reshape(-1, steps.shape[1]) / size for (_, slope), size in zip(pairs, sizes, strict=True)
    ])  # fmt: skip
    left = common - moved @ np.linalg.lstsq(moved, common)[0]
    return bool(np.linalg.norm(left) < NEGLIGIBLE * np.linalg.norm(common))


def _open_entries(matrix: Array, slope: Array, known: Sensitivity) -> Array:
    """Which entries (n, n) of a matrix something unseen moves."""
    size = np.sqrt(np.abs(np.diag(matrix)))
    moved = np.abs(slope @ (known.unit[:, None] * known.unseen)).max(axis=-1, initial=0.0)
    return moved > NEGLIGIBLE * np.outer(size, size)


# -- of what else was found, and of variables beside ---------------------------------------------


def _open_outside(formulation: Formulation, x: Array | None) -> Iterator[str]:
    """Variables that enter no matrix and that no term sees, in a sentence."""
    if x is None or not np.any(formulation.outside):
        return
    known = of_outside(formulation, x)
    words = directions_in_words(outside_variables(formulation), x[formulation.outside], known.unit, known.unseen)
    if words:
        yield f"no term sees a change of {'; nor of '.join(words)}; {_SAME_MATRICES}"


def _others(problem: Prepared, structure: Structure, x: Array | None, rivals: Sequence[Array]) -> Iterator[Finding]:
    """Other answers whose matrices are others."""
    if x is None:
        return
    formulation = problem.formulation
    unit, named, labels = scales_of(formulation.unknowns, x), meaningful(formulation), formulation.labels
    for other in rivals:
        off = np.where(named, np.abs(other - x) / unit, 0.0)
        far = [j for j in np.argsort(-off, kind="stable")[:MOST_LISTED] if off[j] > SAME_ANSWER]
        values = ", ".join(f"{labels[j]} = {other[j]:.4g} in place of {x[j]:.4g}" for j in sorted(far))
        if _other_matrices(problem, structure, x, other):
            sentence = ": ".join(filter(None, ("another structure explains the data as well", values)))
            numbers = {labels[j]: float(other[j]) for j in sorted(far)}
            yield Finding("other answers", Severity.CAUTION, sentence, numbers=numbers)


def _other_matrices(problem: Prepared, mine: Structure, x: Array, other: Array) -> bool:
    """True where other unknowns stand for other matrices, beyond what noise leaves open, and not for the same ones."""
    try:
        its = problem.structure(other)
    except InputError:  # of no structure
        return False
    sizes = [np.sqrt(np.abs(np.diag(a))) + np.finfo(float).tiny for a in system_matrices(mine)]
    pairs = list(zip(system_matrices(mine), system_matrices(its), sizes, strict=True))
    if all(np.all(np.abs(a - b) <= SAME_ANSWER * np.outer(size, size)) for a, b, size in pairs):
        return False
    stds = _stds(problem, mine, x)
    far = most_deviations(sum(std.size for std in stds))
    return any(
        np.any(np.abs(a - b) > np.fmax(SAME_ANSWER * np.outer(size, size), far * std))  # NaN where something is open
        for (a, b, size), std in zip(pairs, stds, strict=True)
    )


def _stds(problem: Prepared, structure: Structure, x: Array) -> tuple[Array, ...]:
    """Standard deviations of M_SS, K_SS and C by the noise; zeros where they take minutes or nothing tells them."""
    try:
        if structure.mode_shapes.size <= LARGE:
            u = uncertainty(problem, structure, x)
            return u.mass, u.stiffness, u.damping
    except InputError:
        pass
    return tuple(np.zeros_like(a) for a in system_matrices(structure))
