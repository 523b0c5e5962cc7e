"""The unknowns of a problem, for summary and report: value, 95 % interval, search space."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sysid.assessment.checks.bounds import sides_of
from sysid.results.answer import Answer

MANY = 60  # rows beyond which a terminal shows none


class Row(NamedTuple):
    """A scalar unknown; `std` is NaN where no record sees it, `side` the bound on which it rests, empty for none."""

    label: str
    value: float
    std: float
    unit: str
    lower: float
    upper: float
    side: str

    @property
    def on_bound(self) -> str:
        """Words for the bound on which the value rests: "on its lower bound"; nothing elsewhere."""
        return f"on its {self.side} bound" * bool(self.side)


def stated_values(it: Answer) -> list[str]:
    """Sentences on how far each value that was stated as known is missed."""
    return [f"{name} ends {z:+.2g} standard deviations from the value stated as known" for name, z in it.facts.misses]


def unknown_rows(it: Answer) -> list[Row]:
    """A row a scalar unknown that was searched and means something by itself: see `sysid.results.facts`."""
    if it.x is None:
        return []
    u = it.quick_uncertainty
    known = {} if u is None else u.variables
    rows: list[Row] = []
    for unknown in (one for one in it.facts.unknowns if not (one.fixed or one.is_ratio)):
        values = np.ravel(it.values[unknown.name], order="F")
        std = np.ravel(known.get(unknown.name, np.full(unknown.shape, np.nan)), order="F").tolist()
        units = [unknown.unit] * unknown.size
        bounds = unknown.lower.tolist(), unknown.upper.tolist()
        rows += map(
            Row, unknown.labels, values.tolist(), std, units, *bounds, sides_of(unknown.lower, unknown.upper, values)
        )
    return rows
