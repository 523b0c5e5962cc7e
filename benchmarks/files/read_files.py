"""One simulated test in every format that is read: `sysid read`, `run`, `export` give a report and the same masses.

Sensors of three axes each on a structure whose table moves along x, y and z at once, its force measured.
The table is in g and the force in kN, so that units are converted on the way.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import json
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

import sysid
from benchmarks.line import Line, below
from sysid.cli import main as cli

_RATE = 200.0
_G = 9.80665
_AXES = "xyz"


def lines(reduced: bool) -> Iterator[Line]:
    """Measure."""
    truth, records = simulated(1 if reduced else 2, 800 if reduced else 6000)
    channels = described(records)
    writers: dict[str, Callable[[Path], None]] = {
        "CSV": lambda path: csv(path, channels),
        "MAT": lambda path: mat(path, channels),
    }
    if importlib.util.find_spec("pyuff") is None:
        yield Line("UFF 58", "pyuff is not installed")
    else:
        for name, (binary, single) in {"UFF 58": (0, 0), "UFF 58b": (1, 0), "UFF 58b single": (1, 1)}.items():
            writers[name] = lambda path, b=binary, s=single: universal(path, channels, b, s)  # type: ignore[misc]
    endings = {"CSV": "csv", "MAT": "mat"}
    with tempfile.TemporaryDirectory() as folder:
        masses = {}
        for name, write in writers.items():
            where = Path(folder, name.replace(" ", "_"))
            where.mkdir()
            file = where / f"test.{endings.get(name, 'uff')}"
            write(file)
            masses[name] = through_commands(file, channels, name)
            report = (where / "result" / "report.html").stat().st_size
            yield Line(f"{name}: bytes of its report", f"{report}", "> 0", report > 0)
    first = masses["CSV"]
    yield below("CSV: mass that moves with the table over the true one - 1", _total(first, truth), 0.005)
    for name, mass in masses.items():
        if name != "CSV":
            apart = float(np.max(np.abs(mass - first)) / np.max(np.abs(first)))
            yield below(f"{name}: masses in the OP4 against those of CSV", apart, 1e-4 if "single" in name else 1e-6)


def simulated(storeys: int, samples: int) -> tuple[sysid.Structure, list[np.ndarray]]:
    """A chain of storeys in each direction, and records of base, responses and force with 0.1 % noise."""
    stretch = np.eye(storeys) - np.eye(storeys, k=-1)
    n = 3 * storeys
    mass, stiff = np.zeros((n + 3, n + 3)), np.zeros((n, n))
    for axis, factor in enumerate((1.0, 1.7, 4.0)):
        at = np.arange(storeys) * 3 + axis
        mass[at, at] = 400.0 - 100.0 * np.arange(storeys)
        stiff[np.ix_(at, at)] = factor * 6e5 * stretch.T @ stretch
    mass[n:, n:] = 100 * np.eye(3)
    G = np.tile(np.eye(3), (storeys, 1))
    full = np.block([[stiff, -stiff @ G], [-G.T @ stiff, G.T @ stiff @ G]])
    truth = sysid.Structure(mass, full, np.full(n, 0.02), n_base=3)
    rng = np.random.default_rng(13)
    lines_, spectrum = np.fft.rfftfreq(samples, 1 / _RATE), np.zeros((3, samples // 2 + 1), complex)
    used = (lines_ > 0.5) & (lines_ < 20)
    spectrum[:, used] = np.exp(2j * np.pi * rng.random((3, int(used.sum()))))
    base = np.fft.irfft(spectrum, samples)
    base /= base.std()
    records = [base, truth.simulate(base, _RATE), truth.simulate_force(base, _RATE)]
    return truth, [one + 1e-3 * one.std() * rng.standard_normal(one.shape) for one in records]


def described(records: list[np.ndarray]) -> list[dict[str, Any]]:
    """Name, role, axis, node, unit and numbers in that unit of every channel."""
    base, response, force = records
    found = []
    for axis in range(3):
        found.append({"role": "base", "node": 1, "values": base[axis] / _G, "unit": "g"})
    for at in range(len(response)):
        found.append({"role": "response", "node": 2 + at // 3, "values": response[at], "unit": "m/s^2"})
    for axis in range(3):
        found.append({"role": "force", "node": 9, "values": force[axis] / 1e3, "unit": "kN"})
    for at, channel in enumerate(found):
        channel["axis"] = _AXES[at % 3]
        channel["position"] = [0.0, 0.0, 3.0 * (channel["node"] - 1) if channel["role"] == "response" else 0.0]
        channel["name"] = f"{channel['role']}{channel['node']}{channel['axis']}"
    return found


def csv(path: Path, channels: list[dict[str, Any]]) -> None:
    """All digits, with a header."""
    values = np.array([channel["values"] for channel in channels])
    heads = ",".join(f"{channel['name']} [{channel['unit']}]" for channel in channels)
    np.savetxt(path, values.T, delimiter=",", header=heads, comments="", fmt="%.17g")


def mat(path: Path, channels: list[dict[str, Any]]) -> None:
    """A vector a channel."""
    scipy.io.savemat(path, {channel["name"]: channel["values"] for channel in channels} | {"fs": _RATE})


def universal(path: Path, channels: list[dict[str, Any]], binary: int, single: int) -> None:
    """A set 58 a channel, behind the positions of the nodes."""
    import pyuff

    places = {channel["node"]: channel["position"] for channel in channels}
    nodes, none = np.array(list(places)), np.zeros(len(places), int)
    x, y, z = np.array([places[int(node)] for node in nodes]).T
    sets = [pyuff.prepare_2411(node_nums=nodes, def_cs=none, disp_cs=none, color=none, x=x, y=y, z=z)]
    for channel in channels:
        values = channel["values"]
        sets.append(
            pyuff.prepare_58(
                binary=binary, func_type=1, rsp_node=channel["node"], rsp_dir=1 + _AXES.index(channel["axis"]),
                ref_node=0, ref_dir=0, x=np.arange(values.size) / _RATE, num_pts=values.size, data=values,
                id1="", id2="", id3="", id4="", id5="", load_case_id=0, rsp_ent_name="s", ref_ent_name="r",
                abscissa_spacing=1, abscissa_inc=1 / _RATE, abscissa_min=0.0, ord_data_type=2 if single else 4,
                ordinate_spec_data_type=9 if channel["role"] == "force" else 12, orddenom_spec_data_type=0,
                abscissa_spec_data_type=17, ordinate_axis_units_lab=channel["unit"], orddenom_axis_units_lab="NONE",
            )
        )  # fmt: skip
    pyuff.UFF(str(path)).write_sets(sets, "overwrite", force_double=not single)
    if single and binary:  # pyuff states single precision in a binary set, and writes double
        content = path.read_bytes()
        for channel in channels:
            values = np.asarray(channel["values"])
            content = content.replace(values.astype("<f8").tobytes(), values.astype("<f4").tobytes())
        path.write_bytes(content)


def through_commands(file: Path, channels: list[dict[str, Any]], name: str) -> np.ndarray:
    """The mass matrix in the OP4, or in the MAT without pyYeti, that the three commands write."""
    lines_ = [] if "UFF" in name or name == "MAT" else [f"sample_rate = {_RATE}"]
    for channel in channels:
        column = f"{channel['node']}+{channel['axis'].upper()}" if "UFF" in name else channel["name"]
        entry = {"column": column} | {key: channel[key] for key in ("name", "role", "axis", "position")}
        entry |= {"unit": channel["unit"]} if name == "MAT" else {}
        lines_ += ["[[sensor]]", *(f"{key} = {json.dumps(value)}" for key, value in entry.items())]
    file.with_suffix(".toml").write_text("\n".join(lines_), encoding="utf-8")
    test, result = file.parent / "test.h5", file.parent / "result"
    nastran = importlib.util.find_spec("pyyeti") is not None
    target = file.parent / ("m.op4" if nastran else "m.mat")
    _said(["read", str(file), "--out", str(test)])
    _said(["run", str(test), "--out", str(result)])
    _said(["export", str(result), str(target)])
    if not nastran:
        return np.asarray(scipy.io.loadmat(target)["M"])
    from pyyeti.nastran import op4

    return np.asarray(op4.read(str(target))["m"])


def _said(words: list[str]) -> None:
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")  # pyuff leaves files open
        status = cli.main(words)
    if status not in (0, 1):
        raise RuntimeError(f"sysid {' '.join(words)} ended with status {status}")


def _total(mass: np.ndarray, truth: sysid.Structure) -> float:
    """Largest relative error of the mass that moves with the table, a direction."""
    G = np.vstack([np.tile(np.eye(3), (len(mass) // 3 - 1, 1)), np.eye(3)])
    total = G.T @ mass @ G
    return float(np.max(np.abs(np.diag(total) / np.diag(truth.rigid_body_mass) - 1)))
