"""Universal files: functions at nodal degrees of freedom (58, 58b) with the geometry of 15 or 2411 and units of 164.

Read with pyuff, an extra. Of the geometry sets 82 (trace lines) and 151 (header) nothing is needed.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sysid.errors import InputError, needed, refuse
from sysid.files import units
from sysid.files.recording import Column, Recording, rate_of

_FUNCTIONS = {0: "general", 1: "time response", 2: "auto spectrum", 3: "cross spectrum", 4: "frequency response",
              6: "coherence", 12: "spectrum"}  # fmt: skip
_READ = (1, 4, 6, 12)
_DIRECTIONS = {1: "x", 2: "y", 3: "z", 4: "rx", 5: "ry", 6: "rz"}
# Data types of functions whose unit no label tells: that of the set 164, and SI without one.
_SPECIFIC = {8: "{length}", 9: "{force}", 11: "{length}/s", 12: "{length}/s²", 13: "{force}"}
# Units by how many of them are an SI unit, as a set 164 states it; SI without one, none where it has no name here.
_SYSTEMS = {
    "length": {1.0: "m", 100.0: "cm", 1000.0: "mm", 1 / units.INCH: "in", 1 / (12 * units.INCH): "ft"},
    "force": {1.0: "N", 1000.0: "mN", 1e-3: "kN", 1 / units.POUND: "lbf"},
}
_MARK = re.compile(rb"^    -1[ \t]*\r?$", re.MULTILINE)
# A binary set: its size in bytes in the 32nd to 43rd place of its first line, and 11 lines of text before the numbers.
_BINARY = re.compile(rb"\s*\n {4}58b.{24}[ ]*(\d+)[^\n]*\n(?:[^\n]*\n){11}")
_LAST = re.compile(rb"    -1[ \t]*\r?$", re.MULTILINE)
_NUMBERS = (15, 58, 164, 2411)  # sets that are read
_KNOWN = {*map(str, _NUMBERS), "82", "151"}  # or without need
# Of a set 58: how many values it says that it has, in the seventh line of its text, place 11 to 20.
_COUNT = re.compile(rb"[^\n]*\n {4}58[^\n]*\n(?:[^\n]*\n){6}[ \d]{10}([ \d]{10})")
_NO_LABEL = ("", "NONE")


def read_universal(path: Path) -> list[Recording]:
    """The recordings of a universal file: its time records, or its spectra, run by run.

    A load case is a run; a function without reference is told by its node and direction, as in ``12+X``. Refused is a
    file cut short, of another type, without sets 58, or whose lengths differ.
    """
    sets = _sets(path)
    stated = next((one for one in sets if one.get("type") == 164), {})
    points = _points(sets, 1 / (stated.get("length") or 1.0))
    file_units = {
        quantity: next((name for one, name in known.items() if abs((stated.get(quantity) or 1.0) / one - 1) < 1e-4), "")
        for quantity, known in _SYSTEMS.items()
    }
    functions = [(at, one) for at, one in enumerate(sets, 1) if one.get("type") == 58]
    kinds = {_FUNCTIONS.get(one["func_type"], str(one["func_type"])) for _, one in functions}
    beside = any(one["func_type"] == 4 for _, one in functions)  # which coherences stand
    used = [(at, one) for at, one in functions if one["func_type"] in _READ and (beside or one["func_type"] != 6)]
    found = ", ".join(sorted({str(one.get("type")) for one in sets})) or "none"
    found += f", functions {', '.join(sorted(kinds))}" * bool(kinds)
    none = f"no time records or frequency responses: sets {found}; export functions as sets 58 or 58b"
    mixed = len({one["func_type"] == 1 for _, one in used}) > 1
    refuse(
        (not used, f"{path} holds {none}"),
        (mixed, f"{path} holds time records and frequency responses: export one kind into a file of its own"),
    )
    runs: dict[int, list[tuple[int, dict[str, Any]]]] = {}
    for at, one in used:
        runs.setdefault(one["load_case_id"] if one["func_type"] not in (4, 6) else 0, []).append((at, one))
    left_out = sorted({str(one.get("type")) for one in sets} - _KNOWN)
    remarks = (f"sets of type {', '.join(left_out)} are left out",) * bool(left_out)
    return [replace(_recording(path, run, points, file_units), remarks=remarks) for run in runs.values()]


def _sets(path: Path) -> list[dict[str, Any]]:
    needed("pyuff", "uff", f"{path}: reading a universal file")
    import pyuff

    try:
        _check_whole(path, path.read_bytes())
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}") from None
    file, sets = pyuff.UFF(str(path)), []
    for at, kind in enumerate(file.get_set_types()):
        try:
            sets.append(file.read_sets(at) if int(kind) in _NUMBERS else {"type": int(kind)})
        except Exception as error:  # pyuff raises Exception itself
            raise InputError(
                f"{path}, set {at + 1} of {len(file.get_set_types())} (type {kind}): {error}; is it damaged, or "
                "another type than it says? Export it again"
            ) from None
    return sets


def _check_whole(path: Path, content: bytes) -> None:
    """Refuse a file whose last set does not end, or that claims more values than it has bytes.

    The numbers of a binary set are stepped over by the size that its first line states, which some programs state too
    small: its last mark follows them without a line end, and they may look like a mark.
    """
    begin, number = _MARK.search(content), 0
    if begin is None:
        raise InputError(f"{path} is no universal file: it has no line '    -1', by which a set begins and ends")
    while begin is not None:
        number += 1
        size = _BINARY.match(content, begin.end())
        end = _MARK.search(content, begin.end()) if size is None else _LAST.search(content, size.end() + int(size[1]))
        if end is None:
            raise InputError(f"{path} is cut short: its last set, number {number}, does not end; export it again")
        count = _COUNT.match(content, begin.end())
        claimed = 0 if count is None else int(count[1].strip() or 0)
        if claimed > end.start() - begin.end():
            raise InputError(f"{path}, set {number}: it claims {claimed} values, and holds fewer: export it again")
        begin = _MARK.search(content, end.end())


def _points(sets: Sequence[dict[str, Any]], length: float) -> dict[int, tuple[float, ...]]:
    """Positions of the nodes, m."""
    return {
        int(node): tuple(float(part) * length for part in place)
        for one in sets
        if one.get("type") in (15, 2411)
        for node, *place in zip(one["node_nums"], one["x"], one["y"], one["z"], strict=True)
    }


def _recording(
    path: Path, run: Sequence[tuple[int, dict[str, Any]]], points: dict[int, Any], file_units: dict[str, str]
) -> Recording:  # fmt: skip
    columns = tuple(_column(path, at, one, points, file_units) for at, one in run)
    first, lengths = run[0][1], {column.values.size for column in columns}
    other = next(((at, one) for at, one in run if not _same_abscissa(one, first)), None)
    if len(lengths) > 1 or other is not None:
        at = other[0] if other else next(at for at, one in run if np.size(one["data"]) != columns[0].values.size)
        raise InputError(
            f"{path}, set {at}: it has other times or frequencies than set {run[0][0]}, with which it forms a run; "
            "export tests of another length or rate with another load case, or into a file of their own"
        )
    x = np.asarray(first["x"], float)[: columns[0].values.size]
    if first["func_type"] != 1:
        return Recording(path, columns, freq=x)
    even = first["abscissa_spacing"]
    return Recording(path, columns, 1 / first["abscissa_inc"] if even else rate_of(x, path, f"set {run[0][0]}"))


def _same_abscissa(one: dict[str, Any], other: dict[str, Any]) -> bool:
    a, b = np.asarray(one["x"], float), np.asarray(other["x"], float)
    return a.shape == b.shape and bool(np.allclose(a, b, rtol=1e-6, atol=0))


def _column(path: Path, at: int, one: dict[str, Any], points: dict[int, Any], file_units: dict[str, str]) -> Column:
    name, values = dof(one["rsp_node"], one["rsp_dir"]), np.asarray(one["data"])
    words = f"{values.size} of {one['num_pts']} values are there: it is cut short, or not of the precision that it says"
    refuse((values.size < one["num_pts"], f"{path}, set {at} ({name}): {words}; export it again"))
    spectrum = one["func_type"] in (4, 6)
    name += " coherence" * (one["func_type"] == 6)
    upper = _unit(one, "ordinate", file_units)
    lower = _unit(one, "orddenom", file_units) if spectrum else ""
    direction = int(one["rsp_dir"])
    axis = ("-" if direction < 0 else "") + _DIRECTIONS.get(abs(direction), "")
    return Column(
        name, values[: one["num_pts"]], f"{upper} / {lower}" if upper and lower else upper, f"set {at} ({name})",
        dof(one["ref_node"], one["ref_dir"]) if spectrum else "", position=points.get(int(one["rsp_node"])), axis=axis,
    )  # fmt: skip


def dof(node: int, direction: int) -> str:
    """A node and direction as test engineers write it: ``12+X``, ``3-RZ``."""
    name = _DIRECTIONS.get(abs(int(direction)), "").upper()
    return f"{int(node)}{'-' if int(direction) < 0 else '+'}{name}"


def _unit(one: dict[str, Any], side: str, file_units: dict[str, str]) -> str:
    """Unit of an axis: its label where that names a unit, else the file's unit of its data type, else ""."""
    for key in (f"{side}_axis_units_lab", f"{side}_axis_lab"):
        label = str(one.get(key, "")).strip().strip("[]()")
        if label not in _NO_LABEL and units.find(label) is not None:
            return label
    label = str(one.get(f"{side}_axis_units_lab", "")).strip()
    if label not in _NO_LABEL:
        return label  # unknown: whoever takes the channel says so
    unit = _SPECIFIC.get(int(one[f"{side}_spec_data_type"]), "").format(**file_units)
    return unit * (units.find(unit) is not None)
