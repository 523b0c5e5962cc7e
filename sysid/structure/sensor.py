"""Sensors: name, place and direction; the axes of sensors and base, and the rigid motion of points."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sysid.errors import InputError, finite_array, instance, sequence, shown, text

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


@dataclass(frozen=True)
class Sensor:
    """One accelerometer axis.

    Parameters
    ----------
    name : str
        Shown in tables and figures.
    position : tuple of float, shape (3,)
        m.
    axis : str or tuple of float, shape (3,)
        "x", "-y", ..., or a direction vector.

    Raises
    ------
    InputError
        Where the name is no text, or position or axis is not as above.
    """

    name: str
    position: tuple[float, float, float]
    axis: str | tuple[float, float, float]

    def __post_init__(self) -> None:
        label = f"sensor {text('the name of a Sensor', self.name)!r}"
        vector3(self.position, f"the position of {label}")
        sensor_row(self.axis, label)

    def to_tree(self) -> dict[str, Any]:
        """Name, position and axis as strings and arrays, for `from_tree`."""
        axis = self.axis if isinstance(self.axis, str) else np.array(self.axis, dtype=float)
        return {"name": self.name, "position": np.array(self.position, dtype=float), "axis": axis}

    @classmethod
    def from_tree(cls, tree: dict[str, Any]) -> Sensor:
        """Sensor from a dictionary that `to_tree` made."""
        axis = tree["axis"] if isinstance(tree["axis"], str) else tuple(tree["axis"].tolist())
        return cls(tree["name"], tuple(tree["position"].tolist()), axis)


def checked_sensors(given: Sequence[Any] | None) -> tuple[Sensor, ...] | None:
    """The sensors of a test or a structure, each a `Sensor`, as a tuple; None where they are not described."""
    sensors = None if given is None else sequence("sensors", given, "a list of sysid.Sensor")
    for at, sensor in enumerate(sensors or ()):
        instance(f"sensors[{at}]", sensor, Sensor)
    return sensors


def sensors_to_tree(sensors: Sequence[Any] | None) -> list[dict[str, Any]] | None:
    """Dictionaries of the sensors of a test or a structure; None where they are not described."""
    return None if sensors is None else [sensor.to_tree() for sensor in sensors]


def sensors_from_tree(trees: Sequence[dict[str, Any]] | None) -> tuple[Sensor, ...] | None:
    """Sensors from what `sensors_to_tree` made."""
    return None if trees is None else tuple(Sensor.from_tree(tree) for tree in trees)
