"""Constraints before a search: whether any point of the search space satisfies them, and how they scale."""

from __future__ import annotations

import casadi as ca
import numpy as np

from sysid.errors import InputError
from sysid.nlp import quiet_options
from sysid.problem.formulation import Formulation
from sysid.structure.structure import Array

HELD = 1e-6  # of a constraint's scale: what counts as satisfied


def scale_of(formulation: Formulation, points: Array) -> Array:
    """Variation of each constraint over the search space, (rows,)."""
    values = np.array([formulation.constraints.at(x) for x in points])
    with np.errstate(invalid="ignore"):
        spread = np.nanmax(np.abs(np.where(np.isfinite(values), values, np.nan)), axis=0, initial=0.0)
    return np.where(spread > 0, spread, 1.0)


def check_constraints(formulation: Formulation, points: Array, site: str) -> None:
    """Refuse constraints that no point satisfies."""
    constraints = formulation.constraints
    if not constraints.lower.size:
        return
    scale = scale_of(formulation, points)
    broken = np.array([constraints.violation(x) for x in points]) / scale
    order = np.argsort(np.sum(np.where(np.isfinite(broken), broken, np.inf) ** 2, axis=1))
    best, at = np.full(scale.size, np.inf), np.inf
    for x in points[order[:8]]:  # those that break them least
        left = _nearest(formulation, x, scale)
        if left.max(initial=0.0) < at:
            best, at = left, left.max(initial=0.0)
        if at <= HELD:
            return
    worst = dict.fromkeys(source for source, miss in zip(constraints.sources, best, strict=True) if miss > HELD)
    raise InputError(
        f"no point within the bounds satisfies {' and '.join(worst)} (problem at {site}): widen the bounds of these "
        "variables, or correct the relation"
    )


def _nearest(formulation: Formulation, start: Array, scale: Array) -> Array:
    """Least violation that IPOPT finds from a point, relative to the scale, (rows,)."""
    constraints, lower, upper = formulation.constraints, formulation.lower, formulation.upper
    width = np.where(upper > lower, upper - lower, 1.0)
    t = ca.MX.sym("t", formulation.size)
    slack = ca.MX.sym("slack", scale.size)
    g = constraints.function(ca.DM(lower) + ca.DM(width) * t) / ca.DM(scale)
    solver = ca.nlpsol(
        "feasible", "ipopt", {"x": ca.vertcat(t, slack), "f": ca.sumsqr(slack), "g": g - slack}, quiet_options(200)
    )
    first = (start - lower) / width
    answer = solver(
        x0=np.concatenate([first, np.zeros(scale.size)]), lbg=constraints.lower / scale, ubg=constraints.upper / scale,
        lbx=np.concatenate([np.zeros(first.size), np.full(scale.size, -np.inf)]),
        ubx=np.concatenate([np.where(upper > lower, 1.0, 0.0), np.full(scale.size, np.inf)]),
    )  # fmt: skip
    # Whatever the status, what counts is the violation at the point that came, put inside the box.
    found = np.clip(np.asarray(answer["x"]).ravel()[: first.size], 0.0, 1.0)
    broken = constraints.violation(lower + width * found) / scale
    return np.where(np.isfinite(broken), broken, np.inf)
