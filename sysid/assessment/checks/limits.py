"""Limits of what was searched and fitted: boxes, lines that are left out, records that nothing fits."""

from __future__ import annotations

from collections.abc import Iterator

from sysid.assessment.checks.context import Context
from sysid.finding import Finding, Severity
from sysid.measurement.spectra import in_words


def search_boxes(context: Context) -> Iterator[Finding]:
    """Boxes in which a swarm searched that are not the usual ones."""
    # Other strategies search all between the bounds.
    if context.outcome is not None and any(phase.name == "swarm" for phase in context.outcome.history.phases):
        for unknown in context.problem.formulation.unknowns:
            if unknown.note:
                yield Finding("search box", Severity.NOTE, unknown.note)


def unfitted_records(context: Context) -> Iterator[Finding]:
    """Records that a misfit of the user's own replaces, and damping that nothing tells."""
    if context.outcome is None:
        return
    formulation = context.problem.formulation
    if not formulation.fits_records:
        sentence = "the problem states a misfit of its own; pictures and scores compare with the records as they are"
        yield Finding("own misfit", Severity.NOTE, sentence)
    if not formulation.tells_damping:
        sentence = "no damping ratio is identified: no unknown of the damping alone enters what is fitted"
        yield Finding("no damping ratio", Severity.NOTE, sentence)


def lines_left_out(context: Context) -> Iterator[Finding]:
    """Lines are left out for all channels, as a record holds NaN there."""
    if context.outcome is None:
        return
    problem, formulation = context.problem, context.problem.formulation
    # Not `formulation.tests`: the term of the problem's own test has matrices that the modal strategy has no use for.
    fitted = [problem.measurement] if formulation.fits_records else []
    tests = [*fitted, *(term.test for term in formulation.further_tests)]
    for i, test in enumerate(tests, start=problem.first_test):
        if test.dropped:
            where = f" ({in_words(test.holes, test.freq)})" if test.holes else ""
            which = "" if len(tests) == 1 else f" of test {i}"
            yield Finding(
                "lines left out", Severity.NOTE,
                f"{test.dropped} lines at which a record holds NaN are left out{which} for all channels alike{where}",
                numbers={"lines": float(test.dropped), "test": float(i)},
            )  # fmt: skip
