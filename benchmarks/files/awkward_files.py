"""Broken and awkward files of a test: each is read right, or told in one line that names file and remedy.

Every case is read by `sysid read` as a user calls it. A status of 0 must come with records that agree with the
true ones, 2 with one line that names the file (or its description) and says a word of the place or the remedy.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.line import Line, below
from sysid.cli import main as cli
from sysid.files import recorded_test

_SAMPLES = 300
_TABLE, _TOP = np.random.default_rng(5).standard_normal((2, _SAMPLES))
_TOML = """\
[[sensor]]
column = "table"
role = "base"
axis = "x"
[[sensor]]
column = "top"
role = "response"
axis = "x"
position = [0.0, 0.0, 3.0]
"""
_READ = ""  # of a file that is to be read right

Case = tuple[str, Callable[[Path], None], str]


def lines(reduced: bool) -> Iterator[Line]:
    """Measure: cases that end otherwise than they should, with their names."""
    wrong = []
    for name, write, words in _CASES:
        with tempfile.TemporaryDirectory() as folder:
            if fault := _fault(Path(folder), write, words):
                wrong.append(f"{name}: {fault}")
    for fault in wrong:
        yield Line("wrong", fault)
    yield below(f"of {len(_CASES)} awkward files, not read right and not told", len(wrong), 0)


def _fault(folder: Path, write: Callable[[Path], None], words: str) -> str:
    """Fault in the end of a case, "" where there is none."""
    (folder / "sensors.toml").write_text(_TOML, encoding="utf-8")
    write(folder)
    files = sorted(str(path) for path in folder.iterdir() if path.suffix != ".toml")
    told, target = io.StringIO(), folder / "out" / "test.h5"
    target.parent.mkdir()
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(told):
        warnings.simplefilter("ignore")
        status = cli.main(["read", *files, "--out", str(target)])
    line = told.getvalue().strip()
    if not words:
        if status:
            return f"status {status}: {line}"
        base, response, _ = recorded_test.load(target).runs[0]
        n = min(base.shape[1], _SAMPLES)
        right = n > _SAMPLES - 3 and np.allclose(base[0, :n], _TABLE[:n]) and np.allclose(response[0, :n], _TOP[:n])
        return "" if right else "read, with other numbers"
    named = "run" in line or "sensors.toml" in line
    if status != 2 or line.count("\n") or not named or words not in line:
        return f"status {status}: {line}"
    return ""


def _rows(comma: bool = False, scale: float = 1.0) -> list[str]:
    time = np.arange(_SAMPLES) / 100
    rows = [f"{t:.4f};{a:.12g};{b:.12g}" for t, a, b in zip(time, _TABLE, _TOP * scale, strict=True)]
    return [row.replace(".", ",") for row in rows] if comma else rows


_HEAD = "time [s];table [m/s^2];top [m/s^2]"


def _text(rows: list[str], head: str = _HEAD, encoding: str = "utf-8") -> Callable[[Path], None]:
    return lambda folder: (folder / "run.csv").write_bytes("\n".join([head, *rows]).encode(encoding)) and None


def _bytes(name: str, content: bytes) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_bytes(content) and None


def _both(write: Callable[[Path], None], toml: str) -> Callable[[Path], None]:
    def done(folder: Path) -> None:
        write(folder)
        (folder / "sensors.toml").write_text(toml, encoding="utf-8")

    return done


def _npz(**arrays: np.ndarray) -> Callable[[Path], None]:
    return lambda folder: np.savez(folder / "run.npz", **arrays)


def _cut(write: Callable[[Path], None], name: str, share: float) -> Callable[[Path], None]:
    def done(folder: Path) -> None:
        write(folder)
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content[: int(share * len(content))])

    return done


def _hdf5(folder: Path) -> None:
    import h5py

    with h5py.File(folder / "run.h5", "w") as file:
        file.update({"table": _TABLE, "top": _TOP, "fs": 100.0})
        for name in ("table", "top"):
            file[name].attrs["unit"] = "m/s^2"


def _named(name: str) -> Callable[[Path], None]:
    """An HDF5 file of another name."""

    def done(folder: Path) -> None:
        _hdf5(folder)
        (folder / "run.h5").rename(folder / name)

    return done


def _matrix(channels: int) -> Callable[[Path], None]:
    """MATLAB's time and a matrix of which the records of the test are the first two columns."""

    def done(folder: Path) -> None:
        from scipy.io import savemat

        matrix = np.vstack([_TABLE, _TOP, np.ones((channels - 2, _SAMPLES))]).T
        savemat(folder / "run.mat", {"x": matrix, "t": np.arange(_SAMPLES) / 100})

    return done


def _mat(folder: Path) -> None:
    from scipy.io import savemat

    savemat(folder / "run.mat", {"table": _TABLE, "top": _TOP, "fs": 100.0})


def _many(content: dict[str, str], toml: str) -> Callable[[Path], None]:
    """Several text files, and what is said of them."""

    def done(folder: Path) -> None:
        for name, text in content.items():
            (folder / name).write_text(text, encoding="utf-8")
        (folder / "sensors.toml").write_text(toml, encoding="utf-8")

    return done


def _with(old: str, new: str) -> list[str]:
    """The rows with what stands in one cell of the 91st replaced."""
    rows = _rows()
    cells = rows[90].split(";")
    cells[int(old)] = new
    return [*rows[:90], ";".join(cells), *rows[91:]]


def _one_each(shift: float = 0.0, fewer: int = 0) -> dict[str, str]:
    """A file a sensor; the second begins later, or is shorter."""
    time = np.arange(_SAMPLES) / 100
    both = (("run_table", time, _TABLE), ("run_top", (time + shift)[: _SAMPLES - fewer], _TOP))
    return {
        f"{name}.csv": "\n".join(["time;a", *(f"{t:.4f};{a:.12g}" for t, a in zip(*pair, strict=False))])
        for name, *pair in both
    }


def _universal(change: Callable[[str], str] = str, **given: Any) -> Callable[[Path], None]:
    """Two time records as sets 58, the text changed; nothing where pyuff is not installed."""

    def done(folder: Path) -> None:
        import pyuff

        sets = [
            pyuff.prepare_58(
                **{
                    "binary": 0, "func_type": 1, "ver_num": 0, "load_case_id": 0, "rsp_ent_name": "NONE",
                    "rsp_node": node, "rsp_dir": 1, "ref_ent_name": "NONE", "ref_node": 0, "ref_dir": 0,
                    "ord_data_type": 4, "num_pts": _SAMPLES, "abscissa_spacing": 1, "abscissa_min": 0.0,
                    "abscissa_inc": 0.01, "abscissa_spec_data_type": 17, "orddenom_spec_data_type": 0,
                    "z_axis_spec_data_type": 0, "ordinate_spec_data_type": 12, "x": np.arange(_SAMPLES) / 100,
                    "data": row, "id1": "", "id2": "", "id3": "", "id4": "", "id5": "",
                }
                | given
            )
            for node, row in ((1, _TABLE), (2, _TOP))
        ]  # fmt: skip
        pyuff.UFF(str(folder / "run.uff")).write_sets(sets, "overwrite")
        path, toml = folder / "run.uff", _TOML.replace('"table"', '"1+X"').replace('"top"', '"2+X"')
        path.write_text(change(path.read_text()))
        (folder / "sensors.toml").write_text(toml)

    return done


_STATED = _TOML.replace('axis = "x"', 'axis = "x"\nunit = "m/s^2"')
_MATRIX = _STATED.replace('"table"', '"x[1]"').replace('"top"', '"x[2]"')
_SECOND = _TOML.partition("[[sensor]]\n")[2].partition("[[sensor]]\n")[2].replace("column", 'name = "top"\ncolumn')
_SECOND = "[[sensor]]\n" + _SECOND.replace('column = "top"', "column = 2")
_TURNS = _HEAD.replace("table [m/s^2]", "table [rad/s^2]")
_EACH = _STATED.replace('"table"', '"run_table"').replace('"top"', '"run_top"')
_WIDE = ";".join(["time [s]", "table [m/s^2]", "top [m/s^2]", *(f"A{k} [g]" for k in range(998))])
_CASES: list[Case] = [
    ("as it should be", _text(_rows()), _READ),
    ("decimal commas", _text(_rows(comma=True)), _READ),
    ("windows-1252", _text(_rows(), "Zeit in Sekunden für Prüfstand;;\n" + _HEAD, "cp1252"), _READ),
    ("UTF-16", _text(_rows(), encoding="utf-16"), _READ),
    ("UTF-16 without its mark", _text(_rows(), encoding="utf-16-le"), _READ),
    ("UTF-32", _text(_rows(), encoding="utf-32"), _READ),
    ("last row cut short", _text([*_rows(), "3.0;0.1"]), _READ),
    ("last row of words", _text([*_rows(), "end;of;test"]), _READ),
    ("mixed units, converted", _text(_rows(scale=1e3), _HEAD.replace("top [m/s^2]", "top [mm/s^2]")), _READ),
    ("a thousand channels", _text([row + ";0.5" * 998 for row in _rows()], _WIDE), _READ),
    ("empty columns", _text([row + ";;" for row in _rows()], _HEAD + ";;"), _READ),
    ("empty", _text([], ""), "is empty"),
    ("words alone", _text(["one", "two"], "three"), "no table of numbers"),
    ("a bad row in the middle", _text([*_rows()[:90], "x;y;z", *_rows()[90:]]), "line 92"),
    ("a number that is none", _text(_with("2", "NaN")), "sample 91"),
    ("an error of a spreadsheet", _text(_with("2", "#N/A")), "line 92"),
    ("one number cell too many", _text(_with("2", "1;2")), "line 92"),
    ("only a header", _text([]), "no table of numbers"),
    ("one row", _text(_rows()[:1]), "no record"),
    ("time that runs backwards", _text(_rows()[::-1]), "backwards"),
    ("time that stands still", _text([row[:3] + row[6:] for row in _rows()]), "--rate"),
    ("time of day", _text([f"01.03.2024 12:00:0{row}" for row in _rows()]), _READ),
    ("a folder", lambda folder: (folder / "run.csv").mkdir(), "is a folder"),
    ("line ends of old Macs", _bytes("run.csv", "\r".join([_HEAD, *_rows()]).encode()), _READ),
    ("zeros behind the end", _bytes("run.csv", "\n".join([_HEAD, *_rows(), "\0" * 99]).encode()), _READ),
    ("two sensors of one name", _both(_text(_rows()), _TOML + _SECOND), "name them apart"),
    ("a base that turns", _both(_text(_rows(), _TURNS), _TOML.replace('"x"', '"rx"', 1)), _READ),
    ("and no position", _both(_text(_rows(), _TURNS), _TOML.replace('"x"', '"rx"', 1).partition("pos")[0]), "turns"),
    ("a file a sensor", _many(_one_each(), "join = true\n" + _EACH), _READ),
    ("a file a sensor, not said", _many(_one_each(), _EACH), "--join"),
    ("a file a sensor, of other times", _many(_one_each(shift=0.5), "join = true\n" + _EACH), "sysid.resample"),
    ("a file a sensor, one short", _many(_one_each(fewer=90), "join = true\n" + _EACH), "210 samples"),
    ("a file a sensor, one a sample short", _many(_one_each(fewer=1), "join = true\n" + _EACH), _READ),
    ("a gap in a channel", _text([*_rows()[:90], "0.9000;;1", *_rows()[91:]]), "sample 91"),
    ("overflow of the logger", _text([*_rows()[:90], "0.9000;inf;1", *_rows()[91:]]), "sample 91"),
    ("two tests in one file", _text([*_rows(), *_rows()]), "two tests"),
    ("two tests with their headers", _text([*_rows(), _HEAD, *_rows()]), "second test"),
    ("missing samples", _text(_rows()[:90] + _rows()[99:]), "uneven"),
    ("a channel is missing", _text([row.rpartition(";")[0] for row in _rows()], _HEAD.rpartition(";")[0]), "'top'"),
    ("a channel twice", _text(_rows(), "time [s];top [m/s^2];top [m/s^2]"), "table"),
    ("no units", _text(_rows(), "time;table;top"), "unit"),
    ("a unit that is none", _text(_rows(), _HEAD.replace("top [m/s^2]", "top [furlong]")), "furlong"),
    ("volts", _text(_rows(), _HEAD.replace("top [m/s^2]", "top [V]")), "'V'"),
    ("no axis", _both(_text(_rows()), _TOML.replace('axis = "x"\n', "", 1)), "axis is missing"),
    ("an axis that is none", _both(_text(_rows()), _TOML.replace('axis = "x"', 'axis = "north"', 1)), "north"),
    ("no base", _both(_text(_rows()), _TOML.replace('"base"', '"response"', 1)), "base"),
    ("a broken TOML", _both(_text(_rows()), "[[sensor"), "no TOML"),
    ("a role that is none", _both(_text(_rows()), _TOML.replace('"base"', '"floor"', 1)), "role"),
    ("a sensor that is no table", _both(_text(_rows()), 'sensor = "x"\n'), "sensor"),
    ("a dead channel", _text([row.rpartition(";")[0] + ";0" for row in _rows()]), "leave it out"),
    ("a spreadsheet", _bytes("run.xlsx", b"PK\3\4"), "ending"),
    ("an archive named CSV", _bytes("run.csv", b"PK\3\4" + bytes(range(256)) * 20), "export it as text"),
    ("noise named MAT", _bytes("run.mat", bytes(range(256)) * 20), "run.mat"),
    ("noise named NPZ", _bytes("run.npz", bytes(range(256)) * 20), "run.npz"),
    ("noise named UFF", _bytes("run.uff", bytes(range(256)) * 20), "run.uff"),
    ("noise named HDF5", _bytes("run.h5", bytes(range(256)) * 20), "run.h5"),
    ("a UFF without sets", _bytes("run.uff", b"    -1\n    -1\n"), "run.uff"),
    ("a UFF with an unknown set", _bytes("run.uff", b"    -1\n  9999\n 1 2 3\n    -1\n"), "run.uff"),
    ("a set 58 cut inside its head", _bytes("run.uff", b"    -1\n    58\nNONE\nNONE\n    -1\n"), "set 1"),
    ("HDF5 named CSV", _named("run.csv"), "ending .h5"),
    ("NPZ", _both(_npz(table=_TABLE, top=_TOP, fs=np.array(100.0)), _STATED), _READ),
    ("NPZ without a rate", _both(_npz(table=_TABLE, top=_TOP), _STATED), "sample_rate"),
    ("NPZ cut short", _both(_cut(_npz(table=_TABLE, top=_TOP), "run.npz", 0.7), _STATED), "run.npz"),
    ("NPZ of pickles", _both(_npz(table=np.array([{}, 1], object)), _STATED), "run.npz"),
    ("NPZ of single numbers", _both(_npz(a=np.array(1.0)), _STATED), "no arrays"),
    ("MAT", _both(_mat, _STATED), _READ),
    ("MAT cut short", _both(_cut(_mat, "run.mat", 0.6), _STATED), "run.mat"),
    ("MAT with time along its longer side", _both(_matrix(3), _MATRIX), _READ),
    ("MAT of more channels than samples", _both(_matrix(1000), _MATRIX), _READ),
    ("NPZ of complex numbers without frequencies", _both(_npz(table=_TABLE + 1j, top=_TOP), _STATED), "--frequency"),
    ("HDF5", _hdf5, _READ),
    ("HDF5 cut short", _cut(_hdf5, "run.h5", 0.6), "run.h5"),
]
if importlib.util.find_spec("pyuff") is not None:
    _CASES += [
        ("UFF", _universal(), _READ),
        ("UFF cut short", _universal(lambda text: text[: int(0.8 * len(text))]), "cut short"),
        ("UFF cut inside a number", _universal(lambda text: text[:-40] + "\n    -1\n"), "set 2"),
        ("UFF of another type", _universal(lambda text: text.replace("    58", "    55", 1)), "run.uff"),
        ("UFF of a type that is none", _universal(lambda text: text.replace("    58", "  9958", 1)), "run.uff"),
        ("UFF with words for numbers", _universal(lambda text: text.replace("E", "x", 60)), "run.uff"),
        ("UFF with the line ends of Windows", _universal(lambda text: text.replace("\n", "\r\n")), _READ),
        (
            "UFF with fewer points than it says",
            _universal(lambda text: text.replace("       300", "       900", 1)),
            "set 1",
        ),
        ("UFF of an unknown unit", _universal(ordinate_axis_units_lab="furlong"), "furlong"),
        ("UFF of no unit", _universal(ordinate_spec_data_type=0), "unit"),
        ("UFF of one channel twice", _universal(rsp_node=1), "'2+X'"),
        ("UFF of coherences", _universal(func_type=6), "coherence"),
    ]
