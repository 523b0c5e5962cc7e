"""The search box: units scaled to the range of each variable, points spread over it, checks of rows and costs."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sysid.errors import InputError, numbers, refuse


def latin_hypercube(count: int, size: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Points (count, size): in each direction one in each of `count` slices.

    The draws are those of ``scipy.stats.qmc.LatinHypercube``, whose import takes longer than many a fit.

    References
    ----------
    M. D. McKay, R. J. Beckman, W. J. Conover, Technometrics 21 (1979) 239-245.
    """
    rng = rng.spawn(1)[0]
    inside = rng.uniform(size=(count, size))
    slices = np.tile(np.arange(1, count + 1), (size, 1))
    for row in slices:
        rng.shuffle(row)
    return np.asarray((slices.T - inside) / count)


FloatArray = NDArray[np.float64]


class Box:
    """Lower and upper bounds, and the scaling of the free variables to the unit cube.

    Particles are points of this cube, and all distances and velocities of the swarm are counted in it; a fixed variable
    (lower == upper) has no range, is left out of distances, and is returned exactly. Conversions clip to the bounds;
    what a particle's velocity does there is told by `ParticleSwarm`. `bounds` are (n_dim, 2) array-like, or
    scipy.optimize.Bounds, and finite; `free` (n_free,) are the indices of the variables with lower < upper.
    """

    def __init__(self, bounds: Any) -> None:
        self.lower, self.upper = _lower_and_upper(bounds)
        self.free = np.flatnonzero(self.upper > self.lower)
        self._span = self.upper[self.free] - self.lower[self.free]

    @property
    def n_dim(self) -> int:
        """Number of variables, the fixed ones included."""
        return self.lower.size

    @property
    def n_free(self) -> int:
        """Number of variables that are not fixed."""
        return self.free.size

    def to_rows(self, unit: FloatArray) -> FloatArray:
        """Points of the unit cube (k, n_free) as rows in the caller's units (k, n_dim), inside the bounds."""
        rows = np.repeat(self.lower[None, :], len(unit), axis=0)
        rows[:, self.free] += unit * self._span
        # lower + 1.0 * (upper - lower) can lie a rounding above upper.
        return np.clip(rows, self.lower, self.upper)

    def scaled(self, vectors: FloatArray) -> FloatArray:
        """Differences in the unit cube (k, n_free) as differences in the caller's units (k, n_dim)."""
        rows = np.zeros((len(vectors), self.n_dim))
        rows[:, self.free] = vectors * self._span
        return rows

    def to_unit(self, x: FloatArray) -> FloatArray:
        """Points in the caller's units (..., n_dim) as points of the unit cube (..., n_free)."""
        unit: FloatArray = (x[..., self.free] - self.lower[self.free]) / self._span
        return np.clip(unit, 0.0, 1.0)

    def clip(self, x: FloatArray) -> FloatArray:
        """Return the nearest point inside the bounds."""
        return np.clip(x, self.lower, self.upper)

    def point(self, x: ArrayLike, name: str) -> FloatArray:
        """Return `x` as a new (n_dim,) array; an error if it is not a point inside the bounds."""
        point = numbers(name, x)
        wrong = f"{name} has shape {point.shape}; give one number a variable, shape ({self.n_dim},)."
        refuse((point.shape != self.lower.shape, wrong))
        outside = np.flatnonzero(~((point >= self.lower) & (point <= self.upper)))
        if outside.size:
            i = outside[0]
            raise InputError(
                f"{name}[{i}] = {point[i]} is outside its bounds [{self.lower[i]}, {self.upper[i]}]; "
                "move it inside or widen the bounds."
            )
        return point


def _lower_and_upper(bounds: Any) -> tuple[FloatArray, FloatArray]:
    if hasattr(bounds, "lb") and hasattr(bounds, "ub"):
        bounds = np.stack(np.broadcast_arrays(np.atleast_1d(bounds.lb), np.atleast_1d(bounds.ub)), axis=-1)
    pairs = numbers("bounds", bounds)
    if pairs.ndim != 2 or pairs.shape[1] != 2 or pairs.shape[0] == 0:
        raise InputError(f"bounds has shape {pairs.shape}; give one pair (lower, upper) a variable, shape (n_dim, 2).")
    lower, upper = pairs[:, 0].copy(), pairs[:, 1].copy()
    with np.errstate(over="ignore", invalid="ignore"):
        endless = np.flatnonzero(~np.isfinite(upper - lower))
    if endless.size:
        i = endless[0]
        raise InputError(
            f"bounds[{i}] = ({lower[i]}, {upper[i]}) has no finite range to sample; give two finite numbers."
        )
    reversed_ = np.flatnonzero(lower > upper)
    if reversed_.size:
        i = reversed_[0]
        raise InputError(f"bounds[{i}] = ({lower[i]}, {upper[i]}) has its lower above its upper; exchange the two.")
    return lower, upper


def checked_costs(costs: ArrayLike, n_rows: int, origin: str) -> FloatArray:
    """The costs, (n_rows,) real numbers, as floats; `origin` follows "The costs" in an error."""
    values = np.asarray(costs)
    of_shape = f"The costs {origin} have shape {values.shape} for {n_rows} rows; give one a row, shape ({n_rows},)."
    of_kind = f"The costs {origin} have type {values.dtype}; give real numbers, such as the norm of a residual."
    refuse((values.shape != (n_rows,), of_shape), (values.dtype.kind not in "biuf", of_kind))
    return values.astype(float)


def checked_rows(rows: ArrayLike, shape: tuple[int, ...], origin: str) -> FloatArray:
    """Rows of a shape as finite floats; `origin` follows "The rows" in an error."""
    values = np.asarray(rows, dtype=float)
    of_shape = f"The rows {origin} have shape {values.shape}; give one a row that was asked for, {shape}."
    endless = f"The rows {origin} are not all finite; leave a row that cannot be repaired as it was."
    refuse((values.shape != shape, of_shape), (not np.isfinite(values).all(), endless))
    return values
