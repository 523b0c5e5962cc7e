"""Every notebook runs from a clean kernel, without an error or a warning, and draws pictures that show something."""

import base64
import io
import json
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

NOTEBOOKS = sorted((Path(__file__).resolve().parents[2] / "notebooks").glob("*.py"))
REAL = [path for path in NOTEBOOKS if "SYSID_DATA" in path.read_text(encoding="utf-8")]
TIMEOUT = 300  # s a cell, for machines that are busy; a whole notebook takes some ten seconds

MISSING = [name for name in ("jupytext", "nbclient", "ipykernel") if find_spec(name) is None]

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(bool(MISSING), reason=f"{', '.join(MISSING)} not installed: pip install '.[notebooks]'"),
]


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Give a function that executes a notebook in a fresh kernel of this interpreter, in an empty folder."""
    import jupytext
    from nbclient import NotebookClient

    spec = tmp_path / "jupyter" / "kernels" / "under_test"
    spec.mkdir(parents=True)
    argv = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
    (spec / "kernel.json").write_text(json.dumps({"argv": argv, "display_name": "under test", "language": "python"}))
    monkeypatch.setenv("JUPYTER_PATH", str(tmp_path / "jupyter"))
    for name in ("JUPYTER_RUNTIME_DIR", "JUPYTER_CONFIG_DIR", "IPYTHONDIR"):
        monkeypatch.setenv(name, str(tmp_path / name.lower()))
    # The kernel chooses the backend that draws into the notebook, unless another one is asked for.
    monkeypatch.delenv("MPLBACKEND", raising=False)
    folder = tmp_path / "work"
    folder.mkdir()

    def execute(path):
        notebook = jupytext.read(path)
        resources = {"metadata": {"path": str(folder)}}
        return NotebookClient(notebook, kernel_name=spec.name, timeout=TIMEOUT, resources=resources).execute()

    return execute


def _outputs(notebook):
    return [output for cell in notebook.cells for output in cell.get("outputs", ())]


def _pictures(notebook):
    """PNGs of a notebook as arrays (height, width, channels)."""
    from matplotlib.image import imread

    coded = [output.data["image/png"] for output in _outputs(notebook) if "image/png" in output.get("data", {})]
    return [imread(io.BytesIO(base64.b64decode(text)), format="png") for text in coded]


def _complaints(notebook):
    """What cells wrote to stderr: warnings, first of all."""
    return [output.text for output in _outputs(notebook) if output.get("name") == "stderr"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_from_a_clean_kernel_and_draws(run, path):
    notebook = run(path)
    assert not _complaints(notebook)
    pictures = _pictures(notebook)
    assert pictures
    for picture in pictures:
        assert min(picture.shape[:2]) >= 50
        assert np.ptp(picture[..., :3]) > 0.5  # ink on paper


@pytest.mark.parametrize("path", REAL, ids=lambda path: path.stem)
def test_a_notebook_on_records_that_are_not_there_says_so_and_ends(run, path, monkeypatch):
    monkeypatch.delenv("SYSID_DATA", raising=False)
    notebook = run(path)
    assert not _complaints(notebook)
    assert len(_pictures(notebook)) == 1
