"""Data that tests of files share: responses of a chain of three masses on its base, and sets of universal files."""

from pathlib import Path

import numpy as np
import pytest

import sysid

FREQ = np.arange(1, 401) * 0.05
STRETCH = np.array([[1.0, 0, 0, -1], [-1, 1, 0, 0], [0, -1, 1, 0]])
TRUTH = sysid.Structure(
    np.diag([4.0, 3.0, 2.0, 0.0]), STRETCH.T @ np.diag([9e3, 7e3, 5e3]) @ STRETCH, [0.02] * 3, n_base=1
)
H = TRUTH.relative_acceleration(FREQ)[:, 0] + 1
F = TRUTH.base_force(FREQ)[0, 0]
IN_MM = {"type": 164, "units_code": 5, "units_description": "mm", "temp_mode": 1, "length": 1e3, "force": 1e3,
         "temp": 1.0, "temp_offset": 273.15}  # fmt: skip


def nodes(z):
    """Set 2411: nodes 1, 2, ... at heights `z`."""
    pyuff = pytest.importorskip("pyuff")
    none, zero = np.zeros(len(z), int), np.zeros(len(z))
    return pyuff.prepare_2411(
        node_nums=np.arange(1, len(z) + 1), def_cs=none, disp_cs=none, color=none, x=zero, y=zero, z=np.array(z)
    )


def function(node, data, freq=FREQ, **given):
    """Set 58: acceleration of a node along x per acceleration of node 100 along x; `given`, what stands otherwise."""
    known = {
        "binary": 0, "func_type": 4, "rsp_node": node, "rsp_dir": 1, "ref_node": 100, "ref_dir": 1, "x": freq,
        "num_pts": freq.size, "data": data, "id1": "", "id2": "", "id3": "", "id4": "", "id5": "", "load_case_id": 0,
        "rsp_ent_name": "s", "ref_ent_name": "r", "abscissa_spacing": 1, "abscissa_inc": freq[1] - freq[0],
        "abscissa_min": freq[0], "ord_data_type": 6, "ordinate_spec_data_type": 12, "orddenom_spec_data_type": 12,
        "abscissa_spec_data_type": 18,
    }  # fmt: skip
    return pytest.importorskip("pyuff").prepare_58(**known | given)


def write_universal(path, sets):
    """Write sets as a universal file."""
    pytest.importorskip("pyuff").UFF(str(path)).write_sets(sets, "overwrite")


def strong_motion(name, channels, step=0.02):
    """What of the format is read, with more digits than it has."""
    lines = ["Corrected accelerogram"]
    for number, row in enumerate(channels, 1):
        lines += [
            f"Chan {number}:  360 Deg",
            f"{row.size} points of accel data equally spaced at {step:.3f} sec, in m/sec2. (1f25.17)",
        ]
        lines += [*(f"{one:25.17f}" for one in row), f"End of data for channel {number}"]
    Path(name).write_text("\n".join(lines))


def save(name, heads, rows):
    """Write a table with a column a row of `rows`."""
    np.savetxt(name, np.array(rows).T, "%.12g", ",", header=",".join(heads), comments="", encoding="utf-8")
