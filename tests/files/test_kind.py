"""Kinds of test that files seem to be, by `sysid doctor FILE`, and what is missing."""

import json

import numpy as np
import pytest

from sysid.cli import main as cli

TIME = np.arange(6000) / 200.0
NOISE = np.random.default_rng(8).standard_normal((2, 6000))
KINDS = {
    "random": (NOISE[0], "random"),
    "two octaves in 30 s": (np.sin(2 * np.pi * np.cumsum(4 * 2 ** (TIME / 15)) / 200), "swept"),
    "dwell": (np.sin(2 * np.pi * 7 * TIME), "one frequency"),
    "earthquake": (NOISE[0] * np.exp(-(((TIME - 10) / 4) ** 2)), "earthquake"),
}


def told(capsys, *words):
    assert cli.main(["doctor", *words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.parametrize("kind", KINDS)
def test_records_in_time_are_told_by_their_kind(tmp_path, capsys, kind):
    """The top follows at a resonance of 6 Hz with 3 % damping, and each channel has noise of 1 %."""
    base, word = KINDS[kind]
    pulse = np.exp(-0.03 * 2 * np.pi * 6 * TIME) * np.sin(2 * np.pi * 6 * TIME)
    top = base + np.convolve(base, pulse)[:6000] * 2 * np.pi * 6 / 200
    both = np.array([base, top]) * (1 + 0.01 * NOISE)
    np.savez(tmp_path / "run.npz", table=both[0], top=both[1], fs=200.0)
    assert word in told(capsys, str(tmp_path / "run.npz"))["runs"][0]["kind"]


@pytest.mark.parametrize("step, coarse", [(0.05, False), (0.5, True)])
def test_functions_of_too_few_lines_at_their_peak_are_told_so(tmp_path, capsys, step, coarse):
    """A peak at 20 Hz of 1 % damping is 0.4 Hz wide."""
    freq = np.arange(1, 800) * step
    np.savez(tmp_path / "h.npz", freq=freq, top=1 / (1 - (freq / 20) ** 2 + 0.02j * freq / 20))
    found = told(capsys, str(tmp_path / "h.npz"))
    assert "analyser" in found["runs"][0]["kind"]
    assert sum("finer lines" in one for one in found["missing"]) == coarse


def test_one_line_of_spectra_is_too_short_to_tell(tmp_path, capsys):
    (tmp_path / "h.csv").write_text("freq [Hz],top_re,top_im\n5.0,1.0,0.1\n")
    assert told(capsys, str(tmp_path / "h.csv"))["runs"][0]["kind"] == "too short to tell"


def test_what_is_missing_is_told_until_nothing_is(tmp_path, capsys):
    path = tmp_path / "run.npz"
    np.savez(path, table=NOISE[0], top=NOISE[1])
    assert len(told(capsys, str(path))["missing"]) == 2  # rate, sensors
    both = [f'[[sensor]]\ncolumn = "{name}"\nrole = "{role}"\naxis = "x"\n' for name, role in
            (("table", "base"), ("top", "response"))]  # fmt: skip
    (tmp_path / "sensors.toml").write_text("sample_rate = 200\n" + "".join(both))
    assert "unit" in told(capsys, str(path))["missing"][0]
    (tmp_path / "sensors.toml").write_text("sample_rate = 200\n" + "".join(f'{one}unit = "g"\n' for one in both))
    assert told(capsys, str(path))["missing"] == []
    assert cli.main(["doctor", str(tmp_path / "none.csv")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    test = str(tmp_path / "test.h5")
    assert cli.main(["read", str(path), "--out", test, "--quiet"]) == 0
    assert told(capsys, test) == told(capsys, test) | {"runs": [], "missing": []}


@pytest.mark.parametrize("command", ["doctor", "read"])
def test_a_folder_is_no_file(tmp_path, monkeypatch, capsys, command):
    monkeypatch.chdir(tmp_path)
    for name in (".", "/"):
        assert cli.main([command, name]) == 2
        assert capsys.readouterr().err == f"sysid: {name} is a folder: name its files\n"
