"""Files of LabVIEW, of the CESMD and of MATLAB as laboratories have them, and several runs of joined exports."""

from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat
from scipy.signal.windows import tukey

import sysid
from benchmarks.records.simulated import four_storeys
from sysid.cli import main as cli
from sysid.files import reading, units
from sysid.files.recorded_test import load

G = 9.80665
A, B = np.round(np.random.default_rng(4).standard_normal((2, 96)), 6)


def sensors(base="a", top="b", unit="g", **more):
    both = ((base, "base"), (top, "response"))
    return {"sensor": [{"column": name, "role": role, "axis": "x", "unit": unit} for name, role in both], **more}


def labview(*segments, begins=(0.0,), multi=False, comma=False):
    """Segments of two channels at 200 Hz, in the form of a sample of lvm_read's, which LabVIEW wrote."""
    lines = ["LabVIEW Measurement\t", "Writer_Version\t2", "Reader_Version\t2", "Separator\tTab",
             f"Decimal_Separator\t{',' if comma else '.'}", "Multi_Headings\tYes",
             f"X_Columns\t{'Multi' if multi else 'One'}", "Time_Pref\tAbsolute", "Date\t2016/08/23",
             "Time\t10:45:47.0352557312499836422", "***End_of_Header***\t", "\t"]  # fmt: skip
    gap = "\t\t" if multi else "\t"
    for begin, segment in zip(begins, segments, strict=True):
        each = {"Samples": segment.shape[1], "Date": "2016/08/23", "Time": f"10:45:{begin:013.10f}",
                "Y_Unit_Label": "g", "X_Dimension": "Time", "X0": "0.0E+0", "Delta_X": "5.000000E-3"}  # fmt: skip
        lines += ["Channels\t2\t\t", *(f"{tag}\t{value}{gap}{value}\t" for tag, value in each.items())]
        lines += ["***End_of_Header***\t\t\t", "X_Value\ta\tX_Value\tb\tComment" if multi else "X_Value\ta\tb\tComment"]
        for at, (a, b) in enumerate(segment.T):
            x = f"{at * 0.005:.6f}"
            lines.append(f"{x}\t{a:.6f}\t{x}\t{b:.6f}" if multi else f"{x}\t{a:.6f}\t{b:.6f}")
        lines.append("")
    head = 12
    return [line.replace(".", ",") if comma and at >= head else line for at, line in enumerate(lines)]


@pytest.mark.parametrize("multi, comma", [(False, False), (False, True), (True, False), (True, True)])
def test_measurement_files_of_labview_keep_their_digits_rate_and_units(tmp_path, multi, comma):
    (tmp_path / "run.lvm").write_text("\r\n".join(labview(np.array([A, B]), multi=multi, comma=comma)))
    test = reading.gather(tmp_path / "run.lvm", sensors(unit=""))
    np.testing.assert_allclose(np.vstack(test.runs[0][:2]), G * np.array([A, B]), rtol=1e-15)
    assert test.sample_rate == 200 and [row.unit for row in test.table] == ["g", "g"]


def test_segments_are_runs_and_those_without_a_gap_are_one(tmp_path):
    """The second begins 96/200 s after the first, the third a second later."""
    text = labview(np.array([A, B]), np.array([B, A]), np.array([A, A]), begins=(10.0, 10.48, 12.0))
    (tmp_path / "run.lvm").write_text("\n".join(text))
    test = reading.gather(tmp_path / "run.lvm", sensors())
    assert [run[0].shape[1] for run in test.runs] == [192, 96]
    np.testing.assert_allclose(test.runs[0][0][0], G * np.hstack([A, B]), rtol=1e-15)


def strong_motion(step=".0050000", shown=".005", unit=", in cm/sec2", count=96):
    """Two channels as the CESMD gives them out; velocity and displacement are left short, which nobody reads."""
    lines = []
    for number, (name, row) in enumerate([("360 Deg", 30 * A), ("Up", 3000 * B)], 1):
        lines += ["Corrected accelerogram   58667-L2866-14236.52", *["Concord"] * 6, f"Chan  {number}:  {name}"]
        lines += ["Station No. 58667", *["-"] * 15, "", *["    1" * 16] * 6, "    1    0    0    0"]
        reals = ["      .000" * 8] * 12
        reals[7] = f"{'      .000' * 4}{step:>10}{'      .000' * 3}"
        lines += [
            *reals,
            "      .000" * 4,
            f"{count:6d} points of accel data equally spaced at {shown:>5} sec{unit}. (8f10.6)",
        ]
        fields = [f"{one:10.4f}" for one in row]
        lines += ["".join(fields[at : at + 8]) for at in range(0, 96, 8)]
        lines += ["    8 points of veloc data equally spaced at  .005 sec, in cm/sec.  (8f10.7)", "  .1000000" * 8]
        lines += [f"/&  ----------  End of data for channel  {number}  ----------"]
    return lines


@pytest.mark.parametrize(
    "step, shown, rate", [(".0050000", ".005", 200), (".0078125", ".008", 128), ("-999.00000", ".010", 100)]
)
def test_strong_motion_records_keep_their_digits_and_tell_axes_and_rate(tmp_path, step, shown, rate):
    """Neighbours of ten places touch; the interval is that of the reals, which has more digits than the line."""
    (tmp_path / "CE58667.V2").write_text("\n".join([*strong_motion(step, shown), ""]))
    said = sensors("Chan 1", "Chan 2", unit="")
    del said["sensor"][1]["axis"]
    test = reading.gather(tmp_path / "CE58667.V2", said)
    wanted = [[float(f"{one:.4f}") for one in row] for row in (30 * A, 3000 * B)]
    np.testing.assert_allclose(np.vstack(test.runs[0][:2]), 0.01 * np.array(wanted), rtol=1e-14)
    assert test.sample_rate == pytest.approx(rate, rel=1e-12)
    assert test.sensors[0].axis == "z"


@pytest.mark.parametrize("ending, change, place", [
    (".lvm", lambda lines: lines[:100], "states 96 samples, and 78"),
    (".lvm", lambda lines: [line.replace("Channels\t2", "Channels\t3") for line in lines], "states 3 channels"),
    (".lvm", lambda lines: [*lines[:60], "0.1\t0.l\t0.2", *lines[61:]], "line 61: holds '0.l'"),
    (".lvm", lambda lines: [*lines[:60], "0.19\tNaN\t0.2", *lines[61:]], r"\(line 61\) is nan"),
    (".lvm", lambda lines: lines[:11], "1 lines"),
    (".V2", lambda lines: lines[:-1], "does not end"),
    (".V2", lambda lines: lines[:50] + lines[51:], "line 46: it states 96 accelerations, and 88"),
    (".V2", lambda lines: [line.replace(", in cm/sec2", "") for line in lines], "no unit is stated"),
    (".V2", lambda lines: lines[:1], "holds no corrected accelerations"),
])  # fmt: skip
def test_a_broken_file_is_told_with_its_place(tmp_path, ending, change, place):
    sound = labview(np.array([A, B])) if ending == ".lvm" else strong_motion()
    (tmp_path / f"run{ending}").write_text("\n".join(change(sound)))
    with pytest.raises(sysid.InputError, match=place):
        reading.gather(tmp_path / f"run{ending}", sensors(*((1, 2) if ending == ".V2" else ("a", "b")), unit=""))


@pytest.mark.parametrize("array", [np.array([A, B]), np.array([A, B]).T])
def test_the_shorter_side_of_a_matrix_is_its_channels_whatever_stands_beside(tmp_path, array):
    """Heights of the two channels are no time."""
    savemat(tmp_path / "run.mat", {"x": array, "fs": 50.0, "height": [0.0, 3.0], "turn": np.eye(3)})
    test = reading.gather(tmp_path / "run.mat", sensors("x[1]", "x[2]"))
    np.testing.assert_array_equal(np.vstack(test.runs[0][:2]), G * np.array([A, B]))


def test_a_square_matrix_is_asked_about(tmp_path):
    savemat(tmp_path / "run.mat", {"x": np.outer(A, B), "fs": 50.0})
    with pytest.raises(sysid.InputError, match="96 rows and as many columns"):
        reading.gather(tmp_path / "run.mat", sensors("x[1]", "x[2]"))


@pytest.mark.parametrize("form", ["{run}_{name}", "{name} {run}", "shaker.{name}.{run}", "{run}/{name}"])
def test_runs_of_joined_files_are_told_by_folders_or_by_names(tmp_path, form):
    paths = []
    for run, sign in (("one", 1), ("two", -1)):
        for name, row in (("a", A), ("b", B)):
            paths.append(tmp_path / (form.format(run=run, name=name) + ".csv"))
            paths[-1].parent.mkdir(exist_ok=True)
            paths[-1].write_text("\n".join(["x", *(f"{sign * one:.6f}" for one in row)]))
    test = reading.gather(paths, sensors(join=True, sample_rate=50.0))
    assert len(test.runs) == 2
    for run, sign in zip(test.runs, (1, -1), strict=True):
        np.testing.assert_allclose(np.vstack(run[:2]), sign * G * np.array([A, B]), rtol=1e-15)


def test_base_sensors_of_one_axis_are_told_by_their_differences(tmp_path):
    """Gains of 0.99 and 1.01 about their mean; opposite ones have no motion in common."""
    for name, other in (("near", 1.02 / 0.98 * A), ("turned", -A)):
        np.savez(tmp_path / f"{name}.npz", a=A, c=other, b=B, fs=50.0)
    said = sensors()
    said["sensor"].append({**said["sensor"][0], "column": "c"})
    test = reading.gather(tmp_path / "near.npz", said)
    np.testing.assert_allclose(test.runs[0][0][0], G * A / 0.98, rtol=1e-12)
    assert sum("'a' 0.98 times (off by 2 %), 'c' 1.02 times (off by 2 %)" in one for one in test.remarks) == 1
    (tmp_path / "test.h5").write_bytes(test.to_bytes())
    kept = load(tmp_path / "test.h5").measurement(estimator="spectra").base_sensors
    assert [one.name for one in kept] == ["a", "c"]
    np.testing.assert_allclose([one[1:] for one in kept], [[0.98, 0.02 / 0.98], [1.02, 0.02 / 1.02]], rtol=1e-9)
    with pytest.raises(sysid.InputError, match=r"\('a', 'c'\) share less than half"):
        reading.gather(tmp_path / "turned.npz", said)


@pytest.mark.parametrize("offset, other, refused", [(3.0, A - 3.0, False), (9.8, 9.8 - A, True)])
def test_offsets_of_base_sensors_are_no_motion(tmp_path, offset, other, refused):
    """The same motion with offsets of either sign agrees; opposite motions differ, gravity on both or not."""
    np.savez(tmp_path / "run.npz", a=A + offset, c=other, b=B, fs=50.0)
    said = sensors(unit="m/s²")
    said["sensor"].append({**said["sensor"][0], "column": "c"})
    if refused:
        with pytest.raises(sysid.InputError, match="share less than half"):
            reading.gather(tmp_path / "run.npz", said)
    else:
        test = reading.gather(tmp_path / "run.npz", said)
        np.testing.assert_allclose(test.runs[0][0][0], A, atol=1e-12)
        assert sum("'a' 1 times" in one and "'c' 1 times" in one for one in test.remarks) == 1


@pytest.mark.parametrize("text", ["cm/sec2", "CM/SEC/SEC", "cm/s/s", "cm/sec^2", "gal"])
def test_units_of_strong_motion_files_are_known(text):
    assert units.find(text) == units.Unit("acceleration", 1e-2)


FLOORS = four_storeys()
WAYS = {
    "in motion": lambda records: records,
    "tapered": lambda records: records * tukey(records.shape[1], 0.1),
    "tapered and padded": lambda records: np.pad(records * tukey(records.shape[1], 0.1), ((0, 0), (20, 20))),
}


def written(folder, records):
    """A file of base and floors at 200 Hz, and what is said of them."""
    names = ["table", "a1", "a2", "a3", "a4"]
    np.savez(folder / "run.npz", fs=FLOORS.sample_rate, **dict(zip(names, records, strict=True)))
    said = [{"column": name, "role": "response", "axis": "x", "unit": "m/s²"} for name in names]
    return {"sensor": [said[0] | {"role": "base"}, *said[1:]]}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("seed", range(3))
def test_a_window_over_the_records_is_told_and_not_taken_for_rest(tmp_path, way, seed):
    rng = np.random.default_rng(seed)
    run = FLOORS.with_noise(FLOORS.run(rng).records(), rng)[0]
    said = written(tmp_path, WAYS[way](np.vstack([run.base, run.response])))
    remarks = " ".join(reading.gather(tmp_path / "run.npz", said).remarks)
    assert "--at-rest" not in remarks
    assert ("window" in remarks) == (way != "in motion")


@pytest.mark.parametrize("quiet", [5.0, 0.0])
def test_records_from_rest_to_rest_are_told_and_run_so(tmp_path, monkeypatch, no_pictures, quiet):
    """A shake of 20 s from `quiet` on, and free decay; noise of 0.3 %."""
    rng, time = np.random.default_rng(2), np.arange(12000) / FLOORS.sample_rate
    base = rng.standard_normal((1, 12000)) * np.where((time >= quiet) & (time < quiet + 20), 1.0, 0.0)
    records = np.vstack([base, FLOORS.structure.simulate(base, FLOORS.sample_rate)])
    records += 3e-3 * np.std(records, axis=1, keepdims=True) * rng.standard_normal(records.shape)
    said = written(tmp_path, records)
    remarks = " ".join(reading.gather(tmp_path / "run.npz", said).remarks)
    assert ("--at-rest" in remarks) == (quiet > 0)
    assert "window" not in remarks
    if quiet:
        monkeypatch.chdir(tmp_path)
        Path("run.toml").write_text(
            "".join("[[sensor]]\n" + "".join(f'{k} = "{v}"\n' for k, v in one.items()) for one in said["sensor"]),
            encoding="utf-8",
        )
        assert cli.main(["read", "run.npz"]) == 0
        assert cli.main(["run", "test.h5", "--at-rest", "--out", "out"]) == 0
        result = sysid.load("out")
        assert result.recipe.parameters["at_rest"] is True
        np.testing.assert_allclose(
            result.structure.natural_frequencies, FLOORS.structure.natural_frequencies, rtol=1e-4
        )
