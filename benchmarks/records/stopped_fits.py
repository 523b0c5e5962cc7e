"""Fits of whole records that are stopped at random times after a first fit settled: Ctrl-C and ``--max-time``.

``python -m benchmarks.records.stopped_fits ARGUMENTS`` is the command ``sysid ARGUMENTS``, which says on standard error
when a fit is kept.
"""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

import sysid
from benchmarks.line import Line, above, below
from benchmarks.mistakes import changing
from benchmarks.problem_modules import ROOT
from benchmarks.records import trial
from benchmarks.records.simulated import Setting, coupled_structure
from sysid.cli import main as cli
from sysid.modal_analysis.fit_monitor import FitMonitor, Fitted

STOPS, LATE = 20, 2.0  # s, by which a run ends after the signal or the time limit
DRIFT, PATIENCE = 0.03, 20.0  # of the first frequency over a record; s until there is an answer
BEGINS, KEPT = "the command begins", "a fit is kept"
FILES = {"result.h5", "summary.json", "report.html"}
MODULE = """
import sysid
from benchmarks.records import stopped_fits
def problem(*, data=None, rng=0, large=False):
    return sysid.Problem(stopped_fits.test(large), mass=sysid.FullMass())
"""


class Stopped(NamedTuple):
    """End of a run: what is wrong with it, empty where nothing is; processor seconds it took to end."""

    wrong: str
    late: float


def test(large: bool) -> sysid.Measurement:
    """Coupled structures whose records take some seconds, or, `large`, many times as long to fit."""
    n, d, seconds = (10, 3, 120.0) if large else (4, 1, 60.0)
    structure = coupled_structure(np.random.default_rng(1), n, d, np.geomspace(2.0, 40.0, n))
    setting, rng = Setting(structure, seconds, 200.0, (1.0, 60.0), (0.5, 90.0), np.eye(d)), np.random.default_rng(0)
    return trial.measurement([setting.with_noise(setting.run(rng).records(), rng)[0]], setting, force=True)


def lines(reduced: bool) -> Iterator[Line]:
    """Stops of one test of each size, half of them by Ctrl-C; and a structure that softens along its record."""
    rng = np.random.default_rng(26)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        (folder / "stopped.py").write_text(MODULE)
        ends = [_end(folder, number, reduced, rng) for number in range(2 if reduced else STOPS)]
    wrong = sorted({one.wrong for one in ends if one.wrong})
    text = f"{len(ends)} fits stopped after the first one settled: modes, status and files as they should be"
    yield above("; ".join([text, *wrong]), sum(not one.wrong for one in ends), len(ends))
    text = "processor seconds at most, from the signal to the saved result or from the limit to the end"
    yield below(text, max(one.late for one in ends), LATE)
    if not reduced:
        yield from _softened(rng)


def _end(folder: Path, number: int, reduced: bool, rng: np.random.Generator) -> Stopped:
    """One run, stopped by a signal or by its time limit.

    After a signal the result is to be there in time; the page is written then. With a limit all is to be over.
    """
    large = not reduced and number % 4 > 1
    kept, ended = _times(folder, large)
    run = _Run(folder, str(number), large, 0.0 if number % 2 == 0 else float(_limit(rng, kept, ended)))
    if run.limit:
        run.wait_until(lambda: BEGINS in run.said)  # all is imported, and the clock of the limit begins
        run.begun = time.perf_counter()
        run.wait_until(lambda: time.perf_counter() > run.begun + run.limit)
    else:
        run.wait_until(lambda: KEPT in run.said)
        time.sleep(rng.uniform(0.0, max(ended - kept, 0.0)))
    due = run.processor_seconds
    if not run.limit:
        os.kill(run.process.pid, signal.SIGINT)  # also of one that has ended, which stays to be asked for its seconds
        run.wait_until((run.out / "result.h5").exists)
        due, saved = 0.0, run.processor_seconds - due
    total = run.end()
    return Stopped(_wrong(run), max(total - due, 0.0) if run.limit else saved)


def _limit(rng: np.random.Generator, kept: float, ended: float) -> float:
    """A time limit by which a run has a fit, s."""
    return rng.uniform(1.6 * kept, max(ended, 1.8 * kept))


class _Run:
    """A run in a process of its own; `limit` in s, 0 for none."""

    def __init__(self, folder: Path, name: str, large: bool, limit: float = 0.0) -> None:
        self.out, self._log, self.limit = folder / name, folder / f"{name}.txt", limit
        paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
        command = ["run", "stopped.py", "--out", name, "--set", f"large={large}"]
        self._before = resource.getrusage(resource.RUSAGE_CHILDREN)
        self.begun = time.perf_counter()
        with self._log.open("w") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "benchmarks.records.stopped_fits", *command]
                + (["--max-time", f"{limit:.2f}"] if limit else []),
                cwd=folder, stdout=subprocess.DEVNULL, stderr=log, env={**os.environ, "PYTHONPATH": paths},
                preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
            )  # fmt: skip

    @property
    def said(self) -> str:
        """Standard error so far."""
        return self._log.read_text()

    @property
    def processor_seconds(self) -> float:
        """Seconds of a processor so far: others work on the machine too. Those of the clock where there is no /proc."""
        stat = Path(f"/proc/{self.process.pid}/stat")
        if not stat.exists():
            return time.perf_counter() - self.begun
        fields = stat.read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def wait_until(self, reached: Callable[[], bool]) -> None:
        """Wait until something is so, or the process has ended, which stays to be asked for its seconds."""
        while not reached() and os.waitid(os.P_PID, self.process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
            time.sleep(0.01)

    def end(self) -> float:
        """Wait for its end; seconds of a processor in all."""
        self.process.wait()
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime + after.ru_stime - self._before.ru_utime - self._before.ru_stime


def _wrong(run: _Run) -> str:
    """Fault of the end of a run; empty where there is none."""
    out, status = run.out, run.process.returncode
    if not (out / "result.h5").exists():
        return f"status {status}, and no result: {run.said.strip().splitlines()[-1]}" if KEPT in run.said else ""
    result = sysid.load(out)
    reached = int(result.judgement not in ("determined", "one of many"))
    there = {path.name for path in out.iterdir() if not path.name.startswith(".")}
    stopped = result.modal[0].stopped
    faults = {
        f"status {status}": status not in ((reached,) if run.limit else (130, reached)),
        f"files {sorted(there)}": not FILES - {"report.html"} <= there <= FILES,
        "no modes": not result.modal[0].omega.size,
        "not told": stopped != bool(result.of_kind("modes not all tried")),
        "determined though stopped": stopped and result.determined,
        "a traceback": "Traceback" in run.said,
    }
    return "; ".join(fault for fault, is_there in faults.items() if is_there)


def _times(folder: Path, large: bool) -> tuple[float, float]:
    """When a run keeps its first fit, and when it has fitted all, s; found once for each test."""
    known = folder / f"times of {large}"
    if not known.exists():
        run = _Run(folder, f"whole {large}", large)
        run.wait_until(lambda: KEPT in run.said)
        kept = time.perf_counter() - run.begun
        run.wait_until(lambda: "local phase" in run.said)
        known.write_text(f"{kept} {time.perf_counter() - run.begun}")
        run.process.kill()
        run.end()
    kept, ended = map(float, known.read_text().split())
    return kept, ended


def _softened(rng: np.random.Generator) -> Iterator[Line]:
    """A first mode that softens along a record of 100 s."""
    base = changing.motion(rng)
    floors = changing.response(base, lambda t: (1 - DRIFT * t / changing.SECONDS) ** 2)
    problem = sysid.Problem(changing.measured(changing.noisy(rng, base, floors)), mass=sysid.FullMass())
    begun = time.process_time()
    result = sysid.identify(problem, rng=0)
    text = f"softening by {DRIFT:.0%}: {result.judgement}, {result.modal[0].omega.size} modes of 2; seconds"
    yield below(text, time.process_time() - begun, PATIENCE)
    yield Line("it is doubtful, or no fit", result.judgement, "yes", result.judgement in ("doubtful", "no fit"))


def main() -> None:
    """Run the command, and say when a fit is kept."""
    keep = FitMonitor.keep

    def told(self: FitMonitor, fit: Fitted) -> None:
        keep(self, fit)
        sys.stderr.write(f"{KEPT}\n")
        sys.stderr.flush()

    FitMonitor.keep = told  # type: ignore[method-assign]
    sys.path.insert(0, str(Path.cwd()))
    sys.stderr.write(f"{BEGINS}\n")
    sys.stderr.flush()
    cli.command()


if __name__ == "__main__":
    main()
