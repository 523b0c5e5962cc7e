"""The end of a search: stopped, without a solution, and what it tells of itself."""

from __future__ import annotations

from collections.abc import Iterator

from sysid.assessment.checks.context import Context
from sysid.finding import Finding, Kind, Severity


def stopped(context: Context) -> Iterator[Finding]:
    """The search was stopped before it found a fit."""
    end = context.outcome
    if end is not None and end.stopped is not None and not end.success:
        yield _no_end("stopped", end.message)


def no_solution(context: Context) -> Iterator[Finding]:
    """The solver ended without a solution."""
    end = context.outcome
    if end is not None and end.stopped is None and not end.success:
        yield _no_end("no solution", end.message)


def _no_end(kind: Kind, message: str) -> Finding:
    words = f"the search ended before it found a fit ({message}): these matrices are no more than the best until then"
    return Finding(kind, Severity.CONTRADICTS, words)


def search_notes(context: Context) -> Iterator[Finding]:
    """Settings and steps of the search that the user should know of."""
    if context.outcome is not None:
        yield from (one for one in context.outcome.findings if one.severity in (Severity.CAUTION, Severity.NOTE))
