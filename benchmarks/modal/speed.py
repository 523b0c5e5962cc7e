"""Processor seconds that an identification of a noise-free test takes, `Problem` and `identify` together."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
from threadpoolctl import threadpool_limits

import sysid
from benchmarks.line import Line, below
from benchmarks.machine import at_full_speed, fixed_work
from benchmarks.modal.identification import identify_records
from benchmarks.modal.random_structures import frequency_lines, random_structure

SECONDS = {10: 0.3, 20: 2.0}  # bounds on the medians, by the number of modes


def lines(reduced: bool) -> Iterator[Line]:
    """Medians over random structures, by kinds of tests, on one thread: processor time, which waits for nobody else.

    Of each structure the least of some rounds counts: what others do on the machine still takes its caches. As slow
    spells of a shared machine last some ten seconds, the reduced form has more rounds while the bound is not met. A
    machine can be slow for hours: the reduced form judges seconds at full speed, as fixed work beside tells it.
    """
    count = 3 if reduced else 10
    directions: dict[str, int | None] = {"d = 3": 3} if reduced else {"d = 3": 3, "d = 1 to 3": None}
    kinds = [(label, d, force) for label, d in directions.items() for force in (False, True)]
    for n, bound in SECONDS.items():
        rounds, most = (2, 180 // n) if reduced else (3, 3)
        tests = {
            f"{label}, {'with' if force else 'no'} force": [_test(seed, n, d, force=force) for seed in range(count)]
            for label, d, force in kinds
        }
        with threadpool_limits(limits=1):
            _seconds(next(iter(tests.values()))[0])  # what is imported at the first call is not counted
            taken, beside = list[list[list[float]]](), list[float]()
            while len(taken) < rounds or (len(taken) < most and _seconds_at_most(taken, beside) > bound):
                taken.append([[_seconds(test) for test in group] for group in tests.values()])
                if reduced:
                    beside.append(fixed_work(3))
        medians = np.median(np.min(taken, axis=0), axis=1)
        shown = "; ".join(f"{kind} {value:.2f}" for kind, value in zip(tests, medians, strict=True))
        what = f"largest median over {count} structures, least of {len(taken)}, processor s"
        name = f"no noise, n = {n}, {60 * n} lines: {what} ({shown})"
        if not reduced:
            yield below(name, float(medians.max()), bound)
            continue
        yield Line(name, f"{medians.max():.3g}")
        text, seconds = at_full_speed(float(medians.max()), min(beside))
        yield below(f"n = {n}: the same {text}", seconds, bound)


def _seconds_at_most(taken: list[list[list[float]]], beside: list[float]) -> float:
    """The largest median so far, at full speed."""
    return at_full_speed(float(np.median(np.min(taken, axis=0), axis=1).max()), min(beside))[1]


def _seconds(test: sysid.Measurement) -> float:
    begun = time.process_time()
    try:
        identify_records(test)
    except Exception:
        return np.inf  # no answer is not a fast answer
    return time.process_time() - begun


def _test(seed: int, n: int, d: int | None, *, force: bool) -> sysid.Measurement:
    structure = random_structure(seed, n=n, d=d)
    return sysid.simulate(structure, frequency_lines(structure), force=force)
