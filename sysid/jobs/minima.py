"""Where many starts ended: distinct minima, and how often each was reached."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from sysid.assessment.sensitivity import meaningful
from sysid.jobs.job import JobResult
from sysid.problem.prepared import Prepared
from sysid.search.continuation import apart
from sysid.structure.structure import Structure
from sysid.structure.thresholds import EXACT, NEGLIGIBLE, SAME_ANSWER


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
    most = 0.0
    for name in ("mass", "stiffness", "damping"):
        a, b = getattr(one, name), getattr(other, name)
        size = np.sqrt(np.maximum(np.abs(np.diag(a)), np.abs(np.diag(b))))
        size[size == 0] = size.max() or 1.0  # a base without mass
        most = max(most, float(np.max(np.abs(a - b) / np.outer(size, size))))
    return most


def as_good(minima: list[Minimum]) -> list[Minimum]:
    """Minima that fit as well as the best one, it included."""
    most = max((1 + SAME_ANSWER) * minima[0].residual, EXACT) if minima else np.nan
    return [minimum for minimum in minima if minimum.residual <= most]
