"""Time of a run with its page, time and size of large pages, time of a summary and of the import of the package."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

import sysid
from benchmarks.line import Line, below
from benchmarks.machine import at_full_speed, fixed_work
from benchmarks.modal.random_structures import frequency_lines, random_structure

MOST_OF_A_RUN = 4.0  # s
MOST_BYTES = 5 * 2**20
MOST_SECONDS, MOST_OF_FORTY = 2.0, 2e6  # of a processor, and bytes, of the page of 40 sensors
AT_ONCE = 0.1  # s, of a summary
IMPORT = 0.25  # s beyond NumPy and CasADi
_IMPORTED = """
import time
import numpy, casadi
begun = time.process_time()
import sysid
print(time.process_time() - begun)
"""


def lines(reduced: bool) -> Iterator[Line]:
    """Seconds of a run, then processor seconds on one thread: the least of some, of imports the median.

    The reduced form leaves out the page of 40 sensors, and judges seconds at the speed of a machine that does nothing
    else: each at that of its own moment, as it changes by a third within seconds.
    """
    with tempfile.TemporaryDirectory() as name, threadpool_limits(limits=1):
        folder = Path(name)
        yield from _of_a_run(folder, reduced)
        page = sysid.write_report(answer(20, 1000, force=True), folder / "large")
        yield below("bytes of the page of 20 sensors, 3 directions, 1,000 lines", page.stat().st_size, MOST_BYTES)
        if not reduced:
            larger = answer(40, 600, force=True)
            taken = [_seconds(lambda: sysid.write_report(larger, folder / "larger.html")) for _ in range(8)]
            text = "page of 40 sensors, 3 directions and force, 600 lines: least of 8, processor s"
            yield below(text, min(taken), MOST_SECONDS)
            yield below("its bytes", (folder / "larger.html").stat().st_size, MOST_OF_FORTY)
        # one of many: without a force, whose matrices have 840 ends
        taken, beside = [], list[float]()
        found = answer(20, 500, force=False)
        for again in range(3):
            if again:  # one that has told nothing yet: the reduced form copies it
                found = replace(found) if reduced else answer(20, 500, force=False)
            taken.append(_seconds(found.summary))
            beside.append(fixed_work(1))
        text = "first summary of 20 sensors without a force, processor s: least"
        yield from _judged(text, min, taken, beside if reduced else [], AT_ONCE)
        yield from _of_imports(folder, reduced)


def _judged(
    text: str, of: Callable[[Sequence[float]], float], taken: list[float], beside: list[float], most: float
) -> Iterator[Line]:
    """The line of these seconds, and of those at full speed, by fixed work beside each, which then is judged."""
    if beside:
        yield Line(text, f"{of(taken):.3g}")
        full = [at_full_speed(one, other)[1] for one, other in zip(taken, beside, strict=True)]
        text, taken = f"the same {at_full_speed(0.0, statistics.median(beside))[0]}", full
    yield below(text, of(taken), most)


def _of_a_run(folder: Path, reduced: bool) -> Iterator[Line]:
    """Seconds of the first command, whose page has pictures."""
    command = [sys.executable, "-m", "sysid", "run", "cantilever_tower", "--quiet", "--out", str(folder / "tower")]
    seconds, beside = [], []
    for run in range(4):
        begun = time.perf_counter()
        subprocess.run(command, check=True, cwd=folder)
        seconds.append(time.perf_counter() - begun)
        beside.append(fixed_work(1))
        if reduced and run and seconds[-1] < MOST_OF_A_RUN:  # else other work may have had the processor
            break
    text = "sysid run cantilever_tower with its page, not the first time, s: least"
    yield from _judged(text, min, seconds[1:], beside[1:] if reduced else [], MOST_OF_A_RUN)


def _of_imports(folder: Path, reduced: bool) -> Iterator[Line]:
    """Processor seconds of the import of the package."""
    count = 9 if reduced else 15
    text = f"import of sysid beyond NumPy and CasADi, median of {count} processes with compiled files, processor s"
    taken, beside = _import_seconds(folder, count)
    yield from _judged(text, statistics.median, taken, beside if reduced else [], IMPORT)


def _import_seconds(folder: Path, count: int) -> tuple[list[float], list[float]]:
    """Of fresh processes, and of fixed work before and after each; as in an installation, compiled files are there."""
    environment = os.environ | {"PYTHONPYCACHEPREFIX": str(folder / "compiled")}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    taken, beside = list[float](), [fixed_work(1)]
    for _ in range(count + 1):
        command = [sys.executable, "-c", _IMPORTED]
        told = subprocess.run(command, check=True, capture_output=True, text=True, env=environment).stdout
        taken.append(float(told))
        beside.append(fixed_work(1))
    both = [(before + after) / 2 for before, after in pairwise(beside)]
    return taken[1:], both[1:]  # the first process writes the compiled files


def answer(n: int, count: int, *, force: bool) -> sysid.Identification:
    """Of a test with noise in three directions: so many sensors and modes, and so many lines."""
    truth = random_structure(7, n=n, d=3)
    test = sysid.simulate(truth, frequency_lines(truth, count), noise=0.01, force=force, rng=7)
    axes = ["xyz"[k] for k in np.argmax(np.abs(truth.rigid_body), axis=1)]
    sensors = [sysid.Sensor(f"sensor {k}", (0.1 * (k % 4), 0.1, float(k)), axis) for k, axis in enumerate(axes)]
    return sysid.identify(sysid.Problem(replace(test, sensors=sensors), mass=sysid.FullMass()), rng=0)


def _seconds(run: Callable[[], object]) -> float:
    begun = time.process_time()
    run()
    return time.process_time() - begun
