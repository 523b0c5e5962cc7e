"""Context of checks: a problem, its modes, and where a search ended."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

from sysid.assessment.checks.noise_multiples import Miss, misses_of
from sysid.finding import Finding, Severity, contradicting
from sysid.modal_analysis.modal_estimate import ModalEstimate
from sysid.problem.prepared import Prepared
from sysid.structure.structure import Array, Structure


class Ended(Protocol):
    """Where a search ended, as far as checks ask: see `sysid.search.strategy.Outcome`."""

    @property
    def structure(self) -> Structure:
        """The best structure."""

    @property
    def x(self) -> Array | None:
        """The unknowns that stand for it."""

    @property
    def success(self) -> bool:
        """Of the last solver."""

    @property
    def message(self) -> str:
        """The solver's message."""

    @property
    def stopped(self) -> BaseException | None:
        """The exception that ended it early."""

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The findings of the search."""

    @property
    def history(self) -> Any:
        """The phases that ran."""


@dataclass(frozen=True, eq=False)
class Context:
    """A problem with its outcome, and the findings of the checks that ran before.

    Attributes
    ----------
    problem : Prepared
        With what its records tell of the modes, which nothing asks before a search.
    outcome : Outcome or None
        None before a search.
    cut_short : bool
        The time was over: a poor fit is blamed on nothing else.
    found : list of Finding
        Of the checks before, which may explain what a later one would tell.
    """

    problem: Prepared
    outcome: Ended | None = None
    cut_short: bool = False
    found: list[Finding] = field(default_factory=list)

    @property
    def modal(self) -> ModalEstimate:
        """The modal estimate of the problem's own records."""
        return self.problem.modal[0]

    @property
    def end(self) -> Ended:
        """The outcome, of which there is one."""
        assert self.outcome is not None
        return self.outcome

    @property
    def is_judged(self) -> bool:
        """True where a search ended by itself; what was stopped on its way has misfits of another kind."""
        end = self.outcome
        if end is None or end.stopped is not None:
            return False
        return end.success or (self.problem.free_modes and not self.cut_short)

    @cached_property
    def named(self) -> tuple[Finding, ...]:
        """Mistakes that were named before or by the search: they explain what else speaks against the fit."""
        return tuple(one for one in contradicting(self.end.findings) if one.kind != "stated masses")

    @property
    def is_explained(self) -> bool:
        """True where nothing more is to be told: no fit to judge, bounds that keep it, or a mistake that was named.

        Beside that mistake averages over segments are looked at all the same, for their leakage.
        """
        if not self.is_judged or self.has("bounds"):
            return True
        return bool(self.named) and not self.problem.screened.measurement.averaged

    def has(self, *kinds: str) -> bool:
        """True where a check before has found one of these."""
        return any(one.kind in kinds for one in self.found)

    @cached_property
    def residual(self) -> float:
        """Relative residual of the accelerations, or of the user's own misfit."""
        problem, end = self.problem, self.end
        if end.x is None or problem.free_modes:
            return problem.screened.measurement.residual(end.structure)
        return problem.residual(end.x)

    @cached_property
    def misses(self) -> list[Miss]:
        """Misfit of the answer to each record in units of its noise; none of a search that was stopped."""
        end = self.end
        return misses_of(self.problem, end.structure, end.x) if end.stopped is None else []

    @property
    def weight(self) -> Severity:
        """Severity of an error of the model: a stated goal that is met accepts it."""
        goal = self.problem.stated.goal
        return Severity.CAUTION if goal is not None and self.residual <= goal else Severity.CONTRADICTS

    @cached_property
    def fits(self) -> list[tuple[int, ModalEstimate, Structure]]:
        """Number, from 1, and modal estimate of each test that is fitted, and the structure as it was in it."""
        problem, end = self.problem, self.end
        pairs = problem.fits(end.structure, end.x)
        return [(i, *pair) for i, pair in enumerate(pairs, start=problem.first_test)]


Check = Callable[[Context], Iterator[Finding]]
