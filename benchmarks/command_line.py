"""`sysid run` as a user calls it: in a process of its own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


def sysid_run(arguments: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """Run ``sysid run ARGUMENTS --out out`` in `folder`; standard output and error are kept as text."""
    command = [sys.executable, "-m", "sysid", "run", *arguments, "--out", "out"]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
