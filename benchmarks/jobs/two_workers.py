"""Gain of a second worker on few and short jobs: eight draws of noise of the tower."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

import sysid
from benchmarks.jobs.lost_workers import bare_pool, bits
from benchmarks.line import Line, above, below
from sysid import catalogue, jobs

DRAWS = 8
SHARE = 0.7  # of one worker's time


def lines(reduced: bool) -> Iterator[Line]:
    """Seconds of the same draws by one worker and by two, alternated, of each the least.

    Workers that have started hold the problem; those of a new pool are forked, and build it. The first pool comes with
    the process that its workers are forked from. Fixed work of NumPy alone runs in turn with the draws: what a second
    worker can gain on this machine at that time, which two free processors halve. The reduced form has three draws,
    and tells the share without holding it to the bound.
    """
    rounds, draws = (2, 3) if reduced else (12, DRAWS)
    recipe = sysid.Recipe("cantilever_tower")
    with threadpool_limits(limits=1):
        x = sysid.identify(catalogue.build(recipe), rng=0).x
        assert x is not None
        recipe = replace(recipe, start=tuple(x.tolist()))
        expected, _ = _drawn(recipe, None, draws)
        first = _drawn(recipe, jobs.processes(2), draws)[1]
        held = {1: jobs.processes(1), 2: jobs.processes(2)}
        ways: dict[str, Callable[[], Callable[[], Executor] | None]] = {
            "here": lambda: None, "one": lambda: held[1], "two": lambda: held[2], "new two": lambda: jobs.processes(2),
        }  # fmt: skip
        with bare_pool(1) as bare_one, bare_pool(2) as bare_two:
            ran = [
                {name: _drawn(recipe, way(), draws) for name, way in ways.items()}
                | {"bare one": _fixed(bare_one, draws), "bare two": _fixed(bare_two, draws)}
                for _ in range(rounds)
            ]
    alike = [one[name][0] == expected for one in ran for name in ways]
    yield above(f"{draws} draws of the tower by one worker and by two: runs with the same bits", sum(alike), len(alike))
    # the first round starts the workers that are held
    least = {name: float(np.min([one[name][1] for one in ran[1:]])) for name in ran[0]}
    told = "; ".join(f"{name} {seconds:.2f}" for name, seconds in least.items())
    share, bare = least["two"] / least["one"], least["bare two"] / least["bare one"]
    what = f"two workers over one, which hold the problem, least of {rounds - 1} each"
    what += f" (s: {told}; new two at first {first:.2f}; fixed work {bare:.2g})"
    yield Line(what, f"{share:.3g}") if reduced else below(what, share, SHARE)
    text = "two new workers, which build the problem, over this process alone"
    yield Line(text, f"{least['new two'] / least['here']:.3g}")


def _drawn(
    recipe: sysid.Recipe, executor: Callable[[], Executor] | None, draws: int
) -> tuple[list[tuple[object, ...]], float]:
    """All of the results of the draws, and their seconds."""
    begun = time.perf_counter()
    ends = sorted(jobs.submit(recipe, draws=draws, executor=executor), key=lambda end: end.index)
    return [bits(end) for end in ends], time.perf_counter() - begun


def _fixed(pool: Executor, pieces: int) -> tuple[list[tuple[object, ...]], float]:
    """Seconds of as many pieces of fixed work."""
    begun = time.perf_counter()
    list(pool.map(_piece, range(pieces)))
    return [], time.perf_counter() - begun


def _piece(seed: int) -> float:
    """About a tenth of a second of NumPy on one thread."""
    with threadpool_limits(limits=1):
        matrix = np.random.default_rng(seed).normal(size=(60, 60))
        return float(sum(np.abs(np.linalg.eigvals(matrix + i)).max() for i in range(120)))
