"""The help of every command: its examples run as they stand."""

import contextlib
import io
import re
import shlex

import numpy as np
import pytest

import sysid
from sysid.cli import main as cli
from sysid.compare import comparison, peers

# In an order in which each finds what those before it wrote.
COMMANDS = ("", "read", "new", "show", "run", "compare", "refine", "report", "export", "list", "doctor")


@pytest.fixture(scope="module")
def helps():
    """The help of each command."""
    found = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", "80")
        for command in COMMANDS:
            with contextlib.redirect_stdout(io.StringIO()) as shown:
                assert cli.main([*command.split(), "--help"]) == 0
            found[command] = shown.getvalue()
    return found


def examples(text):
    lines = text.partition("\nexamples:\n")[2].replace("\\\n", "")
    return re.findall(r"^  (sysid .*)$", lines, re.MULTILINE)


def write_records(folder, sensors):
    """One storey of 1450 kg in g, three times, and the description that the help shows."""
    (folder / "sensors.toml").write_text(sensors)
    structure = sysid.Structure(np.diag([1450.0, 50.0]), 4e5 * np.array([[1.0, -1], [-1, 1]]), [0.02], n_base=1)
    for seed, name in enumerate(("sine", "run1", "run2")):
        rng = np.random.default_rng(seed)
        base = np.cumsum(rng.normal(size=(1, 2000)), axis=1) * np.hanning(2000)
        both = np.vstack([base, structure.simulate(base, 50.0)]) / 9.80665
        both += 1e-3 * both.std() * rng.normal(size=both.shape)
        rows = [f"{k / 50:.2f},{x:.9e},{y:.9e}" for k, (x, y) in enumerate(both.T)]
        (folder / f"{name}.csv").write_text("\n".join(["Time,CH1,CH2 [g]", *rows]) + "\n")
    for name, row in zip(("CH1", "CH2"), both, strict=True):
        (folder / f"{name}.csv").write_text("\n".join(["Time,a [g]", *(f"{k / 50},{x}" for k, x in enumerate(row))]))


def test_all_examples_run(helps, tmp_path, monkeypatch, capsys, no_pictures, from_one_start_in_module):
    monkeypatch.chdir(tmp_path)
    # These take longest, and have tests of their own.
    monkeypatch.setattr(peers, "missing_packages", lambda: ["cma"])
    monkeypatch.delitem(comparison.NAMED, "hpso-ls")
    write_records(tmp_path, helps["read"].partition("sensors.toml:\n")[2])
    for command in COMMANDS:
        found = examples(helps[command])
        assert found, command
        for example in found:
            words = shlex.split(example)[1:]
            assert words[0] == command or not command
            if words[-1].endswith(".op4"):
                pytest.importorskip("pyyeti", reason="needs the extra 'nastran'")
            if command == "refine" and "--workers" not in words:
                words += ["--workers", "1"]  # spares the start of processes
            for option in {"--starts", "--draws"}.intersection(words):
                words[words.index(option) + 1] = "2"  # as many as there must be
            assert cli.main(words) == 0, (example, capsys.readouterr())


def test_help_is_as_wide_as_a_terminal_and_names_json_and_quiet(helps):
    for command, text in helps.items():
        assert not command or ("--json" in text and "--quiet" in text), command
        own = text.partition("\n\n")[2].partition("\nexamples:\n")[0]
        assert max(map(len, own.splitlines())) <= 80, command
