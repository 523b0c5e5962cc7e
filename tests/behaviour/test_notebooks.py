"""Every notebook runs from a clean start, without an error or a warning, and draws pictures that show something.

Jupyter executes the one on records where there are none, in a kernel of its own; all run cell by cell in this process,
as a kernel does it, without the seconds that a new process spends on its imports; their searches begin at the guess
alone, neither other answers nor frequencies that change are looked for, and the poles of records are found once.
"""

import ast
import base64
import contextlib
import io
import json
import os
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from sysid.assessment.checks import rocking
from sysid.modal_analysis import modal_estimate

NOTEBOOKS = sorted((Path(__file__).resolve().parents[2] / "notebooks").glob("*.py"))
REAL = [path for path in NOTEBOOKS if "SYSID_DATA" in path.read_text(encoding="utf-8")]
TIMEOUT = 300  # s a cell, for machines that are busy; a whole notebook takes some ten seconds

MISSING = [name for name in ("jupytext", "nbclient", "ipykernel") if find_spec(name) is None]

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(bool(MISSING), reason=f"{', '.join(MISSING)} not installed: pip install '.[notebooks]'"),
]


@pytest.fixture
def in_a_kernel(tmp_path, monkeypatch):
    """Give a function that executes a notebook in a fresh kernel of this interpreter, in an empty folder.

    It returns the PNGs that the cells show, and what they wrote to stderr: warnings, first of all.
    """
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
        resources = {"metadata": {"path": str(folder)}}
        client = NotebookClient(jupytext.read(path), kernel_name=spec.name, timeout=TIMEOUT, resources=resources)
        outputs = [output for cell in client.execute().cells for output in cell.get("outputs", ())]
        pngs = [output.data["image/png"] for output in outputs if "image/png" in output.get("data", {})]
        complaints = [output.text for output in outputs if output.get("name") == "stderr"]
        return [base64.b64decode(png) for png in pngs], "".join(complaints)

    return execute


@pytest.fixture
def in_this_process(tmp_path, monkeypatch, from_one_start):
    """Give a function that does the same in this process; a warning is an error here."""
    import jupytext
    import matplotlib as mpl

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sysid.assessment.checks.model_error.changes", lambda problem: [])
    once = _once(modal_estimate.find_poles)
    for module in (modal_estimate, rocking):
        monkeypatch.setattr(module, "find_poles", once)
    before = mpl.get_backend()
    mpl.use("agg")

    def execute(path):
        from matplotlib import pyplot as plt

        monkeypatch.setattr(plt, "show", lambda: None)  # what is open is shown when its cell ends
        names, pngs = {"__name__": "__main__"}, []
        with contextlib.redirect_stderr(io.StringIO()) as complaints, mpl.rc_context(), from_one_start():
            for cell in jupytext.read(path).cells:
                if cell.cell_type == "code":
                    shown = _run_cell(cell.source, str(path), names)
                    pngs += [shown] if shown else []
                    pngs += [_png(plt.figure(number)) for number in plt.get_fignums()]
                    plt.close("all")
        return pngs, complaints.getvalue()

    yield execute
    mpl.use(before)


def _once(find_poles):
    """The same for all tests of the same spectra, whichever problem holds them."""
    known = {}

    def found(test, **_):
        if test.whole is not None:
            return find_poles(test)
        parts = test.freq, test.base, test.response, test.rigid_body, test.response_std
        key = tuple(None if part is None else np.asarray(part).tobytes() for part in parts)
        if key not in known:
            known[key] = find_poles(test)
        return known[key]

    return found


def _run_cell(source, file, names):
    """Run a cell, and write what its last expression gives; its PNG, where it has one."""
    *steps, last = ast.parse(source, file).body
    if not isinstance(last, ast.Expr):
        steps, last = [*steps, last], None
    exec(compile(ast.Module(steps, []), file, "exec"), names)
    if last is None or (value := eval(compile(ast.Expression(last.value), file, "eval"), names)) is None:
        return None
    repr(value)
    return value._repr_png_() if hasattr(value, "_repr_png_") else None


def _png(figure):
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=50)
    return file.getvalue()


def _show_something(pngs):
    from matplotlib.image import imread

    assert pngs
    for png in pngs:
        picture = imread(io.BytesIO(png), format="png")
        assert min(picture.shape[:2]) >= 50
        assert np.ptp(picture[..., :3]) > 0.5  # ink on paper


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_from_a_clean_start_and_draws(in_this_process, path):
    if path in REAL and not os.environ.get("SYSID_DATA"):
        pytest.skip("SYSID_DATA names no folder of records")
    pngs, complaints = in_this_process(path)
    assert not complaints
    _show_something(pngs)


@pytest.mark.parametrize("path", REAL, ids=lambda path: path.stem)
def test_a_notebook_on_records_that_are_not_there_says_so_and_ends(in_a_kernel, path, monkeypatch):
    monkeypatch.delenv("SYSID_DATA", raising=False)
    pngs, complaints = in_a_kernel(path)
    assert not complaints
    assert len(pngs) == 1
    _show_something(pngs)
