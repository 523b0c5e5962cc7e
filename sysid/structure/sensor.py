"""Description of a sensor: its name, place and direction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sysid.errors import InputError


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
    """

    name: str
    position: tuple[float, float, float]
    axis: str | tuple[float, float, float]

    def to_tree(self) -> dict[str, Any]:
        """Name, position and axis as strings and arrays, for `from_tree`."""
        axis = self.axis if isinstance(self.axis, str) else np.array(self.axis, dtype=float)
        return {"name": self.name, "position": np.array(self.position, dtype=float), "axis": axis}

    @classmethod
    def from_tree(cls, tree: dict[str, Any]) -> Sensor:
        """Sensor from a dictionary that `to_tree` made."""
        axis = tree["axis"] if isinstance(tree["axis"], str) else tuple(tree["axis"].tolist())
        return cls(tree["name"], tuple(tree["position"].tolist()), axis)


def sensors_to_tree(sensors: Sequence[Any] | None) -> list[dict[str, Any]] | None:
    """Dictionaries of the sensors of a test or a structure; None where they are not described.

    Raises
    ------
    InputError
        If a sensor is described by anything but a `Sensor`.
    """
    if sensors is None:
        return None
    for sensor in sensors:
        if not isinstance(sensor, Sensor):
            raise InputError(f"a sensor is described by a {type(sensor).__name__}; only a sysid.Sensor can be saved")
    return [sensor.to_tree() for sensor in sensors]


def sensors_from_tree(trees: Sequence[dict[str, Any]] | None) -> tuple[Sensor, ...] | None:
    """Sensors from what `sensors_to_tree` made."""
    return None if trees is None else tuple(Sensor.from_tree(tree) for tree in trees)
