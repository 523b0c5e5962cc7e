"""Lines at which a record has no number."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sysid.errors import InputError, finite_array, listed, numbers
from sysid.structure.structure import Array

Missing = Literal["refuse", "drop"]


def present(given: dict[str, Any]) -> tuple[dict[str, Any], dict[str, NDArray[np.bool_]]]:
    """Records and deviations, by name, without the lines at which any of them is NaN; and where they are.

    Infinite numbers stay.

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
        counts = ", ".join(f"{name} at {np.count_nonzero(hole)}" for name, hole in holes.items() if np.any(hole))
        raise InputError(f"missing='drop' leaves no line: of {lines}, NaN stands in {counts}")
    kept = {name: a[..., keep] if a.shape[-1:] == (lines,) else a for name, a in arrays.items()}
    return given | kept, {name: np.isnan(arrays[name]) for name, hole in holes.items() if np.any(hole)}


def named(
    holes: dict[str, NDArray[np.bool_]], freq: Array, sensors: Sequence[str], axis: int
) -> tuple[tuple[str, Array], ...]:
    """Records with NaN, and where, Hz: sensors by name, their `axis` being that of three; others by their own."""
    found: list[tuple[str, Array]] = []
    for name, hole in holes.items():
        rows, names = hole.reshape(1, -1, hole.shape[-1]), [name]
        if name in ("response", "frf"):
            first = np.moveaxis(hole, axis if hole.ndim == 3 else 0, 0)
            rows, names = first.reshape(len(first), -1, freq.size), list(sensors)
        found += [(one, freq[np.any(row, axis=0)]) for one, row in zip(names, rows, strict=True) if np.any(row)]
    return tuple(found)


def in_words(holes: tuple[tuple[str, Array], ...], freq: Array) -> str:
    """Which channels hold NaN and from where to where; what no line of `freq` parts is one range."""
    phrases = []
    for name, at in holes:
        parts = np.split(at, np.flatnonzero(np.diff(np.searchsorted(freq, at))) + 1)
        ranges = [f"{p[0]:.5g}" if p.size == 1 else f"{p[0]:.5g} to {p[-1]:.5g}" for p in parts]
        phrases.append(f"{name} at {listed(ranges)} Hz")
    return "; ".join(phrases)


def complete(name: str, value: ArrayLike, kind: type = float) -> NDArray[Any]:
    """Check that all lines are finite numbers; the message says how lines with NaN are left out."""
    try:
        return finite_array(name, value, kind)
    except InputError as error:
        if not np.any(np.isnan(numbers(name, value, kind))):
            raise
        raise InputError(f"{error}; missing='drop' leaves out the lines at which anything is NaN") from None
