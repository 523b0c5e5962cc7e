"""The residual against a stated goal, or against what explains anything at all; constraints that do not hold."""

from __future__ import annotations

from collections.abc import Iterator

from sysid.assessment.checks.context import Context
from sysid.finding import Finding, Severity
from sysid.structure.thresholds import UNEXPLAINED

_CONVENTIONS = (
    "are the frequencies in Hz, the responses absolute and complex with exp(+iwt), the axes and signs of rigid_body "
    "right, the bounds wide enough?"
)
_SCALE = (
    "without a base force or a mass in kg their scale is not determined, and masses are normalised to 1 kg in each "
    "base direction, which the bounds of the stiffness may exclude: state total_mass, or give the base force"
)


def missed_goal(context: Context) -> Iterator[Finding]:
    """The residual is above the goal, or explains nothing, or a constraint does not hold."""
    end, problem = context.outcome, context.problem
    if end is None:
        return
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
