"""Files of other programs: Nastran's binary OUTPUT4 and direct matrix input (DMIG), universal files of mode shapes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from sysid.export.content import Content, matrices_of, one_line_each, reliability, superelement_of
from sysid.structure.sensor import BASE_AXES, Sensor, sensor_row
from sysid.structure.structure import Array

BASE, FIRST_MODE, FIRST_SENSOR = 1, 1_001, 100_001  # identification numbers of points
_SYMMETRIC, _RECTANGULAR = 6, 2

Point = tuple[int, int]  # its number and component


def write_op4(content: Content, about: tuple[str, ...], path: Path) -> None:
    """Write M, K, C; MCB, KCB, CCB, RCB; DETERMND and NOTE with pyYeti.

    M, K and C have the structure's degrees of freedom first, those of the base last. MCB, KCB and CCB have those of the
    base first, then the modal coordinates, and RCB takes these to the absolute motion of the sensors. DETERMND is 1
    where data and stated model fix every entry, else 0. The format has no place for text: NOTE holds the characters of
    what the file says of itself as numbers (ASCII), one line a row: ``char(NOTE)`` in MATLAB.
    """
    from pyyeti.nastran import op4

    form = superelement_of(content.structure)
    lines = one_line_each((*about, f"rows of RCB: {', '.join(content.sensor_names)}"), 72)
    matrices = {
        **matrices_of(content.structure),
        "MCB": form.mass, "KCB": form.stiffness, "CCB": form.damping, "RCB": form.recovery,
        "DETERMND": np.array([[float(content.it.determined)]]),
        "NOTE": np.array([[float(ord(letter)) for letter in line.ljust(72)] for line in lines]),
    }  # fmt: skip
    op4.write(str(path), list(matrices), list(matrices.values()), sparse="dense")


def write_dmig(content: Content, about: tuple[str, ...], path: Path) -> None:
    """Write points and the matrices MCB, KCB, BCB (mass, stiffness, viscous damping) and RCB (motion of the sensors).

    The base is grid point 1, components as its axes; modal coordinates are scalar points from 1001 on. RCB has the
    sensors as its rows, scalar points from 100001 on. In the case control: ``M2GG = MCB``, ``K2GG = KCB``,
    ``B2GG = BCB``. Numbers below 1e-90 are left out as zeros.
    """
    structure, axes = content.structure, content.base_axes
    form = superelement_of(structure)
    base = [(BASE, BASE_AXES.index(axis) + 1) for axis in axes]
    count = len(form.mass) - structure.n_base
    rows = base + [(FIRST_MODE + k, 0) for k in range(count)]
    sensors = [(FIRST_SENSOR + k, 0) for k in range(structure.n_sensors)]
    fixed = "".join(str(c + 1) for c, axis in enumerate(BASE_AXES) if axis not in axes)
    lines = [
        *one_line_each((*about, *_usage(content)), 72, "$ "),
        f"GRID,{BASE},,0.,0.,0.,,{fixed}".rstrip(","),
        f"SPOINT,{FIRST_MODE},THRU,{FIRST_MODE + count - 1}" if count > 1 else f"SPOINT,{FIRST_MODE}",
        *_matrix("MCB", form.mass, rows, rows, _SYMMETRIC),
        *_matrix("KCB", form.stiffness, rows, rows, _SYMMETRIC),
        *_matrix("BCB", form.damping, rows, rows, _SYMMETRIC),
        *_matrix("RCB", form.recovery, sensors, rows, _RECTANGULAR),
    ]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def _usage(content: Content) -> list[str]:
    names = (f"{FIRST_SENSOR + k} {name}" for k, name in enumerate(content.sensor_names))
    return [
        "the matrices below are not those of the order above but the Craig-Bampton form: "
        f"grid point {BASE} is the base (give it the coordinates of the point that base motion and moments refer to), "
        f"scalar points from {FIRST_MODE} on are the coordinates of the mass-normalised modes on a fixed base, "
        "in ascending order of frequency, those of residual modes, where there are any, last",
        "case control: M2GG = MCB, K2GG = KCB, B2GG = BCB",
        "RCB takes base and modal coordinates to the absolute motion of the sensors; its rows: " + ", ".join(names),
    ]


def _matrix(name: str, matrix: Array, rows: Sequence[Point], columns: Sequence[Point], form: int) -> Iterator[str]:
    """Lines of a matrix in fields of 16 characters; of a symmetric one each entry once: the lower triangle."""
    width = len(columns) if form == _RECTANGULAR else ""
    yield f"DMIG    {name:<8}{0:>8}{form:>8}{2:>8}{0:>8}{'':16}{width:>8}".rstrip()
    for j, (point, component) in enumerate(columns):
        first = j if form == _SYMMETRIC else 0
        # A larger negative exponent has no room in a field.
        entries = [i for i in range(first, len(rows)) if abs(matrix[i, j]) > 1e-90]
        if entries:
            yield f"DMIG*   {name:<16}{point:>16}{component:>16}"
        for i in entries:
            number = f"{matrix[i, j]:>16.9E}".replace("E", "D")  # of double precision
            yield f"*       {rows[i][0]:>16}{rows[i][1]:>16}{number}"


_NORMAL_MODE, _STRUCTURAL, _DISPLACEMENT, _REAL = 2, 1, 8, 2


def write_uff55(content: Content, about: tuple[str, ...], path: Path) -> None:
    """Write nodes (dataset 15) and each mode on the fixed base (55): frequency, damping ratio, shape of modal mass 1.

    Sensors at one place are one node; its motion is the least one that its sensors' signals have in common. Where
    sensors are not described, each is a node at the origin with its motion in x, and the file says so.
    """
    structure, sensors = content.structure, content.sensors
    places, shapes = _nodes(sensors, structure.mode_shapes) if sensors else _in_x(structure.mode_shapes)
    where = "" if sensors else "sensors are not described: node k is sensor k, its motion stands in x"
    one, kelvin = (f"{value:25.17E}".replace("E", "D") for value in (1.0, 273.15))
    lines = [
        *_set(151, one_line_each([text for text in (*about, where) if text], 80)),  # more lines than it asks for
        *_set(164, (f"{1:10d}{'SI: meter, newton':<20}{2:10d}", 3 * one, kelvin)),
        *_set(15, (f"{k:10d}{0:10d}{0:10d}{11:10d}" + _reals(place) for k, place in enumerate(places, 1))),
    ]
    units = where or "SI units, modal mass 1 kg, absolute motion"
    titles = [*one_line_each([reliability(content.it)], 80)[:3], *one_line_each([units], 80)[:1]]
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
