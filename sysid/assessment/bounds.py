"""Unknowns that end on a bound, and whether their bounds explain a misfit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from sysid.assessment.gains import distinct_poles
from sysid.assessment.sensitivity import left_by_constraints
from sysid.modal_analysis.residues import Records, beyond_chance
from sysid.models.stiffness import FREQUENCY_WINDOW
from sysid.models.unknowns import Unknown, scales_of, slices_of
from sysid.nlp import EXACT
from sysid.problem.problem import Problem
from sysid.problem.slopes import Rows, stacked_rows
from sysid.structure.structure import Array, Structure

NEAR = 1e-6  # of an unknown's range: nearer than that it rests on the bound ..
_CLOSE = 1e-4  # .. and, where the range spans decades, of the bound itself
_SHARE = 0.25  # of the squared misfit: bounds that explain less, to first order, are not its cause
_MOST = 8  # unknowns named
_NONE = 1e-9  # of a unit: an unknown that moves less is held by the constraints alone


class OnBound(NamedTuple):
    """An unknown that ends on a bound.

    Attributes
    ----------
    name, entry : str
        Of the unknown and its entry: "damping ratio" and "3", "k" and "[0]".
    side : {"lower", "upper"}
    bound : str
        With its unit.
    source : str
        Who states it: a model's name, or the place where a variable is declared.
    place : int
        In x; -1 for a natural frequency, which is none of the problem's unknowns.
    """

    name: str
    entry: str
    side: str
    bound: str
    source: str
    place: int


def sides_of(lower: Array, upper: Array, values: Array, *, relative: bool = False) -> list[str]:
    """The bound on which each of some values rests: "lower", "upper", or "" for none.

    Of a `relative` unknown, whose ratios alone count, entries in units of the largest rest on a positive lower bound or
    on none.
    """
    if relative:
        values = values / np.abs(values).max()
    near = [
        np.minimum(NEAR * (upper - lower), np.where(end == 0, np.inf, _CLOSE * np.abs(end))) for end in (lower, upper)
    ]
    low, high = values - lower < near[0], upper - values < near[1]
    if relative:
        low, high = low & (lower > 0), np.zeros_like(high)
    return ["lower" if a else "upper" if b else "" for a, b in zip(low, high, strict=True)]


def on_bounds(problem: Problem, structure: Structure, x: Array | None) -> list[OnBound]:
    """Unknowns that end on bounds which the search kept: those of models, variables, and stated frequencies.

    Parameters
    ----------
    problem : Problem
    structure : Structure
        The answer.
    x : (n_variables,) or None
        The unknowns that stand for it; None where the modal strategy chose other degrees of freedom.
    """
    formulation, stiffness = problem.formulation, problem.formulation.parts.stiffness
    models = [type(model).__name__ for model in problem.models]
    sources = [name for name, group in zip(models, formulation.of_models, strict=True) for _ in group]
    sources += [v.declared for v in formulation.variables if not v.fixed]
    found: list[OnBound] = []
    for unknown, part, source in zip(formulation.unknowns, slices_of(formulation.unknowns), sources, strict=True):
        # Modes stand for a free stiffness, and for a mass where modes are free: their entries are held by no bound.
        of_stiffness = formulation.stiffness.free and stiffness.start <= part.start < stiffness.stop
        if of_stiffness or (problem.free_modes and part.start < stiffness.stop):
            continue
        damping = formulation.damping.free and part == formulation.parts.damping
        values = x[part] if x is not None else structure.damping_ratios[: unknown.size] if damping else None
        for i, side in enumerate(_sides(unknown, values)):
            if side:
                bound = f"{getattr(unknown, side)[i]:.4g} {unknown.unit}".strip()
                index = unknown.labels[i].removeprefix(unknown.title)
                found.append(OnBound(unknown.title, index, side, bound, source, part.start + i))
    return [*found, *_on_windows(problem, structure)]


def _sides(unknown: Unknown, values: Array | None) -> list[str]:
    """The same of an unknown, of as many entries as are known."""
    if values is None:
        return []
    return sides_of(unknown.lower[: values.size], unknown.upper[: values.size], values, relative=unknown.relative)


def _on_windows(problem: Problem, structure: Structure) -> Iterator[OnBound]:
    """Natural frequencies on the edge of what a stated one may be wrong by."""
    spectrum, found = problem.formulation.stiffness.spectrum, 2 * np.pi * structure.natural_frequencies
    if spectrum is None:
        return
    count, window = min(spectrum.size, found.size), np.log1p(FREQUENCY_WINDOW)
    off = np.log(found[:count] / spectrum[:count])
    for i in np.flatnonzero(np.abs(np.abs(off) - window) < NEAR * window):
        edge = f"{found[i] / (2 * np.pi):.5g} Hz, {100 * FREQUENCY_WINDOW:g} % from the one stated or found in the data"
        name = type(problem.stiffness).__name__
        yield OnBound("natural frequency", f" {i + 1}", "upper" if off[i] > 0 else "lower", edge, name, -1)


def told(found: Sequence[OnBound]) -> str:
    """The unknowns with their bounds, in words: "spring 2, 3 (upper, 1e+06 N/m)"."""
    groups: dict[tuple[str, str, str], list[str]] = {}
    for one in found:
        groups.setdefault((one.name, one.side, one.bound), []).append(one.entry)
    words = []
    for (name, side, bound), indices in groups.items():
        more = len(indices) - _MOST
        words.append(f"{name}{','.join(indices[:_MOST])}" + f" and {more} more" * (more > 0) + f" ({side}, {bound})")
    more = len(words) - _MOST
    return ", ".join(words[:_MOST]) + f" and {more} more" * (more > 0)


def pressed_in_words(found: Sequence[OnBound]) -> str:
    """That bounds keep the fit from the records, and what to do, in a sentence."""
    sources = dict.fromkeys(one.source for one in found)
    return (
        f"bounds keep the fit from the records: {told(found)}; widen them first ({', '.join(sources)}): the truth lies "
        "beyond, or these unknowns make up for something else that is wrong, which is not judged before"
    )


class Pressure(NamedTuple):
    """What is gained, to first order, if unknowns on bounds may pass them.

    ``share`` is that of the squared misfit; ``significant`` that noise does not gain as much by chance.
    """

    share: float
    significant: bool

    @property
    def explains(self) -> bool:
        """Whether the bounds are a cause of the misfit."""
        return self.significant and self.share >= _SHARE


def pressure(problem: Problem, structure: Structure, x: Array | None, found: Sequence[OnBound]) -> Pressure:
    """How much of the misfit unknowns on bounds would take away.

    The squared misfit less that of the linear least squares about x: with all unknowns free, over those with the ones
    on bounds held. Where modes are free the misfit of free residues, at the structure's poles over those at the data's.

    Parameters
    ----------
    problem : Problem
    structure : Structure
    x : (n_variables,) or None
        The answer.
    found : sequence of OnBound
    """
    places = [one.place for one in found if one.place >= 0]
    if not found:
        return Pressure(0.0, significant=False)
    if x is None or problem.free_modes:
        return _of_poles(problem, structure, len(found))
    if not places:  # a window about a stated frequency, which is no unknown of the problem's
        return Pressure(1.0, significant=True)
    rows = _rows(problem, x)
    size = float(np.sum(rows.residuals**2))
    if size <= EXACT**2:
        return Pressure(0.0, significant=False)
    unit = scales_of(problem.formulation.unknowns, x)
    J = rows.jacobian * unit
    free = left_by_constraints(problem.formulation, x, unit, J, np.full(x.size, True))
    _, s, Vt = np.linalg.svd(free[places])
    held = free @ Vt[int(np.count_nonzero(s > _NONE)) :].T  # what moves no unknown on a bound
    gained = _explained(J @ free, rows.residuals) - _explained(J @ held, rows.residuals)
    noise = float(np.mean(rows.std**2))
    return Pressure(gained / size, significant=gained > noise * beyond_chance(len(places)))


def _of_poles(problem: Problem, structure: Structure, count: int) -> Pressure:
    """The same of modes with free shapes, by `count` unknowns on bounds."""
    records, poles = Records(problem.measurement), distinct_poles(structure)
    own = records.fit(*poles)
    if problem.geometry.pole_ratios.size == 0 or own.squared_error <= EXACT**2 * records.size:
        return Pressure(0.0, significant=False)
    gained = own.squared_error - problem.geometry.poles.residual**2 * records.size
    noise = records.noise(own.left, own.residues.size)
    return Pressure(gained / own.squared_error, significant=bool(gained > noise * beyond_chance(count)))


def _explained(J: Array, residuals: Array) -> float:
    """Squares of the residuals that the columns of J explain."""
    return float(np.sum((J @ np.linalg.lstsq(J, residuals, rcond=1e-9)[0]) ** 2)) if J.shape[1] else 0.0


def _rows(problem: Problem, x: Array) -> Rows:
    """All that is fitted, with its slopes."""
    formulation, rows = problem.formulation, []
    if formulation.fits_records:
        rows.append(formulation.own_test.linearised(x))
    for term in formulation.beside:
        noise = float(np.sqrt(np.mean(rows[0].std ** 2))) if rows else np.nan
        rows.append(term.linearised(x, noise))
    return stacked_rows(rows)
