"""All checks of records and of fits: `CHECKS`, in the order of their weight.

A check looks at a `Context` and yields findings; what it is about stands in the first line of its docstring, of which
the table in docs/mistakes.md is made. Before a search the records alone are looked at (`check_records`).
"""

from __future__ import annotations

from collections.abc import Iterable

from sysid.assessment.checks.against_records import exchanged_sensors, records_of_fit
from sysid.assessment.checks.context import Check, Context, Ended
from sysid.assessment.checks.gains import assumed_totals
from sysid.assessment.checks.mistakes import mistakes_before_search, wrong_records
from sysid.assessment.checks.model_error import (
    beyond_noise,
    changing_frequencies,
    noise_of_records,
    numbers_far_off,
    other_levels,
    unpredicted_tests,
)
from sysid.assessment.checks.search_end import (
    lines_left_out,
    missed_goal,
    no_solution,
    search_boxes,
    search_notes,
    stopped,
    unfitted_records,
    untried_modes,
)
from sysid.assessment.checks.stated import (
    keeping_bounds,
    missed_values,
    on_a_bound,
    pressed_bounds,
    pressure_of,
    stated_masses,
)
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
    found = tuple(mistakes_before_search(problem))
    refuse(*((one.severity is Severity.BLOCKING, str(one)) for one in found))
    return found


def mistakes_of_poor_fit(problem: Prepared, end: Ended) -> tuple[Finding, ...]:
    """Sensors that were swapped, where that explains what a search leaves, so that no other would do better."""
    _, pressed = pressure_of(problem, end)  # what bounds leave may look like swapped sensors
    return exchanged_sensors(problem, end.structure, wholly=pressed.explains)
