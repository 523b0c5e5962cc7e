"""Processor time of the swarm's objective beside that of a commit that had its mathematics in NumPy, by hand."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.line import Line, below
from benchmarks.problem_modules import ROOT

COMMIT = "47a2c0f"
CASES = tuple((n, count) for n in (6, 10, 20) for count in (200, 1000))  # degrees of freedom, lines
TIMES = 15  # both are timed, in turn
BOUND = 1.1
WORKER = Path(__file__).with_name("one_worker.py")


class Worker:
    """A process that times the objective of the package in a folder, on one thread."""

    def __init__(self, folder: Path) -> None:
        environment = {**os.environ, "PYTHONPATH": str(folder), "OPENBLAS_NUM_THREADS": "1"}
        command = [sys.executable, str(WORKER)]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment, cwd=folder
        )

    def __call__(self, case: tuple[int, int]) -> float:
        """Seconds to make the objective of a case, then microseconds a candidate."""
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.write(json.dumps(case) + "\n")
        self.process.stdin.flush()
        return float(self.process.stdout.readline())

    def close(self) -> None:
        """End the process."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait()


def lines() -> Iterator[Line]:
    """Medians of both, alternated, and their ratio."""
    what = f"with force, one thread: microseconds a candidate over those of {COMMIT}"
    with contextlib.ExitStack() as stack:
        older = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        if not _unpacked(older):
            yield Line(what, f"no git history with {COMMIT} here")
            return
        workers = [Worker(folder) for folder in (ROOT, older)]
        for worker in workers:
            stack.callback(worker.close)
        for case in CASES:
            made = [worker(case) for worker in workers]
            took = np.array([[worker(case) for worker in workers] for _ in range(TIMES)])
            new, old = np.median(took, axis=0)
            text = f"n = {case[0]}, d = 3, {case[1]} lines, {what} ({new:.1f} over {old:.1f}, {TIMES} times in turn)"
            yield below(text, float(new / old), BOUND)
            yield Line(f"n = {case[0]}, {case[1]} lines: processor seconds to make it ({COMMIT})",
                       f"{made[0]:.2g} ({made[1]:.2g})")  # fmt: skip


def _unpacked(folder: Path) -> bool:
    """Whether the commit could be written to a folder."""
    archive = folder / "archive.tar"
    command = ["git", "archive", "--output", str(archive), COMMIT]
    try:
        subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):  # no git, or a copy without its history
        return False
    subprocess.run(["tar", "-xf", str(archive), "-C", str(folder)], check=True)
    return True
