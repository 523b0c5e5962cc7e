"""Lines at which a record has no number."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sysid.errors import InputError, finite_array, numbers

Missing = Literal["refuse", "drop"]


def present(given: dict[str, Any]) -> dict[str, Any]:
    """Records and deviations, by name, without the lines at which any of them is NaN; infinite numbers stay.

    Raises
    ------
    InputError
        Where no line is left.
    """
    lines, found = given["freq"].size, {name: value for name, value in given.items() if value is not None}
    arrays = {name: numbers(name, value, float if "std" in name else complex) for name, value in found.items()}
    arrays["freq"] = given["freq"]
    # What stands for all lines alike lacks at all of them.
    holes = {
        name: np.broadcast_to(np.any(np.isnan(array), axis=tuple(range(array.ndim - 1))), lines)
        for name, array in arrays.items()
        if not array.ndim or array.shape[-1] in (1, lines)
    }
    keep = ~np.any(list(holes.values()), axis=0)
    if not np.any(keep):
        told = ", ".join(f"{name} at {np.count_nonzero(hole)}" for name, hole in holes.items() if np.any(hole))
        raise InputError(f"missing='drop' leaves no line: of {lines}, NaN stands in {told}")
    return given | {name: a[..., keep] if a.shape[-1:] == (lines,) else a for name, a in arrays.items()}


def complete(name: str, value: ArrayLike, kind: type = float) -> NDArray[Any]:
    """What has lines as finite numbers; the message says how lines with NaN are left out."""
    try:
        return finite_array(name, value, kind)
    except InputError as error:
        if not np.any(np.isnan(numbers(name, value, kind))):
            raise
        raise InputError(f"{error}; missing='drop' leaves out the lines at which anything is NaN") from None
