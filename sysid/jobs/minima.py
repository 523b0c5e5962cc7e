"""Ends of many jobs together: the distinct minima of many starts, and the spread of many draws of noise."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sysid.assessment.sensitivity import meaningful
from sysid.errors import InputError
from sysid.jobs.job import JobResult
from sysid.problem.prepared import Prepared
from sysid.results.identification import Identification
from sysid.results.tables import changes_by_laws, linear_deviations, quantities
from sysid.search.continuation import apart
from sysid.search.other_answers import entries_apart
from sysid.structure.structure import Structure
from sysid.structure.thresholds import EXACT, LIKELY, NEGLIGIBLE, SAME_ANSWER


@dataclass(frozen=True, eq=False)
class Minimum:
    """Ends of jobs that are one.

    Attributes
    ----------
    results : tuple of JobResult
        By index.
    """

    results: tuple[JobResult, ...]

    @property
    def best(self) -> JobResult:
        """The end with the least residual; among those that differ by round-off the first by index."""
        least = max((1 + NEGLIGIBLE) * min(result.residual for result in self.results), EXACT)
        return next(result for result in self.results if result.residual <= least)

    @property
    def residual(self) -> float:
        """Of the best."""
        return self.best.residual


def distinct(problem: Prepared, results: Iterable[JobResult]) -> list[Minimum]:
    """Minima that the jobs of one problem ended in, the least residual first; jobs without a result are left out.

    Ends are of one minimum where the matrices agree, and all unknowns that mean something by themselves: of shares of a
    total only the ratios count.
    """
    groups: list[tuple[Structure, list[JobResult]]] = []
    named = meaningful(problem.formulation)
    ended = (result for result in results if result.x.size)
    for result in sorted(ended, key=lambda one: (max(one.residual, EXACT), one.index)):
        structure = problem.structure(result.x)
        for first, group in groups:
            x = np.where(named, result.x, group[0].x)
            if apart(problem, x, group[0].x) < SAME_ANSWER and _matrices_apart(structure, first) < SAME_ANSWER:
                group.append(result)
                break
        else:
            groups.append((structure, [result]))
    return [Minimum(tuple(sorted(group, key=lambda one: one.index))) for _, group in groups]


def _matrices_apart(one: Structure, other: Structure) -> float:
    """Largest difference of entries of M, K and C, each over the root of the two diagonal entries."""
    pairs = ((one.mass, other.mass), (one.stiffness, other.stiffness), (one.damping, other.damping))
    return max(entries_apart(a, b, np.maximum(np.abs(np.diag(a)), np.abs(np.diag(b)))) for a, b in pairs)


def as_good(minima: list[Minimum]) -> list[Minimum]:
    """Minima that fit as well as the best one, it included."""
    most = max((1 + SAME_ANSWER) * minima[0].residual, EXACT) if minima else np.nan
    return [minimum for minimum in minima if minimum.residual <= most]


@dataclass(frozen=True)
class Spread:
    """A quantity in many draws beside its linear uncertainty.

    Attributes
    ----------
    name : str
    value : float
        As identified.
    std : float
        Standard deviation to first order; NaN where it is not known.
    drawn : float
        Standard deviation of the draws about `value`.
    inside : float
        Share of the draws within 1.96 of `std` about `value`: 0.95 where the linear interval is right.
    """

    name: str
    value: float
    std: float
    drawn: float
    inside: float

    @property
    def ratio(self) -> float:
        """Of both standard deviations, 1 where the linear one is right; NaN where it is not known."""
        return self.drawn / self.std if self.std > 0 else np.nan


def spreads(result: Identification, ends: Sequence[JobResult]) -> list[Spread]:
    """Frequencies, damping ratios, unknowns and laws of amplitude of a result in the draws that succeeded.

    Raises
    ------
    InputError
        Where fewer than two draws did.
    """
    found = [end for end in ends if end.success]
    if len(found) < 2:
        raise InputError(f"{len(found)} of {len(ends)} draws have a result; two are needed for a spread")
    stds = linear_deviations(result, result.uncertainty)
    unchanged = dict.fromkeys(changes_by_laws(result.structure), 0.0)  # of a draw whose modes have no law
    draws = [_quantities(result, end) if end.score is None else unchanged | end.score.values for end in found]
    rows = []
    for name, value in quantities(result).items():
        if name not in draws[0]:  # a law, where draws fit the unknowns alone
            continue
        off, std = np.array([draw[name] for draw in draws]) - value, stds.get(name, np.nan)
        inside = float(np.mean(np.abs(off) <= LIKELY * std)) if np.isfinite(std) else np.nan
        rows.append(Spread(name, value, std, float(np.sqrt(np.mean(off**2))), inside))
    return rows


def _quantities(result: Identification, end: JobResult) -> dict[str, float]:
    """`quantities` of an end of the problem of a result, by its unknowns."""
    return quantities(replace(result, x=end.x, structure=result.problem.structure(end.x)))
