"""The end of a search: stopped, without a solution, short of its goal, within limits that the user should know of."""

from __future__ import annotations

from collections.abc import Iterator

from sysid.assessment.checks.context import Context, of_tests
from sysid.finding import Finding, Kind, Severity
from sysid.measurement.spectra import in_words
from sysid.structure.thresholds import UNEXPLAINED

_CONVENTIONS = (
    "are the frequencies in Hz, the responses absolute and complex with exp(+iwt), the axes and signs of rigid_body "
    "right, the bounds wide enough?"
)
_SCALE = (
    "without a base force or a mass in kg their scale is not determined, and masses are normalised to 1 kg in each "
    "base direction, which the bounds of the stiffness may exclude: state total_mass, or give the base force"
)


def stopped(context: Context) -> Iterator[Finding]:
    """The search was stopped before it found a fit."""
    end = context.end
    if end.stopped is not None and not end.success:
        yield _no_end("stopped", end.message)


def no_solution(context: Context) -> Iterator[Finding]:
    """The solver ended without a solution."""
    end = context.end
    if end.stopped is None and not end.success:
        yield _no_end("no solution", end.message)


def _no_end(kind: Kind, message: str) -> Finding:
    words = f"the search ended before it found a fit ({message}): these matrices are no more than the best until then"
    return Finding(kind, Severity.CONTRADICTS, words)


def untried_modes(context: Context) -> Iterator[Finding]:
    """The fit of whole records was stopped before all modes were tried."""
    yield from of_tests([[_untried(modal.omega.size)] * bool(modal.stopped) for modal in context.problem.modal])


def _untried(modes: int) -> Finding:
    return Finding(
        "modes not all tried", Severity.CAUTION,
        f"the fit of modes was stopped when it had {modes}, before all that the records may show were tried",
        "let it end: without --max-time (max_time=), or with more", numbers={"modes": float(modes)},
    )  # fmt: skip


def search_notes(context: Context) -> Iterator[Finding]:
    """Settings and steps of the search that the user should know of."""
    yield from (one for one in context.end.findings if one.severity in (Severity.CAUTION, Severity.NOTE))


def missed_goal(context: Context) -> Iterator[Finding]:
    """The residual is above the goal, or explains nothing, or a constraint does not hold."""
    end, problem = context.end, context.problem
    if end.x is not None and end.success and not problem.keeps_constraints(end.x):
        yield Finding("constraint", Severity.CONTRADICTS, "a constraint does not hold")
    goal, residual = problem.stated.goal, context.residual
    if goal is not None and residual > goal:
        sentence = f"the residual {residual:.3g} is above the goal {goal:.3g}"
        yield Finding("goal", Severity.CONTRADICTS, sentence, numbers={"residual": residual, "goal": goal})
    if goal is None and residual > UNEXPLAINED and end.stopped is None and (end.success or not context.cut_short):
        scaled = problem.unit_mass and not problem.formulation.stiffness.free
        sentence, why = f"the residual {residual:.3g} is no fit", _SCALE if scaled else _CONVENTIONS
        yield Finding("residual", Severity.CONTRADICTS, sentence, why, numbers={"residual": residual})


def search_boxes(context: Context) -> Iterator[Finding]:
    """Boxes in which a swarm searched that are not the usual ones."""
    # Other strategies search all between the bounds.
    if any(phase.name == "swarm" for phase in context.end.history.phases):
        for unknown in context.problem.formulation.unknowns:
            if unknown.note:
                yield Finding("search box", Severity.NOTE, unknown.note)


def unfitted_records(context: Context) -> Iterator[Finding]:
    """Records that a misfit of the user's own replaces, and damping that nothing tells."""
    formulation = context.problem.formulation
    if not formulation.fits_records:
        sentence = "the problem states a misfit of its own; pictures and scores compare with the records as they are"
        yield Finding("own misfit", Severity.NOTE, sentence)
    if not formulation.tells_damping:
        sentence = "no damping ratio is identified: no unknown of the damping alone enters what is fitted"
        yield Finding("no damping ratio", Severity.NOTE, sentence)


def lines_left_out(context: Context) -> Iterator[Finding]:
    """Lines are left out for all channels, as a record holds NaN there."""
    problem, formulation = context.problem, context.problem.formulation
    # Not `formulation.tests`: the term of the problem's own test has matrices that the modal strategy has no use for.
    fitted = [problem.measurement] * formulation.fits_records
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
