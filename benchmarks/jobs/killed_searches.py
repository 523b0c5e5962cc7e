"""Searches that are killed at random times and resumed: whether they end in the bits of one that never was."""

from __future__ import annotations

import contextlib
import subprocess
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from benchmarks.jobs import searches
from benchmarks.line import Line, above

KILLS = 100
BESIDE = 2  # searches at a time; these threads only wait for processes


def lines(reduced: bool) -> Iterator[Line]:
    """Of kills spread over the whole search: the results with the right bits, all cases together."""
    rng = np.random.default_rng(11)
    kills = len(searches.CASES) if reduced else KILLS
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(BESIDE) as pool:
        ends = pool.map(lambda case: _whole(case, Path(folder) / case), searches.CASES)
        whole = dict(zip(searches.CASES, ends, strict=True))
        tasks = [(Path(folder) / str(i), searches.CASES[i % len(searches.CASES)], rng.random()) for i in range(kills)]
        killed = list(pool.map(lambda task: _killed(*task, *whole[task[1]]), tasks))
    told = ", ".join(f"{case} {seconds:.1f} s" for case, (seconds, _) in whole.items())
    text = f"{kills} kills (-9) at random times ({told}): resumed, the same bits"
    yield above(text, sum(same for _, same in killed), kills)
    yield Line("of these: killed before there was a state, begun anew", f"{sum(end[0] == 'anew' for end in killed)}")
    yield Line("of these: ended before the kill", f"{sum(end[0] == 'ended' for end in killed)}")


def _whole(case: str, folder: Path) -> tuple[float, dict[str, bytes]]:
    """Seconds that the search takes, and what it finds."""
    process = searches.start(case, folder)
    process.stdout.readline()
    begun = time.perf_counter()
    _end(process)
    return time.perf_counter() - begun, searches.bits(folder)


def _killed(folder: Path, case: str, share: float, seconds: float, expected: dict[str, bytes]) -> tuple[str, bool]:
    """Start of the second process in words, and whether it ended in the expected bits."""
    process = searches.start(case, folder)
    process.stdout.readline()
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(share * seconds)
    ended = process.poll() is not None
    process.kill()
    process.communicate()
    said = "ended" if ended else _end(searches.start(case, folder))
    return said, searches.bits(folder) == expected


def _end(process: subprocess.Popen[str]) -> str:
    out, error = process.communicate()
    if process.returncode:
        raise RuntimeError(error)
    return out.strip()
