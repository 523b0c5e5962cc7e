"""Files whose units have clocks of their own are brought to one by the motion that they share, or refused."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sysid
from benchmarks.records.simulated import four_storeys
from sysid.cli import main as cli
from sysid.files import reading, recorded_test

SETTING = replace(four_storeys(150.0), duration=60.0)
RATE = SETTING.sample_rate
NAMES = ("table", "one", "two", "three", "four")
SAID = {
    "join": True,
    "sensor": [{"column": n, "role": "base" if n == "table" else "response", "axis": "x"} for n in NAMES],
}
CUTS = (100, 431, 0, 1207, 60)  # first sample of each unit's file
ENDS = (11000, 11950, 12000, 11500, 11800)


@pytest.fixture(scope="module")
def motion():
    """Records of table and four storeys, (5, n), cut in motion, with noise."""
    rng = np.random.default_rng(5)
    noisy = SETTING.with_noise(SETTING.run(rng).records(), rng)[0]
    return np.vstack([noisy.base, noisy.response])


@pytest.fixture(scope="module")
def identified():
    """Give a function that identifies a test: once, where units are moved to the same records."""
    known = {}

    def result(test):
        records = test.base.tobytes() + test.response.tobytes()
        if records not in known:
            known[records] = sysid.identify(sysid.Problem(test), rng=0)
        return known[records]

    return result


def written(folder, records, begins, cuts=CUTS, ends=ENDS):
    """A file a unit, its times from its own clock's beginning, s."""
    for name, row, begin, cut, end in zip(NAMES, records, begins, cuts, ends, strict=True):
        table = np.column_stack([begin + np.arange(end - cut) / RATE, row[cut:end]])
        np.savetxt(folder / f"{name}.csv", table, delimiter=",", header="time [s],a [m/s²]", comments="", fmt="%.9g")
    return [folder / f"{name}.csv" for name in NAMES]


def late_by(test, motion):
    """Samples by which each response is late against the base, by where its record stands in the whole."""
    ((base, response, _),) = test.runs
    rows = np.vstack([base, response])
    n = rows.shape[1]
    starts = [
        next(k for k in range(motion.shape[1] - n + 1) if np.allclose(whole[k : k + 5], row[:5], atol=1e-6))
        for whole, row in zip(motion, rows, strict=True)
    ]
    return starts[0] - np.array(starts[1:])


@pytest.mark.parametrize("begins", [(0, 0, 0, 0, 0), (5e4, -3.0, 12.5, 900.0, 1e3)])
def test_units_on_clocks_of_their_own_are_moved_to_within_what_the_fit_finds(tmp_path, motion, identified, begins):
    files = written(tmp_path, motion, begins)
    with pytest.raises(sysid.InputError, match="--align"):
        reading.gather(files, SAID)
    test = reading.gather(files, {**SAID, "align": True})
    late = late_by(test, motion)
    assert np.all(np.abs(late) <= 0.2 * RATE / SETTING.structure.natural_frequencies[0])
    assert sum("is moved by" in remark for remark in test.remarks) == 4
    structure = identified(test.measurement(band=SETTING.lines))
    np.testing.assert_allclose(
        structure.structure.natural_frequencies, SETTING.structure.natural_frequencies, rtol=2e-3
    )
    found = structure.modal[0].delays
    np.testing.assert_allclose(found.values * RATE, late, atol=0.1)
    assert (structure.findings[0].kind == "late sensor") == np.any(late)


def test_units_whose_clocks_agree_stay_as_they_are(tmp_path, motion):
    begins = np.array(CUTS) / RATE
    test = reading.gather(written(tmp_path, motion, begins), {**SAID, "align": True})
    np.testing.assert_array_equal(late_by(test, motion), 0)


def test_equal_times_do_not_hide_records_that_are_seconds_late(tmp_path, motion):
    files = written(tmp_path, motion, [0] * 5, cuts=[800, 0, 800, 800, 800], ends=[11000, 10200, *[11000] * 3])
    test = reading.gather(files, {**SAID, "align": True})
    late = late_by(test, motion)
    assert abs(late[0]) <= 0.2 * RATE / SETTING.structure.natural_frequencies[0]
    np.testing.assert_array_equal(late[1:], 0)


def test_records_of_another_run_are_refused_and_align_needs_files_of_a_run(tmp_path, motion):
    other = motion.copy()
    other[2] = np.random.default_rng(1).standard_normal(motion.shape[1])
    files = written(tmp_path, other, [0] * 5)
    with pytest.raises(sysid.InputError, match=r"two\.csv.*table\.csv.*no motion in common"):
        reading.gather(files, {**SAID, "align": True})
    with pytest.raises(sysid.InputError, match="join"):
        reading.gather(files, {**SAID, "join": False, "align": True})


def test_rates_that_differ_are_refused(tmp_path, motion):
    files = written(tmp_path, motion, [0] * 5)
    times = np.arange(11000) / (1.001 * RATE)
    np.savetxt(
        files[1], np.column_stack([times, motion[1, :11000]]), delimiter=",", header="time [s],a [m/s²]", comments=""
    )
    with pytest.raises(sysid.InputError, match="rate"):
        reading.gather(files, {**SAID, "align": True})


def test_the_command_line_aligns(tmp_path, motion, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    files = written(tmp_path, motion, (5e4, -3.0, 12.5, 900.0, 1e3))
    words = [part for one in SAID["sensor"] for part in ("--sensor", one["column"], f"role={one['role']}", "axis=x")]
    command = ["read", *map(str, files), "--join", *words]
    assert cli.main(command) == 2
    assert "--align" in capsys.readouterr().err
    assert cli.main([*command, "--align"]) == 0
    assert "three.csv is moved by" in capsys.readouterr().out
    assert recorded_test.load("test.h5").runs[0][1].shape[0] == 4


UNITS = ("ground", "floor_1", "floor_2", "floor_3")


@pytest.mark.parametrize("event", ["sine_1p5", "sine_2p0"])
def test_real_units_without_time_in_common_have_the_delays_that_they_have_on_one_clock(tmp_path, event):
    given = os.environ.get("SYSID_DATA")
    shared = Path(__file__).resolve().parents[3] / "shared" / "data" / "mini_shake_table" / "flexible_3_storey"
    folder = (Path(given) if given else shared) / event
    if not folder.is_dir():
        pytest.skip("the records of the shake-table test are not here: set SYSID_DATA to the folder of both events")
    sensors = [{"column": f"{n}.Acc_X", "role": "response", "axis": "x", "name": n} for n in UNITS]
    sensors[0]["role"] = "base"
    apart = []
    for number, unit in enumerate(UNITS):
        head, _, rows = (folder / f"{unit}.csv").read_text(encoding="utf-8-sig").rpartition("PacketCounter")
        names, *lines = ("PacketCounter" + rows).splitlines()
        at = names.split(",").index("SampleTimeFine")
        cells = [line.split(",") for line in lines if line.strip()]
        for row in cells:
            row[at] = f"{float(row[at]) + 1e9 * number:.0f}"
        apart.append(tmp_path / f"{unit}.csv")
        apart[-1].write_text("\n".join([head + names, *map(",".join, cells)]))
    with pytest.raises(sysid.InputError, match="--align"):
        reading.gather(apart, {"sensor": sensors})
    moved = reading.gather(apart, {"sensor": sensors, "align": True})
    one = reading.gather([folder / f"{unit}.csv" for unit in UNITS], {"sensor": sensors})
    rows, right = (np.vstack(test.runs[0][:2]) for test in (moved, one))
    for a, b in zip(rows[1:], right[1:], strict=True):
        late = np.argmax(np.correlate(a, rows[0], "full")) - np.argmax(np.correlate(b, right[0], "full"))
        assert abs(late) / moved.sample_rate < 0.1 / 3.75  # a tenth of a period of the first mode
