"""Matrices and the Craig-Bampton superelement for Nastran: binary OUTPUT4, and direct matrix input (DMIG)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from sysid.export.content import matrices_of, one_line_each, superelement_of
from sysid.results.identification import Identification
from sysid.structure.sensor import BASE_AXES
from sysid.structure.structure import Array

BASE, FIRST_MODE, FIRST_SENSOR = 1, 1_001, 100_001  # identification numbers of points
_SYMMETRIC, _RECTANGULAR = 6, 2

Point = tuple[int, int]  # its number and component


def write_op4(it: Identification, about: tuple[str, ...], path: Path) -> None:
    """Write M, K, C; MCB, KCB, CCB, RCB; DETERMND and NOTE with pyYeti.

    M, K and C have the structure's degrees of freedom first, those of the base last. MCB, KCB and CCB have those of the
    base first, then the modal coordinates, and RCB takes these to the absolute motion of the sensors. DETERMND is 1
    where data and stated model fix every entry, else 0. The format has no place for text: NOTE holds the characters of
    what the file says of itself as numbers (ASCII), one line a row: ``char(NOTE)`` in MATLAB.
    """
    from pyyeti.nastran import op4

    form, lines = superelement_of(it.structure), one_line_each(about, 72)
    matrices = {
        **matrices_of(it.structure),
        "MCB": form.mass, "KCB": form.stiffness, "CCB": form.damping, "RCB": form.recovery,
        "DETERMND": np.array([[float(it.determined)]]),
        "NOTE": np.array([[float(ord(letter)) for letter in line.ljust(72)] for line in lines]),
    }  # fmt: skip
    op4.write(str(path), list(matrices), list(matrices.values()), sparse="dense")


def write_dmig(it: Identification, about: tuple[str, ...], path: Path) -> None:
    """Write points and the matrices MCB, KCB, BCB (mass, stiffness, viscous damping) and RCB (motion of the sensors).

    The base is grid point 1, components as its axes; modal coordinates are scalar points from 1001 on. RCB has the
    sensors as its rows, scalar points from 100001 on. In the case control: ``M2GG = MCB``, ``K2GG = KCB``,
    ``B2GG = BCB``. Numbers below 1e-90 are left out as zeros.
    """
    structure, axes = it.structure, it.measurement.base_axes or ()
    form = superelement_of(structure)
    base = [(BASE, BASE_AXES.index(axis) + 1) for axis in axes]
    rows = base + [(FIRST_MODE + k, 0) for k in range(structure.n)]
    sensors = [(FIRST_SENSOR + k, 0) for k in range(structure.n_sensors)]
    fixed = "".join(str(c + 1) for c, axis in enumerate(BASE_AXES) if axis not in axes)
    lines = [
        *one_line_each((*about, *_usage(it)), 72, "$ "),
        f"GRID,{BASE},,0.,0.,0.,,{fixed}".rstrip(","),
        f"SPOINT,{FIRST_MODE},THRU,{FIRST_MODE + structure.n - 1}" if structure.n > 1 else f"SPOINT,{FIRST_MODE}",
        *_matrix("MCB", form.mass, rows, rows, _SYMMETRIC),
        *_matrix("KCB", form.stiffness, rows, rows, _SYMMETRIC),
        *_matrix("BCB", form.damping, rows, rows, _SYMMETRIC),
        *_matrix("RCB", form.recovery, sensors, rows, _RECTANGULAR),
    ]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def _usage(it: Identification) -> list[str]:
    names = (f"{FIRST_SENSOR + k} {name}" for k, name in enumerate(it.measurement.sensor_names))
    return [
        "the matrices below are not those of the order above but the Craig-Bampton form: "
        f"grid point {BASE} is the base (give it the coordinates of the point that base motion and moments refer to), "
        f"scalar points from {FIRST_MODE} on are the coordinates of the mass-normalised modes on a fixed base, "
        "in ascending order of frequency",
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
