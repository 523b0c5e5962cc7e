"""A benchmark's case in a process of its own, for its memory and its seconds."""

from __future__ import annotations

import json
import os
import subprocess
import sys

from benchmarks.problem_modules import ROOT


def figures_of(module: str, arguments: list[str], patience: float) -> dict:
    """Figures that ``python -m MODULE ARGUMENTS`` prints as JSON in its last line; what it said instead, as "said".

    Parameters
    ----------
    patience : float
        s, after which it is ended.
    """
    command = [sys.executable, "-m", module, *arguments]
    paths = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
    environment = {**os.environ, "PYTHONPATH": paths}
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, cwd=ROOT, env=environment, timeout=patience
        )
    except subprocess.TimeoutExpired:
        return {"said": f"not done after {patience:g} s"}
    if done.returncode:
        return {"said": (done.stderr.strip().splitlines() or ["no output"])[-1]}
    figures: dict = json.loads(done.stdout.strip().splitlines()[-1])
    return figures
