"""The Craig-Bampton superelement as direct matrix input (DMIG) of Nastran, in fields of 16 characters."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from sysid.export.content import one_line_each, statements, superelement_of
from sysid.results.identification import Identification
from sysid.structure.sensor import BASE_AXES
from sysid.structure.structure import Array

PRECISION = "10 significant digits: what 16 characters, the widest field of bulk data, hold beside sign and exponent"
BASE, FIRST_MODE, FIRST_SENSOR = 1, 1_001, 100_001  # identification numbers of points
_SYMMETRIC, _RECTANGULAR = 6, 2

Point = tuple[int, int]  # its number and component


def write_dmig(it: Identification, path: Path) -> None:
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
        *one_line_each((*statements(it, PRECISION), *_usage(it)), 72, "$ "),
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
    """Lines of a matrix; of a symmetric one the lower triangle, as each entry may stand only once."""
    width = len(columns) if form == _RECTANGULAR else ""
    yield f"DMIG    {name:<8}{0:>8}{form:>8}{2:>8}{0:>8}{'':16}{width:>8}".rstrip()
    for j, (point, component) in enumerate(columns):
        first = j if form == _SYMMETRIC else 0
        # A larger negative exponent has no room in a field.
        entries = [i for i in range(first, len(rows)) if abs(matrix[i, j]) > 1e-90]
        if not entries:
            continue
        yield f"DMIG*   {name:<16}{point:>16}{component:>16}"
        for i in entries:
            yield f"*       {rows[i][0]:>16}{rows[i][1]:>16}{_field(matrix[i, j])}"


def _field(value: float) -> str:
    """A number of double precision in 16 characters, ten digits: ``-1.234567890D+05``."""
    return f"{value:>16.9E}".replace("E", "D")
