"""Files of one simulated test in three directions, read, identified and exported by the command line.

The same records as a logger's CSV, as MATLAB arrays, and as universal files 58 (text in double and single precision,
and binary): the masses of the exported files are compared with those of the records as they were simulated.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.io import savemat

import sysid
from benchmarks.line import Line, below
from benchmarks.records.simulated import Setting, coupled_structure
from sysid.cli import main as cli

AXES = "xyz"
STANDARD_GRAVITY = 9.80665


def lines(reduced: bool) -> Iterator[Line]:
    """Measure."""
    kinds = ("csv", "mat") if importlib.util.find_spec("pyuff") is None else ("csv", "mat", "58", "58b", "58 single")
    for seed in range(1 if reduced else 4):
        records, sensors, rate = _test(seed)
        masses = {}
        with tempfile.TemporaryDirectory() as folder:
            for kind in kinds:
                where = Path(folder) / kind.replace(" ", "_")
                where.mkdir()
                masses[kind] = _identified(_write(kind, where, records, sensors, rate), where)
        own = _direct(records, sensors, rate)
        for kind, mass in masses.items():
            most = 1e-4 if kind.endswith("single") else 1e-6
            off = float(np.max(np.abs(mass - own)) / np.max(np.abs(own)))
            yield below(f"test {seed}, {kind}: read, run, export: masses off the records' own", off, most)


def _test(seed: int) -> tuple[dict[str, np.ndarray], list[sysid.Sensor], float]:
    """Records by channel, SI units, of five sensors, three base directions and the base force."""
    rng = np.random.default_rng((seed, 13))
    truth = coupled_structure(rng, 5, 3, np.array([2.1, 3.4, 5.2, 7.7, 9.6]))
    setting = Setting(truth, 60.0, 64.0, (1.0, 14.0), (0.5, 16.0), np.eye(3))
    noisy, _ = setting.with_noise(setting.run(rng).records(), rng)
    sensors = [
        sysid.Sensor(f"a{i}", (0.0, 0.0, float(i)), AXES[int(np.argmax(np.abs(row)))])
        for i, row in enumerate(truth.rigid_body, 1)
    ]
    channels = {f"table {axis}": row for axis, row in zip(AXES, noisy.base, strict=True)}
    channels |= {sensor.name: row for sensor, row in zip(sensors, noisy.response, strict=True)}
    channels |= {f"force {axis}": row for axis, row in zip(AXES, noisy.force, strict=True)}
    return channels, sensors, setting.sample_rate


def _direct(records: dict[str, np.ndarray], sensors: list[sysid.Sensor], rate: float) -> np.ndarray:
    parts = [np.array([records[name] for name in names]) for names in _names(sensors)]
    G = sysid.rigid_body([s.position for s in sensors], [s.axis for s in sensors], base_axes="x y z")
    test = sysid.Measurement.from_time([tuple(parts)], rate, rigid_body=G, sensors=sensors, band=(1.0, 14.0))
    return sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), rng=0).structure.mass


def _names(sensors: list[sysid.Sensor]) -> tuple[list[str], list[str], list[str]]:
    return [f"table {axis}" for axis in AXES], [s.name for s in sensors], [f"force {axis}" for axis in AXES]


def _write(
    kind: str, where: Path, records: dict[str, np.ndarray], sensors: list[sysid.Sensor], rate: float
) -> list[str]:
    """Write the file and its sensors.toml; the files for ``sysid read``."""
    columns = {name: name for name in records}
    if kind == "csv":  # accelerations in g, the force in kN
        path = where / "test.csv"
        units = {name: "kN" if name.startswith("force") else "g" for name in records}
        size = {"g": STANDARD_GRAVITY, "kN": 1000.0}
        table = [np.arange(len(records["a1"])) / rate, *(row / size[units[name]] for name, row in records.items())]
        head = ["Time [s]", *(f"{name} [{unit}]" for name, unit in units.items())]
        np.savetxt(path, np.array(table).T, fmt="%.17g", delimiter=";", header=";".join(head), comments="")
    elif kind == "mat":
        path, columns = where / "test.mat", {name: name.replace(" ", "_") for name in records}
        savemat(path, {columns[name]: row for name, row in records.items()} | {"fs": rate})
    else:
        path, columns = where / "test.unv", _universal(where / "test.unv", kind, records, sensors, rate)
    (where / "sensors.toml").write_text("".join(_described(columns, sensors, kind)), encoding="utf-8")
    return [str(path)]


def _described(columns: dict[str, str], sensors: list[sysid.Sensor], kind: str) -> Iterator[str]:
    axis = {s.name: s.axis for s in sensors} | {f"{what} {a}": a for what in ("table", "force") for a in AXES}
    unit = {"table": "m/s²", "force": "N", "a": "m/s²"}
    place = {s.name: list(s.position) for s in sensors}
    if kind == "csv":
        yield 'time = "Time"\n'
    for name, column in columns.items():
        role = {"table": "base", "force": "force"}.get(name.split()[0], "response")
        yield f'[[sensor]]\ncolumn = "{column}"\nname = "{name}"\nrole = "{role}"\naxis = "{axis[name]}"\n'
        if kind == "mat":
            yield f'unit = "{unit[name.rstrip("0123456789").split()[0]]}"\n'
        if name in place:
            yield f"position = {place[name]}\n"


def _universal(
    path: Path, kind: str, records: dict[str, np.ndarray], sensors: list[sysid.Sensor], rate: float
) -> dict[str, str]:
    """Write sets 58 of time records; the name of each channel in the file, by node and direction."""
    import pyuff

    axis = {s.name: s.axis for s in sensors} | {f"{what} {a}": a for what in ("table", "force") for a in AXES}
    none, zero = np.zeros(len(sensors), int), np.zeros(len(sensors))
    places = {"x": zero, "y": zero, "z": np.array([s.position[2] for s in sensors])}
    nodes = pyuff.prepare_2411(
        node_nums=none + 1 + np.arange(len(sensors)), def_cs=none, disp_cs=none, color=none, **places
    )
    single, sets, columns = kind.endswith("single"), [nodes], {}
    for name, row in records.items():
        node = {"table": 100, "force": 200}.get(name.split()[0]) or int(name[1:])
        columns[name] = f"{node}+{axis[name].upper()}"
        sets.append(
            pyuff.prepare_58(
                binary=int(kind.startswith("58b")), func_type=1, ver_num=0, load_case_id=0, rsp_ent_name="NONE",
                rsp_node=node, rsp_dir=1 + AXES.index(axis[name]), ref_ent_name="NONE", ref_node=0, ref_dir=0,
                ord_data_type=2 if single else 4, num_pts=row.size, abscissa_spacing=1, abscissa_min=0.0,
                abscissa_inc=1 / rate, abscissa_spec_data_type=17, orddenom_spec_data_type=0, z_axis_spec_data_type=0,
                ordinate_spec_data_type=13 if name.startswith("force") else 12, x=np.arange(row.size) / rate,
                data=row, id1=name, id2="", id3="", id4="", id5="",
            )
        )  # fmt: skip
    pyuff.UFF(str(path)).write_sets(sets, "overwrite", force_double=not single)
    return columns


def _identified(files: list[str], where: Path) -> np.ndarray:
    """Mass that the exported file holds, after the three command lines."""
    test, out = where / "test.h5", where / "result"
    exported = where / ("m.op4" if importlib.util.find_spec("pyyeti") else "m.mat")
    for command in (
        ["read", *files, "--out", str(test)],
        ["run", str(test), "--band", "1-14", "--out", str(out)],
        ["export", str(out / "result.h5"), str(exported)],
    ):
        said, wrong = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(wrong):
            status = cli.main(command)
        if status:
            raise RuntimeError(f"{' '.join(command)} ended with status {status}: {wrong.getvalue()}")
    if exported.suffix == ".mat":
        from scipy.io import loadmat

        return np.asarray(loadmat(exported)["M"])
    from pyyeti.nastran import op4

    return np.asarray(op4.read(str(exported))["m"])
