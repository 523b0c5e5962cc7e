"""The page on export: what it shows of Python runs as it stands, and gives what was identified."""

import re
from pathlib import Path

import numpy as np
import pytest

import sysid
from sysid.export.export import FORMATS

PAGE = Path(__file__).resolve().parents[2] / "docs" / "exporting.md"
pytestmark = pytest.mark.skipif(not PAGE.exists(), reason="no documents beside the tests")


def test_the_python_of_the_page_runs_and_reads_what_was_written(result, tmp_path, monkeypatch):
    for package in ("pyyeti", "pyuff", "control"):
        pytest.importorskip(package, reason="needs the extras 'nastran', 'uff' and 'control'")
    monkeypatch.chdir(tmp_path)
    for ending in FORMATS:
        sysid.export(result, f"model{ending}")
    names = {"result": result}
    for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL):
        exec(compile(block, str(PAGE), "exec"), names)
    s = result.structure
    assert np.array_equal(names["M"], s.mass) and np.array_equal(names["K"], s.stiffness)
    for found, right in (("acceleration", s.transmissibility), ("force", s.base_force)):
        right = right(names["freq"])[:, 0]
        assert np.abs(names[found] - right).max() < 1e-6 * np.abs(right).max()
    for lines in (names["about"], names["note"]):
        assert any(line.startswith("judgement: determined") for line in lines)
    np.testing.assert_allclose(names["hertz"], s.natural_frequencies, rtol=1e-5)
    np.testing.assert_allclose(names["x_of_first"], s.mode_shapes[:, 0], rtol=1e-5)
    np.testing.assert_array_equal(names["system"].A, names["named"].A)


def test_the_page_has_every_ending_and_its_precision():
    rows = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| `")]
    for ending, form in FORMATS.items():
        (row,) = [row for row in rows if f"`{ending}`" in row]
        assert row.split("|")[3].strip().startswith(form.precision.partition(":")[0]), ending
