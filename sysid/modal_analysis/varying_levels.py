"""Levels of noise that vary over the lines: stretches of one level each, and the numbers that these are made of."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sysid.structure.structure import Array

KNOTS = 5  # frequencies at which a level is a number of its own, evenly in the root of frequency


def segments(w: Array, most: int = 20, lines: int = 4) -> list[slice]:
    """Stretches of the lines of a run, (L,), rad/s, `most` at most and of so many lines at least: of one level each."""
    root = np.sqrt(w)
    bounds = np.unique(np.searchsorted(root, np.linspace(root[0], root[-1], most + 1)[1:-1]))
    cuts = [0]
    for bound in bounds:
        if bound - cuts[-1] >= lines and w.size - bound >= lines:
            cuts.append(int(bound))
    return [slice(a, b) for a, b in zip(cuts, [*cuts[1:], w.size], strict=True)]


def interpolation_matrix(middles: Array, first: float, last: float) -> Array:
    """Linear interpolation from the values at the `KNOTS` to the middles of segments, (segments, knots)."""
    at = np.linspace(np.sqrt(first), np.sqrt(last), KNOTS)
    return np.array([np.interp(np.sqrt(middles), at, one) for one in np.eye(KNOTS)]).T


def designs(middles: Array, ends: tuple[float, float], varies: NDArray[np.bool_]) -> list[Array]:
    """Matrices from the numbers of a run to the logarithms of all levels, (channels, numbers) a stretch.

    Parameters
    ----------
    middles : (segments,)
        Middles of stretches, rad/s.
    ends : (first, last)
        Lines of the run, rad/s.
    varies : (channels,) of bool
        Channels whose levels vary; others have one number.
    """
    if not np.any(varies):
        return [np.eye(varies.size)] * middles.size
    shape = interpolation_matrix(middles, *ends)
    first = np.concatenate([[0], np.cumsum(np.where(varies, KNOTS, 1))])
    matrices = []
    for row in shape:
        D = np.zeros((varies.size, first[-1]))
        for channel, varying in enumerate(varies):
            D[channel, first[channel] : first[channel + 1]] = row if varying else 1.0
        matrices.append(D)
    return matrices


def extra_numbers(varying: NDArray[np.bool_] | None) -> int:
    """Numbers that varying levels take more than constant ones."""
    return 0 if varying is None else (KNOTS - 1) * int(np.count_nonzero(varying))
