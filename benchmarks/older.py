"""An older commit of this repository beside the package as it is: a process of each, timed in turn."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from benchmarks.problem_modules import ROOT

COMMIT = "47a2c0f"


class Worker:
    """A process that runs a script with the package in a folder, on one thread: a case in, a number out."""

    def __init__(self, folder: Path, script: Path) -> None:
        environment = {**os.environ, "PYTHONPATH": str(folder), "OPENBLAS_NUM_THREADS": "1"}
        self.process = subprocess.Popen(
            [sys.executable, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment,
            cwd=folder,
        )  # fmt: skip

    def __call__(self, case: object) -> float:
        """Answer of the process to a case.

        Raises
        ------
        EOFError
            Where the process has ended.
        """
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.write(json.dumps(case) + "\n")
        self.process.stdin.flush()
        said = self.process.stdout.readline()
        if not said:
            raise EOFError(f"{self.process.args} ended at {case}")
        return float(said)

    def close(self) -> None:
        """End the process."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait()


def unpacked(folder: Path) -> bool:
    """True where the commit could be written to a folder."""
    archive = folder / "archive.tar"
    command = ["git", "archive", "--output", str(archive), COMMIT]
    try:
        subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):  # no git, or a copy without its history
        return False
    subprocess.run(["tar", "-xf", str(archive), "-C", str(folder)], check=True)
    return True
