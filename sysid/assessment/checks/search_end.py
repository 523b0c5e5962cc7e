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


def untried_modes(context: Context) -> Iterator[Finding]:
    """The fit of whole records was stopped before all modes were tried."""
    tests = () if context.outcome is None else context.problem.modal
    for number, modal in enumerate(tests, start=1):
        if modal.stopped:
            m = modal.omega.size
            finding = Finding(
                "modes not all tried", Severity.CAUTION,
                f"the fit of modes was stopped when it had {m}, before all that the records may show were tried",
                "let it end: without --max-time (max_time=), or with more", numbers={"modes": float(m)},
            )  # fmt: skip
            yield finding if len(tests) == 1 else finding.of_test(number)


def search_notes(context: Context) -> Iterator[Finding]:
    """Settings and steps of the search that the user should know of."""
    if context.outcome is not None:
        yield from (one for one in context.outcome.findings if one.severity in (Severity.CAUTION, Severity.NOTE))
