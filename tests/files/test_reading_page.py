"""The examples of docs/reading_files.md run as they stand, and give the test that their files were made from."""

import re
import shlex
from pathlib import Path

import laboratory
import numpy as np
import pytest
import scipy.io
from laboratory import save, strong_motion

import sysid
from sysid.cli import main as cli
from sysid.files import reading, recorded_test

PAGE = Path(__file__).resolve().parents[2] / "docs/reading_files.md"
pytestmark = pytest.mark.skipif(not PAGE.exists(), reason="no documents beside the tests")
TRUTH = sysid.Structure(
    [[5e3, 0, 0], [0, 4e3, 0], [0, 0, 0]], [[4e6, -2e6, -2e6], [-2e6, 2e6, 0], [-2e6, 0, 2e6]], [0.01, 0.015], n_base=1
)
FREQ, RATE = np.arange(1, 301) * 0.025, 50.0
H = TRUTH.transmissibility(FREQ)[:, 0]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The files that the page names."""
    monkeypatch.chdir(tmp_path)
    text = PAGE.read_text(encoding="utf-8")
    for name, toml in zip(("sensors", "accelerance", "two"), re.findall(r"```toml\n(.*?)```", text, re.S), strict=True):
        (tmp_path / f"{name}.toml").write_text(toml, encoding="utf-8")
    base = np.random.default_rng(0).standard_normal((1, 1500))
    channels = np.vstack([base, TRUTH.simulate(base, RATE), TRUTH.simulate_force(base, RATE) / 1e3])
    time, heads = np.arange(1500) / RATE, ("table [m/s²]", "a1 [m/s²]", "a2 [m/s²]", "force [kN]")
    for name in ("log", "run1", "run2"):
        save(f"{name}.csv", ["time [s]", *heads], [time, *channels])
    (tmp_path / "one").mkdir()
    for head, channel in zip(heads, channels, strict=True):
        save(f"one/{head.split()[0]}.csv", ["time [s]", head], [time, channel])
    parts = [part for row in H for part in (row.real, row.imag)]
    save("frf.csv", ["Frequency [Hz]", "h1_re", "h1_im", "h2_re", "h2_im"], [FREQ, *parts])
    save("sweep.csv", ["w [rad/s]", "h1_re", "h1_im", "h2_re", "h2_im"], [2 * np.pi * FREQ, *parts])
    table = 1 / (1e3 + TRUTH.base_force(FREQ)[0, 0])  # a table of 1 t, for a unit force of its shaker
    scipy.io.savemat("shaker.mat", {"freq": FREQ, "table": table, "h1": H[0] * table, "h2": H[1] * table})
    strong_motion("CE24386.V2", [base[0], channels[1]])
    return tmp_path


def universal():
    """A file in mm with two nodes and their transmissibilities."""
    functions = [laboratory.function(node, row, FREQ) for node, row in enumerate(H, 1)]
    laboratory.write_universal("modal.unv", [laboratory.IN_MM, laboratory.nodes([3e3, 6e3]), *functions])


def commands():
    """The lines of the page that read files, without their first two words."""
    text = PAGE.read_text(encoding="utf-8").replace("\\\n", "") if PAGE.exists() else ""
    return re.findall(r"^sysid read (.*)$", text, re.M)


@pytest.mark.parametrize("line", commands())
def test_each_command_reads_the_test_that_its_files_were_made_from(folder, capsys, line):
    if "modal.unv" in line:
        universal()
    assert cli.main(["read", *shlex.split(line)]) == 0, capsys.readouterr().err
    test = recorded_test.load("test.h5")
    for base, response, _ in test.runs:
        if test.freq is not None:
            np.testing.assert_allclose(test.freq, FREQ, rtol=1e-10)
            np.testing.assert_allclose(response / base, H, rtol=1e-9)
        else:
            np.testing.assert_allclose(response, TRUTH.simulate(base, RATE)[: len(response)], rtol=0, atol=1e-9)
    assert len(test.runs) == 1 + line.startswith("run1")
    if "modal.unv" in line:
        assert [(sensor.axis, sensor.position[2]) for sensor in test.sensors] == [("x", 3.0), ("x", 6.0)]


def test_two_references_are_two_runs(folder):
    np.savez("a.npz", freq=FREQ, top_per_x=H[0], top_per_y=0.1 * H[1])
    test = reading.gather("a.npz", "two.toml")
    assert [sensor.name for sensor in test.sensors] == ["top"]
    np.testing.assert_allclose([run[1][0] for run in test.runs], [H[0], 0.1 * H[1]])
    np.testing.assert_array_equal([run[0][:, 0] for run in test.runs], np.eye(2))
