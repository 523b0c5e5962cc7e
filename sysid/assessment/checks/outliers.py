"""Numbers of the records that are far from the fit."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from sysid.assessment.checks.context import Context
from sysid.finding import Finding, Severity
from sysid.modal_analysis.outliers import HUBER


def numbers_far_off(context: Context) -> Iterator[Finding]:
    """Numbers far from the fit: all where they count little, else those that stand alone."""
    if context.outcome is None:
        return
    end, problem = context.outcome, context.problem
    remedy = ""
    if problem.stated.loss == "squares":
        what, remedy = (
            ", while the lines beside them fit",
            ("if they are spikes or drop-outs, state Problem(..., loss='huber'), or leave these lines out"),
        )
    elif any(phase.name == HUBER for phase in end.history.phases):
        what = ": they count little, by Huber's loss"
    else:
        what = (
            ": the search ended before Huber's loss, so they count in full; those that stand alone were left out from "
            "the beginning"
        )
    every = problem.outliers(end.structure, end.x)
    for i, modal, _ in context.fits:
        found = [one for one in every if one.test == i]
        if not found:
            continue
        numbers = modal.records.numbers
        which = "the records" if len(context.fits) == 1 else f"test {i}"
        channels = ", ".join(f"{name} {count}" for name, count in Counter(one.channel for one in found).most_common(4))
        yield Finding(
            "outliers", Severity.NOTE,
            f"{len(found)} of {numbers} numbers of {which} are up to {found[0].size:.3g} deviations from the fit "
            f"({found[0].channel} at {found[0].freq:.5g} Hz; by channel {channels}){what}",
            remedy, run=found[0].run, channel=found[0].channel,
            numbers={
                "count": float(len(found)), "deviations": float(found[0].size), "frequency": float(found[0].freq),
                "test": float(i),
            },
        )  # fmt: skip
