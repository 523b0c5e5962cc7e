"""All checks of records and of fits: `CHECKS`, in the order of their weight.

A check looks at a `Context` and yields findings; what it is about stands in the first line of its docstring, of which
the table in docs/mistakes.md is made. Before a search there is no outcome, and checks of fits find nothing.
"""

from __future__ import annotations

from collections.abc import Iterable

from sysid.assessment.checks.against_records import records_of_fit
from sysid.assessment.checks.bounds import bounds_explain, keeping_bounds, on_a_bound, pressed_bounds
from sysid.assessment.checks.changing import changing_frequencies
from sysid.assessment.checks.context import Check, Context, Ended
from sysid.assessment.checks.exchanged import exchanged_sensors
from sysid.assessment.checks.gains import assumed_totals
from sysid.assessment.checks.goal import missed_goal
from sysid.assessment.checks.limits import lines_left_out, search_boxes, unfitted_records
from sysid.assessment.checks.model_error import beyond_noise, other_levels, unpredicted_tests
from sysid.assessment.checks.noise import noise_of_records
from sysid.assessment.checks.outliers import numbers_far_off
from sysid.assessment.checks.search_end import no_solution, search_notes, stopped, untried_modes
from sysid.assessment.checks.stated_mass import stated_masses
from sysid.assessment.checks.stated_values import missed_values
from sysid.assessment.checks.wrong_records import wrong_records
from sysid.errors import refuse
from sysid.finding import Finding, Severity
from sysid.problem.prepared import Prepared

CHECKS: tuple[Check, ...] = (
    wrong_records,
    stopped,
    keeping_bounds,
    changing_frequencies,
    stated_masses,
    missed_goal,
    beyond_noise,
    unpredicted_tests,
    missed_values,
    records_of_fit,
    pressed_bounds,
    no_solution,
    search_notes,
    untried_modes,
    on_a_bound,
    search_boxes,
    assumed_totals,
    other_levels,
    lines_left_out,
    noise_of_records,
    numbers_far_off,
    unfitted_records,
)
OF_THE_END: tuple[Check, ...] = (stopped, missed_goal, beyond_noise, no_solution)  # whether a search ended at a fit
QUICK: tuple[Check, ...] = (wrong_records, *OF_THE_END, *CHECKS[CHECKS.index(search_notes) :])


def run(context: Context, checks: Iterable[Check] = CHECKS) -> list[Finding]:
    """Run checks one after the other; what they found is added to the context, each finding once."""
    for check in checks:
        for one in check(context):
            if one not in context.found:
                context.found.append(one)
    return context.found


def check_records(problem: Prepared) -> tuple[Finding, ...]:
    """Mistakes that records show before a search, the worst first; nothing is prepared that no check asks for.

    Raises
    ------
    InputError
        Where one is blocking, so that a search would be in vain.
    """
    found = tuple(run(Context(problem)))
    refuse(*((one.severity is Severity.BLOCKING, str(one)) for one in found))
    return found


def mistakes_of_poor_fit(problem: Prepared, end: Ended) -> tuple[Finding, ...]:
    """Sensors that were swapped, where that explains what a search leaves, so that no other would do better."""
    pressed = bounds_explain(problem, end.structure, end.x)  # what they leave may look like swapped sensors
    return exchanged_sensors(problem, end.structure, wholly=pressed)
