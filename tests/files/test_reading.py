"""A laboratory's files are read right, or told in one line that names file, place and remedy."""

import datetime
import re
from itertools import chain

import h5py
import laboratory
import numpy as np
import pytest
import scipy.io
from laboratory import FREQ, F, H

import sysid
from sysid.cli import main as cli
from sysid.files import arrays, reading, recorded_test

G = 9.80665
SENSORS = {
    "sensor": [
        {"column": "table", "role": "base", "axis": "x"},
        {"column": "top", "role": "response", "axis": "x", "position": [0, 0, 3]},
        {"column": "force", "role": "force", "axis": "x"},
    ]
}
MATRIX = {
    "frf": "transmissibility",
    "base_axes": "x",
    "sensor": [
        *({"column": f"H[{i}]", "role": "response", "axis": "x", "position": [0, 0, i]} for i in (1, 2, 3)),
        {"column": "F", "role": "force", "axis": "x", "unit": "N / m/s²"},
    ],
}


def records(n=400):
    """Time at 200 Hz, table in g, top in mm/s², force in kN; and the same in SI units."""
    si = np.random.default_rng(0).standard_normal((3, n))
    return np.arange(n) / 200, si / [[G], [1e-3], [1e3]], si


def table(delimiter=";", comma=True, heads=("Zeit", "table", "top", "force"), units=("s", "g", "mm/s²", "kN")):
    time, values, _ = records()
    rows = ["Logger", "Operator: Müller", delimiter.join(heads)]
    if units:
        rows.append(delimiter.join(units))
    for row in np.vstack([time, values]).T:
        line = delimiter.join(f"{value:.12g}" for value in row)
        rows.append(line.replace(".", ",") if comma else line)
    return rows


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
@pytest.mark.parametrize("delimiter, comma", [(";", True), ("\t", True), (",", False), ("\t", False)])
def test_a_table_is_read_with_any_encoding_delimiter_and_decimal_sign(tmp_path, encoding, delimiter, comma):
    (tmp_path / "run.csv").write_text("\r\n".join(table(delimiter, comma)), encoding=encoding)
    test = reading.gather(tmp_path / "run.csv", SENSORS)
    (base, response, force), si = test.runs[0], records()[2]
    np.testing.assert_allclose(np.vstack([base, response, force]), si, rtol=1e-10)
    assert test.sample_rate == 200
    assert [row.factor for row in test.table] == pytest.approx([G, 1e-3, 1e3])


@pytest.mark.parametrize("rate", [200.08, 199.96])
def test_the_rate_of_a_short_record_is_that_of_its_times(tmp_path, rate):
    """By 4 and by 2 parts in ten thousand off a round number, over 100 samples, times to twelve digits."""
    rows = [f"{i / rate:.12g};{i % 7};{i % 5};{i % 3}" for i in range(100)]
    (tmp_path / "run.csv").write_text("\n".join(["time;table;top;force", "s;g;mm/s²;kN", *rows]), encoding="utf-8")
    assert reading.gather(tmp_path / "run.csv", SENSORS).sample_rate == pytest.approx(rate, rel=1e-9)


@pytest.mark.parametrize(
    "head, form",
    [
        ("Date;Time", lambda at: f"{at:%d.%m.%Y};{at:%H:%M:%S,%f}"),
        ("Date/Time", lambda at: f"{at:%m/%d/%Y %I:%M:%S.%f %p}"),
        ("Timestamp", lambda at: f"{at:%Y-%m-%dT%H:%M:%S.%f}+01:00"),
        ("Elapsed time", lambda at: f"{at:%M:%S.%f}"),
    ],
)
@pytest.mark.parametrize("begins", ["11:59:59", "23:59:59"])
def test_times_of_day_have_dates_beside_them_halves_of_a_day_and_pass_midnight(tmp_path, head, form, begins):
    """Two seconds at 200 Hz; minutes alone begin at zero."""
    begin = datetime.datetime.fromisoformat(f"2026-03-01T{'00:00:00' if head[0] == 'E' else begins}")
    rows = [f"{form(begin + datetime.timedelta(seconds=i / 200))};{i % 7};{i % 5};{i % 3}" for i in range(400)]
    units = f"{';' * head.count(';')};g;mm/s²;kN"
    (tmp_path / "run.csv").write_text("\n".join([f"{head};table;top;force", units, *rows]), encoding="utf-8")
    assert reading.gather(tmp_path / "run.csv", SENSORS).sample_rate == pytest.approx(200, rel=1e-9)


@pytest.mark.parametrize("begins", [46082.5, 740042.5])
def test_day_numbers_of_a_spreadsheet_are_days(tmp_path, begins):
    """Two seconds at 200 Hz from noon of 1 March 2026, as Excel and as MATLAB count days; rounded to .1 ms."""
    rows = [f"{begins + i / 200 / 86400:.9f};{i % 7};{i % 5};{i % 3}" for i in range(400)]
    (tmp_path / "run.csv").write_text("\n".join(["time;table;top;force", ";g;mm/s²;kN", *rows]), encoding="utf-8")
    assert reading.gather(tmp_path / "run.csv", SENSORS).sample_rate == pytest.approx(200, rel=1e-4)


@pytest.mark.parametrize(
    "change",
    [
        lambda rows: ["# " + rows[2], *rows[3:]],
        lambda rows: [*rows[:4], *(row + ";" for row in rows[4:])],
        lambda rows: [",".join(f'"{field}"' for field in row.split(";")) for row in rows],
        lambda rows: [*rows[:3], '"s";"g";"mm/s²";"kN"', *rows[4:]],
    ],
    ids=["sign of comments", "delimiter behind numbers", "decimal commas in quotes", "quotes"],
)
def test_a_header_is_found_whatever_programs_write_about_it(tmp_path, change):
    (tmp_path / "run.csv").write_text("\n".join(change(table(";", True))), encoding="utf-8")
    test = reading.gather(tmp_path / "run.csv", SENSORS)
    np.testing.assert_allclose(np.vstack(test.runs[0]), records()[2], rtol=1e-10)


def test_another_rate_than_the_file_tells_is_taken_and_told(tmp_path):
    (tmp_path / "run.csv").write_text("\n".join(table()), encoding="utf-8")
    test = reading.gather(tmp_path / "run.csv", {**SENSORS, "sample_rate": 100.0})
    assert test.sample_rate == 100 and "200 Hz" in test.remarks[0] and "100 Hz" in test.remarks[0]
    assert not any("200 Hz" in one for one in reading.gather(tmp_path / "run.csv", SENSORS).remarks)


def test_a_run_that_is_given_twice_is_told(tmp_path):
    rows = table()
    for name, lines in (("a", rows), ("b", [*rows[:4], *rows[5:]]), ("c", rows)):
        (tmp_path / f"{name}.csv").write_text("\n".join(lines), encoding="utf-8")
    files = [tmp_path / f"{name}.csv" for name in "abc"]
    (told,) = [one for one in reading.gather(files, SENSORS).remarks if "same records" in one]
    assert told.startswith(f"{files[2]}, beside {files[0]}, ")


def test_units_in_brackets_and_a_cut_last_row(tmp_path):
    heads = ("Time [s]", "table (g)", "top [mm/s^2]", "force [kN]")
    rows = [*table(",", False, heads, None), "2.0,0.1"]
    (tmp_path / "run.csv").write_text("\n".join(rows))
    test = reading.gather(tmp_path / "run.csv", SENSORS)
    np.testing.assert_allclose(test.runs[0][0][0], records()[2][0], rtol=1e-10)
    assert "cut short" in test.remarks[0]


@pytest.mark.parametrize(
    "change, said, words",
    [
        (lambda rows: [*rows[:50], "x;y;z;w", *rows[50:]], SENSORS, "line 51: holds 'x'.*mend or delete"),
        (lambda rows: rows + rows[2:], SENSORS, "line 405: holds 'Zeit'.*second test"),
        (lambda rows: rows + rows[4:], SENSORS, "time does not rise at sample 401.*two tests"),
        (lambda rows: rows[:100] + rows[140:], SENSORS, "uneven, most at sample 97"),
        (lambda rows: rows[:2], SENSORS, "no table of numbers"),
        (lambda rows: [], SENSORS, "is empty"),
        (lambda rows: rows, {}, "which column is which sensor is not said.*'table'.*--sensor"),
        (lambda rows: [rows[2], *rows[4:]], SENSORS, "no unit is stated: add unit"),
        (lambda rows: [row.replace("kN", "mm") for row in rows], SENSORS, "'mm' measures displacement"),
        (lambda rows: [row.replace("kN", "bananas") for row in rows], SENSORS, "'bananas' of .* is not known"),
        (lambda rows: [row.replace("top", "roof") for row in rows], SENSORS, "no column 'top': it has 4 columns"),
        (lambda rows: [row.replace("Zeit", "n") for row in rows], SENSORS, "no column of time.*sample_rate"),
        (lambda rows: rows, {"sensor": [{"column": "top", "role": "response"}]}, "sensor 1 .*axis is missing"),
        (lambda rows: rows, {"sensor": [{"column": "top", "axis": "x"}]}, "sensor 1 .*role is missing; give one of"),
        (lambda rows: rows, {"sensor": [{"column": True, "axis": "x"}]}, "sensor 1: column is missing"),
        (lambda rows: rows, {**SENSORS, "window": "hann", "averages": 9}, "window, averages: said of spectra"),
        (lambda rows: [*rows[:50], "0,23;1e200;0;0", *rows[51:]], SENSORS, r"\(line 51\) is 1e\+200"),
    ],
)
def test_a_broken_table_is_told_in_words(tmp_path, change, said, words):
    path = tmp_path / "run.csv"
    path.write_text("\n".join(change(table())))
    with pytest.raises(sysid.InputError, match=words) as told:
        reading.gather(path, said)
    assert re.search(r"run\.csv|the description", str(told.value))


def test_a_thousand_channels_are_read(tmp_path):
    values = np.random.default_rng(1).standard_normal((50, 1000))
    heads = ",".join(f"A{i} [g]" for i in range(1000))
    np.savetxt(tmp_path / "run.csv", values, delimiter=",", header=heads, comments="")
    roles = ["base", *["response"] * 999]
    sensors = [{"column": f"A{i}", "role": role, "axis": "x"} for i, role in enumerate(roles)]
    test = reading.gather(tmp_path / "run.csv", {"sample_rate": 100, "sensor": sensors})
    np.testing.assert_allclose(test.runs[0][1], G * values.T[1:], rtol=1e-12)


@pytest.mark.parametrize("given, rate", [({"Fs": 250.0}, 250.0), ({"x_values": {"increment": 0.004}}, 250.0)])
def test_the_rate_of_arrays_is_that_of_their_file(tmp_path, given, rate):
    values = {name: np.random.default_rng(1).standard_normal(400) for name in ("table", "top", "force")}
    scipy.io.savemat(tmp_path / "run.mat", values | given)
    with_units = {"sensor": [{**one, "unit": "N" if one["role"] == "force" else "g"} for one in SENSORS["sensor"]]}
    assert reading.gather(tmp_path / "run.mat", with_units).sample_rate == pytest.approx(rate, rel=1e-12)
    scipy.io.savemat(tmp_path / "frf.mat", {name: one + 1j for name, one in values.items()} | {"increment": 0.5})
    assert arrays.read_mat(tmp_path / "frf.mat")[0].sample_rate is None


@pytest.mark.parametrize("ending", ["mat", "npz", "h5"])
def test_arrays_keep_every_bit(tmp_path, ending):
    path, named = tmp_path / f"a.{ending}", {"freq": FREQ, "H": H, "F": F}
    if ending == "mat":
        scipy.io.savemat(path, named)
    elif ending == "npz":
        np.savez(path, **named)
    else:
        with h5py.File(path, "w") as file:
            file.update(named)
    test = sysid.read(path, MATRIX)
    assert np.array_equal(test.response[0], H) and np.array_equal(test.force[0, 0], F)
    assert np.array_equal(test.freq, FREQ)
    np.testing.assert_array_equal(test.rigid_body, np.ones((3, 1)))


@pytest.mark.parametrize("ending", ["mat", "npz", "h5", "uff"])
def test_a_file_of_another_kind_or_cut_short_is_told(tmp_path, ending):
    if ending == "uff":
        pytest.importorskip("pyuff")
    path = tmp_path / f"a.{ending}"
    path.write_bytes(b"nothing of the kind")
    with pytest.raises(sysid.InputError, match=rf"a\.{ending} is no"):
        sysid.read(path, MATRIX)


def test_the_test_file_gives_back_what_was_read(tmp_path):
    (tmp_path / "run.csv").write_text("\n".join(table()))
    test = reading.gather(tmp_path / "run.csv", SENSORS)
    (tmp_path / "test.h5").write_bytes(test.to_bytes())
    again = recorded_test.load(tmp_path / "test.h5")
    assert all(np.array_equal(a, b) for a, b in zip(test.runs[0], again.runs[0], strict=True))
    assert (again.sensors, again.table, again.sample_rate) == (test.sensors, test.table, test.sample_rate)


def functions(binary, conjugated=False):
    """Sets 58 of the three sensors, the second in g, and of the force, behind the positions of their nodes."""
    # pyuff writes the header of a binary set wrongly where it is the first in a file.
    sets = [laboratory.nodes(np.zeros(4))]
    for node, (values, unit) in enumerate([(H[0], "m/s^2"), (H[1] / G, "g"), (H[2], "m/s^2"), (F, "N")], 1):
        units = {"ordinate_axis_units_lab": unit, "orddenom_axis_units_lab": "m/s^2"}
        data = np.conj(values) if conjugated else values
        sets.append(laboratory.function(node, data, binary=binary, **units))
    return sets


UNIVERSAL = {
    "base_axes": "x",
    "sensor": [
        *({"column": f"{i}+X", "role": "response", "axis": "x", "position": [0, 0, i]} for i in (1, 2, 3)),
        {"column": "4+X", "role": "force", "axis": "x"},
    ],
}


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")  # of pyuff
@pytest.mark.parametrize("binary, exact", [(0, 1e-11), (1, 4e-16)])
@pytest.mark.parametrize("conjugated", [False, True])
def test_universal_files_keep_their_numbers_and_show_their_convention(tmp_path, binary, exact, conjugated):
    laboratory.write_universal(tmp_path / "a.uff", functions(binary, conjugated))
    test = reading.gather(tmp_path / "a.uff", UNIVERSAL)
    base, response, force = test.runs[0]
    np.testing.assert_allclose(response, H, rtol=exact)
    np.testing.assert_allclose(force[0], F, rtol=exact)
    np.testing.assert_allclose(test.freq, FREQ, rtol=1e-5)
    assert np.array_equal(base, np.ones((1, FREQ.size)))
    assert ("exp(-iwt)" if conjugated else "exp(+iwt)") in test.remarks[-1]


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")  # of pyuff
@pytest.mark.parametrize("sensors", [1, 2])
def test_binary_sets_are_whole_whatever_their_number_or_cut_short(tmp_path, sensors):
    path = tmp_path / "a.uff"
    laboratory.write_universal(path, functions(1)[: 1 + sensors])
    said = {**UNIVERSAL, "sensor": UNIVERSAL["sensor"][:sensors]}
    np.testing.assert_allclose(reading.gather(path, said).runs[0][1], H[:sensors], rtol=4e-16)
    path.write_bytes(path.read_bytes()[:-3000])
    with pytest.raises(sysid.InputError, match=rf"a\.uff is cut short: its last set, number {1 + sensors}"):
        reading.gather(path, said)


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda text: text[: len(text) // 2], "is cut short: its last set"),
        (
            lambda text: text.replace("    58     ", "    55     "),
            "no time records or frequency responses: sets 2411, 55",
        ),
        (lambda text: "    -1\n    -1\n", "holds no time records"),
    ],
)
def test_a_broken_universal_file_is_told_in_words(tmp_path, change, words):
    path = tmp_path / "a.uff"
    laboratory.write_universal(path, functions(0)[:2])
    path.write_text(change(path.read_text()))
    with pytest.raises(sysid.InputError, match=words) as told:
        reading.gather(path, UNIVERSAL)
    assert "a.uff" in str(told.value)


def test_functions_of_no_stated_form_are_asked_for(tmp_path):
    np.savez(tmp_path / "a.npz", freq=FREQ, H=H, F=F)
    with pytest.raises(sysid.InputError, match=r"a.npz.*receptance, mobility, accelerance or transmissibility"):
        sysid.read(tmp_path / "a.npz", {**MATRIX, "frf": ""})


def test_three_commands_from_a_table_to_a_result(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    np.savez("a.npz", freq=FREQ, H=H, F=F)
    words = [f"--sensor H[{i}] role=response axis=x position=0,0,{i}".split() for i in (1, 2, 3)]
    force = ["--sensor", "F", "role=force", "axis=x", "unit=N / m/s²"]
    given = ["read", "a.npz", "--base-axes", "x", "--frf", "transmissibility", *chain(*words), *force]
    assert cli.main(given) == 0
    assert "factor to SI" in capsys.readouterr().out
    monkeypatch.setattr("sysid.report.report.render", lambda result: "report")
    assert cli.main(["run", "test.h5"]) == 0
    mass = sysid.load("results/test").structure.mass
    np.testing.assert_allclose(np.diag(mass)[:3], [4, 3, 2], rtol=1e-6)
    assert cli.main(["new", "mine", "--data", "test.h5"]) == 0
    assert cli.main(["show", "mine.py"]) == 0
    # Masses of 4, 3 and 2 kg; a goal that is met does not make a total right that the force contradicts.
    for mass, goal, status in (("9", "0.9", 0), ("9", "1e-15", 1), ("12", "0.9", 1)):
        assert cli.main(["run", "test.h5", "--lumped", "--mass", mass, "--goal", goal, "--fresh"]) == status
        assert sysid.load("results/test").problem.goal == float(goal)
    result = sysid.load("results/test")
    assert result.judgement == "doubtful"
    assert result.contradictions[0].kind == "stated mass"  # before what it makes the model miss
    assert cli.main(["run", "cantilever_tower", "--goal", "0.1"]) == 2
    error = capsys.readouterr().err
    assert "--goal " in error and "'sysid read'" in error


def test_a_stated_gain_divides_its_channel_in_records_and_spectra(tmp_path):
    (tmp_path / "run.csv").write_text("\n".join(table()))
    gains = (1.25, 0.8, 1.1)
    stated = [{**one, "gain": gain} for one, gain in zip(SENSORS["sensor"], gains, strict=True)]
    test = reading.gather(tmp_path / "run.csv", {"sensor": stated})
    np.testing.assert_allclose(np.vstack(test.runs[0]), records()[2] / np.array(gains)[:, None], rtol=1e-10)
    np.savez(tmp_path / "a.npz", freq=FREQ, H=H, F=F)
    stated = [{**one, "gain": 0.8} if one["column"] in ("H[2]", "F") else one for one in MATRIX["sensor"]]
    test, plain = (sysid.read(tmp_path / "a.npz", {**MATRIX, "sensor": one}) for one in (stated, MATRIX["sensor"]))
    np.testing.assert_allclose(test.response, plain.response / [[1], [0.8], [1]], rtol=1e-12)
    np.testing.assert_allclose(test.force, plain.force / 0.8, rtol=1e-12)


def test_a_rigid_part_is_stated_of_sensors_with_a_place(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run.csv").write_text("\n".join(table()))
    base, top = ["--sensor", "table", "role=base", "axis=x"], ["--sensor", "top", "role=response", "axis=x"]
    words = ["read", "run.csv", *base, *top]
    assert cli.main([*words, "position=0,0,2", "part=deck"]) == 0
    (sensor,) = recorded_test.load("test.h5").measurement().sensors
    assert (sensor.part, sensor.position) == ("deck", (0.0, 0.0, 2.0))
    capsys.readouterr()
    assert cli.main([*words, "part=deck"]) == 2
    refused = capsys.readouterr().err
    assert refused.count("\n") == 1 and "'top'" in refused and "position" in refused


def test_gain_and_delay_are_stated_at_the_command_line_too(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run.csv").write_text("\n".join(table()))
    base, top = ["--sensor", "table", "role=base", "axis=x"], ["--sensor", "top", "role=response", "axis=x"]
    words = ["read", "run.csv", *base, *top]
    assert cli.main([*words, "gain=0.8"]) == 0
    np.testing.assert_allclose(recorded_test.load("test.h5").runs[0][1][0], records()[2][1] / 0.8, rtol=1e-10)
    assert cli.main([*words, "delay=-0.01"]) == 0
    np.testing.assert_allclose(recorded_test.load("test.h5").runs[0][1][0], records()[2][1][:-2], rtol=1e-10)
    assert cli.main([*words, "gain_std=0.004"]) == 0
    test = recorded_test.load("test.h5").measurement()
    assert test.gain_std.tolist() == [0.004] and test.base_gain_std is None
    wrongs = ("gain=0", "0.995"), ("gain=low", "0.995"), ("gain_std=-1", "0.005"), ("delay=late", "0.002")
    for wrong, right in wrongs:
        capsys.readouterr()
        assert cli.main([*words, wrong]) == 2
        told = capsys.readouterr().err
        assert told.count("\n") == 1 and wrong[:4] in told and right in told


def test_tolerances_of_base_and_force_are_those_of_their_directions(tmp_path):
    """Two sensors at z = 1 and 3 m: ry is (a_2 - a_1) / 2, of which these are -1/2 and 3/2 at unit rotation."""
    x = np.random.default_rng(0).standard_normal((3, 400))
    np.savez(tmp_path / "run.npz", fs=200.0, low=x[0], high=x[1], top=x[2])
    place = lambda z: {"axis": "x", "position": [0.0, 0.0, z], "unit": "m/s²"}  # noqa: E731
    said = {"base_axes": "x ry", "sensor": [
        {"column": "low", "role": "base", "gain_std": 0.01, **place(1.0)},
        {"column": "high", "role": "base", "gain_std": 0.01, **place(3.0)},
        {"column": "top", "role": "response", "gain_std": 0.02, **place(5.0)},
    ]}  # fmt: skip
    test = sysid.read(tmp_path / "run.npz", said)
    assert test.gain_std.tolist() == [0.02] and test.force_gain_std is None
    # x is 3/2 a_1 - a_2 / 2.
    np.testing.assert_allclose(test.base_gain_std, 0.01 * np.hypot([1.5, 0.5], [0.5, 1.5]))


def test_a_stated_delay_is_taken_off_its_channel_in_records_and_spectra(tmp_path):
    rate, delays, time = 200.0, (0.0, 0.0125, -0.00337), np.arange(600) / 200
    motion = lambda t: np.sin(2 * np.pi * 7 * t) + np.cos(2 * np.pi * 31.3 * t)  # noqa: E731
    late = [motion(time - delay) for delay in delays]
    np.savez(tmp_path / "run.npz", fs=rate, table=late[0], top=late[1], force=late[2])
    units = ("m/s²", "m/s²", "N")
    every = zip(SENSORS["sensor"], delays, units, strict=True)
    test = reading.gather(
        tmp_path / "run.npz", {"sensor": [{**one, "delay": s, "unit": unit} for one, s, unit in every]}
    )
    rows = np.vstack(test.runs[0])
    np.testing.assert_allclose(rows, np.tile(rows[0], (3, 1)), atol=1e-8)
    assert rows.shape[1] == 600 - 64 - 3  # the delays in whole samples are 2 and -1
    assert sum("late" in remark for remark in test.remarks) == 2
    np.savez(tmp_path / "a.npz", freq=FREQ, H=H, F=F)
    stated = [{**one, "delay": 0.002} if one["column"] in ("H[2]", "F") else one for one in MATRIX["sensor"]]
    test, plain = (sysid.read(tmp_path / "a.npz", {**MATRIX, "sensor": one}) for one in (stated, MATRIX["sensor"]))
    turn = np.exp(2j * np.pi * plain.freq * 0.002)
    np.testing.assert_allclose(test.response, plain.response * np.array([turn**0, turn, turn**0]), rtol=1e-12)
    np.testing.assert_allclose(test.force, plain.force * turn, rtol=1e-12)


def test_a_file_without_sensors_points_to_the_help_in_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    np.savez("a.npz", freq=FREQ, H=H, F=F)
    assert cli.main(["read", "a.npz"]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and "sysid read --help" in told and "[[sensor]]" not in told


def test_what_a_library_raises_of_a_foreign_file_is_one_line(tmp_path, monkeypatch):
    def fails(path):
        raise ZeroDivisionError("of a\nlibrary")

    monkeypatch.setitem(reading._READERS, ".npz", fails)
    (tmp_path / "a.npz").write_bytes(b"x")
    with pytest.raises(sysid.InputError, match=r"a\.npz cannot be read \(of a library\).*Export it again"):
        reading.gather(tmp_path / "a.npz", MATRIX)


def test_files_of_one_sensor_each_are_joined_to_runs_by_their_folders(tmp_path):
    time, _, si = records()
    roles = {"a": "base", "b": "response"}
    sensors = [{"column": name, "role": role, "axis": "x", "unit": "m/s²"} for name, role in roles.items()]
    paths = [tmp_path / run / f"{name}.csv" for run in ("first", "second") for name in "ab"]
    for path, row in zip(paths, [*si[:2], *-si[:2]], strict=True):
        path.parent.mkdir(exist_ok=True)
        np.savetxt(path, np.array([time, row]).T, fmt="%.17g", delimiter=";", header="time [s];acc", comments="")
    test = reading.gather(paths, {"join": True, "sensor": sensors})
    for (base, response, _), sign in zip(test.runs, (1, -1), strict=True):
        assert np.array_equal([base[0], response[0]], sign * si[:2])
    with pytest.raises(sysid.InputError, match=r"a\.csv has no column 'b', which .*b\.csv.*--join"):
        reading.gather(paths[:2], {"sensor": sensors[1:]})
    late = (time + 0.5, si[1])
    np.savetxt(paths[1], np.array(late).T, fmt="%.17g", delimiter=";", header="time [s];acc", comments="")
    with pytest.raises(sysid.InputError, match=r"b\.csv.*sample 1 is at 0.5 s, that of a\.csv at 0 s.*sysid\.resample"):
        reading.gather(paths[:2], {"join": True, "sensor": sensors})


def test_a_date_above_the_header_is_no_row_of_the_table(tmp_path):
    rows = ["Shaker test;;;", "01.02.2024;;;", "Time [s];table [g];top [mm/s²];force [kN]"]
    rows += [f"{i / 200:.3f};{i % 7};{i % 5};{i % 3}" for i in range(100)]
    (tmp_path / "run.csv").write_text("\n".join(rows), encoding="utf-8")
    assert reading.gather(tmp_path / "run.csv", SENSORS).sample_rate == 200
