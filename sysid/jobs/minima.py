"""Where many starts ended: distinct minima, and how often each was reached."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from sysid.jobs.job import JobResult
from sysid.nlp import EXACT
from sysid.problem.problem import Problem
from sysid.search.continuation import apart

_ONE = 1e-3  # of an unknown's size: ends nearer to each other are one minimum
_ALIKE = 1e-3  # relative difference of residuals up to which minima fit alike


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
        """The end with the least residual."""
        return min(self.results, key=lambda result: result.residual)

    @property
    def residual(self) -> float:
        """Of the best."""
        return self.best.residual


def distinct(problem: Problem, results: Iterable[JobResult]) -> list[Minimum]:
    """Minima that the jobs of one problem ended in, the least residual first; jobs without a result are left out."""
    groups: list[list[JobResult]] = []
    ended = (result for result in results if result.x.size)
    for result in sorted(ended, key=lambda one: (one.residual, one.index)):
        for group in groups:
            if apart(problem, result.x, group[0].x) < _ONE:
                group.append(result)
                break
        else:
            groups.append([result])
    return [Minimum(tuple(sorted(group, key=lambda one: one.index))) for group in groups]


def as_good(minima: list[Minimum]) -> list[Minimum]:
    """Minima that fit as well as the best one, it included."""
    most = max((1 + _ALIKE) * minima[0].residual, EXACT) if minima else np.nan
    return [minimum for minimum in minima if minimum.residual <= most]
