"""Xsens DOT files: a synthetic file round trip, the traps of real ones, mistakes, and the records of a real test."""

import os
from pathlib import Path

import numpy as np
import pytest

import sysid
from sysid import InputError
from sysid.files import xsens_dot

COLUMNS = [
    "PacketCounter", "SampleTimeFine", "Euler_X", "Euler_Y", "Euler_Z",
    "Acc_X", "Acc_Y", "Acc_Z", "Gyr_X", "Gyr_Y", "Gyr_Z",
]  # fmt: skip
PREAMBLE = "sep=,\nDeviceTag:,Xsens DOT\nFirmwareVersion:,3.0.0\nAppVersion:,2023\nStartTime: ,today\n© somebody\n\n"


@pytest.fixture
def record():
    """Time in µs, accelerations (3, n), rotation rates in deg/s (3, n); the first sample is the zeros of the unit."""
    rng = np.random.default_rng(0)
    time = 613251808 + np.round(np.arange(50) * 1e6 / 120).astype(int)
    acceleration, rates = rng.normal(size=(2, 3, 50))
    acceleration[2] += 9.81
    acceleration[:, 0] = 0
    return time, acceleration, rates


def text(record, *, columns=COLUMNS, preamble=PREAMBLE):
    time, acceleration, rates = record
    values = {"PacketCounter": np.arange(len(time)), "SampleTimeFine": time}
    values |= {f"Acc_{a}": row for a, row in zip("XYZ", acceleration, strict=True)}
    values |= {f"Gyr_{a}": row for a, row in zip("XYZ", rates, strict=True)}
    rows = [",".join(repr(float(values.get(c, np.zeros(len(time)))[i])) for c in columns) for i in range(len(time))]
    return preamble + ",".join(columns) + "\n" + "\n".join(rows) + "\n"


def write(folder, content, encoding="utf-8"):
    file = folder / "unit.csv"
    file.write_text(content, encoding=encoding)
    return file


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
@pytest.mark.parametrize("preamble", [PREAMBLE, ""])
@pytest.mark.parametrize("columns", [COLUMNS, COLUMNS[::-1], [*COLUMNS, "Mag_X"]])
def test_what_was_written_is_read_in_si_units_without_the_first_row(tmp_path, record, encoding, preamble, columns):
    time, acceleration, rates = record
    unit = xsens_dot.read_xsens_dot(write(tmp_path, text(record, columns=columns, preamble=preamble), encoding))
    np.testing.assert_allclose(unit.time, time[1:] * 1e-6, rtol=1e-15)
    np.testing.assert_array_equal(unit.acceleration, acceleration[:, 1:])
    np.testing.assert_allclose(unit.rotation_rate, rates[:, 1:] * np.pi / 180, rtol=1e-14)


def test_a_path_may_be_a_string(tmp_path, record):
    file = write(tmp_path, text(record))
    np.testing.assert_array_equal(xsens_dot.read_xsens_dot(str(file)).time, xsens_dot.read_xsens_dot(file).time)


def test_windows_line_ends(tmp_path, record):
    plain = xsens_dot.read_xsens_dot(write(tmp_path, text(record)))
    file = tmp_path / "windows.csv"
    file.write_bytes(text(record).replace("\n", "\r\n").encode())
    np.testing.assert_array_equal(xsens_dot.read_xsens_dot(file).acceleration, plain.acceleration)


class TestMistakes:
    def refuse(self, file, match):
        with pytest.raises(InputError, match=match) as caught:
            xsens_dot.read_xsens_dot(file)
        assert file.name in str(caught.value)

    def test_no_file(self, tmp_path):
        self.refuse(tmp_path / "none.csv", "cannot read")

    def test_a_folder(self, tmp_path):
        self.refuse(tmp_path, "cannot read")

    def test_not_text(self, tmp_path):
        file = tmp_path / "unit.csv"
        file.write_bytes(bytes(range(128, 256)))
        self.refuse(file, "cannot read")

    @pytest.mark.parametrize("content", ["", "a,b\n1,2\n", PREAMBLE])
    def test_another_kind_of_file(self, tmp_path, content):
        self.refuse(write(tmp_path, content), "no header line with SampleTimeFine")

    def test_columns_that_are_missing(self, tmp_path, record):
        fewer = [c for c in COLUMNS if c not in ("Acc_Y", "Gyr_Z")]
        self.refuse(write(tmp_path, text(record, columns=fewer)), "lacks the columns Acc_Y, Gyr_Z")

    def test_cut_off_in_a_row(self, tmp_path, record):
        self.refuse(write(tmp_path, text(record)[:-60]), "unit.csv")

    def test_words_among_numbers(self, tmp_path, record):
        self.refuse(write(tmp_path, text(record) + ",".join(["x"] * len(COLUMNS)) + "\n"), "unit.csv")

    @pytest.mark.parametrize("rows", [0, 1, 2])
    def test_too_few_rows(self, tmp_path, record, rows):
        lines = text(record).splitlines()
        header = next(i for i, line in enumerate(lines) if "SampleTimeFine" in line)
        self.refuse(write(tmp_path, "\n".join(lines[: header + 1 + rows]) + "\n"), "rows")

    @pytest.mark.parametrize("bad", [np.nan, np.inf])
    def test_samples_that_are_not_finite(self, tmp_path, record, bad):
        record[1][1, 7] = bad
        self.refuse(write(tmp_path, text(record)), "NaN or infinite")

    @pytest.mark.parametrize("step", [0, -5])
    def test_time_that_does_not_rise(self, tmp_path, record, step):
        record[0][8] = record[0][7] + step
        # Counted as the unit's own PacketCounter does, from 0.
        self.refuse(write(tmp_path, text(record)), "SampleTimeFine does not rise at row 8")


UNITS = ("ground", "floor_1", "floor_2", "floor_3")


@pytest.fixture(params=["sine_1p5", "sine_2p0"])
def event(request):
    """The records of a real shake-table test, where they are at hand."""
    given = os.environ.get("SYSID_DATA")
    shared = Path(__file__).resolve().parents[3] / "shared" / "data" / "mini_shake_table" / "flexible_3_storey"
    folder = (Path(given) if given else shared) / request.param
    if not folder.is_dir():
        pytest.skip("the records of the shake-table test are not here: set SYSID_DATA to the folder of both events")
    return {unit: xsens_dot.read_xsens_dot(folder / f"{unit}.csv") for unit in UNITS}


def test_real_units_stand_upright_at_120_hz(event):
    for unit in event.values():
        assert np.median(np.diff(unit.time)) == pytest.approx(1 / 120, rel=1e-3)
        assert unit.acceleration.shape == unit.rotation_rate.shape == (3, unit.time.size)
        assert np.mean(unit.acceleration[2]) == pytest.approx(9.81, abs=0.2)  # gravity along Z
        assert np.all(np.linalg.norm(unit.acceleration, axis=0) > 1)  # the row of zeros is gone
        assert np.max(np.abs(unit.rotation_rate)) < 10  # rad/s, not deg/s


def test_real_floors_resonate_at_the_known_first_mode(event):
    """The relative motion of the top floor peaks within 2 % of 3.75 Hz, from units brought to one clock."""
    time, (ground, *floors) = sysid.resample([(unit.time, unit.acceleration[:1]) for unit in event.values()])
    records = [x - x.mean() for x in (ground, *floors)]
    test = sysid.Measurement.from_time(
        [(records[0], np.vstack(records[1:]), None)], 1 / (time[1] - time[0]), rigid_body=np.ones((3, 1)),
        band=(2.5, 6.0),
    )  # fmt: skip
    power = np.abs(test.relative[0, 2]) ** 2
    assert np.sum(test.freq * power**2) / np.sum(power**2) == pytest.approx(3.75, rel=0.02)
