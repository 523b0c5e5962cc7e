"""The unknowns of a problem as variables of a nonlinear program, each in units of its scale."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from sysid.models.unknowns import Unknown, scales_of, split
from sysid.nlp import NonlinearProgram
from sysid.structure.structure import Array


def add_unknowns(z: NonlinearProgram, unknowns: Sequence[Unknown], x: Array, held: slice = slice(0, 0)) -> ca.MX:
    """The unknowns as expressions of new ones in units of their scale, those in `held` as numbers."""
    pieces, at = [], 0
    for unknown, values in zip(unknowns, split(unknowns, x), strict=True):
        if held.start <= at < held.stop:
            pieces.append(ca.MX(ca.DM(values)))
        else:
            unit = scale_of_unknown(unknown, values)
            labels = [label.removeprefix(unknown.title) for label in unknown.labels]
            scaled = z.variable(unknown.title, values / unit, unknown.lower / unit, unknown.upper / unit, labels)
            pieces.append(scaled * ca.DM(unit))
        at += unknown.size
    return ca.vertcat(*pieces)


def scale_of_unknown(unknown: Unknown, values: Array) -> Array:
    """Unit in which IPOPT counts an unknown: its start, or a part of its range where that is larger."""
    unit = scales_of([unknown], values)
    return np.where(unit > 0, unit, 1.0)
