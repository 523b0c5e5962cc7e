"""Constraints: the relations that a problem is given, and the rows that a search keeps."""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from sysid.errors import InputError
from sysid.models.expressions import written_in
from sysid.models.unknowns import expression_of, user_site
from sysid.problem.terms import column_of
from sysid.structure.structure import Array


class Constraints(NamedTuple):
    """``lower <= function(x) <= upper``; `sources` names the constraint of each row, and its variables.

    Without constraints it has no rows.
    """

    function: ca.Function
    lower: Array
    upper: Array
    sources: tuple[str, ...]

    @property
    def equal(self) -> Array:
        """Which rows are equalities, (rows,)."""
        return self.lower == self.upper

    def at(self, x: Array) -> Array:
        """Values at `x`, (rows,)."""
        return np.asarray(self.function(x)).ravel()

    def violation(self, x: Array) -> Array:
        """By how much they leave their bounds at `x`, (rows,)."""
        values = self.at(x)
        return np.maximum(np.maximum(self.lower - values, values - self.upper), 0.0)


class ConstraintRow(NamedTuple):
    """A constraint ``lower <= expression <= 0``, an equality where `lower` is 0, and what messages call it."""

    expression: ca.MX
    lower: float
    source: str


def constraint_row(number: int, value: Any) -> ConstraintRow:
    """The row of a constraint that was given."""
    relation = expression_of(value)
    name = f"constraint {number}"
    kinds = {ca.OP_LE: -np.inf, ca.OP_LT: -np.inf, ca.OP_EQ: 0.0}
    lower = next((low for k, low in kinds.items() if isinstance(relation, ca.MX) and relation.is_op(k)), None)
    if lower is None:
        what = type(value).__name__ if not isinstance(value, ca.MX) else f"the expression {str(value)[:60]}"
        raise InputError(
            f"{name} is {what} ({user_site()}): a constraint is a relation of variables, such as "
            f"k[0] <= k[1] or ca.sum1(m) == 9{written_in(relation) if isinstance(relation, ca.MX) else ''}"
        )
    row = column_of(name, relation.dep(0) - relation.dep(1))
    return ConstraintRow(row, lower, name + written_in(relation, ","))
