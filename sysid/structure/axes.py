"""Axes of sensors and of the base, and the rigid motion of points."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sysid.errors import InputError, finite_array, sequence, shown

Array = NDArray[np.floating[Any]]
BASE_AXES = ("x", "y", "z", "rx", "ry", "rz")


def unit_vector(value: ArrayLike, label: str) -> Array:
    """`value` as a vector (3,) of length one."""
    vector = vector3(value, label)
    size = float(np.linalg.norm(vector))
    if size == 0.0:
        raise InputError(f"{label} is the zero vector")
    return vector / size


def vector3(value: ArrayLike, label: str) -> Array:
    """`value` as a finite vector (3,)."""
    vector = finite_array(label, value)
    if vector.shape != (3,):
        raise InputError(f"{label} must be three finite numbers, got {shown(value)}")
    return vector


def sensor_row(axis: str | ArrayLike, label: str) -> Array:
    """Factors of a node's six motions in the signal of a sensor on it, (6,).

    `axis` is a vector (3,), of any length, or a string: "x", "-y", and "rx", "-rz" for rotations.
    """
    row = np.zeros(6)
    if isinstance(axis, str):
        match = re.fullmatch(r"([+-]?)(r?[xyz])", axis)
        if match is None:
            raise InputError(
                f"the axis of {label} must be a vector or one of x y z rx ry rz (signed), got {shown(axis)}"
            )
        sign, name = match.groups()
        row[BASE_AXES.index(name)] = float(f"{sign}1")
    else:
        row[:3] = unit_vector(axis, f"the axis of {label}")
    return row


def base_columns(base_axes: str | Iterable[str]) -> list[int]:
    """Return the indices 0 to 5 of the base axes: "xyz", "x rz" or ["x", "rz"]."""
    names = base_axes if isinstance(base_axes, str) else sequence("base_axes", base_axes, "names such as ['x', 'rz']")
    text = names if isinstance(names, str) else " ".join(n if isinstance(n, str) else repr(n) for n in names)
    if re.fullmatch(r"([\s,]*r?[xyz])+[\s,]*", text) is None:
        raise InputError(f"base_axes must be any of x y z rx ry rz, got {shown(base_axes)}")
    columns = [BASE_AXES.index(axis) for axis in re.findall(r"r?[xyz]", text)]
    if len(set(columns)) < len(columns):
        raise InputError(f"base_axes names an axis twice: {base_axes!r}")
    return columns


def rigid_motion(points: Array, origin: ArrayLike) -> Array:
    """Motion of `points` (n, 3) for unit motions of `origin` in x y z rx ry rz, (6 n, 6)."""
    arms = points - vector3(origin, "origin")
    motion = np.tile(np.eye(6), (len(arms), 1, 1))
    motion[:, :3, 3:] = np.cross(np.eye(3), arms[:, None]).swapaxes(1, 2)  # theta × r
    return motion.reshape(-1, 6)
