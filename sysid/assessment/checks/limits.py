"""Limits of what was searched and fitted."""

from __future__ import annotations

from collections.abc import Iterator

from sysid.assessment.checks.context import Context
from sysid.finding import Finding, Severity


def search_boxes(context: Context) -> Iterator[Finding]:
    """Boxes in which a swarm searched that are not the usual ones."""
    # Other strategies search all between the bounds.
    if context.outcome is not None and any(phase.name == "swarm" for phase in context.outcome.history.phases):
        for unknown in context.problem.formulation.unknowns:
            if unknown.note:
                yield Finding("search box", Severity.NOTE, unknown.note)


def unfitted_records(context: Context) -> Iterator[Finding]:
    """Records that a misfit of the user's own replaces, and damping that nothing tells."""
    formulation = context.problem.formulation
    if context.outcome is not None and not formulation.fits_records:
        told = "the problem states a misfit of its own; pictures and scores compare with the records as they are"
        yield Finding("own misfit", Severity.NOTE, told)
    if context.outcome is not None and not formulation.tells_damping:
        told = "no damping ratio is identified: no unknown of the damping alone enters what is fitted"
        yield Finding("no damping ratio", Severity.NOTE, told)
