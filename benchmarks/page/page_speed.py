"""Time of the page of a large answer, of its summary and of the import of the package."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

import sysid
from benchmarks.line import Line, below
from benchmarks.machine import at_full_speed, fixed_work
from benchmarks.modal.random_structures import frequency_lines, random_structure

MOST_SECONDS, MOST_BYTES = 2.0, 2e6  # of the page
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
    """Processor seconds on one thread: the least of some of the page and the summary, the median of some imports.

    The reduced form, run beside other work, tells the seconds of the page without holding them to the bound, and judges
    those of the import at the speed of a machine that does nothing else.
    """
    with tempfile.TemporaryDirectory() as folder, threadpool_limits(limits=1):
        large = _answer(40, 600, force=True)
        page = sysid.write_report(large, Path(folder) / "large.html")  # what is imported at first is not counted
        rounds = 3 if reduced else 8
        taken = [_seconds(lambda: sysid.write_report(large, page)) for _ in range(rounds)]
        text = f"page of 40 sensors, 3 directions and force, 600 lines: least of {rounds}, processor s"
        yield Line(text, f"{min(taken):.3g}") if reduced else below(text, min(taken), MOST_SECONDS)
        yield below("its bytes", page.stat().st_size, MOST_BYTES)
        # one of many: without a force, whose matrices have 840 ends
        taken = [_seconds(_answer(20, 500, force=False).summary) for _ in range(1 if reduced else 3)]
        yield below("first summary of 20 sensors without a force, processor s", min(taken), AT_ONCE)
        count = 5 if reduced else 15
        text = f"import of sysid beyond NumPy and CasADi, median of {count} processes with compiled files, processor s"
        taken, beside = _import_seconds(Path(folder), count)
        seconds = statistics.median(taken)
        if reduced:
            yield Line(text, f"{seconds:.3g}")
            # The machine's speed changes by a third within seconds: each process is judged at that of its own moment.
            pairs = zip(taken, beside, strict=True)
            seconds = statistics.median(at_full_speed(one, other)[1] for one, other in pairs)
            text = f"the same {at_full_speed(seconds, statistics.median(beside))[0]}"
        yield below(text, seconds, IMPORT)


def _import_seconds(folder: Path, count: int) -> tuple[list[float], list[float]]:
    """Of fresh processes, and of fixed work beside each; as in an installation, Python's compiled files are there."""
    environment = os.environ | {"PYTHONPYCACHEPREFIX": str(folder / "compiled")}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    taken, beside = list[float](), list[float]()
    for _ in range(count + 1):
        command = [sys.executable, "-c", _IMPORTED]
        told = subprocess.run(command, check=True, capture_output=True, text=True, env=environment).stdout
        taken.append(float(told))
        beside.append(fixed_work(1))
    return taken[1:], beside[1:]  # the first process writes the compiled files


def _answer(n: int, count: int, *, force: bool) -> sysid.Identification:
    truth = random_structure(7, n=n, d=3)
    test = sysid.simulate(truth, frequency_lines(truth, count), noise=0.01, force=force, rng=7)
    axes = ["xyz"[k] for k in np.argmax(np.abs(truth.rigid_body), axis=1)]
    sensors = [sysid.Sensor(f"sensor {k}", (0.1 * (k % 4), 0.1, float(k)), axis) for k, axis in enumerate(axes)]
    return sysid.identify(sysid.Problem(replace(test, sensors=sensors), mass=sysid.FullMass()), rng=0)


def _seconds(run: Callable[[], object]) -> float:
    begun = time.process_time()
    run()
    return time.process_time() - begun
