"""The unknowns of a problem that has its own, for the faces: value, 95 % interval, search space."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sysid.models.unknowns import split
from sysid.problem.formulation import labels_of
from sysid.results.identification import Identification

_ON_BOUND = 1e-6  # of the range
MANY = 60  # rows beyond which a terminal shows none


class Row(NamedTuple):
    """A scalar unknown; `std` is NaN where no record sees it."""

    label: str
    value: float
    std: float
    unit: str
    lower: float
    upper: float

    @property
    def on_bound(self) -> str:
        """The bound on which the value rests, "lower" or "upper", else nothing."""
        near = _ON_BOUND * (self.upper - self.lower)
        return "lower" if self.value - self.lower < near else "upper" if self.upper - self.value < near else ""


def stated_values(it: Identification) -> list[str]:
    """How far each value that was stated as known is missed, in words."""
    known = it.problem.formulation.known if it.problem.is_written else None
    if known is None or it.x is None:
        return []
    off = np.asarray(known(it.x)).ravel()
    return [
        f"{name} ends {z:+.2g} standard deviations from the value stated as known"
        for name, z in zip(it.problem.formulation.known_names, off, strict=True)
    ]


def rows_of(it: Identification) -> list[Row]:
    """A row a scalar unknown; none for a problem of models alone."""
    problem = it.problem
    if not problem.is_written or it.x is None:
        return []
    u = it.quick_uncertainty
    rows: list[Row] = []
    for variable, values in zip(problem.variables, split(problem.variables, it.x), strict=True):
        std = np.full(variable.size, np.nan) if u is None else np.ravel(u.variables[variable.name], order="F")
        rows += [
            Row(label, float(value), float(s), variable.unit, float(low), float(high))
            for label, value, s, low, high in zip(
                labels_of(variable), values, std, variable.lower, variable.upper, strict=True
            )
        ]
    return rows
