"""Values that are stated as known, and that the fit misses."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sysid.assessment.checks.context import Context
from sysid.finding import Finding, Severity
from sysid.problem.formulation import Formulation
from sysid.structure.structure import Array
from sysid.structure.thresholds import beyond_chance


def missed_values(context: Context) -> Iterator[Finding]:
    """Stated masses, or values stated as known, cannot be met together with the records."""
    if context.outcome is not None and not context.has("bounds"):
        yield from (one for one in context.outcome.findings if one.kind == "stated masses")
    if not context.is_explained and context.end.x is not None:
        formulation, x = context.problem.formulation, context.end.x
        yield from _priors(formulation, x)
        yield from (one for term in formulation.beside for one in term.findings(x))


def _priors(formulation: Formulation, x: Array) -> Iterator[Finding]:
    """Values that are stated as known, where errors as stated do not miss them all so far."""
    names = [name for term in formulation.priors for name in term.labels]
    off = np.concatenate([np.zeros(0), *(term.numbers(x) for term in formulation.priors)])
    if np.sum(off**2) > beyond_chance(off.size) and not any(term.findings(x) for term in formulation.priors):
        missed = ", ".join(f"{name} by {z:+.2g}" for name, z in zip(names, off, strict=True))
        yield Finding(
            "stated values", Severity.CONTRADICTS,
            f"the values that are stated as known are missed together, in standard deviations: {missed}",
            "they, another number, or the model is wrong",
            numbers=dict(zip(names, off.tolist(), strict=True)),
        )  # fmt: skip
