"""Awkward and broken files: each is read right, or refused by one line that names file, place and remedy."""

from __future__ import annotations

import contextlib
import io
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from scipy.io import savemat

from benchmarks.line import Line
from sysid.cli import main as cli
from sysid.files import recorded_test

RATE, SAMPLES = 100.0, 400
RECORDS = np.random.default_rng(3).standard_normal((3, SAMPLES)).round(6)  # table, a1, a2, m/s²
NAMES = ("table", "a1", "a2")
SENSORS = """time = "time"
[[sensor]]
column = "table"
role = "base"
axis = "x"
[[sensor]]
column = "a1"
role = "response"
axis = "x"
position = [0, 0, 1]
[[sensor]]
column = "a2"
role = "response"
axis = "x"
position = [0, 0, 2]
"""
BY_RATE = SENSORS.replace('time = "time"', "sample_rate = 100.0")
RIGHT, REFUSED, ONE_LESS = "read right", "refused in one clear line", "read without its last row, and said so"


def lines(reduced: bool) -> Iterator[Line]:
    """Of all files: those whose outcome is another than the right one."""
    for name, (write, sensors, expected, words) in CASES.items():
        with tempfile.TemporaryDirectory() as folder:
            where = Path(folder)
            path = write(where)
            (where / "sensors.toml").write_text(sensors, encoding="utf-8")
            outcome = _outcome(path, where, words)
        yield Line(name, outcome, expected, outcome == expected)


def _outcome(path: Path, where: Path, words: tuple[str, ...]) -> str:
    said, wrong = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(wrong):
        status = cli.main(["read", str(path), "--out", str(where / "test.h5")])
    error = wrong.getvalue()
    if status:
        missing = [word for word in words if word not in error]
        named = path.name in error or "sensors.toml" in error  # the file at fault
        clear = named and status == 2 and error.count("\n") == 1 and not missing and not (where / "test.h5").exists()
        return REFUSED if clear else f"status {status}, without {missing}: {error}"
    run = recorded_test.load(where / "test.h5").runs[0]
    found = np.vstack(run[:2])
    if found.shape == RECORDS.shape and np.allclose(found, RECORDS, rtol=1e-9, atol=1e-12):
        return RIGHT
    short = found.shape == (3, SAMPLES - 1) and np.allclose(found, RECORDS[:, :-1], rtol=1e-9, atol=1e-12)
    return ONE_LESS if short and "last" in said.getvalue() + error else f"read as {found.shape}: {said.getvalue()}"


def _rows(delimiter: str = ",", comma: bool = False, records: np.ndarray = RECORDS) -> list[str]:
    rows = [delimiter.join(f"{x:.16g}" for x in (at / RATE, *row)) for at, row in enumerate(records.T)]
    return [row.replace(".", ",") for row in rows] if comma else rows


def _table(
    change: Callable[[list[str]], list[str]] = lambda rows: rows,
    head: str = "time [s],table [m/s²],a1 [m/s²],a2 [m/s²]",
    *,
    encoding: str = "utf-8",
    delimiter: str = ",",
    comma: bool = False,
    records: np.ndarray = RECORDS,
    name: str = "log.csv",
) -> Callable[[Path], Path]:
    """What writes a text table into a folder; `change` of its lines, the header among them."""

    def write(where: Path) -> Path:
        content = "\n".join(change([head, *_rows(delimiter, comma, records)])) + "\n"
        (where / name).write_bytes(content.encode(encoding))
        return where / name

    return write


def _bytes(name: str, content: bytes) -> Callable[[Path], Path]:
    def write(where: Path) -> Path:
        (where / name).write_bytes(content)
        return where / name

    return write


def _mat(cut: int = 0, **changes: object) -> Callable[[Path], Path]:
    def write(where: Path) -> Path:
        arrays = {**dict(zip(NAMES, RECORDS, strict=True)), "fs": RATE, **changes}
        savemat(where / "log.mat", {name: one for name, one in arrays.items() if one is not None})
        content = (where / "log.mat").read_bytes()
        (where / "log.mat").write_bytes(content[: len(content) - cut])
        return where / "log.mat"

    return write


def _folder(where: Path) -> Path:
    (where / "log.csv").mkdir()
    return where / "log.csv"


_WIDE = np.vstack([RECORDS, np.zeros((997, SAMPLES))])
_IN_G = RECORDS / np.array([[9.80665], [1.0], [1e-3]])  # the table in g, the second sensor in mm/s²
_UNITLESS = SENSORS.replace('axis = "x"\n', 'axis = "x"\nunit = "m/s²"\n')
_OF_A_MATRIX = _UNITLESS.replace('time = "time"', "")
for _at, _name in enumerate(NAMES, 1):
    _OF_A_MATRIX = _OF_A_MATRIX.replace(f'"{_name}"', f'"x[{_at}]"')
_UFF = b"    -1\n   151\nmodel\n    -1\n"
CASES: dict[str, tuple[Callable[[Path], Path], str, str, tuple[str, ...]]] = {
    "a plain table": (_table(), SENSORS, RIGHT, ()),
    "decimal commas, semicolons": (
        _table(head="time [s];table [m/s²];a1 [m/s²];a2 [m/s²]", delimiter=";", comma=True), SENSORS, RIGHT, ()),
    "Latin-1, units with a degree of their own": (_table(encoding="latin-1"), SENSORS, RIGHT, ()),
    "UTF-16 of a spreadsheet": (_table(encoding="utf-16"), SENSORS, RIGHT, ()),
    "Windows line ends, a line of text above": (
        _table(lambda rows: [row + "\r" for row in ("Logger 7, test of Monday", *rows)]), SENSORS, RIGHT, ()),
    "a line of units below the header": (
        _table(lambda rows: ["time,table,a1,a2", "s,m/s²,m/s²,m/s²", *rows[1:]]), SENSORS, RIGHT, ()),
    "units of three kinds": (
        _table(head="time [s],table [g],a1 [m/s²],a2 [mm/s²]", records=_IN_G), SENSORS, RIGHT, ()),
    "a thousand channels": (
        _table(head=",".join(("time [s]", *(f"{n} [m/s²]" for n in (*NAMES, *range(997))))), records=_WIDE),
        SENSORS, RIGHT, ()),
    "a last row cut short": (_table(lambda rows: [*rows[:-1], rows[-1][:9]]), SENSORS, ONE_LESS, ()),
    "a word in the middle": (
        _table(lambda rows: [*rows[:200], "1.99,0.1,overflow,0.2", *rows[201:]]), SENSORS, REFUSED, ("line 201",)),
    "a row with a field too few in the middle": (
        _table(lambda rows: [*rows[:200], "1.99,0.1,0.2", *rows[201:]]), SENSORS, REFUSED, ("line 201",)),
    "two tests in one file": (_table(lambda rows: [*rows, "", *rows]), SENSORS, REFUSED, ()),
    "time that runs back": (
        _table(lambda rows: [*rows[:200], *rows[100:]]), SENSORS, REFUSED, ("time",)),
    "a gap in time": (_table(lambda rows: [*rows[:200], *rows[260:]]), SENSORS, REFUSED, ("time",)),
    "a channel missing": (
        _table(lambda rows: [row.rpartition(",")[0] for row in rows]), SENSORS, REFUSED, ("a2",)),
    "a unit that is not known": (
        _table(head="time [s],table [furlong],a1 [m/s²],a2 [m/s²]"), SENSORS, REFUSED, ("furlong", "table")),
    "no units at all": (_table(head="time,table,a1,a2"), SENSORS, REFUSED, ("unit", "table")),
    "units said beside it": (_table(head="time,table,a1,a2"), _UNITLESS, RIGHT, ()),
    "a blank cell": (
        _table(lambda rows: [*rows[:200], "1.99,0.1,,0.2", *rows[201:]]), SENSORS, REFUSED, ("a1",)),
    "a header alone": (_table(lambda rows: rows[:1]), SENSORS, REFUSED, ()),
    "an empty file": (_bytes("log.csv", b""), SENSORS, REFUSED, ()),
    "bytes of something else": (_bytes("log.csv", bytes(range(256)) * 40), SENSORS, REFUSED, ()),
    "an ending that is not known": (_bytes("log.tdms", b"TDSm"), SENSORS, REFUSED, ("tdms",)),
    "a folder": (_folder, SENSORS, REFUSED, ("folder",)),
    "axes not said": (_table(), SENSORS.replace('axis = "x"\n', "", 1), REFUSED, ("axis",)),
    "MATLAB arrays": (_mat(), _UNITLESS.replace('time = "time"', ""), RIGHT, ()),
    "MATLAB, as rows of a matrix": (
        _mat(table=None, a1=None, a2=None, x=RECORDS), _OF_A_MATRIX, RIGHT, ()),
    "MATLAB, cut short": (_mat(cut=900), BY_RATE, REFUSED, ()),
    "MATLAB, a channel of another length": (
        _mat(a2=RECORDS[2, :100]), _UNITLESS.replace('time = "time"', ""), REFUSED, ("a2",)),
    "a universal file without functions": (_bytes("log.unv", _UFF), BY_RATE, REFUSED, ("151",)),
    "a universal file cut short": (_bytes("log.unv", _UFF[:-9]), BY_RATE, REFUSED, ("cut short",)),
    "a universal file that is none": (_bytes("log.unv", b"hello\n"), BY_RATE, REFUSED, ("-1",)),
}  # fmt: skip
