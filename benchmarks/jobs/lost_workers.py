"""A thousand jobs on workers that are killed, what a job costs beside its own time, and what two workers gain."""

from __future__ import annotations

import multiprocessing
import os
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

import sysid
from benchmarks.line import Line, above, below
from sysid import jobs

JOBS, WORKERS, EVERY = 1000, 4, 10.0  # s between two kills
LEAST, OVERHEAD = 0.5, 20.0  # s and ms a job
GAIN = 0.9  # of what bare NumPy gains
REPEATS = 5
BATCH = 16  # jobs of one measurement of the gain
MODULE = '''
"""A chain of storeys, each with a spring and a damper."""

import casadi as ca
import numpy as np

import sysid


def problem(*, data=None, rng=0, n=5):
    stretch = np.eye(n, n + 1) - np.eye(n, n + 1, -1)
    stretch[0, n] = -1.0
    size = np.random.default_rng(3).uniform(0.6, 1.6, (3, n))
    masses, springs, dampers = size * np.array([[1000.0], [1e6], [600.0]])
    k = sysid.Variable("spring", n, lower=1e5, upper=1e7, log=True)
    c = sysid.Variable("damper", n, lower=60.0, upper=6e3, log=True)
    M = np.diag(np.append(masses, 0.0))
    K, C = (stretch.T @ np.diag(part) @ stretch for part in (springs, dampers))
    truth = sysid.Structure(M, K, damping_matrix=C[:n, :n], n_base=1)
    f = truth.natural_frequencies
    test = sysid.simulate(truth, np.geomspace(0.4 * f[0], 1.5 * f[-1], 150), noise=0.01, rng=0)
    K, C = (stretch.T @ ca.diag(part) @ stretch for part in (k, c))
    return sysid.Problem(test, mass=M, stiffness=K, damping=C)
'''


def lines(reduced: bool) -> Iterator[Line]:
    """Results and bits under kills; time beside the jobs' own; gain of a second worker, alternated with bare NumPy."""
    with tempfile.TemporaryDirectory() as folder, threadpool_limits(limits=1):
        module = Path(folder) / "chain.py"
        module.write_text(MODULE)
        recipe = sysid.Recipe(str(module))
        yield from _survival(recipe, Path(folder) / "ledger", 8 if reduced else JOBS, EVERY)
        if not reduced:
            own, beside = _overhead(recipe, 40)
            yield above("seconds that a job takes in this process, median", own, LEAST)
            yield below("milliseconds a job on a worker, with its ledger, beside its own time", beside, OVERHEAD)
            yield from _gain(recipe)


def _survival(recipe: sysid.Recipe, ledger: Path, count: int, every: float) -> Iterator[Line]:
    expected = {result.index: bits(result) for result in jobs.submit(recipe, starts=count)}
    stop, killed = threading.Event(), list[int]()
    killer = threading.Thread(target=_kill_now_and_then, args=(stop, every, killed))
    killer.start()
    try:
        found = {
            result.index: bits(result)
            for result in jobs.submit(recipe, starts=count, executor=jobs.processes(WORKERS), out=ledger)
        }
    finally:
        stop.set()
        killer.join()
    alike = sum(found.get(index) == bits for index, bits in expected.items())
    text = f"{count} jobs on {WORKERS} workers, one killed every {every:g} s ({len(killed)} in all): the same bits"
    yield above(text, alike, count)


def bits(result: jobs.JobResult) -> tuple[object, ...]:
    """All of a result."""
    return result.seed, result.success, result.message, repr(result.residual), result.x.tobytes()


def _kill_now_and_then(stop: threading.Event, every: float, killed: list[int]) -> None:
    """Kill a random worker process of this one, again and again."""
    rng = np.random.default_rng(5)
    while not stop.wait(every):
        workers = [child.pid for child in multiprocessing.active_children() if child.pid]
        if workers:
            killed.append(int(rng.choice(workers)))
            os.kill(killed[-1], signal.SIGKILL)


def _overhead(recipe: sysid.Recipe, count: int) -> tuple[float, float]:
    """Median of a job's own time, s, and what one worker takes beside it for each, ms.

    Both are of the same jobs on the same worker: its speed on a shared machine is another one every minute.
    """
    with tempfile.TemporaryDirectory() as folder, jobs.processes(1)() as pool:
        list(jobs.submit(recipe, executor=pool))  # its worker has built the problem
        own, beside = list[float](), list[float]()
        for i in range(3):
            clock = Path(folder) / f"{i}.txt"
            run = lambda i=i, clock=clock: list(  # noqa: E731
                jobs.submit(recipe, starts=count, executor=_Clocked(pool, clock), out=f"{folder}/{i}")
            )
            taken = _timed(run)
            times = [float(line) for line in clock.read_text().split()]
            own += times
            beside.append(1e3 * (taken - sum(times)) / count)
    return float(np.median(own)), float(np.median(beside))


class _Clocked(Executor):
    """Another executor, whose calls write what they take by themselves to a file."""

    def __init__(self, pool: Executor, clock: Path) -> None:
        self.pool, self.clock = pool, clock

    def submit(self, call: Callable[..., object], /, *given: object, **options: object) -> Future[object]:
        return self.pool.submit(_clocked, self.clock, call, *given, **options)


def _clocked(clock: Path, call: Callable[..., object], *given: object, **options: object) -> object:
    begun = time.perf_counter()
    result = call(*given, **options)
    with clock.open("a") as file:
        file.write(f"{time.perf_counter() - begun}\n")
    return result


def _gain(recipe: sysid.Recipe) -> Iterator[Line]:
    ratios = np.zeros((REPEATS, 2))
    with jobs.processes(1)() as one, jobs.processes(2)() as two, bare_pool(1) as bare_one, bare_pool(2) as bare_two:
        ways: tuple[tuple[Callable[[Executor], object], Executor, Executor], ...] = (
            (lambda pool: list(jobs.submit(recipe, starts=BATCH, executor=pool)), one, two),
            (lambda pool: list(pool.map(_numbers, range(BATCH))), bare_one, bare_two),
        )
        for run, single, double in ways:  # what is made once is made
            run(single), run(double)
        for row in ratios:
            for i, (run, single, double) in enumerate(ways):
                row[i] = _timed(lambda run=run, pool=single: run(pool)) / _timed(lambda run=run, pool=double: run(pool))
    gain, bare = np.median(ratios, axis=0)
    yield Line("two workers over one: bare NumPy, median", f"{bare:.3g}")
    yield Line("two workers over one: jobs, median", f"{gain:.3g}")
    low, share, high = np.quantile(ratios[:, 0] / ratios[:, 1], [0.25, 0.5, 0.75])
    yield above(
        f"gain of jobs over that of bare NumPy, alternated (quartiles {low:.2f}-{high:.2f})", float(share), GAIN
    )


def bare_pool(workers: int) -> ProcessPoolExecutor:
    """Processes without anything of sysid's."""
    return ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"))


def _numbers(seed: int) -> float:
    """About half a second of NumPy on one thread."""
    with threadpool_limits(limits=1):
        matrix = np.random.default_rng(seed).normal(size=(60, 60))
        return float(sum(np.abs(np.linalg.eigvals(matrix + i)).max() for i in range(100)))


def _timed(run: Callable[[], object]) -> float:
    begun = time.perf_counter()
    run()
    return time.perf_counter() - begun
