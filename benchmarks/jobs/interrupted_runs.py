"""Ctrl-C, once and twice, at random times of ``sysid run``: what is said, and what is on the disk."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

import sysid
from benchmarks.line import Line, above

INTERRUPTS = 50
BESIDE = 2
SETTINGS = ("elements=3", "force=False", "noise=0")
COMMAND = [
    "run",
    "cantilever_tower",
    "--strategy",
    "hpso-ls",
    *(word for one in SETTINGS for word in ("--set", one)),
    "--out",
]
FILES = {"result.h5", "summary.json", "report.html"}
LAST = 1.0  # s at the end of a run, in which a fifth of all interrupts strike
WROTE_ALL, BEST_SO_FAR, NOTHING = "all was written", "the best so far", "nothing"


def lines(reduced: bool) -> Iterator[Line]:
    """Of interrupts from the start of a run to its end: those after which all is as it was said."""
    rng = np.random.default_rng(12)
    count = 2 if reduced else INTERRUPTS
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(BESIDE) as pool:
        imported, ended = _whole(Path(folder) / "whole")
        times = rng.uniform(imported, ended, count)
        times[::5] = rng.uniform(ended - LAST, ended, len(times[::5]))
        tasks = [(Path(folder) / str(i), times[i], i % 2 + 1, rng.uniform(0.0, 0.5)) for i in range(count)]
        ends = list(pool.map(lambda task: _interrupted(*task), tasks))
    kinds = Counter(kind for kind, _ in ends)
    wrong = sorted({why for _, why in ends if why})
    found = ", ".join(f"{kind} {kinds[kind]}" for kind in (WROTE_ALL, BEST_SO_FAR, NOTHING))
    text = f"{count} Ctrl-C, every other one double, over the {ended - imported:.1f} s of a run: nothing lost ({found}"
    yield above(text + (f"; {'; '.join(wrong)})" if wrong else ")"), sum(not why for _, why in ends), count)


def _start(folder: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "sysid", *COMMAND, str(folder)], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip


def _whole(folder: Path) -> tuple[float, float]:
    """When a run has begun to work, and when it has ended, s."""
    begun = time.perf_counter()
    process = _start(folder)
    process.stdout.readline()
    imported = time.perf_counter() - begun
    process.communicate()
    return imported, time.perf_counter() - begun


def _interrupted(folder: Path, when: float, times: int, apart: float) -> tuple[str, str]:
    """Files on the disk after it, and what is wrong with them; an empty text where nothing is."""
    process = _start(folder)
    for wait in (when, apart)[:times]:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(wait)
        process.send_signal(signal.SIGINT)  # nothing happens where it has ended
    out, error = process.communicate(timeout=120)
    there = {path.name for path in folder.iterdir()} if folder.exists() else set()
    status = process.returncode
    if "Traceback" in error or "Traceback" in out:
        return NOTHING, f"a traceback: {' / '.join(error.split()[-40:])}"
    if status not in (0, 130):
        return NOTHING, f"status {status}: {error.strip()}"
    if "result.h5" not in there:
        swarm = "swarm  " in error
        return NOTHING, f"nothing was saved, but there was a candidate: {error}" if swarm or there or not status else ""
    result = sysid.load(folder)
    if status == 0 or not result.interrupted:
        missing = FILES - there if status == 0 else set()
        return WROTE_ALL, f"{missing} missing" if missing or "unfinished.h5" in there else ""
    return BEST_SO_FAR, "" if np.isfinite(result.residual) else "it has no residual"
