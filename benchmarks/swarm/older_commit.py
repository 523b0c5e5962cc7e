"""Processor time of the swarm's objective beside that of a commit that had its mathematics in NumPy, by hand."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.line import Line, below
from benchmarks.older import COMMIT, workers

CASES = tuple((n, count) for n in (6, 10, 20) for count in (200, 1000))  # degrees of freedom, lines
TIMES = 15  # both are timed, in turn
BOUND = 1.1


def lines() -> Iterator[Line]:
    """Medians of both, alternated, and their ratio."""
    what = f"with force, one thread: microseconds a candidate over those of {COMMIT}"
    with workers(Path(__file__).with_name("one_worker.py")) as both:
        if not both:
            yield Line(what, f"no git history with {COMMIT} here")
            return
        for case in CASES:
            made = [worker(case) for worker in both]
            took = np.array([[worker(case) for worker in both] for _ in range(TIMES)])
            new, old = np.median(took, axis=0)
            text = f"n = {case[0]}, d = 3, {case[1]} lines, {what} ({new:.1f} over {old:.1f}, {TIMES} times in turn)"
            yield below(text, float(new / old), BOUND)
            yield Line(f"n = {case[0]}, {case[1]} lines: processor seconds to make it ({COMMIT})",
                       f"{made[0]:.2g} ({made[1]:.2g})")  # fmt: skip
