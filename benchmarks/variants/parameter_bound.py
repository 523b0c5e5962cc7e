"""Cramér-Rao bound of unknowns of a structure in any test, at their true values.

Nothing of the identification is used: responses are those of `sysid.Structure`, or of any function of the unknowns,
and their derivatives central differences of the fourth order. With circular noise of ``E|e|² = std²`` the information
is ``2 / std² Re(J^H J)``.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def parameter_bound(
    response: Callable[[np.ndarray], np.ndarray], true: np.ndarray, std: np.ndarray | float, step: float = 1e-4
) -> np.ndarray:
    """Least covariance of unbiased estimates of `true`, relative to the true values, (p, p).

    Parameters
    ----------
    response : callable
        Unknowns (p,) to complex records of any shape.
    true : (p,)
    std : broadcast to the records
    step : float
        Of the differences, relative.
    """
    columns = []
    for j, value in enumerate(true):
        h = step * value

        def at(times: float, j: int = j, h: float = h) -> np.ndarray:
            moved = true.copy()
            moved[j] += times * h
            return response(moved)

        columns.append(((8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * h) * value / std).ravel())
    J = np.array(columns).T  # by relative changes, so that springs and dampers are alike
    information = 2 * (J.conj().T @ J).real
    return np.linalg.inv(information)
