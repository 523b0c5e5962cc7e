"""Nonlinear least squares from many starts at once, without derivatives: for small problems whose least is zero."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sysid.structure.structure import Array
from sysid.structure.thresholds import EPSILON

_FIRST, _LEAST, _MOST = 1e-2, 1e-12, 1e8  # damping of a step, in squared singular values
_LESS, _MORE = 0.2, 5.0  # its change after a step that was taken, and after one that was not


@dataclass(eq=False)
class LeastSquares:
    """Levenberg and Marquardt's method from many starts in the unit box, all stepping together.

    Parameters
    ----------
    rows : callable
        (count, p) to residuals (count, m); what is not finite is never stepped to. What one point gives must not
        depend on the others.
    points : (count, p)
        Starts within [0, 1]; then where each has come.

    Attributes
    ----------
    left : (count,)
        Norm of the residuals there.
    idle : (count,)
        Which have come to rest, as no step lowers what is left.
    """

    rows: Callable[[Array], Array]
    points: Array

    def __post_init__(self) -> None:
        self._values = self.rows(self.points)
        self.left = _norms(self._values)
        self.damping = np.full(len(self.points), _FIRST)
        self.idle: NDArray[np.bool_] = ~np.isfinite(self.left)

    def step(self) -> None:
        """One step of all that are not idle."""
        at = np.flatnonzero(~self.idle)
        if not at.size:
            return
        x, r = self.points[at], self._values[at]
        J = self._slopes(x, r)
        # A bound that a point lies on, and that its descent presses against, holds that unknown.
        down = -np.einsum("cmp,cm->cp", J, r)
        held = ((x <= 0) & (down < 0)) | ((x >= 1) & (down > 0))
        J = np.where(held[:, None, :], 0.0, J)
        square = np.einsum("cmp,cmq->cpq", J, J)
        size = np.einsum("cpp->cp", square)
        size = np.maximum(size, 1e-12 * size.max(axis=1, keepdims=True)) + np.finfo(float).tiny
        damped = square + (self.damping[at, None] * size)[:, :, None] * np.eye(x.shape[1])
        move = np.linalg.solve(damped, np.where(held, 0.0, down)[:, :, None])[:, :, 0]
        new = np.clip(x + move, 0.0, 1.0)
        values = self.rows(new)
        left = _norms(values)
        better = left < self.left[at]
        taken = at[better]
        self.points[taken], self._values[taken], self.left[taken] = new[better], values[better], left[better]
        self.damping[at] *= np.where(better, _LESS, _MORE)
        self.damping = np.maximum(self.damping, _LEAST)
        self.idle[at] = (self.damping[at] > _MOST) | (np.abs(new - x).max(axis=1) < np.finfo(float).eps)

    def _slopes(self, x: Array, r: Array) -> Array:
        """Jacobians (count, m, p) by differences towards the middle of the box."""
        count, p = x.shape
        step = EPSILON**0.5  # of a unit; what differences lose only slows the last steps where the least is zero
        h = np.where(x > 0.5, -step, step)
        moved = x[:, None, :] + h[:, :, None] * np.eye(p)
        values = self.rows(moved.reshape(count * p, p)).reshape(count, p, -1)
        J = (values - r[:, None, :]) / h[:, :, None]
        return np.where(np.isfinite(J), J, 0.0).swapaxes(1, 2)


def _norms(values: Array) -> Array:
    """Of each row of residuals; infinite where one is not finite."""
    with np.errstate(invalid="ignore", over="ignore"):
        left = np.linalg.norm(values, axis=1)
    return np.where(np.isfinite(left), left, np.inf)
