"""Broken and awkward files of a test: each is read right, or told in one line that names file and remedy.

Every case is read by `sysid read` as a user calls it. A status of 0 must come with records that agree with the
true ones, 2 with one line that names the file (or its description) and says a word of the place or the remedy.
"""

from __future__ import annotations

import contextlib
import io
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

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
    """What is wrong with how a case ends, "" where nothing is."""
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


def _mat(folder: Path) -> None:
    from scipy.io import savemat

    savemat(folder / "run.mat", {"table": _TABLE, "top": _TOP, "fs": 100.0})


_STATED = _TOML.replace('axis = "x"', 'axis = "x"\nunit = "m/s^2"')
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
    ("NPZ", _both(_npz(table=_TABLE, top=_TOP, fs=np.array(100.0)), _STATED), _READ),
    ("NPZ without a rate", _both(_npz(table=_TABLE, top=_TOP), _STATED), "sample_rate"),
    ("NPZ cut short", _both(_cut(_npz(table=_TABLE, top=_TOP), "run.npz", 0.7), _STATED), "run.npz"),
    ("NPZ of pickles", _both(_npz(table=np.array([{}, 1], object)), _STATED), "run.npz"),
    ("NPZ of single numbers", _both(_npz(a=np.array(1.0)), _STATED), "no arrays"),
    ("MAT", _both(_mat, _STATED), _READ),
    ("MAT cut short", _both(_cut(_mat, "run.mat", 0.6), _STATED), "run.mat"),
    ("HDF5", _hdf5, _READ),
    ("HDF5 cut short", _cut(_hdf5, "run.h5", 0.6), "run.h5"),
]
