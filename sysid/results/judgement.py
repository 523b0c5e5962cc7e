"""Judgement of where a search ended: what checks find, what is determined, and how far noise leaves it known."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sysid.assessment.checks import OF_THE_END, QUICK, run
from sysid.assessment.checks.context import Context
from sysid.assessment.checks.gains import assumed, rests_on
from sysid.assessment.determination import BY_RANK, determine
from sysid.assessment.sensitivity import system_matrices
from sysid.assessment.uncertainty import LARGE
from sysid.finding import Finding, Severity, cautions, contradicting, is_fit, weightiest_first
from sysid.problem.prepared import Prepared
from sysid.problem.problem import Problem
from sysid.results.identification import Identification
from sysid.search.other_answers import with_other_answers
from sysid.search.session import Session, TimeIsOver, within
from sysid.search.strategy import Outcome
from sysid.structure.thresholds import EXACT

_KNOWN = 0.1  # of the root of two diagonal entries; an entry with a larger standard deviation is not known
_NOT_JUDGED = Finding(
    "not judged", Severity.CAUTION,
    "what data and model determine, and how far noise leaves it known, was not judged: the time was over",
    "give it more time (--max-time, max_time=)",
)  # fmt: skip


class Verdict(NamedTuple):
    """Verdict on where a search ended: a fit or why not, with what the solver says."""

    success: bool
    message: str


def judge(problem: Problem, prepared: Prepared, end: Outcome, why: str, seed: int, session: Session) -> Identification:
    """Judge where a search ended: `why` tells why its strategy was taken, the session has its log and clock."""
    context = Context(prepared, end, session.cut_short)
    verdict = verdict_of(context)
    session.log(f"done: {verdict.message}")
    try:
        with within(session.left):
            known = determine(prepared.screened, end.structure, end.x, end.alternatives)
            run(context)
        open_ = cautions(known.findings)
        if verdict.success and known.judged_by == BY_RANK and not (open_ or contradicting(context.found)):
            end = with_other_answers(prepared, end, session)
            with within(session.left):
                open_ = cautions(determine(prepared.screened, end.structure, end.x, end.alternatives).findings)
        closed = tuple(one for one in known.findings if one not in cautions(known.findings))
    except TimeIsOver:
        run(context, QUICK)
        open_, closed = (_NOT_JUDGED,), ()
    found = [*context.found, *end.findings, *open_]
    if not (contradicting(found) or cautions(found)):
        found = [*closed, *found, *assumed(prepared)]
    strategy, ending = Finding("strategy", Severity.NOTE, why), Finding("ending", Severity.NOTE, end.message)
    it = Identification(
        structure=end.structure,
        problem=problem,
        prepared=prepared,
        x=end.x,
        strategy=end.strategy,
        seed=seed,
        history=replace(end.history, log=tuple(session.lines), wall_time=session.seconds),
        findings=weightiest_first((strategy, *found, ending)),
        interrupted=session.interrupted or isinstance(end.stopped, KeyboardInterrupt),
    )
    try:
        with within(session.left):
            more = tuple(_check_precision(it))
            return it.with_findings(more) if more else it
    except TimeIsOver:
        return it.with_findings((_NOT_JUDGED,))


def verdict_of(context: Context) -> Verdict:
    """Judge where a search ended, by checks of the end of a search alone: a fit or not."""
    found, end = [one for check in OF_THE_END for one in check(context)], context.end
    wrong = [str(one) for one in contradicting(found) if one.kind not in ("stopped", "no solution")]
    # What the solver says stands first where it did not succeed, else last.
    return Verdict(is_fit(found), "; ".join((*wrong, end.message) if end.success else (end.message, *wrong)))


def _check_precision(it: Identification) -> Iterator[Finding]:
    """Entries that noise leaves open though they are fixed without it, and gains that what is determined rests on.

    Null directions of exact records are closed by their noise, and show as large standard deviations only.
    """
    if not it.determined:
        return
    exact = max(it.residual, it.force_residual or 0.0) < EXACT
    if it.x is not None and not it.prepared.free_modes:
        # A further test may be noisy, and what is stated as known always is.
        exact = exact and not it.prepared.formulation.priors and it.prepared.objective(it.x) < EXACT
    if exact:
        return
    if it.structure.mode_shapes.size > LARGE:
        sentence = "whether noise leaves each entry known was not judged, as that takes minutes: see uncertainty"
        yield Finding("noise not judged", Severity.NOTE, sentence)
        return
    u, open_ = it.uncertainty, False
    stds = (u.mass, u.stiffness, u.damping)
    for name, matrix, std in zip(("M_SS", "K_SS", "C"), system_matrices(it.structure), stds, strict=True):
        size = np.sqrt(np.diag(matrix))
        size[size == 0] = max(size.max(), np.finfo(float).tiny)  # a degree of freedom without a damper
        largest = float(np.max(std / np.outer(size, size)))
        if not largest <= _KNOWN:
            up_to = "open" if np.isnan(largest) else f"with standard deviations up to {100 * largest:.2g} %"
            sentence, open_ = f"noise leaves entries of {name} {up_to}", True
            yield Finding("noise", Severity.CAUTION, sentence, numbers={"largest": largest})
    if not open_ and it.prepared.formulation.fits_records:
        yield from rests_on(it.measurement, it.gains, it.gain_worth)
