"""Mode shapes as a universal file: nodes (dataset 15) and one dataset 55 a mode."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from sysid.export.content import one_line_each, reliability
from sysid.results.identification import Identification
from sysid.structure.sensor import Sensor, sensor_row
from sysid.structure.structure import Array

_SI = f"{1.0:25.17E}".replace("E", "D") * 3
_NORMAL_MODE, _STRUCTURAL, _DISPLACEMENT, _REAL = 2, 1, 8, 2


def write_uff55(it: Identification, about: tuple[str, ...], path: Path) -> None:
    """Write frequency, damping ratio and shape of each mode on the fixed base, mass-normalised (modal mass 1 kg).

    Sensors at one place are one node; its motion is the least one that its sensors' signals have in common. Where
    sensors are not described, each is a node at the origin with its motion in x, and the file says so.
    """
    structure, sensors = it.structure, it.measurement.sensors
    places, shapes = _nodes(sensors, structure.mode_shapes) if sensors else _in_x(structure.mode_shapes)
    where = "" if sensors else "sensors are not described: node k is sensor k, its motion stands in x"
    lines = [
        *_set(151, one_line_each([text for text in (*about, where) if text], 80)),  # more lines than it asks for
        *_set(164, (f"{1:10d}{'SI: meter, newton':<20}{2:10d}", _SI, f"{273.15:25.17E}".replace("E", "D"))),
        *_set(15, (f"{k:10d}{0:10d}{0:10d}{11:10d}" + _reals(place) for k, place in enumerate(places, 1))),
    ]
    units = where or "SI units, modal mass 1 kg, absolute motion"
    titles = [*one_line_each([reliability(it)], 80)[:3], *one_line_each([units], 80)[:1]]
    for mode in range(structure.n):
        figures = structure.natural_frequencies[mode], 1.0, structure.damping_ratios[mode], 0.0
        lines += _set(55, _mode(mode + 1, figures, shapes[:, :, mode], titles))
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def _mode(number: int, figures: Sequence[float], shape: Array, titles: Sequence[str]) -> Iterator[str]:
    yield from [*titles, "NONE", "NONE", "NONE", "NONE"][:4]
    yield f"mode {number}"
    width = shape.shape[1]
    yield "".join(f"{value:10d}" for value in (_STRUCTURAL, _NORMAL_MODE, width // 3 + 1, _DISPLACEMENT, _REAL, width))
    yield f"{2:10d}{4:10d}{1:10d}{number:10d}"
    yield _reals(figures)
    for node, motion in enumerate(shape, 1):
        yield f"{node:10d}"
        yield _reals(motion)


def _in_x(shapes: Array) -> tuple[Array, Array]:
    """One node a sensor, at the origin, its motion in x."""
    motions = np.zeros((len(shapes), 3, shapes.shape[1]))
    motions[:, 0] = shapes
    return np.zeros((len(shapes), 3)), motions


def _nodes(sensors: Sequence[Sensor], shapes: Array) -> tuple[Array, Array]:
    """Places (nodes, 3) and motions (nodes, 3 or 6, modes) of the nodes; 6 where a sensor records a rotation."""
    rows = np.array([sensor_row(sensor.axis, sensor.name) for sensor in sensors])
    width = 6 if np.any(rows[:, 3:]) else 3
    places = list(dict.fromkeys(tuple(map(float, sensor.position)) for sensor in sensors))
    motions = np.zeros((len(places), width, shapes.shape[1]))
    for k, place in enumerate(places):
        here = [j for j, sensor in enumerate(sensors) if tuple(map(float, sensor.position)) == place]
        motions[k] = np.linalg.pinv(rows[here, :width]) @ shapes[here]
    return np.array(places), motions


def _set(number: int, lines: Sequence[str] | Iterator[str]) -> list[str]:
    return [f"{-1:6d}", f"{number:6d}", *lines, f"{-1:6d}"]


def _reals(values: Sequence[float] | Array) -> str:
    return "".join(f"{value:13.5E}" for value in values)
