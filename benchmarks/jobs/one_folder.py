"""Pairs of ``sysid run`` in one folder: one gives the result, the other is refused, whenever it begins."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import sysid
from benchmarks.line import Line, above

PAIRS, TOGETHER = 40, 0.05  # s between the two of a pair
COMMAND = [sys.executable, "-m", "sysid", "run", "shear_building", "--strategy", "continuation", "--quiet"]
FILES = {"result.h5", "summary.json", "report.html"}
REFUSED, ONE, BOTH = "is in use by another run", "the other refused", "the other after its end"


def lines(reduced: bool) -> Iterator[Line]:
    """Pairs begun together, at any offset up to the length of a run, and after a first one that was killed."""
    rng = np.random.default_rng(25)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        begun = time.perf_counter()
        _start(folder / "whole").communicate()
        seconds, answer = time.perf_counter() - begun, _answer(folder / "whole")
        for name, longest, pairs in (
            (f"begun within {1e3 * TOGETHER:.0f} ms", TOGETHER, 1 if reduced else PAIRS),
            (f"begun within the {seconds:.1f} s of a run", seconds, 1 if reduced else PAIRS // 2),
        ):
            ends = [_pair(folder / f"{name} {i}", rng.uniform(0, longest), answer) for i in range(pairs)]
            allowed = {ONE} if longest == TOGETHER else {ONE, BOTH}
            yield _line(f"{pairs} pairs of runs in one folder, {name}", ends, allowed)
        killed = 1 if reduced else PAIRS // 4
        ends = [_after_kill(folder / f"killed {i}", rng.uniform(0, seconds), answer) for i in range(killed)]
        yield _line(f"{killed} runs in the folder of one that was killed (-9)", ends, {ONE})


def _line(name: str, ends: list[str], allowed: set[str]) -> Line:
    found = ", ".join(f"{count} {end}" for end, count in Counter(ends).items())
    return above(f"{name}: one result each ({found})", sum(end in allowed for end in ends), len(ends))


def _start(folder: Path, *more: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*COMMAND, "--out", str(folder), *more], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def _pair(folder: Path, apart: float, answer: bytes) -> str:
    """Ends of two runs, in words."""
    first = _start(folder)
    time.sleep(apart)
    second = _start(folder)
    said = [process.communicate()[1].strip().splitlines() for process in (first, second)]
    status = [first.returncode, second.returncode]
    wrong = _wrong(folder, answer)
    refusals = [line for text in said for line in text if REFUSED in line]
    if not wrong and sorted(status) == [0, 2]:
        return ONE if len(refusals) == 1 == len(said[status.index(2)]) else f"said {said}"
    return BOTH if status == [0, 0] and not wrong else f"status {status}{wrong}: {said}"


def _after_kill(folder: Path, when: float, answer: bytes) -> str:
    """End of a run in the folder where one was killed, and of one begun beside it."""
    first = _start(folder)
    with contextlib.suppress(subprocess.TimeoutExpired):
        first.wait(when)
    first.kill()
    first.communicate()
    second = _start(folder, "--fresh")
    third = _start(folder, "--fresh")
    said = [process.communicate()[1].strip() for process in (second, third)]
    status = sorted([second.returncode, third.returncode])
    wrong = _wrong(folder, answer)
    return ONE if status == [0, 2] and REFUSED in "".join(said) and not wrong else f"status {status}{wrong}: {said}"


def _wrong(folder: Path, answer: bytes) -> str:
    """Fault in the files of a folder; an empty text where there is none."""
    there = {path.name for path in folder.iterdir()} if folder.exists() else set()
    if there != FILES:
        return f", files {sorted(there)}"
    return "" if _answer(folder) == answer else ", another answer"


def _answer(folder: Path) -> bytes:
    return sysid.load(folder).x.tobytes()
