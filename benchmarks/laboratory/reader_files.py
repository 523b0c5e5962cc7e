"""Files of LabVIEW, the CESMD, MATLAB and joined exports, read by the command line, and a broken twin of each.

What is read right has the samples that stand in the file, to their last digit, the rate, the runs, the names; what is
broken gets exit status 2 and one line on stderr, which names the file and holds some words of the fault.
"""

from __future__ import annotations

import contextlib
import io
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.laboratory.written_files import (
    SAMPLES,
    Lvm,
    StrongMotion,
    matlab_7_3,
    rounded,
    strong_motion_values,
    xsens_dot,
)
from benchmarks.line import Line, below
from sysid.cli import main as cli
from sysid.files import recorded_test

G = 9.80665
TABLE, TOP, THIRD = rounded(np.random.default_rng(29).standard_normal((3, SAMPLES)) * 0.4)
LONG = rounded(np.random.default_rng(30).standard_normal((2, 3 * SAMPLES)) * 0.4)
BOTH = np.array([TABLE, TOP])
RATE = 128.0


@dataclass(frozen=True)
class Case:
    """Files by their names in a folder, the sensors said of them, and what is to be read, or words of the refusal.

    `runs` are (base, response, ...) in SI units, all channels in rows; `words` of a broken twin.
    """

    name: str
    files: dict[str, str | bytes | Callable[[Path], None]]
    toml: str
    runs: Sequence[np.ndarray] = ()
    words: str = ""
    rate: float = RATE
    options: tuple[str, ...] = ()
    told: str = ""  # words that stand on stdout
    exact: float = 1e-12


def sensors(base: str, *others: str, unit: str = "", top: str = "", each: str = "") -> str:
    """A TOML of one base channel along x and the others, at heights of 3 m, 6 m, ..."""
    unit = f'unit = "{unit}"\n' * bool(unit)
    text = f'{top}[[sensor]]\ncolumn = "{base}"\nrole = "base"\naxis = "x"\n{unit}{each}'
    for at, name in enumerate(others, 1):
        text += f'[[sensor]]\ncolumn = "{name}"\nrole = "response"\naxis = "x"\nposition = [0.0, 0.0, {3.0 * at}]\n'
        text += unit + each
    return text


def lines(reduced: bool) -> Iterator[Line]:
    """Measure: cases that end otherwise than they should, with their names."""
    for what, kinds in _GROUPS.items():
        cases = kinds()
        wrong = [f"{case.name}: {fault}" for case in cases if (fault := fault_of(case))]
        for fault in wrong:
            yield Line("wrong", fault)
        broken = sum(bool(case.words) for case in cases)
        yield below(f"{what}: of {len(cases) - broken} files and {broken} broken ones, wrong", len(wrong), 0)


def fault_of(case: Case) -> str:
    """Fault in the end of a case, "" where there is none."""
    with tempfile.TemporaryDirectory() as name:
        folder, target = Path(name), Path(name) / "out" / "test.h5"
        target.parent.mkdir()
        paths = []
        for file, content in case.files.items():
            path = folder / file
            path.parent.mkdir(exist_ok=True)
            paths.append(str(path))
            if callable(content):
                content(path)
            else:
                path.write_bytes(content if isinstance(content, bytes) else content.encode())
        (folder / "said.toml").write_text(case.toml, encoding="utf-8")
        told, said = io.StringIO(), io.StringIO()
        with warnings.catch_warnings(), contextlib.redirect_stdout(said), contextlib.redirect_stderr(told):
            warnings.simplefilter("error")
            asked = ["read", *paths, "--sensors", str(folder / "said.toml"), "--out", str(target), *case.options]
            status = cli.main(asked)
        line = told.getvalue().strip()
        if case.words:
            named = any(path in line for path in paths) or "said.toml" in line
            return "" if status == 2 and "\n" not in line and named and case.words in line else f"{status}: {line}"
        if status:
            return f"{status}: {line}"
        return _difference(recorded_test.load(target), case, said.getvalue())


def _difference(test: recorded_test.RecordedTest, case: Case, told: str) -> str:
    """Difference between what was read and what was written, "" where there is none."""
    if case.told not in told:
        return f"{case.told!r} is not told"
    if test.freq is None and not np.isclose(test.sample_rate, case.rate, rtol=1e-9):
        return f"at {test.sample_rate} Hz"
    if len(test.runs) != len(case.runs):
        return f"{len(test.runs)} runs"
    for run, wanted in zip(test.runs, case.runs, strict=True):
        read = np.vstack([part for part in run if part is not None])
        if read.shape != wanted.shape or not np.allclose(read, wanted, rtol=case.exact, atol=case.exact):
            return f"other numbers, of {read.shape}"
    return ""


def _cut(text: str, share: float) -> str:
    return text[: int(share * len(text))]


def _swapped(text: str, row: int, old: str, new: str, end: str = "\r\n") -> str:
    """The text with something in one line replaced."""
    every = text.split(end)
    assert old in every[row], every[row]
    every[row] = every[row].replace(old, new, 1)
    return end.join(every)


def labview() -> list[Case]:
    """Measurement files of LabVIEW."""
    names, units = ["table", "top"], ["g", "m/s^2"]
    si, toml = BOTH * np.array([[G], [1.0]]), sensors("table", "top")

    def file(**changed: object) -> Lvm:
        return Lvm(**{"names": names, "units": units, "segments": [BOTH], **changed})  # type: ignore[arg-type]

    def case(name: str, written: Lvm | str | bytes, words: str = "", **changed: object) -> Case:
        content = written.text() if isinstance(written, Lvm) else written
        given = {"toml": toml, "runs": [si], **changed}
        return Case(name, {"run.lvm": content}, words=words, **given)  # type: ignore[arg-type]

    sound, latin = file().text(), file(names=["Sockel Süd", "top"])
    bare = sensors("column 2", "column 3", unit="g", top='time = "column 1"\n')
    thirds = np.split(LONG, 3, axis=1)
    packed, pause = file(segments=thirds, headings=False), file(segments=thirds[:2], gaps=[3.0])
    slow = np.where(np.arange(SAMPLES) < SAMPLES // 2, THIRD, np.nan)
    beside = file(
        names=["table", "slow", "top"], units=["g", "g", "m/s^2"], segments=[np.array([TABLE, slow, TOP])],
        samples=[SAMPLES, SAMPLES // 2, SAMPLES], steps=[1 / RATE, 2 / RATE, 1 / RATE],
    )  # fmt: skip
    empty = file(
        names=["table", "Untitled", "top"], units=["g", "", "m/s^2"], samples=[SAMPLES, 0, SAMPLES],
        segments=[np.array([TABLE, np.full(SAMPLES, np.nan), TOP])],
    )  # fmt: skip
    once = np.where(np.arange(SAMPLES) < 1, THIRD, np.nan)
    packets = file(
        names=["table", "slow", "top"], units=["g", "g", "m/s^2"], samples=[SAMPLES, 1, SAMPLES], headings=False,
        segments=[np.array([a, once, b]) for a, b in thirds], steps=[1 / RATE, 1.0, 1 / RATE],
    )  # fmt: skip
    freq = np.arange(1, SAMPLES + 1)
    H = 1 / (1 - (freq / 80) ** 2 + 0.04j * freq / 80)
    H = rounded(H.real) + 1j * rounded(H.imag)
    spectra = file(
        names=["top (Real)", "top (Imag)"], units=["g/g", "g/g"], segments=[np.array([H.real, H.imag])],
        dimension="Frequency", rate=1.0,
    )  # fmt: skip
    spectra_toml = (
        'base_axes = "x"\nfrf = "transmissibility"\n[[sensor]]\ncolumn = "top"\nrole = "response"\naxis = "x"\n'
    )
    ones = [np.vstack([np.ones(SAMPLES - 1), H[1:]])]
    plain = "\r\n".join(f"{at / RATE:.7f}\t{a:.6f}\t{b:.6f}" for at, (a, b) in enumerate(BOTH.T))
    row = next(at for at, one in enumerate(sound.split("\r\n")) if one.startswith("X_Value")) + 91
    cell, before = f"{TOP[90]:.6f}", f"\t{TABLE[90]:.6f}"
    return [
        case("one column of times", file()),
        case("commas between, points in numbers", file(separator=",")),
        case("tabs between, decimal commas", file(comma=True)),
        case("no column of times", file(x_columns="No")),
        case("a column of times a channel", file(x_columns="Multi")),
        case("an increment of few digits", file(x_columns="No", steps=["0.007813"] * 2)),
        case("an increment of few digits beside times", file(steps=["0.007813"] * 2)),
        case("slow channels in packets", packets, runs=[LONG * si_of], told="left out: slow"),
        case("times in ms", file(x_unit="ms")),
        case("comments", file(comment="LOST, then found")),
        case("a special block", file(special="Packet_Notes\nOperator\tMüller\nChannels\t9")),
        case("a channel without samples", empty),
        case("a channel at half the rate", beside, told="left out: slow"),
        case("blank lines at the end", sound + "\r\n\t\r\n\r\n"),
        case("line ends of Unix", file(end="\n")),
        case("Latin letters", latin.text().encode("cp1252"), toml=sensors("Sockel Süd", "top")),
        case("a byte order mark", b"\xef\xbb\xbf" + sound.encode()),
        case("UTF-16", sound.encode("utf-16")),
        case("two segments, a pause between", pause, runs=[thirds[0] * si_of, thirds[1] * si_of]),
        case("three segments without a pause", file(segments=thirds), runs=[LONG * si_of], told="3 segments"),
        case("three packets under one header", packed, runs=[LONG * si_of]),
        case("no header", plain, toml=bare, runs=[BOTH * G]),
        case("no increment, but times", file(replaced={"Delta_X": "Comment_X"}), rate=RATE),
        case("a frequency response", spectra, toml=spectra_toml, runs=ones),
        case("cut inside a row", sound[: sound.index(cell)], "91 are there"),
        case("cut inside a row, behind its times", sound[: sound.index(before)], "fields where 3 are needed"),
        case("cut between rows", "\r\n".join(sound.split("\r\n")[: row + 1]), "91 are there"),
        case("cut in the header", _cut(sound, 0.04), "***End_of_Header***"),
        case("cut before the table", sound[: sound.index("X_Value")], "no table"),
        case("another number of channels", file(replaced={"Channels\t2": "Channels\t3"}), "3 channels"),
        case("channels in letters", file(replaced={"Channels\t2": "Channels\ttwo"}), "'two'"),
        case("samples in letters", file(replaced={"Samples\t240": "Samples\tmany"}), "'many'"),
        case("an increment of nothing", file(x_columns="No", steps=["0.000000"] * 2), "sample_rate"),
        case("no unit", file(units=["g", ""]), "no unit"),
        case("volts", file(units=["g", "Volts"]), "'Volts'"),
        case("neither times nor increment", file(x_columns="No", replaced={"Delta_X": "Other"}), "sample_rate"),
        case("another increment than its times", file(steps=[0.01, 0.01]), "128 Hz and the file's rate 100 Hz"),
        case("letters in a number", _swapped(sound, row, cell, "0.l23"), f"line {row + 1}: holds '0.l23'"),
        case("NaN", _swapped(sound, row, cell, "NaN"), f"(line {row + 1})"),
        case("a gap", _swapped(sound, row, cell, ""), f"(line {row + 1})"),
        case("a special block without end", file(replaced={"Channels": "***Start_Special***\r\n"}), "does not end"),
        case("empty", "", "is empty"),
        case("of lengths, not times", file(dimension="Length"), "'Length'"),
        case("uneven times", _swapped(sound, row, sound.split("\r\n")[row].split("\t")[0], "0.706"), "uneven"),
    ]  # fmt: skip


si_of = np.array([[G], [1.0]])


def strong_motion() -> list[Case]:
    """Corrected accelerations of the CESMD."""
    values = strong_motion_values(300 * BOTH)
    three = strong_motion_values(300 * np.array([TABLE, TOP, THIRD]))
    toml, two = sensors("Chan 1", "Chan 2"), ["360 Deg  Ground floor", "360 Deg  Roof"]

    def case(name: str, written: StrongMotion | str | bytes, words: str = "", **changed: object) -> Case:
        content = written.text() if isinstance(written, StrongMotion) else written
        given = {"toml": toml, "runs": [0.01 * values], "rate": 100.0, **changed}
        return Case(name, {"CE24386.V2": content}, words=words, **given)  # type: ignore[arg-type]

    sound = StrongMotion(two, values).text()
    large = strong_motion_values(3e5 * BOTH)
    many = strong_motion_values(30 * np.random.default_rng(3).standard_normal((16, SAMPLES)))
    up = toml + '[[sensor]]\ncolumn = "Chan 3"\nrole = "response"\n'
    each = {f"chan{at}.v2": StrongMotion([two[at - 1]], values[at - 1 : at], first=at).text() for at in (1, 2)}
    later = sound.index("veloc data equally") + 3000
    cell = next(line for line in sound.split("\n") if "points of accel data" in line)
    row = sound[: sound.index(cell)].count("\n") + 12
    number = sound.split("\n")[row][10:20]
    unlike = StrongMotion(two[:1], values[:1]).text() + StrongMotion(two[1:], values[1:], step=0.02, first=2).text()
    bare = sound.replace(", in cm/sec2", "")
    return [
        case("two channels", StrongMotion(two, values), told="filtered to 0.12 to 46 Hz"),
        case("three, one upwards", StrongMotion([*two, "Up  Roof"], three), toml=up, runs=[0.01 * three]),
        case("sixteen", StrongMotion([f"{at} Deg" for at in range(16)], many), runs=[0.01 * many],
             toml=sensors(*(f"Chan {at}" for at in range(1, 17)))),
        case("in capitals, units apart", StrongMotion(two, values, old=True, unit="cm/sec/sec")),
        case("in g", StrongMotion(two, strong_motion_values(BOTH), unit="g"), runs=[G * BOTH]),
        case("an interval of four digits", StrongMotion(two, values, step=1 / 128), rate=128.0),
        case("numbers that touch", StrongMotion(two, large), runs=[0.01 * large]),
        case("line ends of Windows, blank lines", StrongMotion(two, values, end="\r\n").text() + "\r\n\r\n"),
        case("Latin letters", sound.replace("Northridge", "Année  à").encode("latin-1")),
        case("no unit, but stated", bare, toml=sensors("Chan 1", "Chan 2", unit="cm/s2")),
        Case("a file a channel", each, sensors("chan1", "chan2", top="join = true\n"), [0.01 * values], rate=100.0),
        Case("two events", {"a.V2": sound, "b.V2": StrongMotion(two, -values).text()}, toml,
             [0.01 * values, -0.01 * values], rate=100.0),
        case("cut in its accelerations", _cut(sound, 0.3), "is cut short"),
        case("cut in the velocity of the last", _cut(sound, 0.9), "is cut short"),
        case("lines lost in its accelerations", sound.replace(sound.split("\n")[row], "", 1), "states 240"),
        case("more values stated", StrongMotion(two, values, count=256), "256"),
        case("fewer values stated", StrongMotion(two, values, count=224), "224"),
        case("letters in a number", _swapped(sound, row, number, number[:-2] + "l0", "\n"), f"line {row + 1}: holds"),
        case("no unit", bare, "no unit"),
        case("uncorrected, Volume 1", sound.replace("data equally spaced", "data"), "Volume 1"),
        case("of two intervals", unlike, "intervals of"),
        case("of no interval", StrongMotion(two, values, step=0.0), "interval of 0 s"),
        case("the end marks are lost", sound.replace("End of data", "Data end"), "is cut short"),
        case("empty", "", "is empty"),
        case("an archive", b"PK\3\4" + bytes(range(256)) * 20, "CE24386.V2"),
        case("no channel of this name", sound[:later] + sound[later:], "'Chan 9'", toml=sensors("Chan 1", "Chan 9")),
    ]  # fmt: skip


def matlab() -> list[Case]:
    """Arrays of MATLAB and NumPy with channels in rows or columns."""
    from scipy.io import savemat

    toml = sensors("acc[1]", "acc[2]", unit="g")
    runs = [BOTH * G]

    def five(**arrays: object) -> Callable[[Path], None]:
        return lambda path: savemat(path, arrays)

    def cut(write: Callable[[Path], None]) -> Callable[[Path], None]:
        def done(path: Path) -> None:
            write(path)
            path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])

        return done

    def case(
        name: str, write: Callable[[Path], None], words: str = "", file: str = "run.mat", **changed: object
    ) -> Case:
        given = {"toml": toml, "runs": runs, **changed}
        return Case(name, {file: write}, words=words, **given)  # type: ignore[arg-type]

    times, bad = np.arange(SAMPLES) / RATE, BOTH.copy()
    bad[1, 90] = np.nan
    square = np.vstack([BOTH, np.ones((SAMPLES - 2, SAMPLES))])
    inside = sensors("run.acc[1]", "run.acc[2]", unit="g")
    return [
        case("channels in rows", five(acc=BOTH, fs=RATE)),
        case("channels in columns", five(acc=BOTH.T, fs=RATE)),
        case("rows, compressed", lambda path: savemat(path, {"acc": BOTH, "fs": RATE}, do_compression=True)),
        case("rows, version 4", lambda path: savemat(path, {"acc": BOTH, "fs": RATE}, format="4")),
        case("rows, version 7.3", lambda path: matlab_7_3(path, {"acc": BOTH, "fs": np.array(RATE)})),
        case("columns, version 7.3", lambda path: matlab_7_3(path, {"acc": BOTH.T, "fs": np.array(RATE)})),
        case("rows with times", five(acc=BOTH, t=times)),
        case("rows beside a number a channel", five(acc=BOTH, fs=RATE, height=np.array([0.0, 3.0]))),
        case("rows beside a small matrix", five(acc=BOTH, fs=RATE, turn=np.eye(3))),
        case("more channels than samples, with times", five(acc=np.vstack([BOTH, np.ones((900, SAMPLES))]).T, t=times)),
        case("rows in a structure", five(run={"acc": BOTH, "fs": RATE}), toml=inside),
        case("rows of NPZ", lambda path: np.savez(path, acc=BOTH, fs=RATE), file="run.npz"),
        case("as many channels as samples", five(acc=square, fs=RATE), "rows and as many columns"),
        case("as many as times", five(acc=square, t=times), "rows and as many columns"),
        case("as many, version 7.3", lambda path: matlab_7_3(path, {"acc": square, "fs": np.array(RATE)}), "as many"),
        case("no rate", five(acc=BOTH), "sample_rate"),
        case("another rate than its times", five(acc=BOTH, t=times, fs=50.0), "the file's rate 50 Hz"),
        case("a rate of nothing", five(acc=BOTH, fs=0.0), "sample_rate"),
        case("cut short", cut(five(acc=BOTH, fs=RATE)), "run.mat"),
        case("cut short, version 7.3", cut(lambda path: matlab_7_3(path, {"acc": BOTH})), "run.mat"),
        case("NaN in a row", five(acc=bad, fs=RATE), "sample 91"),
        case("no unit", five(acc=BOTH, fs=RATE), "no unit", toml=sensors("acc[1]", "acc[2]")),
        case("a channel that is none", five(acc=BOTH, fs=RATE), "no column", toml=toml.replace("[2]", "[3]")),
        case("text for numbers", five(acc="none", fs=RATE), "no arrays"),
    ]  # fmt: skip


def _csv(values: np.ndarray, names: str = "acc", rate: float = RATE, begin: float = 0.0) -> str:
    rows = [f"{begin + at / rate:.7f};" + ";".join(f"{one:.6f}" for one in row) for at, row in enumerate(values.T)]
    return "\r\n".join([f"time;{names}", *rows, "", ""])


def joined() -> list[Case]:
    """Several runs of exports of one sensor each, in one call."""
    join = "join = true\n"
    apart, runs = sensors("table", "top", unit="g"), [BOTH * G, -BOTH * G]
    toml = join + apart

    def named(form: str, second: np.ndarray = -BOTH, **changed: float) -> dict[str, str | bytes]:
        pairs = [("run1", BOTH, {}), ("run2", second, changed)]
        return {
            form.format(run=run, sensor=sensor): _csv(row[None], **more)
            for run, rows, more in pairs
            for sensor, row in zip(("table", "top"), rows, strict=True)
        }

    time = np.arange(SAMPLES) / 100.0
    units = {
        f"{run}/{name}.csv": xsens_dot(start + time, row)
        for run, start, rows in (("one", 5.0, BOTH), ("two", 900.0, -BOTH))
        for name, row in zip(("table", "top"), rows, strict=True)
    }
    still = BOTH - BOTH.mean(axis=1, keepdims=True)
    dot_toml = sensors("table.Acc_X", "top.Acc_X")
    parted = {
        f"{name}.lvm": Lvm([name], ["g"], [row[None], -row[None]], gaps=[2.0]).text()
        for name, row in zip(("table", "top"), BOTH, strict=True)
    }
    uneven = {**parted, "top.lvm": Lvm(["top"], ["g"], [TOP[None]]).text()}
    late = {**units, "two/top.csv": xsens_dot(2000.0 + time, TOP)}
    beside = {"table.csv": _csv(TABLE[None]), "top_left.csv": _csv(THIRD[None]), "top.csv": _csv(TOP[None])}
    more, missing = named("{run}_{sensor}.csv"), named("{run}_{sensor}.csv")
    del missing["run2_top.csv"]
    several = {
        f"{run}-{name}.csv": _csv(rows, "x;y")
        for run, sign in (("a", 1), ("b", -1))
        for name, rows in (("base", sign * np.array([TABLE, THIRD])), ("roof", sign * np.array([TOP, THIRD])))
    }
    return [
        Case("folders", named("{run}/{sensor}.csv"), toml, runs),
        Case("run before the sensor", named("{run}_{sensor}.csv"), toml, runs),
        Case("run behind the sensor", named("{sensor}_{run}.csv"), toml, runs),
        Case("run around the sensor", named("shaker-{sensor}-{run}.csv"), toml, runs),
        Case("said at the command line", named("{run} {sensor}.csv"), apart, runs, options=("--join",)),
        Case("one run", dict(list(named("{run}_{sensor}.csv").items())[:2]), toml, runs[:1]),
        Case("whole names as they were", dict(list(named("{run}_{sensor}.csv").items())[:2]),
             sensors("run1_table", "run1_top", unit="g", top=join), runs[:1]),
        Case("the second run numbered", {file.replace("run1_", "").replace("run2_", "2 "): content for file, content in
             named("{run}_{sensor}.csv").items()}, toml, runs),
        Case("a sensor that is not described", beside, toml, runs[:1]),
        Case("a sensor that is not described, in two runs", {**more, "run1_spare.csv": _csv(THIRD[None])}, toml, runs),
        Case("several columns a file", several, sensors("base.x", "roof.x", unit="g", top=join), runs),
        Case("runs of two lengths", named("{run}_{sensor}.csv", -BOTH[:, :200]), toml, [runs[0], runs[1][:, :200]]),
        Case("units of Xsens in two folders", units, dot_toml, [still, -still], rate=100.0, exact=1e-6),
        Case("LabVIEW files of two segments", parted, sensors("table", "top", top=join), runs),
        Case("a file is missing", missing, toml, words="no file of 'top'"),
        Case("of other rates", named("{run}_{sensor}.csv", rate=64.0), toml, words="128 Hz"),
        Case("not said to be joined", named("{run}_{sensor}.csv"), apart, words="--join"),
        Case("units with no time in common", late, dot_toml, words="no time in common"),
        Case("other numbers of segments", uneven, sensors("table", "top", top=join), words="other numbers of runs"),
        Case("a sensor in no file", named("{run}_{sensor}.csv"), sensors("table", "roof", unit="g", top=join),
             words="no column 'roof'"),
        Case("a file is empty", {**named("{run}_{sensor}.csv"), "run2_top.csv": ""}, toml, words="top.csv is empty"),
    ]  # fmt: skip


def base_and_gaps() -> list[Case]:
    """Several base channels of one axis, and numbers that are none."""

    def twice(second: str) -> str:
        each = f'[[sensor]]\ncolumn = "b"\nrole = "base"\naxis = "{second}"\nunit = "g"\nposition = [2.0, 0.0, 0.0]\n'
        return sensors("a", "top", unit="g") + each

    def bases(second: np.ndarray) -> str:
        return _csv(np.array([TABLE, second, TOP]), "a;b;top")

    off = rounded(TABLE + 0.02 * THIRD)
    share = f"off by {100 * np.linalg.norm(off - TABLE) / 2 / np.linalg.norm(off):.2g} %"
    mean, si = (TABLE + off) / 2, lambda base: np.array([base, TOP]) * G
    turned = '[[sensor]]\ncolumn = "{}"\nrole = "base"\naxis = "x"\nunit = "g"\nposition = [0.0, {}, 0.0]\n'
    turns = 'base_axes = "x rz"\n' + turned.format("a", 1.0) + turned.format("b", -1.0) + sensors("a", "top", unit="g")[
        sensors("a", "top", unit="g").index("[[sensor]]", 5) :]  # fmt: skip
    both = np.array([(TABLE + off) / 2, (off - TABLE) / 2, TOP]) * G
    text = _csv(BOTH, "table;top")
    toml = sensors("table", "top", unit="g")
    cell, third = f"{TOP[90]:.6f}", _csv(np.array([TABLE, TOP, THIRD]), "table;top;spare")
    spare = f"{THIRD[90]:.6f}"
    dead = "\r\n".join(
        line.rpartition(";")[0] + ";NaN" if at and line else line for at, line in enumerate(third.split("\r\n"))
    )
    return [
        Case("two that agree", {"run.csv": bases(TABLE)}, twice("x"), [si(TABLE)], told="'b' 1 times"),
        Case("two that differ by 2 %", {"run.csv": bases(off)}, twice("x"), [si(mean)], told=share),
        Case("two of unlike gains", {"run.csv": bases(rounded(1.06 * TABLE))}, twice("x"),
             [si((TABLE + rounded(1.06 * TABLE)) / 2)], told="'b' 1.029 times"),
        Case("two that face each other", {"run.csv": bases(-off)}, twice("-x"), [si(mean)], told=share),
        Case("a table that turns", {"run.csv": bases(off)}, turns, [both]),
        Case("NaN in a column that is not used", {"run.csv": _swapped(third, 91, spare, "NaN")}, toml, [si(TABLE)]),
        Case("a column of NaN", {"run.csv": dead}, toml, [si(TABLE)]),
        Case("two of opposite signs", {"run.csv": bases(-TABLE)}, twice("x"), words="less than half"),
        Case("two of unlike units", {"run.csv": bases(rounded(9.80665 * TABLE))}, twice("x"), words="less than half"),
        Case("two of unlike motions", {"run.csv": bases(THIRD)}, twice("x"), words="less than half"),
        Case("NaN", {"run.csv": _swapped(text, 91, cell, "NaN")}, toml, words="sample 91 of 240 (line 92) is nan"),
        Case("NaN behind blank lines", {"run.csv": "Logger\r\n\r\n\r\n" + _swapped(text, 91, cell, "NaN")}, toml,
             words="sample 91 of 240 (line 95) is nan"),
        Case("a gap", {"run.csv": _swapped(text, 91, cell, "")}, toml, words="(line 92) is nan"),
        Case("overflow", {"run.csv": _swapped(text, 91, cell, "-inf")}, toml, words="(line 92) is -inf"),
        Case("a spreadsheet's error", {"run.csv": _swapped(text, 91, cell, "#NV")}, toml, words="line 92: holds '#NV'"),
        Case("a whole column of NaN", {"run.csv": dead}, sensors("table", "spare", unit="g"), words="(240 such)"),
    ]  # fmt: skip


_GROUPS = {
    "LabVIEW measurement files": labview,
    "strong-motion records": strong_motion,
    "arrays of MATLAB and NumPy": matlab,
    "several runs of joined exports": joined,
    "base channels of one axis, numbers that are none": base_and_gaps,
}
