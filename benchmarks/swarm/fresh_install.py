"""The README's two commands in a new virtual environment: whether they work, and how long they take."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.line import Line, below
from benchmarks.problem_modules import ROOT


def lines(reduced: bool) -> Iterator[Line]:
    """The README's two commands, from a clean copy of the checkout."""
    if reduced:
        yield Line("fresh environment", "left out of the reduced form")
        return
    with tempfile.TemporaryDirectory() as folder:
        copy, venv = Path(folder) / "checkout", Path(folder) / "venv"
        subprocess.run(["git", "clone", "--quiet", str(ROOT), str(copy)], check=True)
        subprocess.run([sys.executable, "-m", "venv", str(venv)], check=True)
        scripts = venv / ("Scripts" if sys.platform == "win32" else "bin")
        python, command = scripts / "python", shutil.which("sysid", path=str(scripts)) or str(scripts / "sysid")
        subprocess.run([python, "-m", "pip", "install", "--quiet", "."], cwd=copy, check=True)
        begun = time.perf_counter()
        status = subprocess.run(
            [command, "run", "cantilever_tower"], cwd=copy, check=False, capture_output=True
        ).returncode
        yield below(
            f"fresh environment: sysid run cantilever_tower, s (status {status})", time.perf_counter() - begun, 120
        )
        subprocess.run([python, "-m", "pip", "install", "--quiet", ".[test]"], cwd=copy, check=True)
        begun = time.perf_counter()
        run = subprocess.run([python, "-m", "pytest", "-q"], cwd=copy, check=False, capture_output=True, text=True)
        last = (run.stdout.strip().splitlines() or ["no output"])[-1]
        yield below(f"fresh environment: pytest, s ({last})", time.perf_counter() - begun, 600)
        yield Line(
            "fresh environment: both end with status 0",
            f"{status}, {run.returncode}",
            "0, 0",
            status == run.returncode == 0,
        )
