"""Processor time of identifications beside that of an older commit, in turn, and of the modal fit alone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.line import Line, below
from benchmarks.older import COMMIT, Worker, workers

Case = tuple[str, int, int, int, int]  # what, modes, base directions, lines, seed
# Bounds are of the ratio of processor times: seconds asked for over those of the older commit on one machine.
SPECTRA: dict[Case, tuple[float, float]] = {
    ("identify", 10, 3, 400, 3): (0.2, 0.27),
    ("identify", 20, 3, 500, 3): (0.45, 0.6),
    ("identify", 40, 3, 600, 3): (1.4, 2.8),
    ("identify", 40, 3, 1500, 3): (4.0, 9.6),
    ("identify", 100, 3, 600, 0): (5.0, 9.7),
    ("identify", 40, 1, 600, 0): (2.0, 9.0),
    ("fit", 50, 3, 1000, 0): (2.0, 1.0),
}
RECORDS: dict[Case, tuple[float, float]] = {("records", 10, 3, 300_000, 0): (8.0, 15.5)}
SHORT = 2  # cases of the reduced form
TIMES = 3  # in turn


def lines(reduced: bool) -> Iterator[Line]:
    """Medians of both and their ratio; the reduced form takes the two smallest tests."""
    cases = {**SPECTRA, **RECORDS}
    with workers(Path(__file__).with_name("one_estimate.py")) as both:
        if not both:
            yield Line(f"processor time over that of {COMMIT}", f"no git history with {COMMIT} here")
            return
        for worker in both:
            worker(next(iter(cases)))  # what is imported at the first call is not counted
        for case, (asked, before) in list(cases.items())[: SHORT if reduced else None]:
            yield _line(case, both, asked, before)


def _line(case: Case, both: list[Worker], asked: float, before: float) -> Line:
    """The ratio of the medians of one case."""
    what, n, d, count, _ = case
    taken = []
    for _ in range(1 if what == "records" else TIMES):
        try:
            taken.append([worker(case) for worker in both])
        except EOFError as error:
            return Line(f"{what}, n = {n}, d = {d}, {count} lines", str(error), f"<= {asked / before:.3g}", False)
    new, old = np.median(taken, axis=0)
    text = f"{what}, noise and force, n = {n}, d = {d}, {count} lines: processor s over those of {COMMIT}"
    return below(f"{text} ({new:.3g} over {old:.3g}; asked for: {asked:g} over {before:g})", float(new / old),
                 round(asked / before, 3))  # fmt: skip
