"""Lines at which a record holds NaN."""

from __future__ import annotations

from collections.abc import Iterator

from sysid.assessment.checks.context import Context
from sysid.finding import Finding, Severity
from sysid.measurement.missing import in_words


def lines_left_out(context: Context) -> Iterator[Finding]:
    """Lines are left out for all channels, as a record holds NaN there."""
    problem, formulation = context.problem, context.problem.formulation
    if context.outcome is None:
        return
    # Not `formulation.tests`: the term of the problem's own test has matrices that the modal strategy has no use for.
    own = [problem.measurement] if formulation.fits_records else []
    tests = [*own, *(term.test for term in formulation.further_tests)]
    for i, test in enumerate(tests, start=problem.first_test):
        if test.dropped:
            where = f" ({in_words(test.holes, test.freq)})" if test.holes else ""
            which = "" if len(tests) == 1 else f" of test {i}"
            yield Finding(
                "lines left out", Severity.NOTE,
                f"{test.dropped} lines at which a record holds NaN are left out{which} for all channels alike{where}",
                numbers={"lines": float(test.dropped), "test": float(i)},
            )  # fmt: skip
