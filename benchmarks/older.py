"""An older commit of this repository beside the package as it is: a process of each, asked in turn."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from benchmarks.problem_modules import ROOT

COMMIT = "47a2c0f"


class Worker:
    """A process that runs a script with the package in a folder, on one thread: a case in, an answer out."""

    def __init__(self, folder: Path, script: Path) -> None:
        environment = {**os.environ, "PYTHONPATH": str(folder), "OPENBLAS_NUM_THREADS": "1"}
        self.process = subprocess.Popen(
            [sys.executable, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment,
            cwd=folder,
        )  # fmt: skip

    def __call__(self, case: object) -> Any:
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
        return json.loads(said)

    def close(self) -> None:
        """End the process."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait()


def answer_cases(answer: Callable[..., object]) -> None:
    """Answer case after case, each a list of arguments on a line of JSON, on one thread: all that a script does."""
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1):
        for line in sys.stdin:
            print(json.dumps(answer(*json.loads(line))), flush=True)


@contextlib.contextmanager
def workers(script: Path) -> Iterator[list[Worker]]:
    """Processes of a script of a group, with the package as it is and with that commit's; none without its history."""
    with contextlib.ExitStack() as stack:
        older = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        if not _unpacked(older):
            yield []
            return
        for part in {".", "records", "modal", script.parent.name}:  # what poses a case is the same for both
            for name in (ROOT / "benchmarks" / part).glob("*.py"):
                target = older / "benchmarks" / part / name.name
                target.parent.mkdir(exist_ok=True)
                target.write_bytes(name.read_bytes())
        both = [Worker(folder, folder / script.relative_to(ROOT)) for folder in (ROOT, older)]
        for worker in both:
            stack.callback(worker.close)
        yield both


def _unpacked(folder: Path) -> bool:
    """True where the commit could be written to a folder."""
    archive = folder / "archive.tar"
    command = ["git", "archive", "--output", str(archive), COMMIT]
    try:
        subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):  # no git, or a copy without its history
        return False
    subprocess.run(["tar", "-xf", str(archive), "-C", str(folder)], check=True)
    return True
