"""Run benchmarks one after the other, or those that judge no seconds side by side."""

from __future__ import annotations

import contextlib
import io
import multiprocessing
import time
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from typing import NamedTuple

from benchmarks.line import HEADER, WIDTHS, Line, row, rule
from benchmarks.registry import Benchmark


def run(benchmarks: Sequence[Benchmark], reduced: bool, processes: int = 1) -> list[str]:
    """Run benchmarks, print their lines, and give those that are not met.

    With several processes those that judge no seconds run first, side by side, each printed when it has ended.
    """
    begun = time.perf_counter()
    beside = [b for b in benchmarks if processes > 1 and not b.alone(reduced)]
    ends = []
    context = _fresh_processes()
    with ThreadPoolExecutor(processes) as pool:
        for future in as_completed([pool.submit(_in_its_own_process, b, reduced, context) for b in beside]):
            text, end = future.result()
            print(text, end="", flush=True)
            ends.append(end)
    ends += [_measure(b, reduced) for b in benchmarks if b not in beside]
    unmet = [text for end in ends for text in end.unmet]
    count = sum(end.count for end in ends)
    print(f"\nlines: {count}; not met: {len(unmet)}; {time.perf_counter() - begun:.0f} s in all")
    for text in unmet:
        print(f"NOT MET  {text}")
    return unmet


def _fresh_processes() -> multiprocessing.context.BaseContext:
    """A process for each benchmark, as where it runs alone; what nearly all of them import is imported once."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["sysid", "scipy.optimize", "scipy.stats", "scipy.signal", "matplotlib.pyplot"])
    return context


def _in_its_own_process(
    benchmark: Benchmark, reduced: bool, context: multiprocessing.context.BaseContext
) -> tuple[str, End]:  # fmt: skip
    """What `_captured` gives, from a pool of one: pools that renew their processes can wait for ever (Python 3.11)."""
    with ProcessPoolExecutor(1, context) as pool:
        return pool.submit(_captured, benchmark, reduced).result()


class End(NamedTuple):
    """How many lines a benchmark has, and which are not met."""

    count: int
    unmet: list[str]


def _measure(benchmark: Benchmark, reduced: bool) -> End:
    """Run one benchmark and print its lines as they come."""
    print(f"\n== {benchmark.name}: {benchmark.what}\n{row(HEADER, WIDTHS)}\n{rule(WIDTHS)}", flush=True)
    begun, count, unmet = time.perf_counter(), 0, []
    for line in _lines(benchmark, reduced):
        print(line, flush=True)
        count += 1
        if line.met is False:
            unmet.append(f"{benchmark.name}: {line.text}: {line.figure}, bound {line.bound}")
    print(f"{benchmark.name}: {time.perf_counter() - begun:.1f} s", flush=True)
    return End(count, unmet)


def _captured(benchmark: Benchmark, reduced: bool) -> tuple[str, End]:
    """One benchmark in a process beside others: what it would print, and its end."""
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        end = _measure(benchmark, reduced)
    return printed.getvalue(), end


def _lines(benchmark: Benchmark, reduced: bool) -> Iterator[Line]:
    try:
        yield from benchmark.lines(reduced)
    except Exception as error:  # a crash is not met, and must not end the other benchmarks
        traceback.print_exc()
        yield Line("runs to its end", f"{type(error).__name__}: {error}", "no error", False)
