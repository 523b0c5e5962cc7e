"""Files of a test as five kinds of recorder write them, and the list of sensors beside them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.io import savemat

from benchmarks.laboratory.written_files import Lvm, StrongMotion

G = 9.80665  # m/s²
DIRECTIONS = {"x": 1, "y": 2, "z": 3}


class Channel(NamedTuple):
    """A channel: its name in the file, role, axis and position, m."""

    name: str
    role: str
    axis: str
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)


def sensors_list(channels: Sequence[Channel], columns: Sequence[str], unit: dict[str, str], top: str = "") -> str:
    """A TOML of channels in these columns; `unit` by role, where the file does not tell it."""
    text = top
    for one, column in zip(channels, columns, strict=True):
        text += f'[[sensor]]\ncolumn = "{column}"\nname = "{one.name}"\nrole = "{one.role}"\naxis = "{one.axis}"\n'
        text += f"position = {list(one.position)}\n"
        text += f'unit = "{unit[one.role]}"\n' if one.role in unit else ""
    return text


def csv(path: Path, channels: Sequence[Channel], rows: np.ndarray, rate: float) -> str:
    """A logger's table, accelerations in g and forces in kN; the list of sensors."""
    units = [("kN", 1000.0) if one.role == "force" else ("g", G) for one in channels]
    head = ["Time [s]", *(f"{one.name} [{unit}]" for one, (unit, _) in zip(channels, units, strict=True))]
    table = [np.arange(rows.shape[1]) / rate, *(row / size for row, (_, size) in zip(rows, units, strict=True))]
    np.savetxt(path, np.array(table).T, fmt="%.9g", delimiter=";", header=";".join(head), comments="")
    return sensors_list(channels, [one.name for one in channels], {})


def matlab(path: Path, channels: Sequence[Channel], rows: np.ndarray, rate: float) -> str:
    """Arrays of MATLAB with the rate as fs; the list of sensors, which states the units."""
    columns = [one.name.replace(" ", "_") for one in channels]
    savemat(path, dict(zip(columns, rows, strict=True)) | {"fs": rate})
    return sensors_list(channels, columns, {"base": "m/s²", "response": "m/s²", "force": "N"})


def labview(path: Path, channels: Sequence[Channel], rows: np.ndarray, rate: float) -> str:
    """A LabVIEW measurement file, in g and kN; the list of sensors."""
    units = ["kN" if one.role == "force" else "g" for one in channels]
    size = np.array([1000.0 if unit == "kN" else G for unit in units])[:, None]
    scale = 10 ** np.floor(np.log10(0.05 / np.abs(rows / size).max()))  # six decimals are enough for no less
    assert scale <= 1, "records are too small for six decimals"
    path.write_text(Lvm([one.name for one in channels], units, [rows / size], rate).text(), encoding="utf-8")
    return sensors_list(channels, [one.name for one in channels], {})


def strong_motion(path: Path, channels: Sequence[Channel], rows: np.ndarray, rate: float) -> str:
    """A Volume 2 file of the CESMD, in cm/s²; the list of sensors."""
    path.write_text(StrongMotion([one.name for one in channels], 100 * rows, 1 / rate).text(), encoding="utf-8")
    return sensors_list(channels, [f"Chan {at}" for at in range(1, len(channels) + 1)], {})


def universal(path: Path, channels: Sequence[Channel], rows: np.ndarray, rate: float) -> str:
    """Time records as sets 58; the list of sensors."""
    kinds = [_kind(one) for one in channels]
    sets = [
        _set_58(at, one, row, np.arange(row.size) / rate, 1, (kind, 0), 2)
        for at, (one, row, kind) in enumerate(zip(channels, rows, kinds, strict=True), 1)
    ]
    return _written(path, channels, sets, "")


def functions(path: Path, channels: Sequence[Channel], freq: np.ndarray, rows: np.ndarray, coherence: np.ndarray,
              top: str) -> str:  # fmt: skip
    """Functions of an analyser per acceleration of the base along x, and their coherences, as sets 58."""
    sets = [
        _set_58(at, one, row, freq, kind, (_kind(one) if kind == 4 else 0, 12 if kind == 4 else 0), data)
        for kind, data, values in ((4, 5, rows), (6, 2, coherence))
        for at, (one, row) in enumerate(zip(channels, values, strict=True), 1)
    ]
    return _written(path, channels, sets, top)


def _kind(one: Channel) -> int:
    return 13 if one.role == "force" else 12


def _set_58(
    node: int, one: Channel, row: np.ndarray, x: np.ndarray, function: int, kinds: tuple[int, int], data: int
) -> dict:  # fmt: skip
    """A function at a node in single precision: of type 1 over time, 4 of response, 6 of coherence over frequency."""
    import pyuff

    over = function != 1
    return dict(pyuff.prepare_58(
        binary=0, func_type=function, ver_num=0, load_case_id=0, rsp_ent_name="NONE", rsp_node=node,
        rsp_dir=DIRECTIONS[one.axis], ref_ent_name="NONE", ref_node=900 if over else 0, ref_dir=1 if over else 0,
        ord_data_type=data, num_pts=row.size, abscissa_spacing=1, abscissa_min=float(x[0]),
        abscissa_inc=float(x[1] - x[0]), abscissa_spec_data_type=18 if over else 17, orddenom_spec_data_type=kinds[1],
        z_axis_spec_data_type=0, ordinate_spec_data_type=kinds[0], x=x, data=row, id1=one.name, id2="", id3="", id4="",
        id5="",
    ))  # fmt: skip


def _written(path: Path, channels: Sequence[Channel], sets: list[dict], top: str) -> str:
    import pyuff

    pyuff.UFF(str(path)).write_sets(sets, "overwrite", force_double=False)
    columns = [f"{at}+{one.axis.upper()}" for at, one in enumerate(channels, 1)]
    return sensors_list(channels, columns, {}, top)


def stepped_table(path: Path, channels: Sequence[Channel], freq: np.ndarray, rows: np.ndarray) -> str:
    """A table of amplitudes and phases over frequency, in g and N; the list of sensors."""
    units = [("N", 1.0) if one.role == "force" else ("g", G) for one in channels]
    head, table = ["Frequency [Hz]"], [freq]
    for one, row, (unit, size) in zip(channels, rows, units, strict=True):
        head += [f"Mag({one.name}) [{unit}]", f"Phase({one.name}) [deg]"]
        table += [np.abs(row) / size, np.degrees(np.angle(row))]
    np.savetxt(path, np.array(table).T, fmt="%.9g", delimiter=",", header=",".join(head), comments="")
    return sensors_list(channels, [one.name for one in channels], {}, 'frf = "spectrum"\n')
