"""All checks of records and of fits: `CHECKS`, in the order of their weight.

A check looks at a `Context` and yields findings; what it is about stands in the first line of its docstring, of which
the table in docs/mistakes.md is made. Before a search the records alone are looked at (`mistakes.check_records`).
"""

from __future__ import annotations

from sysid.assessment.checks import (
    against_records,
    brackets,
    damaged_samples,
    gains,
    mistakes,
    model_error,
    rocking,
    search_end,
    stated,
)
from sysid.assessment.checks.context import Check

CHECKS: tuple[Check, ...] = (
    mistakes.late_channels,
    mistakes.wrong_records,
    damaged_samples.damaged_channels,
    gains.base_sensors,
    search_end.stopped,
    stated.keeping_bounds,
    model_error.changing_frequencies,
    model_error.laws_of_amplitude,
    rocking.rocking_tables,
    brackets.soft_brackets,
    stated.stated_masses,
    search_end.missed_goal,
    model_error.beyond_noise,
    model_error.least_squares,
    model_error.unpredicted_tests,
    stated.missed_values,
    against_records.records_of_fit,
    stated.pressed_bounds,
    search_end.no_solution,
    search_end.search_notes,
    search_end.untried_modes,
    stated.on_a_bound,
    search_end.search_boxes,
    gains.modes_below,
    model_error.other_levels,
    search_end.lines_left_out,
    model_error.noise_of_records,
    model_error.numbers_far_off,
    search_end.unfitted_records,
)
OF_THE_END: tuple[Check, ...] = (
    search_end.stopped,
    search_end.missed_goal,
    model_error.beyond_noise,
    search_end.no_solution,
)  # whether a search ended at a fit
_OF_RECORDS, _NOTES = CHECKS[: CHECKS.index(search_end.stopped)], CHECKS[CHECKS.index(search_end.search_notes) :]
QUICK: tuple[Check, ...] = (*_OF_RECORDS, *OF_THE_END, *_NOTES)
