"""Description of a sensor: its name, place and direction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sysid.errors import instance, sequence, text
from sysid.structure.axes import sensor_row, vector3


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
