"""Checks of arguments, with one error message for each mistake."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sysid.errors import InputError

FloatArray = NDArray[np.float64]


def checked_costs(costs: ArrayLike, n_rows: int, origin: str) -> FloatArray:
    """Return the costs as an array of floats; `origin` follows "The costs" in an error.

    Raises
    ------
    InputError
        If they are not `n_rows` real numbers in one dimension.
    """
    values = np.asarray(costs)
    if values.shape != (n_rows,):
        raise InputError(
            f"The costs {origin} have shape {values.shape} for {n_rows} rows; give one a row, shape ({n_rows},)."
        )
    if values.dtype.kind not in "biuf":
        raise InputError(
            f"The costs {origin} have type {values.dtype}; give real numbers, such as the norm of a residual."
        )
    return values.astype(float)


def checked_rows(rows: ArrayLike, shape: tuple[int, ...], origin: str) -> FloatArray:
    """Return rows as finite floats; `origin` follows "The rows" in an error.

    Raises
    ------
    InputError
        If their shape is another, or one of their numbers is not finite.
    """
    values = np.asarray(rows, dtype=float)
    if values.shape != shape:
        raise InputError(f"The rows {origin} have shape {values.shape}; give one a row that was asked for, {shape}.")
    if not np.isfinite(values).all():
        raise InputError(f"The rows {origin} are not all finite; leave a row that cannot be repaired as it was.")
    return values
